"""Pixel features against closed forms and GDAL, and under turning, mirroring and scaling."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray as xr
from scipy.interpolate import interpn
from worlds import terrain_of

from trustbo.errors import TrustboError
from trustbo.terrain import FEATURES, feature, gradient, pixel_size, rays
from trustbo.terrain.features import (
    canopy_cover,
    canopy_height,
    openness,
    pixel_feature,
    roughness,
    slope,
    step_height,
    tri,
    vegetation_density,
)

GDAL = Path(__file__).parent.parent / "data" / "gdal"
SHORT = [name for name in FEATURES if name != "openness"]
INSIDE = (slice(1, -1), slice(1, -1))


def pixel_features(terrain, names):
    return {name: FEATURES[name].compute(terrain) for name in names}


def tilted(a=0.3, b=-0.2, resolution=1.0, n=12):
    row, col = np.mgrid[:n, :n]
    return a * col * resolution + b * row * resolution


def rough_terrain(seed=0, n=24):
    rng = np.random.default_rng(seed)
    return terrain_of(rng.normal(size=(n, n)), rng.uniform(0.0, 6.0, (n, n)))


@pytest.mark.parametrize("resolution", [0.5, 1.0, 3.0])
def test_a_plane_has_its_own_slope_everywhere_inside(resolution):
    terrain = terrain_of(tilted(resolution=resolution), resolution=resolution)
    np.testing.assert_allclose(slope(terrain)[INSIDE], np.arctan(np.hypot(0.3, 0.2)), atol=1e-12)


@pytest.mark.parametrize("rise", [0.0, 0.1, 1.0, 10.0])
def test_slope_is_the_arctangent_of_the_rise(rise):
    inside = slope(terrain_of(tilted(rise, 0.0)))[INSIDE]
    np.testing.assert_allclose(inside, np.arctan(rise), atol=1e-12)


def test_a_plane_s_roughness_tri_and_step_have_closed_forms():
    terrain = terrain_of(tilted())
    np.testing.assert_allclose(roughness(terrain)[INSIDE], 2 * 0.5, rtol=1e-12)
    np.testing.assert_allclose(step_height(terrain)[INSIDE], 0.5, rtol=1e-12)
    squares = 6 * 0.3**2 + 6 * 0.2**2  # each of the 8 steps is +-0.3 i +- 0.2 j
    np.testing.assert_allclose(tri(terrain)[INSIDE], np.sqrt(squares), rtol=1e-12)


def read_heights(path):
    """Heights, NaN where missing, and the height and width of a pixel."""
    with rasterio.open(path) as source:
        return source.read(1, masked=True).astype(float).filled(np.nan), source.res


def assert_equal_to_gdal(compute, dem, res, gdal):
    """gdaldem sums heights in float32; this bounds the rounding of its slope, in degrees."""
    y, x = (step * np.arange(n) for step, n in zip(res, dem.shape, strict=True))
    ours = compute(xr.Dataset({"dem": (("y", "x"), dem)}, {"y": -y, "x": x}))
    atol = 1e-5
    if compute is slope:
        ours = np.rad2deg(ours)
        atol = np.rad2deg(2.0 * np.finfo(np.float32).eps * np.nanmax(np.abs(dem)) / min(res))
    np.testing.assert_allclose(ours, gdal, rtol=1e-5, atol=atol)


@pytest.mark.parametrize(
    ("name", "compute"), [("slope", slope), ("roughness", roughness), ("tri", tri)]
)
@pytest.mark.parametrize("raster", ["dem.tif", "wellington.tif"])
def test_all_pixels_are_equal_to_gdaldem_with_compute_edges(raster, name, compute):
    """Results of GDAL stored with the commands that made them (tests/data/gdal/README.md)."""
    dem, res = read_heights(GDAL / raster)
    gdal, _ = read_heights(
        GDAL / f"{raster.removesuffix('dem.tif').replace('.tif', '_')}{name}.tif"
    )
    assert_equal_to_gdal(compute, dem, res, gdal)


@pytest.mark.skipif(shutil.which("gdaldem") is None, reason="gdaldem is not installed")
@pytest.mark.parametrize("name", ["wellington", "tahoe", "bcts", "topography"])
def test_slopes_of_real_terrains_are_equal_to_gdaldem(name, real_terrain, tmp_path):
    res = (0.6, 0.5)
    for path in real_terrain(name):
        dem, _ = read_heights(path)
        profile = {"driver": "GTiff", "height": dem.shape[0], "width": dem.shape[1], "count": 1}
        at = rasterio.Affine(res[1], 0.0, 0.0, 0.0, -res[0], 0.0)
        profile |= {"dtype": "float32", "nodata": np.nan, "transform": at, "crs": "EPSG:32633"}
        with rasterio.open(tmp_path / "dem.tif", "w", **profile) as target:
            target.write(dem.astype(np.float32), 1)

        command = ["gdaldem", "slope", "dem.tif", "slope.tif", "-compute_edges", "-q"]
        subprocess.run(command, cwd=tmp_path, check=True)
        gdal, _ = read_heights(tmp_path / "slope.tif")
        assert_equal_to_gdal(slope, dem, res, gdal)


def test_float32_heights_give_what_float64_gives():
    terrain = terrain_of(500.0 + np.random.default_rng(0).normal(size=(20, 20)))
    single = terrain.astype(np.float32)
    double = single.astype(float)  # the same heights
    for compute in (slope, roughness, tri, step_height):
        assert compute(single).dtype == np.float32
        np.testing.assert_allclose(compute(single), compute(double), rtol=3e-6, atol=3e-6)


def test_features_of_tall_rasters_equal_those_of_their_parts():
    tall = rough_terrain(n=200)
    tall["dem"][[60, 64, 127], [3, 70, 20]] = np.nan  # beside the blocks that threads compute
    part = tall.isel(y=slice(50, 150), x=slice(None))
    for compute in (slope, roughness, tri, step_height):
        np.testing.assert_array_equal(compute(tall)[51:149], compute(part)[1:-1])


def test_canopy_height_and_cover():
    height = np.zeros((40, 40))
    height[:, 20:] = 8.0
    terrain = terrain_of(np.zeros((40, 40)), height)
    np.testing.assert_allclose(canopy_height(terrain), height)
    cover = canopy_cover(terrain)
    np.testing.assert_allclose(cover[:, :14], 0.0, atol=1e-12)
    np.testing.assert_allclose(cover[:, 26:], 1.0)
    np.testing.assert_allclose(cover[20, 20], 6 / 11)  # 6 of 11 columns are wooded


@pytest.mark.parametrize(
    ("height", "share"), [(0.0, 0.0), (2.0, 1.4 / 3), (6.0, 1.2 / 3), (12.0, 0.0)]
)
def test_vegetation_density_is_the_share_of_the_lowest_metres(height, share):
    """Crowns fill the upper 70 %: 6 m ones from 1.8 m on, 12 m ones from 3.6 m on."""
    density = vegetation_density(terrain_of(np.zeros((20, 20)), height))
    np.testing.assert_allclose(density, share, atol=1e-12)


def test_openness_of_flat_ground_and_of_uniform_shrubs():
    flat = terrain_of(np.zeros((60, 60)))
    np.testing.assert_allclose(openness(flat, reach=20.0), 1.0)
    shrubs = terrain_of(np.zeros((60, 60)), 2.0)
    # Rays at 1 m, inside the layer from 0.6 m to 2 m all the way; float32 inside.
    through = openness(shrubs, reach=20.0, eye=1.0, target=1.0)
    np.testing.assert_allclose(through, np.exp(-0.1 * 20.0), rtol=1e-6)


@pytest.mark.parametrize(("pixel", "reach"), [((1.0, 1.0), 9.0), ((1.5, 0.7), 6.3)])
def test_openness_is_the_mean_of_rays_from_the_middle_of_squares(pixel, reach):
    rng = np.random.default_rng(3)
    dem = rng.normal(size=(32, 36)).cumsum(0) * 0.3
    height = np.maximum(rng.normal(1.0, 2.0, dem.shape), 0.0)
    index = np.arange(32), np.arange(36)
    coords = {"y": -pixel[0] * index[0], "x": pixel[1] * index[1]}
    maps = {"dem": (("y", "x"), dem), "dsm": (("y", "x"), dem + height)}
    ours = openness(xr.Dataset(maps, coords), reach)
    for r, c in ((1.5, 1.5), (13.5, 17.5), (29.5, 33.5)):
        angle = 2.0 * np.pi * np.arange(16) / 16
        end = np.stack([r - reach * np.sin(angle) / pixel[0], c + reach * np.cos(angle) / pixel[1]])
        end = end[:, (end >= 0.0).all(0) & (end[0] <= 31.0) & (end[1] <= 35.0)].T
        z = interpn(index, dem, np.concatenate([[[r, c]], end])) + 1.0
        ends = np.column_stack([np.tile([r, c, z[0]], (len(end), 1)), end, z[1:]])
        expected = rays.transmittances(dem, dem + height, pixel, ends, 0.1, 0.3).mean()
        square = ours[int(r - 1.5) : int(r + 2.5), int(c - 1.5) : int(c + 2.5)]
        np.testing.assert_allclose(square, expected, atol=1e-12)


def test_features_keep_missing_pixels_missing():
    dem = tilted(n=30)
    dem[5, 6] = np.nan
    terrain = terrain_of(dem, 1.0)
    for name, values in pixel_features(terrain, SHORT).items():
        assert np.isnan(values[5, 6]), name
        assert np.isfinite(values[15, 15]), name
    assert np.isnan(openness(terrain, 5.0)[5, 6])


@pytest.mark.parametrize("turn", [np.rot90, np.fliplr, np.flipud])
def test_turning_the_terrain_turns_every_feature(turn):
    before = rough_terrain()
    after = terrain_of(turn(before["dem"].values), turn((before["dsm"] - before["dem"]).values))
    corner = np.zeros(before["dem"].shape, bool)
    corner[np.ix_([0, -1], [0, -1])] = True  # level only to the east and west, as in GDAL

    a, b = pixel_features(before, SHORT), pixel_features(after, SHORT)
    for name in SHORT:
        here, there = (np.where(corner, 0.0, values) for values in (b[name], turn(a[name])))
        np.testing.assert_allclose(here, there, rtol=1e-9, atol=1e-12, err_msg=name)

    a, b = openness(before, 6.0), openness(after, 6.0)
    np.testing.assert_allclose(b, turn(a), atol=1e-5)


def test_a_constant_height_changes_nothing():
    before = rough_terrain(1)
    after = terrain_of(before["dem"].values + 64.0, (before["dsm"] - before["dem"]).values)
    a, b = pixel_features(before, SHORT), pixel_features(after, SHORT)
    for name in SHORT:
        np.testing.assert_allclose(b[name], a[name], rtol=1e-9, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(openness(before, 6.0), openness(after, 6.0), atol=1e-6)


def test_heights_and_pixels_scaled_together_keep_slope():
    before = rough_terrain(2)
    after = terrain_of(3.0 * before["dem"].values, resolution=3.0)
    np.testing.assert_allclose(slope(after), slope(before), rtol=1e-12)
    np.testing.assert_allclose(tri(after), 3.0 * tri(before), rtol=1e-12)


def test_a_feature_of_one_s_own():
    @feature("northness", sign=1)
    def northness(terrain):
        east, north = gradient(terrain["dem"].values, pixel_size(terrain))
        return -north / np.hypot(east, north)

    try:
        falls_north = terrain_of(tilted(0.0, 0.3))
        values = pixel_features(falls_north, ["northness"])
        np.testing.assert_allclose(values["northness"][INSIDE], 1.0)
        with pytest.raises(TrustboError, match="northness"):
            feature("northness", sign=1)(np.hypot)
    finally:
        del FEATURES["northness"]
    with pytest.raises(TrustboError, match="sign"):
        feature("other", sign=0)
    with pytest.raises(TrustboError, match="name"):
        feature(None, sign=1)


def of_function(function, terrain):
    """Compute a feature that is registered only for this call."""
    feature("own", sign=1)(function)
    try:
        return pixel_feature("own", terrain)
    finally:
        del FEATURES["own"]


@pytest.mark.parametrize(
    "other_order",
    [
        lambda values: values.sortby("y"),
        lambda values: values.transpose("x", "y").sortby("x", ascending=False),
        lambda values: values.drop_vars(["y", "x"]).transpose("x", "y"),
        lambda values: values.values,
    ],
)
def test_features_are_aligned_with_the_terrain_by_their_labels(other_order):
    terrain = rough_terrain()
    found = of_function(lambda given: other_order(given["dem"]), terrain)
    np.testing.assert_array_equal(found, terrain["dem"].values)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda dem: dem.assign_coords(y=dem["y"] + 0.5),
        lambda dem: dem.assign_coords(x=[f"column {i}" for i in range(24)]),
        lambda dem: dem.isel(y=slice(3)),
        lambda dem: dem.rename(y="row", x="col"),
        lambda dem: dem.expand_dims("band"),
        lambda dem: dem.values[:3],
        lambda dem: 0.5,
        lambda dem: None,
        lambda dem: np.full(dem.shape, "high"),
    ],
)
def test_features_that_are_no_numbers_of_the_pixels_are_refused(wrong):
    with pytest.raises(TrustboError, match="'own'"):
        of_function(lambda terrain: wrong(terrain["dem"]), rough_terrain())


def test_a_definition_of_a_feature_may_run_again():
    def define(factor):
        @feature("stones", sign=-1)
        def stones(terrain):
            return factor * terrain["dem"].values

        return stones

    try:
        define(1.0)
        again = define(2.0)
        assert FEATURES["stones"].compute is again
    finally:
        del FEATURES["stones"]

    with pytest.raises(TrustboError, match="slope"):
        feature("slope", sign=-1)(lambda terrain: terrain["dem"].values)


def test_a_hole_in_the_surface_leaves_the_means_around_it():
    terrain = terrain_of(tilted(n=30), 1.0)
    surface = terrain["dsm"].values.copy()
    surface[5, 6] = np.nan
    holed = terrain.assign(dsm=terrain["dsm"].copy(data=surface))
    np.testing.assert_allclose(vegetation_density(holed), vegetation_density(terrain), rtol=1e-6)


def test_missing_pixels_count_neither_as_covered_nor_as_clear():
    rng = np.random.default_rng(0)
    dem = np.where(rng.random((25, 30)) < 0.3, np.nan, 0.0)
    height = rng.choice([0.0, 8.0], dem.shape)
    cover = canopy_cover(terrain_of(dem, height))

    padded = np.pad(np.where(np.isnan(dem), np.nan, height), 5, mode="edge")
    for row, col in np.argwhere(np.isfinite(dem)).tolist():
        square = padded[row : row + 11, col : col + 11]
        known = square[np.isfinite(square)]
        assert cover[row, col] == pytest.approx((known > 2.0).mean()), (row, col)
