"""Reading rasters: aligned, metric, and refused where they cannot serve."""

import tracemalloc

import numpy as np
import pytest
import rasterio
import rasterio.warp
import xarray as xr
from rasterio.transform import from_origin

from trustbo.errors import TerrainError, TrustboError
from trustbo.terrain import align, read_terrain, synthetic_terrain
from trustbo.terrain.dataset import clean, pixel_size

UTM = "EPSG:32633"


def write_raster(path, values, *, crs=UTM, transform=None, nodata=None):
    transform = from_origin(500_000.0, 5_000_000.0, 1.0, 1.0) if transform is None else transform
    height, width = values.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=height,
        width=width,
        count=1,
        dtype=values.dtype,
        crs=crs,
        transform=transform,
        nodata=nodata,
    ) as sink:
        sink.write(values, 1)
    return path


def plane(rows=20, cols=30):
    row, col = np.mgrid[:rows, :cols]
    return (100.0 + 0.1 * col - 0.2 * row).astype("float32")


def test_a_pair_comes_out_aligned_north_up_and_in_metres(tmp_path):
    dem = write_raster(tmp_path / "dem.tif", plane())
    dsm = write_raster(tmp_path / "dsm.tif", plane() + 3.0)
    terrain = read_terrain(dem, dsm)
    assert terrain["dem"].dims == ("y", "x")
    assert terrain["y"][0] > terrain["y"][-1]
    assert terrain.rio.crs.to_epsg() == 32633
    assert pixel_size(terrain) == (1.0, 1.0)
    np.testing.assert_allclose(terrain["dem"], plane())
    np.testing.assert_allclose(terrain["dsm"] - terrain["dem"], 3.0)


def test_a_coarser_shifted_dsm_is_brought_onto_the_dem_s_grid(tmp_path):
    dem = write_raster(tmp_path / "dem.tif", plane(40, 40))
    transform = from_origin(500_000.0 - 4.0, 5_000_000.0 + 6.0, 2.0, 2.0)
    row, col = np.mgrid[:30, :30]
    # The same plane, 5 m higher, sampled at the coarse pixels' centres.
    x, y = -4.0 + 2.0 * col + 0.5, -6.0 + 2.0 * row + 0.5
    values = (105.0 + 0.1 * x - 0.2 * y).astype("float32")
    dsm = write_raster(tmp_path / "dsm.tif", values, transform=transform)
    terrain = read_terrain(dem, dsm)
    assert terrain["dem"].shape == (40, 40)
    inner = (terrain["dsm"] - terrain["dem"]).isel(x=slice(4, -4), y=slice(4, -4))
    # Bilinear resampling reproduces a plane, up to float32.
    np.testing.assert_allclose(inner, 5.0, atol=1e-3)


def test_degrees_are_reprojected_to_the_local_utm_zone(tmp_path):
    transform = from_origin(15.0, 45.0, 1e-5, 1e-5)
    dem = write_raster(tmp_path / "dem.tif", plane(60, 60), crs="EPSG:4326", transform=transform)
    dsm = write_raster(
        tmp_path / "dsm.tif", plane(60, 60) + 2.0, crs="EPSG:4326", transform=transform
    )
    terrain = read_terrain(dem, dsm)
    assert terrain.rio.crs.to_epsg() == 32633
    height, width = pixel_size(terrain)
    # 1e-5 degree is 1.11 m of latitude and 0.79 m of longitude at 45 degrees north.
    assert 0.7 < width < 1.2
    assert height == pytest.approx(width)
    extent = terrain["x"].max() - terrain["x"].min()
    assert float(extent) == pytest.approx(60e-5 * 111_320 * np.cos(np.pi / 4), rel=0.05)


def test_nodata_of_either_raster_stays_missing(tmp_path):
    ground = plane()
    ground[2, 3] = -9999.0
    surface = plane() + 1.0
    surface[5, 6] = -1.0
    dem = write_raster(tmp_path / "dem.tif", ground, nodata=-9999.0)
    dsm = write_raster(tmp_path / "dsm.tif", surface, nodata=-1.0)
    terrain = read_terrain(dem, dsm)
    missing = np.argwhere(np.isnan(terrain["dem"].values))
    assert missing.tolist() == [[2, 3], [5, 6]]
    assert (np.isnan(terrain["dsm"]) == np.isnan(terrain["dem"])).all()


def test_integer_rasters_are_read(tmp_path):
    dem = write_raster(tmp_path / "dem.tif", plane().astype("int16"), nodata=-32768)
    terrain = read_terrain(dem, dem)
    assert terrain["dem"].dtype == float


def test_a_surface_below_the_ground_is_raised_and_counted(tmp_path):
    surface = plane() + 1.0
    surface[:, :3] -= 2.0
    dem = write_raster(tmp_path / "dem.tif", plane())
    dsm = write_raster(tmp_path / "dsm.tif", surface)
    with pytest.warns(UserWarning, match=r"below the DEM on 10\.0% of pixels"):
        terrain = read_terrain(dem, dsm)
    assert float((terrain["dsm"] - terrain["dem"]).min()) == 0.0
    assert terrain.attrs["clipped_share"] == pytest.approx(0.1)


def test_south_up_rasters_are_turned_round(tmp_path):
    flipped = rasterio.Affine(1.0, 0.0, 500_000.0, 0.0, 1.0, 5_000_000.0 - 20.0)
    dem = write_raster(tmp_path / "dem.tif", plane()[::-1].copy(), transform=flipped)
    terrain = read_terrain(dem, dem)
    np.testing.assert_allclose(terrain["dem"], plane())


def test_rasters_without_georeference_need_crs_and_resolution(tmp_path):
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        dem = write_raster(
            tmp_path / "dem.tif", plane(), crs=None, transform=rasterio.Affine.identity()
        )
    with pytest.raises(TerrainError, match="carries no georeference; pass both crs="):
        read_terrain(dem, dem)
    terrain = read_terrain(dem, dem, crs=UTM, resolution=2.0)
    assert pixel_size(terrain) == (2.0, 2.0)
    np.testing.assert_allclose(terrain["dem"], plane())


def test_a_raster_without_crs_is_refused_unless_it_is_given(tmp_path):
    dem = write_raster(tmp_path / "dem.tif", plane(), crs=None)
    with pytest.raises(TerrainError, match="has no coordinate reference system; pass crs="):
        read_terrain(dem, dem)
    assert read_terrain(dem, dem, crs=UTM).rio.crs.to_epsg() == 32633
    with pytest.raises(TerrainError, match="crs 'nonsense' is not one PROJ knows"):
        read_terrain(dem, dem, crs="nonsense")


def test_files_that_are_absent_or_no_raster_are_named(tmp_path):
    text = tmp_path / "notes.txt"
    text.write_text("no raster")
    dem = write_raster(tmp_path / "dem.tif", plane())
    with pytest.raises(TerrainError, match=r"dsm: '.*notes.txt' is no raster that GDAL can read"):
        read_terrain(dem, text)
    with pytest.raises(TerrainError, match=r"dem: there is no file '.*absent.tif'"):
        read_terrain(tmp_path / "absent.tif", dem)


def test_rasters_of_two_places_are_refused(tmp_path):
    dem = write_raster(tmp_path / "dem.tif", plane())
    far = from_origin(600_000.0, 5_000_000.0, 1.0, 1.0)
    dsm = write_raster(tmp_path / "dsm.tif", plane(), transform=far)
    with pytest.raises(TerrainError, match=r"do not overlap: in EPSG:32633 they cover \(500000.0"):
        read_terrain(dem, dsm)


def test_rasters_of_nothing_but_nodata_are_refused(tmp_path):
    dem = write_raster(tmp_path / "dem.tif", plane())
    empty = write_raster(tmp_path / "dsm.tif", np.full((20, 30), -9999.0), nodata=-9999.0)
    with pytest.raises(TerrainError, match=r"dsm: '.*dsm.tif' is all nodata"):
        read_terrain(dem, empty)


def test_rotated_grids_and_feet_are_refused(tmp_path):
    rotated = from_origin(500_000.0, 5_000_000.0, 1.0, 1.0) * rasterio.Affine.rotation(10)
    dem = write_raster(tmp_path / "rotated.tif", plane(), transform=rotated)
    with pytest.raises(TerrainError, match="rotated grid; warp it to north-up first"):
        read_terrain(dem, dem)
    feet = write_raster(tmp_path / "feet.tif", plane(), crs="EPSG:2225")
    with pytest.raises(TerrainError, match="is in US survey foot, but heights and distances must"):
        read_terrain(feet, feet)
    site = 'ENGCRS["site",EDATUM["corner"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],'
    local = write_raster(tmp_path / "site.tif", plane(), crs=site + 'LENGTHUNIT["metre",1]]')
    with pytest.raises(TerrainError, match="is in a CRS that is no map of the Earth; give it a"):
        read_terrain(local, local)


def test_a_raster_may_lie_across_the_antimeridian(tmp_path):
    east, west = (
        write_raster(
            tmp_path / f"{left}.tif",
            plane(60, 60),
            crs="EPSG:4326",
            transform=from_origin(left, -16.0, 1e-5, 1e-5),
        )
        for left in (179.9997, -180.0003)
    )
    terrain = read_terrain(east, west)
    assert float(terrain["dem"].notnull().mean()) > 0.95
    np.testing.assert_allclose(terrain["dem"], terrain["dsm"], atol=1e-6)


@pytest.mark.parametrize("shift", [1e-8, 3e-7, 1e-4])
def test_grids_that_differ_by_rounding_are_one_grid(tmp_path, shift):
    dem = write_raster(tmp_path / "dem.tif", plane())
    moved = from_origin(500_000.0 + shift, 5_000_000.0, 1.0, 1.0 + 1e-9)
    dsm = write_raster(tmp_path / "dsm.tif", plane() + 1.0, transform=moved)
    terrain = read_terrain(dem, dsm)
    assert terrain["dem"].notnull().all()
    np.testing.assert_allclose(terrain["dsm"] - terrain["dem"], 1.0)


def test_metres_labelled_as_degrees_are_recognised(tmp_path):
    dem = write_raster(tmp_path / "dem.tif", plane(), crs="EPSG:4326")
    with pytest.raises(TerrainError, match="are no place on Earth in it; give the CRS its"):
        read_terrain(dem, dem)
    metres = write_raster(tmp_path / "metres.tif", plane())
    with pytest.raises(TerrainError, match=r"dsm: '.*dem.tif' has CRS EPSG:4326, but its bounds"):
        read_terrain(metres, dem)
    far = write_raster(tmp_path / "far.tif", plane(), transform=from_origin(5e9, 5e9, 1.0, 1.0))
    with pytest.raises(TerrainError, match=r"dem: '.*far.tif' has CRS EPSG:32633, but its bounds"):
        read_terrain(far, metres)


def test_a_bare_image_needs_metres_per_pixel(tmp_path):
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        dem = write_raster(
            tmp_path / "dem.tif", plane(), crs=None, transform=rasterio.Affine.identity()
        )
    with pytest.raises(TerrainError, match="is in degrees, but resolution= is in metres"):
        read_terrain(dem, dem, crs="EPSG:4326", resolution=1.0)
    for resolution in (-1.0, 0.0, np.nan, "1"):
        with pytest.raises(TrustboError, match="resolution must be positive and finite"):
            read_terrain(dem, dem, crs=UTM, resolution=resolution)


def test_web_mercator_s_stretched_metres_are_not_taken_for_metres(tmp_path):
    x, y = rasterio.warp.transform("EPSG:4326", "EPSG:3857", [15.0], [47.0])
    stretched = from_origin(x[0], y[0], 1.0, 1.0)
    dem = write_raster(tmp_path / "dem.tif", plane(60, 60), crs="EPSG:3857", transform=stretched)
    terrain = read_terrain(dem, dem)
    assert terrain.rio.crs.to_epsg() == 32633
    extent = float(terrain["x"].max() - terrain["x"].min())
    assert extent == pytest.approx(60 * np.cos(np.deg2rad(47.0)), rel=0.06)


@pytest.mark.parametrize("name", ["wellington", "tahoe", "bcts", "topography"])
def test_real_terrain_is_read_in_metres(name, real_terrain):
    terrain = read_terrain(*real_terrain(name))
    assert terrain.rio.crs.is_projected
    height, width = pixel_size(terrain)
    assert 0.4 < height < 1.1
    assert 0.4 < width < 1.1
    assert (terrain["dsm"] >= terrain["dem"]).where(terrain["dem"].notnull(), True).all()


@pytest.mark.parametrize("name", ["wellington", "tahoe", "bcts", "topography"])
def test_a_lazy_window_once_cleaned_is_that_part_of_the_eager_terrain(name, real_terrain):
    eager = read_terrain(*real_terrain(name))
    # Where it is warped (tahoe is in degrees), a lazy height is the eager one to float32.
    rtol = 2.0**-24 if name == "tahoe" else 0.0
    clipped = valid = 0
    with read_terrain(*real_terrain(name), lazy=True) as lazy:
        assert lazy["dem"].dtype == np.float32
        for top in range(0, lazy.sizes["y"], 100):
            rows = {"y": slice(top, top + 100)}
            window, n_clipped, n_valid = clean(lazy.isel(rows))
            xr.testing.assert_allclose(window, eager.isel(rows), rtol=rtol, atol=0.0)
            xr.testing.assert_identical(window["spatial_ref"], eager["spatial_ref"])
            clipped, valid = clipped + n_clipped, valid + n_valid
    assert valid == eager["dem"].count()
    assert clipped / valid == eager.attrs["clipped_share"]


def test_a_window_is_cleaned_like_the_whole(tmp_path):
    ground, surface = plane(), plane() + 1.0
    surface[0, :6] -= 3.0
    ground[0, 0] = surface[1, 1] = np.nan
    dem, dsm = (write_raster(tmp_path / f"{i}.tif", a) for i, a in enumerate((ground, surface)))
    with read_terrain(dem, dsm, lazy=True) as lazy:
        window = lazy.isel(y=slice(0, 2)).load()
        cleaned, clipped, valid = clean(window)
    assert (clipped, valid) == (5, 58)
    assert cleaned["dem"].dtype == np.float32  # as it was read
    assert np.argwhere(np.isnan(cleaned["dem"].values)).tolist() == [[0, 0], [1, 1]]
    assert (cleaned["dsm"][0, 1:6] == cleaned["dem"][0, 1:6]).all()
    np.testing.assert_array_equal(window["dsm"], surface[:2])
    nothing, clipped, valid = clean(window.isel(y=[0], x=[0]))
    assert (clipped, valid, nothing["dem"].size) == (0, 0, 1)


def test_a_raster_larger_than_the_memory_is_read_by_windows(tmp_path):
    size, corner = 20_000, from_origin(500_000.0, 5_000_000.0, 1.0, 1.0)
    profile = dict(driver="GTiff", width=size, height=size, count=1, dtype="float32", crs=UTM)
    for name, shift in (("dem", 0.0), ("dsm", 0.25)):
        with rasterio.open(
            tmp_path / f"{name}.tif",
            "w",
            **profile,
            transform=corner @ rasterio.Affine.translation(shift, shift),
            tiled=True,
            sparse_ok=True,
        ) as sink:
            rows = np.full((512, size), 100.0 + 10.0 * shift, "float32")
            sink.write(rows, 1, window=((10_240, 10_752), (0, size)))
    tracemalloc.start()
    with read_terrain(tmp_path / "dem.tif", tmp_path / "dsm.tif", lazy=True) as terrain:
        window = terrain.isel(y=slice(10_400, 10_500)).load()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(window["dem"], 100.0)
    np.testing.assert_allclose(window["dsm"][:, 1:], 102.5)
    # One variable of the whole is 1600 MB, of the window 8 MB.
    assert peak < 150e6


def test_a_warped_height_does_not_depend_on_the_window_it_is_read_in(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    # Pixels of 500 m, so that the map projection is far from linear over the raster.
    corner = from_origin(500_000.0, 5_000_000.0, 500.0, 500.0)
    dem = write_raster(tmp_path / "dem.tif", plane(90, 80), transform=corner)
    left, top = rasterio.warp.transform(UTM, "EPSG:4326", [495_000.0], [5_005_000.0])
    degrees = from_origin(left[0], top[0], 3.5e-3, 3e-3)
    rough = (100.0 + rng.random((190, 190))).astype("float32")
    dsm = write_raster(tmp_path / "dsm.tif", rough, crs="EPSG:4326", transform=degrees)
    with read_terrain(dem, dsm, lazy=True) as terrain:
        whole = terrain["dsm"].values
    monkeypatch.setattr(align, "BLOCK", 32)
    monkeypatch.setattr(align, "BLOCK_PIXELS", 500)
    with read_terrain(dem, dsm, lazy=True) as terrain:
        blocks = terrain["dsm"].values
        # The transformer errs by a thousandth of a pixel, the relief is 1 m per pixel.
        np.testing.assert_allclose(blocks, whole, rtol=0.0, atol=4e-3)
        for window in (np.s_[5:6, :], np.s_[31:77, 13:37], np.s_[:, 79:]):
            np.testing.assert_allclose(terrain["dsm"][window], blocks[window], rtol=2.0**-23)


def test_lazy_variables_are_indexed_as_any_other(tmp_path):
    flipped = rasterio.Affine(-1.0, 0.0, 500_030.0, 0.0, 1.0, 5_000_000.0 - 20.0)
    dem = write_raster(tmp_path / "dem.tif", plane()[::-1, ::-1].copy(), transform=flipped)
    with read_terrain(dem, dem, lazy=True) as terrain:
        for key in (
            np.s_[:, :],
            np.s_[3],
            np.s_[3, 4],
            np.s_[::-3, 5:1:-1],
            np.s_[[5, 1], 2:20:4],
            np.s_[4:4],
            np.s_[2, 4:4],
        ):
            np.testing.assert_array_equal(terrain["dem"][key], plane()[key])
        copy = terrain.copy(deep=True)
        copy["dem"][0, 0] = 0.0
        assert float(copy["dem"][0, 0]) == 0.0
        assert float(terrain["dem"][0, 0]) == plane()[0, 0]
    with pytest.raises(TerrainError, match=r"dem: '.*dem.tif' could not be read .* was closed"):
        terrain.load()


def test_synthetic_terrain_is_seeded_and_as_ordered():
    terrain = synthetic_terrain((100.0, 80.0), resolution=2.0, seed=3, canopy_cover=0.3)
    assert terrain["dem"].shape == (50, 40)
    xr.testing.assert_identical(
        terrain, synthetic_terrain((100.0, 80.0), resolution=2.0, seed=3, canopy_cover=0.3)
    )
    assert (terrain["dem"] != synthetic_terrain((100.0, 80.0), 2.0, seed=4)["dem"]).any()
    assert float((terrain["dsm"] > terrain["dem"]).mean()) == pytest.approx(0.3, abs=0.01)
    assert terrain.rio.crs.to_epsg() == 32616


def test_synthetic_terrain_refuses_what_it_cannot_make():
    with pytest.raises(TerrainError, match="need 4 x 4"):
        synthetic_terrain((3.0, 3.0))
    with pytest.raises(TerrainError, match="need hurst in"):
        synthetic_terrain((50.0, 50.0), canopy_cover=1.5)


@pytest.mark.parametrize(
    ("attribute", "message"),
    [
        ({"nodata": "none"}, "has a nodata attribute that is no number: none; correct it"),
        ({"scales": (1.0, 0.1)}, "has bands scaled differently; open it with"),
    ],
)
def test_tags_of_an_array_that_make_no_sense_are_named(attribute, message):
    dem = synthetic_terrain((20.0, 20.0), seed=0)["dem"].assign_attrs(attribute)
    with pytest.raises(TerrainError, match=message):
        read_terrain(dem)


def vrt(path, side):
    """A file of 300 bytes that unpacks to side x side pixels of 1 m."""
    path.write_text(
        f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}"><SRS>{UTM}</SRS>'
        "<GeoTransform>5e5, 1, 0, 5e6, 0, -1</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"/></VRTDataset>'
    )
    return path


def test_a_small_file_that_unpacks_to_gigabytes_is_refused_at_once(tmp_path):
    dem = vrt(tmp_path / "dem.vrt", 70_000)
    with pytest.raises(TerrainError, match=r"70000 x 70000 pixels, 39.2 GB .* max_pixels=9e6"):
        read_terrain(dem, dem)
    with pytest.raises(TerrainError, match=r"70000 x 70000 pixels, 39.2 GB .* lazy=True"):
        read_terrain(dem, dem, resolution=1.0)
    window = read_terrain(dem, dem, lazy=True).isel(y=slice(0, 2), x=slice(0, 2))
    assert (window["dem"].load() == 0.0).all()
    with pytest.raises(TerrainError, match=r"1000000 x 1000000 pixels, too many .* gdal_translate"):
        read_terrain(vrt(dem, 1_000_000), dem, max_pixels=9e6)
