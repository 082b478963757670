"""Every kind of raster that is opened, and every way in which one says "missing"."""

import zipfile
from contextlib import nullcontext

import numpy as np
import pytest
import rasterio
import rasterio.shutil
import rioxarray
import xarray as xr
from rasterio.enums import ColorInterp
from rasterio.io import MemoryFile
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT

from trustbo.errors import TerrainError, TrustboError
from trustbo.terrain import read_terrain
from trustbo.terrain.dataset import assemble_terrain, require_terrain

UTM = "EPSG:32633"
CORNER = from_origin(500_000.0, 5_000_000.0, 1.0, 1.0)
HOLE = (2, 3)


def plane(hole=None, dtype="float32"):
    row, col = np.mgrid[:8, :10]
    values = (100.0 + col - 2.0 * row).astype(dtype)
    if hole is not None:
        values[HOLE] = hole
    return values


def write_raster(
    path, *bands, mask=None, internal=True, scale=None, alpha=False, units=None, **profile
):
    height, width = bands[0].shape
    profile = {"crs": UTM, "transform": CORNER, "dtype": bands[0].dtype} | profile
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal),
        rasterio.open(
            path, "w", "GTiff", height=height, width=width, count=len(bands), **profile
        ) as sink,
    ):
        for i, band in enumerate(bands, start=1):
            sink.write(band, i)
        if alpha:
            sink.colorinterp = [ColorInterp.gray, ColorInterp.alpha]
        if mask is not None:
            sink.write_mask(mask)
        if scale is not None:
            sink.scales, sink.offsets = [scale[0]], [scale[1]]
        if units is not None:
            sink.units = [units] * len(bands)
    return path


def assert_is_the_plane(terrain):
    """The plane with its one hole, whichever way it was written."""
    for name in ("dem", "dsm"):
        np.testing.assert_array_equal(terrain[name], plane(np.nan, float))
    assert terrain.rio.crs.to_epsg() == 32633
    assert terrain.rio.bounds() == (500_000.0, 4_999_992.0, 500_010.0, 5_000_000.0)


@pytest.fixture
def tif(tmp_path):
    return write_raster(tmp_path / "dem.tif", plane(-9999.0), nodata=-9999.0)


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("address", ["/vsizip/{}/dem.tif", "zip://{}!dem.tif", "GTIFF_DIR:1:{}"])
def test_whatever_gdal_can_address_is_read(tif, address, lazy):
    archive = tif.with_suffix(".zip")
    with zipfile.ZipFile(archive, "w") as sink:
        sink.write(tif, "dem.tif")
    path = address.format(tif if "GTIFF" in address else archive)
    terrain = read_terrain(path, str(tif), lazy=lazy)
    assert_is_the_plane(terrain)
    terrain.close()


def test_a_cloud_optimised_geotiff_is_read(tif):
    rasterio.shutil.copy(tif, tif.with_name("cog.tif"), driver="COG")
    assert_is_the_plane(read_terrain(tif, tif.with_name("cog.tif")))


@pytest.mark.parametrize("lazy", [False, True])
def test_an_open_dataset_is_read_and_left_open(tif, lazy):
    with (
        rasterio.open(tif) as dataset,
        WarpedVRT(dataset) as warped,
        MemoryFile(tif.read_bytes()) as memory,
        memory.open() as in_memory,
    ):
        for dsm in (dataset, warped, in_memory):
            terrain = read_terrain(dataset, dsm, lazy=lazy)
            assert_is_the_plane(terrain)
            terrain.close()
            assert not dataset.closed
            assert not dsm.closed
    with pytest.raises(TerrainError, match=r"dem: '.*dem.tif' is closed; open it"):
        read_terrain(dataset, tif)


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("how", [{}, {"masked": True}, {"mask_and_scale": True}])
def test_an_array_of_rioxarray_is_read_however_it_was_opened(tif, how, lazy):
    with rioxarray.open_rasterio(tif, **how) as opened:
        for array in (
            opened,
            opened.isel(band=0),
            opened.load().transpose("x", "y", "band"),
            opened.isel(y=slice(None, None, -1)),
            opened.rename("height").to_dataset(),
            xr.concat([opened, opened + 1.0], "band"),
        ):
            assert_is_the_plane(read_terrain(array, array, lazy=lazy))


def test_an_array_with_its_nodata_value_in_the_encoding_is_masked():
    coords = {"y": 4_999_999.5 - np.arange(8.0), "x": 500_000.5 + np.arange(10.0)}
    array = xr.DataArray(plane(-1.0), coords, ("y", "x")).rio.write_crs(UTM)
    for note in (array.attrs, array.encoding):
        note["_FillValue"] = np.float32(-1.0)
        assert_is_the_plane(read_terrain(array, array))
        del note["_FillValue"]
    assert float(read_terrain(array, array)["dem"].min()) == -1.0
    assert_is_the_plane(read_terrain(array, array, nodata=-1))


@pytest.mark.parametrize("names", [("lat", "lon"), ("latitude", "longitude")])
def test_an_array_over_latitude_and_longitude_is_reprojected(tmp_path, names):
    coords = {names[0]: 45.0 - 1e-5 * np.arange(8), names[1]: 15.0 + 1e-5 * np.arange(10)}
    array = xr.DataArray(plane(), coords, names)
    with pytest.raises(TerrainError, match="dem: DataArray has no coordinate reference system"):
        read_terrain(array, array)
    corner = from_origin(15.0 - 0.5e-5, 45.0 + 0.5e-5, 1e-5, 1e-5)
    path = write_raster(tmp_path / "dem.tif", plane(), crs="EPSG:4326", transform=corner)
    xr.testing.assert_allclose(
        read_terrain(array, array, crs="EPSG:4326"), read_terrain(path, path), rtol=1e-6
    )


def test_an_array_of_plain_numbers_is_placed_like_a_bare_image():
    array = xr.DataArray(plane(), dims=("y", "x"))
    for bare in (array, array.assign_coords(y=np.arange(8) + 0.5, x=np.arange(10) + 0.5)):
        with pytest.raises(TerrainError, match="dem: DataArray carries no georeference"):
            read_terrain(bare, bare, crs=UTM)
        terrain = read_terrain(bare, bare, crs=UTM, resolution=2.0)
        np.testing.assert_array_equal(terrain["dem"], plane())
        assert terrain.rio.bounds() == (0.0, 0.0, 20.0, 16.0)


LARGEST = float(np.finfo("float32").max)
SEEN = np.full((8, 10), 255, "uint8")
SEEN[HOLE] = 0


@pytest.mark.parametrize(
    ("bands", "profile"),
    [
        ([plane(-9999.0)], {"nodata": -9999.0}),
        ([plane(-LARGEST)], {"nodata": -LARGEST}),
        ([plane(np.nan)], {}),
        ([plane(np.nan)], {"nodata": np.nan}),
        ([plane(np.nan)], {"nodata": -9999.0}),
        ([plane(np.inf)], {}),
        ([plane(-np.inf)], {"nodata": -9999.0}),
        ([plane(-32768, "int16")], {"nodata": -32768}),
        ([plane(0, "uint8")], {"nodata": 0}),
        ([plane(0)], {"mask": SEEN}),
        ([plane(0)], {"mask": SEEN, "internal": False}),
        # Of a tag and a mask together, GDAL knows the mask alone.
        ([plane(-9999.0)], {"nodata": -9999.0, "mask": np.full_like(SEEN, 255)}),
        ([plane(dtype="uint8"), SEEN], {"alpha": True}),
    ],
    ids=lambda v: str(sorted(v)) if isinstance(v, dict) else "",
)
def test_missing_heights_become_nan_however_they_are_marked(tmp_path, bands, profile):
    path = write_raster(tmp_path / "dem.tif", *bands, **profile)
    assert_is_the_plane(read_terrain(path, path))
    with read_terrain(path, path, lazy=True) as terrain:
        assert_is_the_plane(terrain)


def test_whole_numbers_without_nodata_are_all_heights(tmp_path):
    path = write_raster(tmp_path / "dem.tif", plane(0, "uint8"))
    np.testing.assert_array_equal(read_terrain(path, path)["dem"], plane(0))


def test_scale_and_offset_are_applied_after_the_nodata_value(tmp_path):
    stored = ((plane(dtype=float) - 50.0) / 0.5).astype("int16")
    # As a height, 95 m is none that is missing.
    stored[HOLE] = 95
    path = write_raster(tmp_path / "dem.tif", stored, nodata=95, scale=(0.5, 50.0))
    assert_is_the_plane(read_terrain(path, path))
    untagged = write_raster(tmp_path / "untagged.tif", stored, scale=(0.5, 50.0))
    assert_is_the_plane(read_terrain(untagged, untagged, nodata=95))
    for how in ({}, {"masked": True}, {"mask_and_scale": True}):
        with rioxarray.open_rasterio(path, **how) as array:
            assert_is_the_plane(read_terrain(array, array))


@pytest.mark.parametrize(
    ("fill", "dtype"),
    [
        (-9999.0, "float32"),
        (-999.0, "float32"),
        (-LARGEST, "float32"),
        (1e20, "float64"),
        (-32768, "int16"),
        (65535, "uint16"),
    ],
)
def test_a_fill_value_that_nothing_declares_is_no_height(tmp_path, fill, dtype):
    path = write_raster(tmp_path / "dem.tif", plane(fill, dtype))
    message = rf"dem: '.*dem.tif' holds {float(fill)!r}, at row 2, column 3: no height on land"
    with pytest.raises(TerrainError, match=message.replace("+", r"\+")) as caught:
        read_terrain(path, path)
    # The remedy it names works as it stands.
    named = str(caught.value).split("nodata=")[1].split(", or")[0]
    assert_is_the_plane(read_terrain(path, path, nodata=float(named)))
    with read_terrain(path, path, lazy=True) as terrain:
        np.testing.assert_array_equal(terrain["dem"][:2], plane()[:2])
        with pytest.raises(TerrainError, match="at row 2, column 3"):
            terrain.isel(y=slice(1, 4)).load()


def test_the_nodata_value_is_rounded_as_the_raster_s_type_does(tmp_path):
    path = write_raster(tmp_path / "dem.tif", plane(-9999.9))
    assert_is_the_plane(read_terrain(path, path, nodata=-9999.9))


def test_of_several_bands_the_first_is_read(tmp_path):
    path = write_raster(tmp_path / "dem.tif", plane(-1.0), plane() + 50.0, nodata=-1.0)
    assert_is_the_plane(read_terrain(path, path))


def test_rasters_too_small_to_have_a_slope_are_refused(tmp_path, tif):
    for shape in ((1, 1), (1, 10)):
        path = write_raster(tmp_path / "small.tif", plane()[: shape[0], : shape[1]])
        with pytest.raises(TerrainError, match=rf"dsm: .* has {shape[0]} x {shape[1]} pixels; a t"):
            read_terrain(tif, path)
    with rioxarray.open_rasterio(tif) as array:
        with pytest.raises(TerrainError, match="dem: DataArray has 1 x 10 pixels"):
            read_terrain(array.isel(y=[0]), tif)
        for empty in (array.isel(y=slice(0)), array.isel(band=slice(0))):
            with pytest.raises(TerrainError, match=r"has axes \{.*: 0.*\}; need \(y, x\)"):
                read_terrain(empty, tif)


def test_what_is_no_raster_is_named_with_what_would_be_one(tif):
    array = read_terrain(tif, tif)["dem"]
    with pytest.raises(TerrainError, match=r"dem must be a path, .* or an xarray.DataArray; got n"):
        read_terrain(plane(), tif)
    with pytest.raises(TerrainError, match=r"dsm is a Dataset of dem, dsm; give one DataArray, e"):
        read_terrain(tif, read_terrain(tif, tif))
    with pytest.raises(TerrainError, match=r"of which none are known as y and x; name them"):
        read_terrain(array.drop_vars(["x", "y"]).rename(y="northing", x="easting"), tif)
    with pytest.raises(TerrainError, match=r"has axes .*'time': 2.*; need \(y, x\), or bands"):
        read_terrain(array.expand_dims(band=3, time=2), tif)
    with pytest.raises(TerrainError, match="dem: DataArray 'dem''s x is not a regular axis"):
        read_terrain(array.isel(x=[0, 1, 3]), tif)
    with pytest.raises(TerrainError, match="holds complex128, which are no heights"):
        read_terrain(array.astype(complex), tif)
    with pytest.raises(TerrainError, match="nodata must be a number; got 'none'"):
        read_terrain(tif, tif, nodata="none")


def test_a_file_of_several_rasters_names_them(tmp_path, tif):
    both = read_terrain(tif, tif)
    both.to_netcdf(tmp_path / "both.nc")
    with pytest.raises(TerrainError, match=r"no band of its own; give one of its parts: .*both.nc"):
        read_terrain(tmp_path / "both.nc", tif)
    assert_is_the_plane(read_terrain(f"netcdf:{tmp_path / 'both.nc'}:dem", tif))


def test_a_damaged_file_is_named(tmp_path):
    path = write_raster(tmp_path / "dem.tif", np.random.default_rng(0).random((300, 300)))
    path.write_bytes(path.read_bytes()[:200_000])
    with pytest.raises(TerrainError, match=r"dem: '.*dem.tif' could not be read .*; it is damaged"):
        read_terrain(path, path)


FOOT, SURVEY_FOOT = 0.3048, 1200.0 / 3937.0
IN_FEET = "EPSG:32611+6360"  # NAVD88 height (ftUS)


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize(
    ("units", "crs", "metres", "name"),
    [
        ("ft", UTM, FOOT, "ft"),
        ("Feet", UTM, FOOT, "Feet"),
        ("Foot_US", UTM, SURVEY_FOOT, "Foot_US"),
        (None, IN_FEET, SURVEY_FOOT, "US survey foot"),
        ("ftUS", IN_FEET, SURVEY_FOOT, "ftUS"),
        (None, "EPSG:32611+8228", FOOT, "foot"),
    ],
)
def test_heights_in_feet_become_metres_and_it_is_said(tmp_path, units, crs, metres, name, lazy):
    stored = 33.0 * plane(np.nan, float)  # to 3600 feet: no fill value, nor is -9000 feet a height
    path = write_raster(tmp_path / "dem.tif", stored, crs=crs, units=units)
    metric = write_raster(tmp_path / "dsm.tif", plane() + 2000.0, crs=crs.split("+")[0])
    with pytest.warns(UserWarning, match=rf"dem: .* has heights in '{name}'; .* to metres") as said:
        terrain = read_terrain(path, metric, lazy=lazy)
    assert [w.filename for w in said if w.category is UserWarning] == [__file__]
    np.testing.assert_allclose(terrain["dem"], stored * metres, rtol=1e-6)
    assert terrain["dem"].attrs["stored_units"] == name
    assert terrain["dem"].attrs["units"] == "m"
    assert "stored_units" not in terrain["dsm"].attrs
    assert terrain.rio.crs == crs.split("+")[0]  # no longer says that heights are in feet
    terrain.close()
    with rioxarray.open_rasterio(path) as array, pytest.warns(UserWarning, match="DataArray has h"):
        np.testing.assert_allclose(read_terrain(array, metric)["dem"], stored * metres)


def test_a_given_crs_says_the_unit_of_heights_too(tmp_path):
    path = write_raster(tmp_path / "dem.tif", plane(), crs=None)
    with pytest.warns(UserWarning, match="'US survey foot'"):
        terrain = read_terrain(path, path, crs=IN_FEET)
    np.testing.assert_allclose(terrain["dem"], plane() * SURVEY_FOOT)


def test_mountains_in_feet_are_heights_and_fill_values_in_feet_are_not(tmp_path):
    high = write_raster(tmp_path / "high.tif", plane() + 28_900.0, units="ft")
    with pytest.warns(UserWarning, match="'ft'"):
        assert float(read_terrain(high, high)["dem"].max()) > 8_800.0
    for fill in (-9999.0, -999.0, 32_767.0):
        path = write_raster(tmp_path / "fill.tif", plane(fill), units="ft")
        with (
            pytest.warns(UserWarning, match="'ft'"),
            pytest.raises(TerrainError, match=rf"holds {fill}, scaled to .* m, at row 2, column 3"),
        ):
            read_terrain(path, path)


def test_unknown_and_contradictory_units_of_heights_are_refused(tmp_path):
    path = write_raster(tmp_path / "dem.tif", plane(), units="furlong")
    with pytest.raises(TerrainError, match="heights in 'furlong'; metres and feet are known: conv"):
        read_terrain(path, path)
    path = write_raster(tmp_path / "both.tif", plane(), crs=IN_FEET, units="m")
    with pytest.raises(TerrainError, match="in 'm' by its band, but in 'US survey foot' by its CR"):
        read_terrain(path, path)


@pytest.mark.parametrize("units", ["m", "metre", "Meters", "metres"])
def test_metres_by_any_name_are_metres(tmp_path, units):
    path = write_raster(tmp_path / "dem.tif", plane(np.nan), units=units)
    assert_is_the_plane(read_terrain(path, path))


@pytest.mark.parametrize("lazy", [False, True])
def test_a_dem_alone_is_a_terrain_without_canopy(tif, lazy):
    with pytest.warns(UserWarning, match=r"no surface \(DSM\) is given, so no canopy is") as said:
        terrain = read_terrain(tif, lazy=lazy)
    assert len([w for w in said if w.category is UserWarning]) == 1
    assert_is_the_plane(terrain)
    assert terrain.attrs["surface"] == "the ground, as no DSM is known"
    terrain.close()


def test_a_dem_alone_in_degrees_is_warped_once_for_both(tmp_path):
    corner = from_origin(15.0, 45.0, 1e-5, 1e-5)
    path = write_raster(tmp_path / "dem.tif", plane(), crs="EPSG:4326", transform=corner)
    with pytest.warns(UserWarning, match="no surface"):
        terrain = read_terrain(path)
    assert terrain["dem"].equals(terrain["dsm"])
    xr.testing.assert_equal(terrain["dem"], read_terrain(path, path)["dem"])


def test_arrays_that_are_not_in_metres_are_no_terrain_yet(tif):
    terrain = read_terrain(tif, tif)
    feet = terrain["dem"].assign_attrs(units="ft")
    with pytest.raises(
        TerrainError, match="dem has heights in 'ft', not metres; read it with read"
    ):
        assemble_terrain(feet, terrain["dsm"])
    with pytest.raises(TerrainError, match="dsm has heights in 'ft', not metres"):
        require_terrain(terrain.assign(dsm=feet))
    with pytest.raises(TerrainError, match="in 'm' by its band, but in 'US survey foot' by its CR"):
        require_terrain(terrain.rio.write_crs(IN_FEET))


# --- averaged ---


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A DEM and a DSM of 3007 x 3000 pixels of 1 m, and the DEM's values."""
    folder, fill = tmp_path_factory.mktemp("large"), -9999.0
    values = np.random.default_rng(0).uniform(100.0, 200.0, (3007, 3000)).astype("float32")
    values[:30, :20] = values[30:60, :10] = values[60:90, :30] = fill  # 2/3, 1/3, all of a block
    for name, extra in (("dem", 0.0), ("dsm", 5.0)):
        stored = np.where(values == fill, fill, values + np.float32(extra))
        tiled = {"tiled": True, "blockxsize": 512, "blockysize": 512}
        write_raster(folder / f"{name}.tif", stored.astype("float32"), nodata=fill, **tiled)
    return folder, np.where(values == fill, np.nan, values.astype(float))


@pytest.mark.parametrize("how", [{"max_pixels": 10_100}, {"resolution": 30.2}])
@pytest.mark.parametrize("lazy", [False, True])
def test_large_rasters_are_averaged_block_by_block(how, lazy, large, capsys, monkeypatch):
    folder, values = large
    monkeypatch.setattr("trustbo.terrain.raster._PIXELS", 400_000)  # in several strips
    paths = folder / "dem.tif", folder / "dsm.tif"
    each = "'.*' has 3007 x 3000 pixels, 30 x 30 of them are averaged to one of 30 m"
    said = rf"^dem: {each}; dsm: {each}\. For another size, give resolution=\.$"
    with pytest.warns(UserWarning, match=said) if "max_pixels" in how else nullcontext():
        terrain = read_terrain(*paths, **how, lazy=lazy, progress=True)
    blocks = values[:3000].reshape(100, 30, 100, 30)
    mean = np.nanmean(np.where(np.isnan(blocks).all((1, 3), keepdims=True), 0.0, blocks), (1, 3))
    mean[0, 0] = mean[2, 0] = np.nan  # over half is missing
    assert np.isfinite(mean[1, 0])
    # Sums of 900 float64 in another order; lazily, heights are float32.
    np.testing.assert_allclose(terrain["dem"], mean, rtol=1e-6 if lazy else 1e-12)
    np.testing.assert_allclose(terrain["dsm"], mean + 5.0, rtol=1e-6)  # stored as float32
    assert terrain.rio.bounds() == (500_000.0, 4_997_000.0, 503_000.0, 5_000_000.0)
    assert "reading dem" in capsys.readouterr().err
    terrain.close()


def test_rasters_of_one_crs_are_averaged_to_one_size(large, tmp_path):
    folder, values = large
    half = from_origin(500_000.0, 5_000_000.0, 2.0, 2.0)
    coarse = values[:3006].reshape(1503, 2, 1500, 2).mean((1, 3)) + 5.0
    write_raster(tmp_path / "dsm.tif", coarse.astype("float32"), nodata=np.nan, transform=half)
    said = r"3000 pixels, 30 x 30 .* of 30 m; .* 1503 x 1500 pixels, 15 x 15 .* of 30 m\. For"
    with pytest.warns(UserWarning, match=said):
        terrain = read_terrain(folder / "dem.tif", tmp_path / "dsm.tif", max_pixels=10_100)
    both = terrain["dsm"] - terrain["dem"]
    np.testing.assert_allclose(both.values[3:], 5.0, atol=1e-4)


def test_a_size_that_no_pixels_are_left_of_is_refused(tif):
    with pytest.raises(TerrainError, match="8 x 10 pixels, too few to average 5 x 5 of them; give"):
        read_terrain(tif, tif, resolution=5.0)
    for how in ({"resolution": 0.0}, {"max_pixels": -1.0}):
        with pytest.raises(TrustboError, match=f"{next(iter(how))} must be positive and finite"):
            read_terrain(tif, tif, **how)
