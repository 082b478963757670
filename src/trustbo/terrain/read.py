"""Read a DEM and a DSM onto one metric grid.

Faulty rasters are rejected or corrected here: the rest of the package relies on heights in metres,
NaN where missing, on a metric grid with north at the top.
"""

import gc
import math
import re
import warnings
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from os.path import expanduser, isdir
from typing import Any

import numpy as np
import rasterio
import rioxarray  # noqa: F401  # the accessor `rio`
import xarray as xr
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader
from rioxarray.exceptions import MissingSpatialDimensionError

from trustbo.errors import TrustboError, require_kind, require_positive, see, warn
from trustbo.files import FilePath
from trustbo.terrain.heights import ACCESSOR_FILL, in_metres
from trustbo.terrain.pixels import pixel_size
from trustbo.terrain.place import (
    horizontal,
    on_metric_grid,
    pixel_side,
    placed,
    quiet_affine,
    require_map,
    require_proj,
    same_grid,
    vertical_axis,
)

MOST_PIXELS = 1e8  # per raster: about 3 GB while it is read
_LARGE = 1_000_000  # pixels; intermediate rasters of a larger terrain are freed at once
_CLIPPED = 0.02  # fraction of pixels with the surface below the ground that causes a warning
_NOISE = 0.1  # m: a surface that is less than this below the ground is due to resampling
_LOWEST = 0.02  # quantile of the canopy height that counts as its lowest value
_SHIFTED = 0.3  # m: a higher lowest value may be due to a vertical shift
_LEVEL = 0.3  # m above the lowest value within which canopy heights count as equal to it
_EQUAL = 0.3  # fraction of equal canopy heights above which a vertical shift is likely
_UNCOVERED = 0.02  # fraction of the DEM without a surface that causes a warning
_COARSER = 2.0  # ratio of pixel sizes from which the coarser raster smooths the heights
_TILES = "to read tiles as one raster, combine them: gdalbuildvrt -srcnodata -9999 all.vrt *.tif"
_ROUNDING = 1e-3  # of a pixel: smaller errors of a grid are rounding
_EXACT = 1e-6  # of a pixel: smaller errors of coordinates are left as they are
_BANDS = {"dem": {"dem", "dtm", "elevation"}, "dsm": {"dsm", "surface"}}
"""Names that identify a band of heights."""
_OF_BANDS = {"scales": "scale_factor", "offsets": "add_offset", "units": "units"}
"""Attributes with one entry for each band, and the corresponding attribute of one band."""
_TALL = 60.0  # m: a higher median of the canopy height is unlikely
_RAISED = 20.0  # m: a higher 5 % quantile of the canopy height is unlikely


def read_terrain(
    dem: FilePath | xr.DataArray,
    dsm: FilePath | xr.DataArray | None = None,
    *,
    crs: object = None,
    resolution: float | None = None,
    nodata: float | None = None,
) -> xr.Dataset:
    """Read a digital elevation model (ground) and a digital surface model (canopy, roofs).

    Both are resampled to the DEM's grid. The DEM is warped to its UTM zone (outside all zones, to a
    local transverse Mercator map) if it is in degrees, or if its map is rotated by over 22.5
    degrees or distorts lengths by over 1 %, as EPSG:3857 does. A surface below the ground is raised
    to the ground. If the band or the CRS declares feet, heights are converted to metres, with a
    warning; depths become negative heights.

    Args:
        dem: Heights: the path or address of a raster that GDAL reads (`/vsizip/...`,
            `https://...`), or a DataArray with coordinates and a CRS set by rioxarray. Of several
            bands, the one named "dem", "dtm" or "elevation" is read ("dsm" or "surface" for `dsm`),
            or else the first. NaN, infinity, nodata values and pixels hidden by a mask or an alpha
            band are missing; scale and offset are applied.
        dsm: Heights of the surface, in the same forms, on any grid that overlaps the DEM's. If it
            is omitted, the ground is used as the surface, and a warning is issued.
        crs: Coordinate reference system of rasters without one, e.g. `"EPSG:32633"`.
        resolution: Pixel size in metres; smaller pixels are averaged in square blocks of about
            this size, and incomplete blocks at the edge are dropped.
        nodata: Additional stored value that marks missing data.

    Returns:
        Dataset with `dem` and `dsm`, float64 in metres, dims (y, x) with north at the top, NaN
        where either has no data; the CRS is in `spatial_ref`.

    Raises:
        TrustboError: A source is not a raster of heights, is not georeferenced, or is too large for
            memory; values are impossible as heights on land; the vertical datums differ; or no
            pixel has both heights.

    Example:
        >>> terrain = tb.terrain.read_terrain("dem.tif", "dsm.tif", resolution=1.0)
    """
    require_proj()
    stored = [_stored(dem, "dem")]
    if dsm is not None:
        stored.append(_stored(dsm, "dsm"))

    terrain = _on_one_grid(stored, crs, nodata)
    del stored
    _free_rasters(terrain)
    if dsm is None:
        warn("no surface (DSM) is given, so no canopy is known: only the ground blocks sight.")
    else:
        _warn_of_shift(terrain)
    return terrain if resolution is None else _averaged(terrain, resolution)


def _on_one_grid(
    stored: Sequence[xr.DataArray], crs: object, nodata: float | None = None
) -> xr.Dataset:
    """Convert the stored values of a DEM and, if given, a DSM to a terrain on the DEM's grid.

    See `read_terrain` for the arguments and the result.
    """
    # If one raster has a CRS and the other has none, `crs` is that of the other.
    is_placed = [raster.rio.crs is not None for raster in stored]
    given = [crs if all(is_placed) or not own else None for own in is_placed]

    heights = [_heights(raster, own, nodata) for raster, own in zip(stored, given, strict=True)]
    ground = heights[0]
    surface = heights[-1]
    sides = pixel_side(ground), pixel_side(surface)

    datums = [heights.attrs["datum"] for heights in (ground, surface)]
    if all(datums) and datums[0] != datums[1]:
        raise TrustboError(
            f"{ground.name} has heights above {datums[0]!r}, but {surface.name} above "
            f"{datums[1]!r}; transform one of them, e.g. with gdalwarp -t_srs."
        )

    alike = same_grid(ground, surface)
    ground = on_metric_grid(ground)
    if not alike:
        with quiet_affine():
            surface = surface.rio.reproject_match(
                ground, resampling=Resampling.bilinear, nodata=np.nan
            )

    surface = on_metric_grid(surface)
    return _placed_on(_paired(ground, surface, sides), ground.rio.crs)


def require_terrain(terrain: xr.Dataset) -> xr.Dataset:
    """Check a user's dataset of `dem` and `dsm` as `read_terrain` does, and return the result.

    Raises TrustboError if `dem` or `dsm` is missing, or if `read_terrain` rejects the data.
    """
    remedy = "give a Dataset with dem and dsm over (y, x), as from read_terrain"
    if not {"dem", "dsm"} <= {*require_kind("terrain", terrain, xr.Dataset, remedy)}:
        raise TrustboError(f"the terrain has {', '.join(map(str, terrain))}; {remedy}.")

    require_proj()
    # The variable with the CRS is not a coordinate in a file that was opened by xarray.
    names = {terrain[name].attrs.get("grid_mapping", "spatial_ref") for name in ("dem", "dsm")}
    terrain = terrain.set_coords([name for name in names if name in terrain.variables])
    crs = terrain.rio.crs or terrain["dem"].rio.crs
    if crs is None:
        raise TrustboError(
            "the terrain has no coordinate reference system; open its file with "
            'decode_coords="all", or set it, e.g. with terrain.rio.write_crs("EPSG:32633"); '
            f"{see('howto/your-own-terrain')}."
        )

    stored = [_stored_array(terrain[name], name) for name in ("dem", "dsm")]
    checked = _on_one_grid(stored, crs).assign_attrs(terrain.attrs)
    del stored
    _free_rasters(checked)
    return checked


def _free_rasters(terrain: xr.Dataset) -> None:
    """Free the intermediate rasters of a large terrain.

    The accessor `rio` of an array refers to the array, so only the garbage collector frees it.
    """
    if terrain["dem"].size >= _LARGE:
        gc.collect()


def check_size(shape: tuple[int, ...], name: str) -> None:
    """Check that a raster fits into memory."""
    if math.prod(shape) > MOST_PIXELS:
        raise TrustboError(
            f"{name} has {shape} pixels, too many for the memory; crop it or use larger "
            "pixels, e.g. with gdalwarp -tr 5 5 -r average."
        )


def _heights(array: xr.DataArray, given: object, nodata: float | None) -> xr.DataArray:
    """Convert the stored values of a raster to heights in metres with north at the top.

    `given` is the CRS of a raster without one. The attribute `datum` is the vertical datum; None if
    none is declared.
    """
    name = str(array.name)
    crs = require_map(name, array.rio.crs, given)
    axis, datum = vertical_axis(crs)
    values = in_metres(array, axis, nodata)
    coords = {axis: array[axis].values for axis in ("y", "x")}
    heights = xr.DataArray(values, coords, name=name, attrs={"datum": datum})
    if coords["y"][0] < coords["y"][-1]:
        heights = heights.sortby("y", ascending=False)
    if coords["x"][0] > coords["x"][-1]:
        heights = heights.sortby("x")
    return placed(heights.rio.write_crs(horizontal(crs).to_string(), inplace=True), name)


def _stored(raster: FilePath | xr.DataArray, role: str) -> xr.DataArray:
    """Read stored values of a file or an array, dims (y, x), named after `role` in messages."""
    remedy = "give a path or a DataArray"
    if isinstance(raster, list | tuple):
        remedy = f"{remedy}; {_TILES}"
    require_kind(role, raster, str | PathLike | xr.DataArray, remedy)

    if isinstance(raster, xr.DataArray):
        return _stored_array(raster, role)

    path = expanduser(raster)
    name = f"{role}: {path!r}"
    if isdir(path):
        raise TrustboError(f"{name} is a folder; give the path of a raster. {_TILES}.")

    quiet = warnings.catch_warnings(action="ignore", category=NotGeoreferencedWarning)
    with _reading(name), quiet, rasterio.open(path) as file:
        return _of_array(_of_file(file, role, name), role, name)


def _stored_array(raster: xr.DataArray, role: str) -> xr.DataArray:
    """Read stored values of an array, dims (y, x), named after `role` in messages."""
    name = f"{role}: DataArray" + (f" {raster.name!r}" if raster.name else "")
    with _reading(name):
        return _of_array(raster, role, name).compute()  # reads the file of a lazy array


@contextmanager
def _reading(name: str) -> Iterator[None]:
    """Raise a TrustboError for an error of GDAL, with the message of its first cause.

    The first cause names the file or the block that cannot be read.
    """
    try:
        yield
    except RasterioError as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        message = str(cause).rstrip(".")
        raise TrustboError(f"{name} cannot be read by GDAL: {message}.") from None


def _of_file(file: DatasetReader, role: str, name: str) -> xr.DataArray:
    """Read the band of heights of a GDAL dataset, NaN where a mask or an alpha band hides a pixel.

    With a mask or an alpha band, GDAL's own mask ignores the nodata tag, so the tag is added to the
    declared fill values.
    """
    if not file.count:
        parts = ", ".join(file.subdatasets) or "nothing"
        raise TrustboError(f"{name} has no band; give one of its subdatasets: {parts}.")

    check_size(file.shape, name)
    t = file.transform
    shear_x = abs(t.b) * file.height  # over the whole raster
    shear_y = abs(t.d) * file.width
    turned = shear_x > _ROUNDING * abs(t.a) or shear_y > _ROUNDING * abs(t.e)
    if t.is_identity and file.rpcs is not None:
        raise TrustboError(
            f"{name} is placed only by the coefficients of its camera (RPCs), which need heights "
            "of the ground; warp it to a map, e.g. with gdalwarp -rpc -to RPC_DEM=ground.tif "
            "-t_srs EPSG:32633. Declared corners would put it elsewhere."
        )
    if t.is_identity or turned:
        raise TrustboError(
            f"{name} is not georeferenced, or only by control points or a rotated grid; warp it to "
            "a map, e.g. with gdalwarp -t_srs EPSG:32633, or declare its corners, e.g. with "
            "gdal_edit.py -a_ullr."
        )

    alpha = [k for k, colour in enumerate(file.colorinterp) if colour == ColorInterp.alpha]
    opaque = [k for k in range(file.count) if k not in alpha or k == 0]
    names = [file.descriptions[k] or "" for k in opaque]
    band = opaque[_band_of_heights(names, role)]

    colour = file.colorinterp[band]
    if colour not in (ColorInterp.undefined, ColorInterp.gray):
        raise TrustboError(
            f"{name} is a picture: its band {band + 1} has the colour {colour.name!r}; give a "
            "raster of heights, e.g. one of its bands, extracted with gdal_translate -b."
        )
    _warn_of_bands(names, band, name)

    stored = file.read(band + 1, masked=True)
    values = stored.astype(np.result_type(stored, np.float32)).filled(np.nan)

    for k in alpha:  # GDAL's mask ignores alpha bands of floats
        values[file.read(k + 1) == 0] = np.nan

    attrs = {
        "_FillValue": file.nodata, "scale_factor": file.scales[band],
        "add_offset": file.offsets[band], "units": file.units[band],
    }  # fmt: skip
    rows = np.arange(file.height) + 0.5
    cols = np.arange(file.width) + 0.5
    coords = {"y": t.f + rows * t.e, "x": t.c + cols * t.a}

    array = xr.DataArray(values, coords, ("y", "x"), attrs=attrs)
    return array if file.crs is None else array.rio.write_crs(file.crs, inplace=True)


def _band_of_heights(names: Sequence[str], role: str) -> int:
    """Return the index of the band whose name says that it has the heights of a role, or else 0.

    Args:
        names: Names of the bands, "" for bands without one.
        role: "dem" or "dsm".
    """
    words = [set(re.findall("[a-z]+", name.lower())) for name in names]
    named = [k for k, of_band in enumerate(words) if of_band & _BANDS[role]]
    return named[0] if len(named) == 1 else 0


def _warn_of_bands(names: Sequence[str], band: int, name: str) -> None:
    if len(names) > 1:
        listed = f" ({', '.join(text or 'unnamed' for text in names)})" if any(names) else ""
        warn(
            f"{name} has {len(names)} bands{listed}; band {band + 1} is used as heights. To use "
            "another one, give a DataArray, e.g. rioxarray.open_rasterio(file).sel(band=2)."
        )


def _band_names(array: xr.DataArray, dim: Hashable) -> list[str]:
    """Return the names of an array's bands: its labels, or descriptions as from rioxarray."""
    labels = array[dim].values.tolist()
    if all(isinstance(label, str) for label in labels):
        return labels

    descriptions = array.attrs.get("long_name")
    if isinstance(descriptions, tuple | list) and len(descriptions) == len(labels):
        return [text or "" for text in descriptions]
    return [""] * len(labels)


def _attrs_of_band(array: xr.DataArray) -> dict[Any, Any]:
    """Return the attributes of one band of an array; rioxarray stores tuples for all bands.

    The band is that of the coordinate `band`, which counts from 1 and remains after `sel`.
    """
    number = array.coords.get("band")
    is_known = number is not None and number.ndim == 0 and number.dtype.kind in "iu"
    band = int(number) - 1 if number is not None and is_known else 0

    attrs = dict(array.attrs)
    for several, one in _OF_BANDS.items():
        values = attrs.get(several)
        if isinstance(values, tuple | list) and band < len(values):
            attrs[one] = values[band]
    return attrs


def _of_array(array: xr.DataArray, role: str, name: str) -> xr.DataArray:
    """Reduce an array to dims (y, x), evenly spaced, and to the band of heights."""
    check_size(array.shape, name)

    # The operations below drop rioxarray's accessor, and with it what its methods have set.
    crs = array.rio.crs
    fill = _accessor_fill(array)

    try:
        y = array.rio.y_dim
        x = array.rio.x_dim
    except MissingSpatialDimensionError:
        y = "lat"
        x = "lon"

    bands = [dim for dim in array.dims if dim not in (y, x)]
    if not {y, x} <= set(array.dims) & set(array.coords) or len(bands) > 1 or not array.size:
        raise TrustboError(
            f"{name} has axes {dict(array.sizes)}; it needs rows and columns, named (y, x), with "
            "coordinates, and at most one axis of bands. A rotated grid has no such coordinates; "
            "warp it, e.g. with array.rio.reproject."
        )

    if bands:
        names = _band_names(array, bands[0])
        band = _band_of_heights(names, role)
        _warn_of_bands(names, band, name)
        array = array.isel({bands[0]: band})
    array = array.transpose(y, x).assign_attrs(_attrs_of_band(array))

    rows, cols = (_even(array[axis].values, f"{name}'s {axis}") for axis in (y, x))
    if (unit := str(array[x].attrs.get("units")).lower()).startswith(("k", "f", "us", "rad")):
        raise TrustboError(f"{name} has x in {unit!r}; convert x and y to metres.")

    array = array.rename({y: "y", x: "x"}).assign_coords(y=rows, x=cols).rename(name)
    array = array.assign_attrs({ACCESSOR_FILL: fill})
    return array if crs is None else array.rio.write_crs(crs, inplace=True)


def _accessor_fill(array: xr.DataArray) -> float | None:
    """Return the fill value of rioxarray's accessor, as from `set_nodata`; None if there is none.

    A fill value that the array's type cannot hold does not occur in the array.
    """
    try:
        return array.rio.nodata
    except (OverflowError, TypeError, ValueError):
        return None


def _even(values: np.ndarray, what: str) -> np.ndarray:
    """Return evenly spaced coordinates; raises TrustboError if they are uneven or fewer than two.

    Coordinates that were stored as float32 are rounded to 0.5 m in the north of a UTM zone.
    """
    given = values.astype(float)
    if len(given) < 2:
        raise TrustboError(f"{what} has one value; a terrain needs at least two rows and columns.")

    even = np.linspace(given[0], given[-1], len(given))
    step = abs(even[1] - even[0])
    off = np.abs(given - even).max()

    single = (given.astype(np.float32) == given).all()
    rounding = 2.0 * np.finfo(np.float32).eps * np.abs(given).max() if single else 0.0
    if not off <= max(_ROUNDING * step, min(rounding, 0.5 * step)) or step == 0.0:
        raise TrustboError(f"{what} is not evenly spaced; resample it to a regular grid.")
    return given if off <= _EXACT * step else even


def _paired(ground: xr.DataArray, surface: xr.DataArray, sides: tuple[float, float]) -> xr.Dataset:
    """Combine two rasters on one grid, with common NaN and no surface below the ground.

    `sides` are the sides of their pixels before they were brought onto one grid, in metres.
    """
    dem = ground.values
    dsm = surface.values

    valid = np.isfinite(dem) & np.isfinite(dsm)
    if not valid.any():
        raise TrustboError(
            "no pixel has both a DEM and a DSM height: the rasters cover different areas, or one "
            "is all nodata where they overlap."
        )

    uncovered = 1.0 - valid.sum() / np.isfinite(dem).sum()
    if uncovered > _UNCOVERED:
        warn(
            f"the DSM has no height on {uncovered:.1%} of the DEM's pixels; these pixels count as "
            f"missing, and robots cannot cross them. Give a DSM that covers the DEM; {_TILES}."
        )

    canopy = (dsm - dem)[valid]
    if (share := (canopy < -_NOISE).mean()) > _CLIPPED:
        check = "both have the same vertical datum and that they are not swapped"
        if max(sides) >= _COARSER * min(sides):
            check = (
                f"both have similar pixels: the DEM's have {sides[0]:.3g} m and the DSM's "
                f"{sides[1]:.3g} m, and the coarser raster smooths the heights"
            )
        warn(
            f"the DSM lies below the DEM on {share:.1%} of pixels; it is raised to the DEM there. "
            f"Check that {check}."
        )

    low, middle = np.quantile(canopy, [0.05, 0.5], overwrite_input=True)
    del canopy
    if low > _RAISED or middle > _TALL:
        warn(
            f"the DSM lies {middle:.3g} m above the DEM in the median, and over {low:.3g} m nearly "
            "everywhere: check that both have the same unit and the same vertical datum."
        )

    dsm = np.fmax(dem, dsm)
    dsm[~valid] = np.nan
    heights = {"dem": np.where(valid, dem, np.nan), "dsm": dsm}
    maps = {name: (("y", "x"), z, {"units": "m"}) for name, z in heights.items()}
    return xr.Dataset(maps, {axis: ground[axis].values for axis in ("y", "x")})


def _warn_of_shift(terrain: xr.Dataset) -> None:
    """Warn if the DSM seems to be shifted upwards: in a forest, canopy heights are not so equal."""
    canopy = (terrain["dsm"] - terrain["dem"]).values
    canopy = canopy[np.isfinite(canopy)]

    lowest = np.quantile(canopy, _LOWEST, overwrite_input=True)
    share = (canopy < lowest + _LEVEL).mean()
    if _SHIFTED < lowest <= _RAISED and share > _EQUAL:
        warn(
            f"the DSM lies {lowest:.3g} m above the DEM on {share:.0%} of pixels, and nearly "
            "nowhere lower: check that both have the same vertical datum. Open ground at this "
            "height would count as canopy and block sight."
        )


def _averaged(terrain: xr.Dataset, resolution: float) -> xr.Dataset:
    """Average square blocks of side `resolution`, m; NaN if over half of a block is missing."""
    side = require_positive("resolution", resolution)
    shape = terrain["dem"].shape
    tall, wide = (max(1, round(side / pixel)) for pixel in pixel_size(terrain))

    if shape[0] < 2 * tall or shape[1] < 2 * wide:
        raise TrustboError(f"{shape} pixels are too few for {tall} x {wide}; reduce resolution=.")

    squares: Any = terrain.coarsen(y=tall, x=wide, boundary="trim")
    mean = squares.mean().where(2 * squares.count() >= tall * wide)
    return _placed_on(mean, terrain.rio.crs)


def _placed_on(terrain: xr.Dataset, crs: Any) -> xr.Dataset:
    """Store the CRS, and the position and the size of the pixels in it, in a new terrain."""
    terrain = terrain.rio.write_crs(crs, inplace=True)
    with quiet_affine():
        return terrain.rio.write_transform(terrain.rio.transform(recalc=True), inplace=True)
