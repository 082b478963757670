"""Reading of rasters: heights in metres, missing ones NaN, north up; what cannot serve is refused.

Many of the faulty rasters are those of public bug reports.
"""

import os
import subprocess
import sys
import warnings

import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.rpc
import rasterio.warp
import rioxarray
import xarray as xr
from rasterio import Affine
from rasterio.control import GroundControlPoint
from rasterio.enums import ColorInterp
from rasterio.transform import from_origin
from worlds import terrain_of

from trustbo.errors import TrustboError
from trustbo.terrain import pixel_size, read_terrain
from trustbo.terrain.read import require_terrain

UTM = "EPSG:32633"
CORNER = from_origin(500_000.0, 5_000_000.0, 1.0, 1.0)
HOLE = (2, 3)
LARGEST = float(np.finfo("float32").max)


EQUAL_CANOPY = pytest.mark.filterwarnings("ignore:the DSM lies")
"""For canopies that have one height on purpose."""


def plane(hole=None, dtype="float32", shape=(8, 10)):
    """Heights (row, col) of a plane, with a value in the hole if one is given."""
    row, col = np.mgrid[: shape[0], : shape[1]]
    values = (100.0 + col - 2.0 * row).astype(dtype)
    if hole is not None:
        values[HOLE] = hole
    return values


def write(path, *bands, crs=UTM, transform=CORNER, mask=None, colours=None, **profile):
    unit = profile.pop("unit", None)
    scale, gcps = profile.pop("scale", None), profile.pop("gcps", None)
    dtype = profile.pop("dtype", bands[0].dtype)
    height, width = bands[0].shape
    with rasterio.open(
        path, "w", driver="GTiff", height=height, width=width, count=len(bands),
        dtype=dtype, crs=crs, transform=transform, **profile,
    ) as sink:  # fmt: skip
        for k, values in enumerate(bands, 1):
            sink.write(values, k)
        if mask is not None:
            sink.write_mask(mask)
        if colours is not None:
            sink.colorinterp = colours
        if unit is not None:
            sink.units = [unit] * len(bands)
        if scale is not None:
            sink.scales, sink.offsets = [scale[0]] * len(bands), [scale[1]] * len(bands)
        if gcps is not None:
            sink.gcps = gcps
    return path


def array(values, crs=UTM, step=1.0, left=500_000.5, top=4_999_999.5):
    coords = {
        "y": top - step * np.arange(values.shape[0]),
        "x": left + step * np.arange(values.shape[1]),
    }
    made = xr.DataArray(values, coords, ("y", "x"))
    return made if crs is None else made.rio.write_crs(crs)


def assert_is_the_plane(terrain):
    holed = plane(np.nan, float)
    np.testing.assert_allclose(terrain["dem"], holed, rtol=1e-6)
    np.testing.assert_array_equal(terrain["dsm"].isnull(), np.isnan(holed))


@pytest.fixture
def tif(tmp_path):
    return write(tmp_path / "tif.tif", plane(np.nan))


@EQUAL_CANOPY
def test_a_pair_comes_out_aligned_north_up_and_in_metres(tmp_path):
    dem = write(tmp_path / "dem.tif", plane())
    dsm = write(tmp_path / "dsm.tif", plane() + 3.0)
    terrain = read_terrain(dem, dsm)
    assert terrain["dem"].dims == ("y", "x")
    assert terrain["y"][0] > terrain["y"][-1]
    assert terrain.rio.crs.to_epsg() == 32633
    assert pixel_size(terrain) == (1.0, 1.0)
    assert terrain.rio.bounds() == (500_000.0, 4_999_992.0, 500_010.0, 5_000_000.0)
    np.testing.assert_allclose(terrain["dem"], plane())
    np.testing.assert_allclose(terrain["dsm"] - terrain["dem"], 3.0)
    again = require_terrain(terrain)
    xr.testing.assert_identical(again, terrain)


def test_paths_and_arrays_are_read_alike(tif):
    with rioxarray.open_rasterio(tif) as opened:
        for source in (tif, str(tif), opened, opened[0], array(plane(np.nan))):
            assert_is_the_plane(read_terrain(source, source))


@EQUAL_CANOPY
def test_a_coarser_shifted_dsm_is_brought_onto_the_dem_s_grid(tmp_path):
    dem = write(tmp_path / "dem.tif", plane(shape=(40, 40)))
    row, col = np.mgrid[:30, :30]
    # The same plane, 5 m higher, sampled at the coarse pixels' centres.
    values = (105.0 + (-4.0 + 2.0 * col + 0.5) - 2.0 * (-6.0 + 2.0 * row + 0.5)).astype("float32")
    shifted = from_origin(500_000.0 - 4.0, 5_000_000.0 + 6.0, 2.0, 2.0)
    terrain = read_terrain(dem, write(tmp_path / "dsm.tif", values, transform=shifted))
    inner = (terrain["dsm"] - terrain["dem"]).isel(x=slice(4, -4), y=slice(4, -4))
    np.testing.assert_allclose(inner, 5.0, atol=1e-3)  # bilinear resampling reproduces a plane


@pytest.mark.parametrize(
    ("bands", "profile"),
    [
        ([plane(-9999.0)], {"nodata": -9999.0}),
        ([plane(-LARGEST)], {"nodata": -LARGEST}),
        ([plane(np.nan)], {"nodata": -9999.0}),
        ([plane(-np.inf)], {}),
        ([plane(-32768, "int16")], {"nodata": -32768}),
        ([plane(0)], {"mask": np.where(plane(0) == 0, 0, 255).astype("uint8")}),
        # Of a tag and a mask together, GDAL knows the mask alone.
        ([plane(-9999.0)], {"nodata": -9999.0, "mask": np.full((8, 10), 255, "uint8")}),
        ([plane(0), np.where(plane(0) == 0, 0, 255).astype("float32")],
         {"colours": [ColorInterp.gray, ColorInterp.alpha]}),
        ([plane(0, "uint8"), np.where(plane(0) == 0, 0, 255).astype("uint8")],
         {"colours": [ColorInterp.gray, ColorInterp.alpha]}),
        # Stored 95 is missing, though 97.5 m, which it would mean, is a height.
        ([((plane(140.0, float) - 50.0) / 0.5).astype("int16")], {"nodata": 180,
         "scale": (0.5, 50.0)}),
    ],
)  # fmt: skip
def test_missing_heights_become_nan_however_they_are_marked(tmp_path, bands, profile):
    path = write(tmp_path / "dem.tif", *bands, **profile)
    assert_is_the_plane(read_terrain(path, path))
    if "mask" not in profile and len(bands) == 1:
        for how in ({}, {"masked": True}, {"mask_and_scale": True}):
            with rioxarray.open_rasterio(path, **how) as opened:
                assert_is_the_plane(read_terrain(opened, opened))


@pytest.mark.parametrize(
    "marked",
    [
        array(plane(-9999.0)).rio.write_nodata(-9999.0),
        array(plane(-9999.0)).assign_attrs(missing_value=-9999.0),
        array(plane(-9999.0)).assign_attrs(_FillValue=[-9999.0]),
    ],
)
def test_fills_that_an_array_declares_are_missing(marked):
    assert_is_the_plane(read_terrain(marked, marked))


@pytest.mark.parametrize(
    ("fill", "dtype"),
    [(-9999.0, "float32"), (-999.0, "float32"), (-LARGEST, "float32"), (1e20, "float64"),
     (-32768, "int16"), (65535, "uint16"), (-4823.6, "float64"), (-460.0, "float64")],
)  # fmt: skip
def test_undeclared_and_blended_fills_are_refused_and_the_remedy_works(tmp_path, fill, dtype):
    path = write(tmp_path / "dem.tif", plane(fill, dtype))
    with pytest.raises(TrustboError, match="row 2, column 3") as caught:
        read_terrain(path)
    named = float(str(caught.value).split("nodata=")[1].split(", or")[0])
    assert_is_the_plane(read_terrain(path, path, nodata=named))
    with pytest.raises(TrustboError, match="row 2, column 3"):
        read_terrain(array(plane(fill, dtype)))


def test_low_land_is_land():
    shore = array(np.linspace(-431.0, -400.0, 80).reshape(8, 10))
    np.testing.assert_array_equal(read_terrain(shore, shore)["dem"], shore)


@pytest.mark.parametrize("scale", [(0.1, 0.0), (0.01, 0.0), (0.1, 1000.0)])
def test_a_fill_times_a_scale_is_refused(tmp_path, scale):
    path = write(tmp_path / "dem.tif", plane(-9999, "int16"), scale=scale)
    with pytest.raises(TrustboError, match="row 2, column 3"):
        read_terrain(path)


def test_heights_in_centimetres_are_said_to_be_in_another_unit(tmp_path):
    path = write(tmp_path / "dem.tif", (plane() * 200).astype("uint16"))
    with pytest.raises(TrustboError, match="unit"):
        read_terrain(path)


def test_zeros_apart_from_all_heights_are_warned_of_and_a_coast_is_not():
    clipped = plane(dtype=float)
    clipped[:3, :3] = 0.0
    with pytest.warns(UserWarning, match="exactly 0 m"):
        read_terrain(array(clipped), array(clipped))
    coast = array(np.maximum(plane(dtype=float) - 95.0, 0.0))
    read_terrain(coast, coast)  # warnings are errors


@pytest.mark.parametrize("units", ["m m-1", "m/s", "kg m-2", "0.1 m", "m**-1"])
def test_units_that_are_no_lengths_are_refused(units):
    with pytest.raises(TrustboError, match="not in metres or feet"):
        read_terrain(array(plane()).assign_attrs(units=units))


def test_depths_of_cf_files_are_below_sea_level_and_axes_in_km_are_refused():
    depths = array(plane(dtype=float)).assign_attrs(units="m", positive="down")
    np.testing.assert_array_equal(read_terrain(depths, depths)["dem"], -plane(dtype=float))
    far = array(plane())
    far["x"].attrs["units"] = "km"
    with pytest.raises(TrustboError, match="km"):
        read_terrain(far, far)


def test_blocks_of_pixels_that_are_not_square_are_square():
    tall = array(plane(shape=(40, 40))).assign_coords(y=4_999_998.0 - 4.0 * np.arange(40.0))
    assert pixel_size(read_terrain(tall, tall, resolution=8.0)) == (8.0, 8.0)


def test_pictures_are_refused_and_several_bands_are_warned_of(tmp_path):
    byte = plane(dtype="uint8")
    picture = write(tmp_path / "rgb.tif", byte, byte, byte, photometric="RGB")
    with pytest.raises(TrustboError, match="red"):
        read_terrain(picture)
    two = write(tmp_path / "two.tif", plane(np.nan), plane())
    with pytest.warns(UserWarning, match="2 bands"):
        assert_is_the_plane(read_terrain(two, two))


@EQUAL_CANOPY
def test_a_band_is_found_by_its_name_in_files_and_arrays(tmp_path):
    path = write(tmp_path / "both.tif", plane() + 9.0, plane())
    with rasterio.open(path, "r+") as file:
        file.descriptions = "DSM", "ground (DTM)"
        file.scales = 1.0, 0.9
    with pytest.warns(UserWarning, match="(Scales|Offsets) differ"):
        from_rioxarray = rioxarray.open_rasterio(path)
    labelled = xr.concat([array(plane()), array(plane() + 9.0)], "band")
    labelled = labelled.assign_coords(band=["dem", "dsm"])[::-1]

    for raster, scale in ((path, 0.9), (from_rioxarray, 0.9), (labelled, 1.0)):
        with pytest.warns(UserWarning, match="2 bands"):
            terrain = read_terrain(raster, raster)
        np.testing.assert_allclose(terrain["dem"], scale * plane(dtype=float))
        np.testing.assert_allclose(terrain["dsm"], plane() + 9.0)


def test_an_alpha_band_may_be_before_the_band_of_heights(tmp_path):
    opaque = np.full((8, 10), 255, "float32")
    colours = [ColorInterp.gray, ColorInterp.alpha, ColorInterp.undefined]
    path = write(tmp_path / "dem.tif", plane() + 9.0, opaque, plane(), colours=colours)
    with rasterio.open(path, "r+") as file:
        file.set_band_description(3, "dem")
    with pytest.warns(UserWarning, match="2 bands .* band 3 is used"):
        terrain = read_terrain(path, array(plane()))
    np.testing.assert_allclose(terrain["dem"], plane())


@pytest.mark.parametrize("number", ["tenth", None, np.nan, [0.1, 1.0]])
@pytest.mark.parametrize("key", ["scale_factor", "add_offset"])
def test_scales_and_offsets_that_are_not_numbers_are_refused(key, number):
    with pytest.raises(TrustboError, match=key):
        read_terrain(array(plane()).assign_attrs({key: number}))


def test_a_fill_may_be_too_large_to_be_scaled():
    largest = -float(np.finfo(float).max)
    stored = array(plane(largest, float)).assign_attrs(_FillValue=largest, scale_factor=[2.0])
    terrain = read_terrain(stored, stored)  # warnings are errors
    np.testing.assert_allclose(terrain["dem"], 2.0 * plane(np.nan, float))


def test_attributes_of_all_bands_are_those_of_the_chosen_band(tmp_path):
    path = write(tmp_path / "feet.tif", plane(), 10.0 * plane())
    with rasterio.open(path, "r+") as file:
        file.scales = 1.0, 0.1
        file.units = "ft", "m"
    with pytest.warns(UserWarning, match="(Scales|Offsets) differ"):
        chosen = rioxarray.open_rasterio(path).sel(band=2)
    np.testing.assert_allclose(read_terrain(chosen, chosen)["dem"], plane(), rtol=1e-6)


@pytest.mark.parametrize("fill", [-99.99, 6553.5])
def test_fills_that_arithmetic_turned_into_heights_are_warned_of(fill):
    holed = plane(dtype=float)
    holed[:2, :2] = fill
    with pytest.warns(UserWarning, match="within 10"):
        read_terrain(array(holed), array(holed))
    terrain = read_terrain(array(holed), array(holed), nodata=fill)  # warnings are errors
    assert int(terrain["dem"].isnull().sum()) == 4

    flat_roof = plane(dtype=float)
    flat_roof[:2, :2] = 150.0
    read_terrain(array(plane()), array(flat_roof))


def test_heights_that_were_scaled_before_are_warned_of(tmp_path):
    path = write(tmp_path / "packed.tif", (10.0 * plane() + 1.0).astype("int16"), scale=(0.1, 0.0))
    packed = rioxarray.open_rasterio(path, masked=True)
    np.testing.assert_allclose(read_terrain(packed, packed)["dem"], plane() + 0.1)

    scaled = (packed * 0.1).assign_attrs(packed.attrs)
    with pytest.warns(UserWarning, match="scale 0.1"):
        read_terrain(scaled, scaled)


def test_heights_in_feet_become_metres_with_a_warning(tmp_path):
    stored = 33.0 * plane(np.nan, float)  # to 3600 feet: no fill value
    for unit, crs, metres in (
        ("ft", UTM, 0.3048),
        ("Foot_US", UTM, 1200.0 / 3937.0),
        (None, "EPSG:32611+6360", 1200.0 / 3937.0),
        (None, "EPSG:32611+8228", 0.3048),
    ):
        path = write(tmp_path / "dem.tif", stored, crs=crs, unit=unit)
        with pytest.warns(UserWarning, match="metres"):
            terrain = read_terrain(path, path)
        np.testing.assert_allclose(terrain["dem"], stored * metres, rtol=1e-6)
        assert terrain.rio.crs == crs.split("+")[0]
    for unit in ("m", "Meters", "metres above sea level", "m NAVD88"):
        path = write(tmp_path / "dem.tif", plane(np.nan), unit=unit)
        assert_is_the_plane(read_terrain(path, path))
    for unit, crs in (("furlong", UTM), ("cm", UTM), ("m", "EPSG:32611+6360")):
        with pytest.raises(TrustboError, match="unit"):
            read_terrain(write(tmp_path / "dem.tif", plane(), crs=crs, unit=unit))


def test_two_vertical_datums_are_refused_and_depths_turned(tmp_path):
    geoid = write(tmp_path / "geoid.tif", plane(), crs=UTM + "+5773")
    above = rasterio.crs.CRS.from_wkt(pyproj.CRS(UTM).to_3d().to_wkt())
    ellipsoid = write(tmp_path / "ellipsoid.tif", plane() + 45.0, crs=above)
    with pytest.raises(TrustboError, match="EGM96"):
        read_terrain(geoid, ellipsoid)
    read_terrain(geoid, geoid)
    depth = write(tmp_path / "depth.tif", plane(), crs=UTM + "+6357")
    np.testing.assert_allclose(read_terrain(depth, depth)["dem"], -plane())


@pytest.mark.parametrize("surface", [3.28 * plane() + 10.0, plane() + 45.0])
def test_a_surface_higher_than_any_forest_everywhere_is_warned_of(surface):
    with pytest.warns(UserWarning, match="datum"):
        read_terrain(array(plane()), array(surface))


@pytest.mark.parametrize("shift", [0.5, 1.5, 15.0])
def test_a_surface_that_is_shifted_upwards_is_warned_of(shift):
    with_trees = plane() + shift
    with_trees[:, :4] += np.linspace(2.0, 9.0, 8)[:, None]
    with pytest.warns(UserWarning, match=f"{shift:.3g} m above the DEM on 60%"):
        read_terrain(array(plane()), array(with_trees))


def test_a_forest_without_a_gap_and_rounded_open_ground_are_not_warned_of():
    rng = np.random.default_rng(0)
    forest = plane(dtype=float) + rng.uniform(1.0, 20.0, (8, 10))
    read_terrain(array(plane()), array(forest))
    rounded = plane(dtype=float) + rng.uniform(-0.05, 0.05, (8, 10))
    assert float(read_terrain(array(plane()), array(rounded))["dsm"].mean()) > plane().mean()


def test_a_surface_below_the_ground_is_raised_and_counted():
    surface = plane() + 1.0
    surface[:, :2] -= 2.0
    with pytest.warns(UserWarning, match=r"20\.0%"):
        terrain = read_terrain(array(plane()), array(surface))
    assert float((terrain["dsm"] - terrain["dem"]).min()) == 0.0
    require_terrain(terrain)  # without another warning


def test_without_a_surface_it_is_the_ground(tif):
    with pytest.warns(UserWarning, match=r"no surface \(DSM\)") as said:
        terrain = read_terrain(tif)
    assert [w.filename for w in said if w.category is UserWarning] == [__file__]
    xr.testing.assert_equal(terrain["dem"], terrain["dsm"])


def test_south_up_and_east_first_rasters_are_turned_round(tmp_path):
    flipped = Affine(1.0, 0.0, 500_000.0, 0.0, 1.0, 5_000_000.0 - 8.0)
    path = write(tmp_path / "dem.tif", plane()[::-1].copy(), transform=flipped)
    np.testing.assert_allclose(read_terrain(path, path)["dem"], plane())
    mirrored = array(plane()).isel(x=slice(None, None, -1))
    np.testing.assert_allclose(read_terrain(mirrored, mirrored)["dem"], plane())


def test_rotated_grids_are_refused_and_rounding_is_no_rotation(tmp_path):
    turned = write(tmp_path / "turned.tif", plane(), transform=CORNER * Affine.rotation(10))
    with pytest.raises(TrustboError, match="rotated"):
        read_terrain(turned)
    rounded = Affine(1.0, 1e-16, 500_000.0, -1e-16, -1.0, 5_000_000.0)
    path = write(tmp_path / "rounded.tif", plane(np.nan), transform=rounded)
    assert_is_the_plane(read_terrain(path, path))


SITE = (
    'ENGCRS["site",EDATUM["corner"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],'
    'LENGTHUNIT["metre",1]]'
)


@pytest.mark.parametrize("crs", ["EPSG:2225", None, SITE])
def test_maps_in_feet_of_no_place_or_without_crs_are_refused(tmp_path, crs):
    path = write(tmp_path / "dem.tif", plane(), crs=crs)
    with pytest.raises(TrustboError):
        read_terrain(path)


@pytest.mark.parametrize("crs", ["EPSG:4978", "EPSG:5703"])
def test_crs_that_is_no_map_is_refused(tmp_path, crs):
    path = write(tmp_path / "dem.tif", plane(), crs=None)
    with pytest.raises(TrustboError):
        read_terrain(path, crs=crs)


def test_crs_is_for_rasters_without_one(tmp_path):
    path = write(tmp_path / "dem.tif", plane(), crs=None)
    assert read_terrain(path, path, crs=UTM).rio.crs.to_epsg() == 32633
    with pytest.raises(TrustboError, match="PROJ"):
        read_terrain(path, crs="nonsense")
    other = write(tmp_path / "other.tif", plane())
    read_terrain(other, other, crs=UTM)
    with pytest.raises(TrustboError, match="EPSG:32633"):
        read_terrain(other, crs="EPSG:32632")


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_rasters_without_a_place_are_refused(tmp_path):
    corners = [(0, 0, 0.0, 0.0), (0, 10, 10.0, 0.0), (8, 0, 0.0, -8.0)]
    points = [GroundControlPoint(r, c, 500_000.0 + x, 5_000_000.0 + y) for r, c, x, y in corners]
    gcps = points, rasterio.crs.CRS.from_epsg(32633)
    placed = write(tmp_path / "gcps.tif", plane(), crs=None, transform=None, gcps=gcps)
    bare = write(tmp_path / "bare.tif", plane(), crs=None, transform=Affine.identity())
    with pytest.raises(TrustboError, match="georeference"):
        read_terrain(bare, crs=UTM)
    with pytest.raises(TrustboError, match="control points"):
        read_terrain(placed)
    with pytest.raises(TrustboError, match="coordinates"):
        read_terrain(array(plane()).drop_vars(["x", "y"]))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_corners_are_no_remedy_for_rasters_of_a_camera(tmp_path):
    unit = [0.0, 0.0, 1.0, *[0.0] * 17]
    one = [1.0, *[0.0] * 19]
    rpcs = rasterio.rpc.RPC(
        height_off=100.0, height_scale=500.0, lat_off=45.0, lat_scale=0.1, line_den_coeff=one,
        line_num_coeff=unit, line_off=4.0, line_scale=4.0, long_off=15.0, long_scale=0.1,
        samp_den_coeff=one, samp_num_coeff=unit, samp_off=5.0, samp_scale=5.0,
    )  # fmt: skip
    raster = write(tmp_path / "rpcs.tif", plane(), crs=None, transform=None, rpcs=rpcs)
    with pytest.raises(TrustboError, match="RPC_DEM") as refused:
        read_terrain(raster)
    assert "a_ullr" not in str(refused.value)


@EQUAL_CANOPY
def test_degrees_are_warped_to_the_local_utm_zone():
    degrees = array(plane(shape=(60, 60)), "EPSG:4326", 1e-5, 15.0, 45.0)
    terrain = read_terrain(degrees, degrees + 2.0)
    assert terrain.rio.crs.to_epsg() == 32633
    height, width = pixel_size(terrain)
    assert height == pytest.approx(width)
    extent = float(terrain["x"].max() - terrain["x"].min())
    assert extent == pytest.approx(60e-5 * 111_320 * np.cos(np.pi / 4), rel=0.05)
    south = array(plane(shape=(60, 60)), "EPSG:4326", 1e-5, -70.0, -33.0)
    assert read_terrain(south, south).rio.crs.to_epsg() == 32719


@pytest.mark.parametrize(("west", "east"), [(-180.0003, 179.9997), (-170.0, 190.0)])
def test_longitudes_may_be_counted_past_180(west, east):
    both = [array(plane(shape=(60, 60)), "EPSG:4326", 1e-5, left, -16.0) for left in (east, west)]
    terrain = read_terrain(*both)
    assert float(terrain["dem"].notnull().mean()) > 0.95
    np.testing.assert_allclose(terrain["dem"], terrain["dsm"], atol=1e-6)


def test_coordinates_rounded_to_float32_are_even():
    degrees = array(plane(), "EPSG:4326", 1.0 / 3600.0, 15.0, 47.0)
    rounded = degrees.assign_coords({a: degrees[a].astype("float32") for a in ("y", "x")})
    assert read_terrain(rounded, rounded)["dem"].notnull().mean() > 0.5
    uneven = array(plane()).isel(x=[0, 1, 3, 4])
    with pytest.raises(TrustboError, match="evenly"):
        read_terrain(uneven)


@pytest.mark.parametrize(
    ("crs", "x", "y"),
    [("EPSG:3857", 1_669_792.0, 5_942_074.0), ("EPSG:3413", -2_167_296.0, 580_725.0),
     ("EPSG:2048", -18_584.0, 3_708_220.0), ("EPSG:3413", 418_708.0, -112_192.0)],
)  # fmt: skip
def test_maps_that_distort_or_are_turned_are_warped_to_north_up(crs, x, y):
    """Web Mercator, polar stereographic, South-oriented, and beyond 84 degrees north.

    The plane rises towards a known place, whose height the warped map must have.
    """
    source = array(plane(dtype=float, shape=(60, 60)) + 100.0, crs, 2.0, x, y)
    terrain = read_terrain(source, source)
    to_source = pyproj.Transformer.from_crs(terrain.rio.crs.to_wkt(), crs, always_xy=True)
    to_degrees = pyproj.Transformer.from_crs(terrain.rio.crs.to_wkt(), 4326, always_xy=True)
    n, m = terrain["dem"].shape
    for i, j in ((n // 2, m // 2), (n // 3, m // 2), (n // 2, m // 3)):
        u, v = to_source.transform(float(terrain["x"][j]), float(terrain["y"][i]))
        here = 200.0 + (u - x) / 2.0 + 2.0 * (v - y) / 2.0
        assert float(terrain["dem"][i, j]) == pytest.approx(here, abs=0.1)
    middle = float(terrain["x"][m // 2])
    (west, south), (east, north) = (
        to_degrees.transform(middle, float(terrain["y"][k])) for k in (-1, 0)
    )
    assert north > south
    assert abs(east - west) * np.cos(np.deg2rad(north)) < 0.1 * (north - south)


def test_national_grids_are_left_as_they_are():
    for crs, x, y in (("EPSG:2193", 1_800_000.0, 5_430_000.0), ("EPSG:3035", 4.4e6, 3.0e6)):
        source = array(plane(), crs, 1.0, x, y)
        terrain = read_terrain(source, source)
        np.testing.assert_array_equal(terrain["dem"], plane())
        assert terrain.rio.crs.to_string() == crs


@pytest.mark.parametrize(
    ("crs", "step", "x", "y"),
    [("EPSG:4326", 1.0, 500_000.0, 5_000_000.0), (UTM, 1.0, 5e9, 5e9), (UTM, 1e-4, 15.2, 47.1)],
)
def test_coordinates_of_another_crs_are_refused(crs, step, x, y):
    with pytest.raises(TrustboError, match="CRS"):
        read_terrain(array(plane(), crs, step, x, y))


def test_rasters_of_two_places_or_all_nodata_are_refused(tif):
    with pytest.raises(TrustboError, match="different areas"):
        read_terrain(tif, array(plane(), left=600_000.0))
    with pytest.raises(TrustboError, match="nodata"):
        read_terrain(tif, array(np.full((8, 10), np.nan)))


def test_what_is_no_raster_of_heights_is_refused(tmp_path, tif):
    (tmp_path / "notes.txt").write_text("no raster")
    damaged = write(tmp_path / "damaged.tif", np.random.default_rng(0).random((300, 300)))
    damaged.write_bytes(damaged.read_bytes()[:200_000])
    both = read_terrain(tif, tif)
    both.to_netcdf(tmp_path / "both.nc")
    for wrong in (
        tmp_path / "notes.txt", tmp_path / "absent.tif", damaged, tmp_path / "both.nc", plane(),
        write(tmp_path / "complex.tif", plane().astype("complex64"), dtype="complex_int16"),
        array(plane().astype(complex)), array(plane())[:1], array(plane()).expand_dims(t=2, b=3),
        array(plane()).rename(y="north", x="east"), array(plane())[:0],
    ):  # fmt: skip
        with pytest.raises(TrustboError):
            read_terrain(wrong)
    assert_is_the_plane(read_terrain(*[f"netcdf:{tmp_path / 'both.nc'}:dem"] * 2))
    for wrong in (both["dem"], both.drop_vars("dsm"), both.drop_vars("spatial_ref")):
        with pytest.raises(TrustboError):
            require_terrain(wrong)


def test_half_of_a_mosaic_at_zero_is_warned_of_and_level_ground_is_not():
    mosaic = plane(dtype=float)
    mosaic[:, 4:] = 0.0
    with pytest.warns(UserWarning, match=r"60\.0%"):
        read_terrain(array(mosaic), array(mosaic))
    hill = np.zeros((8, 10))
    hill[3:5, 4:6] = [[2.0, 30.0], [5.0, 12.0]]
    for level in (np.zeros((8, 10)), hill, np.where(hill > 0.0, 30.0, 0.0)):
        read_terrain(array(level), array(level))


@EQUAL_CANOPY
def test_ground_that_the_surface_does_not_cover_is_warned_of():
    surface = plane(dtype=float) + 2.0
    surface[:, 5:] = np.nan
    with pytest.warns(UserWarning, match=r"50\.0%"):
        terrain = read_terrain(array(plane()), array(surface))
    require_terrain(terrain)  # without another warning
    read_terrain(array(surface), array(plane() + 5.0))  # a surface that covers more


def test_a_coarse_surface_below_the_ground_is_told_from_another_datum():
    rough = plane(shape=(40, 40)) + 5.0 * np.random.default_rng(0).random((40, 40))
    coarse = array(plane(shape=(10, 10)), step=4.0, left=500_002.0, top=4_999_998.0)
    with pytest.warns(UserWarning, match="4 m") as said:
        read_terrain(array(rough), coarse)
    assert not any("datum" in str(w.message) for w in said)


@pytest.mark.filterwarnings("ignore:It is recommended to use 'rio.write_crs")
def test_what_rioxarray_s_accessor_holds_is_used():
    tagged = array(plane(-1.0), crs=None)
    tagged.rio.set_nodata(-1.0, inplace=True)
    tagged.rio.set_crs(UTM, inplace=True)
    assert_is_the_plane(read_terrain(tagged, tagged))


def test_fill_values_that_are_no_numbers_are_refused(tif):
    with pytest.raises(TrustboError, match="nodata"):
        read_terrain(tif, tif, nodata="none")
    with pytest.raises(TrustboError, match="missing_value"):
        read_terrain(array(plane()).assign_attrs(missing_value="none"))


def test_the_given_crs_is_that_of_the_raster_without_one(tif):
    latlon = array(plane(shape=(60, 60)), "EPSG:4326", 1e-5, 15.0, 45.0)
    bare = read_terrain(latlon, latlon)["dsm"].drop_vars("spatial_ref")
    bare = xr.DataArray(bare.values, {axis: bare[axis].values for axis in ("y", "x")}, ("y", "x"))
    terrain = read_terrain(latlon, bare, crs=UTM)
    np.testing.assert_allclose(terrain["dsm"], terrain["dem"], atol=0.01)


def test_errors_of_gdal_name_the_file_that_is_missing(tmp_path):
    place = '<GeoTransform>500000,1,0,5200000,0,-1</GeoTransform><VRTRasterBand dataType="Float32">'
    source = '<SimpleSource><SourceFilename relativeToVRT="1">tile_7.tif</SourceFilename>'
    vrt = tmp_path / "mosaic.vrt"
    vrt.write_text(
        f'<VRTDataset rasterXSize="8" rasterYSize="8"><SRS>{UTM}</SRS>{place}{source}'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with pytest.raises(TrustboError, match="tile_7"):
        read_terrain(vrt)
    tile = write(tmp_path / "tile.tif", np.random.default_rng(0).random((300, 300)))
    tile.write_bytes(tile.read_bytes()[:200_000])
    with (
        rioxarray.open_rasterio(tile) as lazy,
        pytest.raises(TrustboError, match="scanline"),
    ):
        read_terrain(lazy)


def test_tiles_in_a_list_or_a_folder_are_refused_with_the_remedy(tmp_path, tif):
    for tiles in ([tif, tif], tmp_path):
        with pytest.raises(TrustboError, match="gdalbuildvrt"):
            read_terrain(tiles)


def test_a_path_in_the_home_folder_is_expanded(tif, monkeypatch):
    monkeypatch.setenv("HOME", str(tif.parent))
    assert_is_the_plane(read_terrain("~/tif.tif", "~/tif.tif"))


def test_a_terrain_saved_and_opened_by_xarray_keeps_its_crs(tmp_path, tif):
    terrain = read_terrain(tif, tif)
    terrain.to_netcdf(tmp_path / "terrain.nc")
    with xr.open_dataset(tmp_path / "terrain.nc") as opened:
        assert require_terrain(opened).rio.crs.to_epsg() == 32633
        with pytest.raises(TrustboError, match="decode_coords"):
            require_terrain(opened.drop_vars("spatial_ref"))


def test_terrain_is_read_when_warnings_are_errors(tif):
    degrees = array(plane(shape=(60, 60)), "EPSG:4326", 1e-5, 15.0, 45.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_terrain(degrees, degrees)
        read_terrain(tif, array(plane() + 15.0, step=2.0, left=500_001.0, top=4_999_999.0))


def test_resolution_averages_whole_numbers_of_pixels(tmp_path, monkeypatch):
    values = np.random.default_rng(0).uniform(100.0, 200.0, (307, 300)).astype("float32")
    values[:30, :20] = values[30:60, :10] = -9999.0  # 2/3 and 1/3 of a block
    path = write(tmp_path / "dem.tif", values, nodata=-9999.0)
    terrain = read_terrain(path, path, resolution=30.2)
    blocks = np.where(values == -9999.0, np.nan, values)[:300].reshape(10, 30, 10, 30)
    mean = np.nanmean(blocks.astype(float), (1, 3))
    mean[0, 0] = np.nan  # over half is missing
    np.testing.assert_allclose(terrain["dem"], mean, rtol=1e-12)
    assert terrain.rio.bounds() == (500_000.0, 4_999_700.0, 500_300.0, 5_000_000.0)
    stripped = array(np.where(values == -9999.0, np.nan, values))
    np.testing.assert_array_equal(
        read_terrain(stripped, stripped, resolution=30.0)["dem"], terrain["dem"]
    )
    for wrong in (0.0, 200.0):
        with pytest.raises(TrustboError, match="resolution"):
            read_terrain(path, path, resolution=wrong)
    monkeypatch.setattr("trustbo.terrain.read.MOST_PIXELS", 1000.0)
    for large in (path, stripped):
        with pytest.raises(TrustboError, match="memory"):
            read_terrain(large)


@pytest.mark.parametrize("name", ["wellington", "tahoe", "bcts", "topography"])
def test_real_terrain_is_read_in_metres(name, real_terrain):
    terrain = read_terrain(*real_terrain(name))
    assert terrain.rio.crs.is_projected
    assert all(0.4 < side < 1.1 for side in pixel_size(terrain))
    assert (terrain["dsm"] >= terrain["dem"]).where(terrain["dem"].notnull(), True).all()


READERS = """
import warnings
warnings.simplefilter("ignore")
import rioxarray, sys, xarray
import trustbo as tb
from trustbo.workspace.grid import Grid

terrain = xarray.open_dataset(sys.argv[1], decode_coords="all")
grid = Grid((2, 2), 0.0, 60.0, 30.0, 30.0, crs="EPSG:32633")
maps = xarray.Dataset({"trust": (("row", "col"), [[0.0, 1.0], [2.0, 3.0]])})
for read in (
    lambda: tb.terrain.read_terrain("dem.tif"),
    lambda: tb.terrain.synthetic_terrain((60.0, 60.0)),
    lambda: tb.Workspace.from_terrain(terrain, (2, 2)),
    lambda: grid.place(maps),
):
    try:
        read()
        print("read")
    except tb.TrustboError as error:
        print("PROJ_DATA" in str(error) and "PROJ_LIB" in str(error))
"""


def test_data_of_another_proj_is_named(tmp_path):
    terrain_of(np.ones((60, 60))).to_netcdf(tmp_path / "terrain.nc")
    other = {"PROJ_LIB": str(tmp_path)}  # a folder without PROJ's database, as of another version
    command = [sys.executable, "-c", READERS, str(tmp_path / "terrain.nc")]
    done = subprocess.run(
        command, env=os.environ | other, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["True"] * 4, done.stderr
