"""From pixels to cells: in strips, with one's own features."""

from functools import partial

import numpy as np
import pytest
import xarray as xr

import trustbo as tb
from trustbo.errors import TerrainError, TrustboError
from trustbo.terrain import (
    TRAVERSABILITY,
    PixelFeature,
    pixel_features,
    read_terrain,
    strips,
    synthetic_terrain,
)
from trustbo.terrain.features import canopy_cover, slope
from trustbo.workspace import Workspace
from trustbo.workspace.awareness import cell_maps
from trustbo.workspace.grid import Grid


@pytest.fixture(scope="module")
def terrain():
    terrain = synthetic_terrain((130.0, 90.0), seed=2, relief=6.0)
    terrain["dem"][40:44, 20:30] = np.nan
    terrain["dsm"][40:44, 20:30] = np.nan
    return terrain


@pytest.fixture
def thin(monkeypatch):
    """Strips of a few rows, and a sample that is not the whole raster."""
    monkeypatch.setattr("trustbo.terrain.strips._PIXELS", 90 * 7)
    monkeypatch.setattr("trustbo.terrain.pixel_awareness.MAX_PIXELS", 130 * 90 - 1)


def test_strips_give_what_the_whole_raster_gives(terrain, monkeypatch):
    features = {
        "traversability": ("slope", "tri", "curvature", "tpi", "roughness", "step_height"),
        "visibility": ("canopy_height", "canopy_cover", "vegetation_density", "openness"),
    }
    whole = Workspace.from_terrain(terrain, (4, 3), features=features)
    # The sample stays whole, so that both fit the same composites.
    monkeypatch.setattr("trustbo.terrain.strips._PIXELS", 90 * 7)
    thin = Workspace.from_terrain(terrain, (4, 3), features=features)
    assert len(list(strips.strips(terrain, 12))) > 4
    for name in features:
        np.testing.assert_allclose(thin.pixels[name], whole.pixels[name], rtol=0, atol=1e-6)
    np.testing.assert_allclose(thin.awareness, whole.awareness, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(thin.pixels["passable"], whole.pixels["passable"])


def test_a_sample_of_rows_fits_nearly_what_all_pixels_fit(terrain, monkeypatch):
    whole = Workspace.from_terrain(terrain, (4, 3))
    monkeypatch.setattr("trustbo.terrain.strips._PIXELS", 90 * 7)
    monkeypatch.setattr("trustbo.terrain.pixel_awareness.MAX_PIXELS", 130 * 90 - 1)
    monkeypatch.setattr("trustbo.terrain.pixel_awareness.SAMPLE", 130 * 90 // 4)
    sampled = Workspace.from_terrain(terrain, (4, 3))
    # A quarter of 11 700 correlated pixels: percentiles are off by a few hundredths.
    np.testing.assert_allclose(sampled.awareness, whole.awareness, atol=0.05)
    for name, index in whole.composites.items():
        np.testing.assert_allclose(sampled.composites[name].loadings_, index.loadings_, atol=0.05)


def test_a_lazily_read_terrain_gives_what_one_in_memory_gives(terrain, tmp_path, monkeypatch):
    for name in ("dem", "dsm"):
        terrain[name].astype("float32").rio.to_raster(tmp_path / f"{name}.tif")
    files = tmp_path / "dem.tif", tmp_path / "dsm.tif"
    eager = Workspace.from_terrain(read_terrain(*files), (4, 3), bounds=False)
    monkeypatch.setattr("trustbo.terrain.strips._PIXELS", 90 * 7)
    lazy_terrain = read_terrain(*files, lazy=True)
    with pytest.raises(TerrainError, match=r"average it to pixels of 2 m, .* bounds=False"):
        Workspace.from_terrain(lazy_terrain, (4, 3))
    lazy = Workspace.from_terrain(lazy_terrain, (4, 3), bounds=False)
    lazy_terrain.close()
    assert lazy.pixels is None
    np.testing.assert_allclose(lazy.awareness, eager.awareness, atol=1e-5)
    np.testing.assert_array_equal(lazy.passable, eager.passable)


def test_features_of_one_s_own_and_one_used_as_it_is(terrain):
    gentle = PixelFeature(lambda t: np.cos(slope(t)), +1)
    workspace = Workspace.from_terrain(
        terrain,
        (4, 3),
        features={
            "traversability": {"gentle": gentle, "slope": PixelFeature(slope, -1)},
            "cover": PixelFeature(partial(canopy_cover, radius=3.0), -1, 3.0),
        },
    )
    assert list(workspace.awareness["feature"].values) == [
        "traversability",
        "cover",
        "line_of_sight",
    ]
    assert set(workspace.composites) == {"traversability"}
    mean = workspace.grid.cell_means(canopy_cover(terrain, radius=3.0))
    np.testing.assert_allclose(
        workspace.awareness.sel(robot="r1", feature="cover"), mean, atol=1e-6
    )


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ({"z": ("slope", "steep")}, "unknown feature 'steep'; choose one of slope"),
        ({"z": ()}, r"feature 'z' must be names of pixel features, e.g. \['slope', 'tri'\]"),
        ({"z": 3}, "feature 'z' must be names of pixel features"),
        ({"z": PixelFeature(lambda t: t["dem"], 1)}, r"must lie in \[0, 1\]; it has .* Scale it"),
    ],
)  # fmt: skip
def test_features_that_are_none_are_refused(terrain, features, message):
    with pytest.raises(TrustboError, match=message):
        Workspace.from_terrain(terrain, (4, 3), features=features)


def test_clipping_is_reported_for_lazy_terrains_too(tmp_path):
    terrain = synthetic_terrain((60.0, 60.0), seed=1)
    terrain["dem"].rio.to_raster(tmp_path / "dem.tif")
    (terrain["dem"] - 1.0).rio.write_crs(terrain.rio.crs).rio.to_raster(tmp_path / "dsm.tif")
    lazy = read_terrain(tmp_path / "dem.tif", tmp_path / "dsm.tif", lazy=True)
    with pytest.warns(UserWarning, match="DSM lies below the DEM on 100.0% of pixels"):
        Workspace.from_terrain(lazy, (2, 2), features={"z": ["slope", "tri"]}, bounds=False)
    lazy.close()


def test_cells_in_degrees(terrain):
    grid = Workspace.from_terrain(terrain, (4, 3)).grid
    assert grid.cell_at_lonlat(*grid.lonlat((2, 1))) == (2, 1)
    lon, lat = grid.lonlat((0, 0))
    assert -180.0 <= lon <= 180.0
    assert -90.0 <= lat <= 90.0
    bare = Workspace.from_awareness(np.full((1, 2, 2, 1), 0.5)).grid
    with pytest.raises(TrustboError, match="this grid has no coordinate reference system"):
        bare.lonlat((0, 0))


def test_pixel_maps_are_those_of_the_terrain(terrain):
    workspace = Workspace.from_terrain(terrain, (4, 3))
    assert isinstance(workspace.pixels, xr.Dataset)
    assert set(workspace.pixels) == {"traversability", "visibility", "passable"}
    xr.testing.assert_equal(workspace.pixels["y"], terrain["y"])
    assert workspace.pixels["visibility"].isnull().sum() == 40


def test_with_the_same_composites_a_larger_raster_s_way_gives_the_same(terrain, thin):
    """Feature by feature in one place, the slope of `passable` used again: pixel by pixel equal."""
    features = {"traversability": TRAVERSABILITY, "cover": ["canopy_cover", "tri"]}
    robot = tb.Robot(max_slope=0.3)
    grid = Grid.over(terrain, (4, 3))
    strip_by_strip = cell_maps(terrain, grid, features, tb.Team(robots=(robot,), lead=robot))
    composites = strip_by_strip.composites
    for name, parts in features.items():
        whole = composites[name].transform(pixel_features(terrain, parts))
        np.testing.assert_allclose(strip_by_strip.pixels[name], whole, rtol=0, atol=1e-9)
    steep = slope(terrain).values <= 0.3
    np.testing.assert_array_equal(strip_by_strip.pixels["passable"], steep)
