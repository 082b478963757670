"""Read a DEM and a DSM onto one metric grid.

Faulty rasters are rejected or corrected here: the rest of the package relies on heights in metres,
NaN where missing, on a metric grid with north at the top.
"""

import math
import os
import re
import warnings
from contextlib import nullcontext
from os import PathLike
from typing import Any

import numpy as np
import rasterio
import rioxarray  # noqa: F401  # the accessor `rio`
import xarray as xr
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader
from rasterio.vrt import WarpedVRT
from rioxarray.exceptions import MissingSpatialDimensionError

from trustbo.errors import TrustboError, require_positive
from trustbo.files import FilePath
from trustbo.terrain.heights import Coding, decoded, vertical_of, warn, warn_of_zeros
from trustbo.terrain.place import (
    horizontal,
    known_crs,
    on_metric_grid,
    placed,
    require_map,
    same_grid,
    vertical_axis,
)

type RasterLike = FilePath | DatasetReader | WarpedVRT | xr.DataArray

_MOST_PIXELS = 1e8  # of a raster: some 3 GB while it is read
_CLIPPED = 0.02  # share of pixels with the surface below the ground, above which a warning is due
_TALL, _RAISED = 60.0, 20.0  # m: unlikely medians and 5 % quantiles of canopy heights
_DEGREE = 111_195.0  # of latitude, m
_FILL_NAMES = ("_FillValue", "missing_value", "fill_value", "nodata")
_HEIGHT_BANDS = re.compile(r"elev|height|altitude|\b(dem|dsm|dtm)\b", re.IGNORECASE)


def read_terrain(
    dem: RasterLike,
    dsm: RasterLike | None = None,
    *,
    crs: object = None,
    resolution: float | None = None,
    nodata: float | None = None,
) -> xr.Dataset:
    """Read a digital elevation model (ground) and a digital surface model (canopy, roofs).

    Both are resampled to the DEM's grid. The DEM is warped to its UTM zone (outside all zones, to a
    local transverse Mercator map) if it is in degrees, or if its map is rotated from north or wrong
    in length by over 1 %, as EPSG:3857 is. The surface is raised to the ground where it is below.
    Heights in feet, according to the band or the CRS, are converted to metres, with a warning;
    depths become negative heights.

    Args:
        dem: Heights: a path or an address of a raster that GDAL reads (`/vsizip/...`,
            `https://...`), an open rasterio dataset, or a DataArray with coordinates and a CRS of
            rioxarray. Of several bands, the one described as elevation is read, else the first.
            NaN, infinity, nodata values and pixels hidden by a mask or an alpha band are missing;
            scale and offset are applied.
        dsm: Heights of the surface, in the same forms, on any grid that overlaps the DEM's. Without
            it, the surface is the ground, with a warning.
        crs: Coordinate reference system of rasters without one, e.g. `"EPSG:32633"`.
        resolution: Pixel size in metres: rasters with smaller pixels are averaged over whole
            numbers of pixels, to about this size.
        nodata: Another stored value that marks missing data.

    Returns:
        Dataset with `dem` and `dsm`, float64 in metres, dims (y, x) with north at the top, NaN
        where one of the two has no data; the CRS is in `spatial_ref`. The attribute
        `clipped_share` is the share of pixels whose surface was raised.

    Raises:
        TrustboError: A source is not a raster of heights, is not georeferenced, or is too large for
            the memory; values are impossible as heights on land; the vertical datums differ; no
            pixel has both heights.

    Example:
        >>> terrain = tb.terrain.read_terrain("dem.tif", "dsm.tif", resolution=1.0)
    """
    given = None if crs is None else known_crs(crs)
    ground = _heights(dem, "dem", given, resolution, nodata)
    heights = on_metric_grid(ground)
    if dsm is None:
        warn("no surface (DSM) is given, so no canopy is known: only the ground blocks sight.")
        return _paired(heights, heights)
    surface = _heights(dsm, "dsm", given, resolution, nodata)
    datums = [heights.attrs["datum"] for heights in (ground, surface)]
    if all(datums) and datums[0] != datums[1]:
        raise TrustboError(
            f"{ground.name} has heights above {datums[0]!r}, but {surface.name} above "
            f"{datums[1]!r}; transform one of them, e.g. with gdalwarp -t_srs."
        )
    if same_grid(surface, ground):
        surface = on_metric_grid(surface)  # exactly as the ground was
    if not same_grid(heights, surface):
        how = Resampling.bilinear
        surface = surface.rio.reproject_match(heights, resampling=how, nodata=np.nan)
    return _paired(heights, surface)


def require_terrain(terrain: xr.Dataset) -> xr.Dataset:
    """Check a user's dataset of `dem` and `dsm` as `read_terrain` does, and return the result.

    TrustboError: `dem` or `dsm` is missing, or `read_terrain` rejects the data.
    """
    if not isinstance(terrain, xr.Dataset) or not {"dem", "dsm"} <= set(terrain.data_vars):
        raise TrustboError(
            "a terrain is a Dataset with dem and dsm over (y, x), as read_terrain gives it; got "
            f"{type(terrain).__name__}."
        )
    read = read_terrain(terrain["dem"], terrain["dsm"], crs=terrain.rio.crs)
    clipped = max(read.attrs["clipped_share"], terrain.attrs.get("clipped_share", 0.0))
    return read.assign_attrs(terrain.attrs, clipped_share=clipped)


def pixel_size(terrain: xr.Dataset) -> tuple[float, float]:
    """Pixel height and width in metres."""
    y, x = (terrain.variables[axis].values for axis in ("y", "x"))
    return abs(float(y[-1] - y[0])) / (len(y) - 1), abs(float(x[-1] - x[0])) / (len(x) - 1)


# --- one raster ---


def _heights(
    raster: RasterLike,
    role: str,
    given: CRS | None,
    resolution: float | None,
    nodata: float | None,
) -> xr.DataArray:
    """Heights of one raster, dem or dsm, in metres with north up, averaged to a resolution.

    The attribute `datum` is the vertical datum, None if nothing declares one.
    """
    array = _stored(raster, role)
    name = str(array.name)
    crs = require_map(name, array.rio.crs, given)
    vertical = vertical_of(name, array.attrs.get("units"), vertical_axis(crs))
    if abs(vertical.metres) != 1.0:
        warn(f"{name} has heights in {vertical.unit!r}; they are converted to metres.")

    def note(default: float, *names: str) -> float:
        found = [array.attrs[one] for one in names if one in array.attrs]
        return _number(names[0], np.ravel(found[0])[0]) if found else default

    fills = _declared_fills(array)
    if nodata is not None:
        fills = *fills, _number("nodata", nodata)
    scale, offset = note(1.0, "scale_factor", "scales"), note(0.0, "add_offset", "offsets")
    coding = Coding(name, fills, scale, offset, vertical.metres)
    coords = {axis: array[axis].values for axis in ("y", "x")}
    heights = xr.DataArray(decoded(array.to_numpy(), coding), coords, name=name)
    heights = _averaged(heights, crs.is_geographic, resolution)
    warn_of_zeros(heights.values, name)
    heights = heights.sortby("y", ascending=False).sortby("x").assign_attrs(datum=vertical.datum)
    return placed(heights.rio.write_crs(horizontal(crs)), name)


def _averaged(heights: xr.DataArray, in_degrees: bool, resolution: float | None) -> xr.DataArray:
    """Means over square blocks of about a resolution, m; NaN if over half of a block is missing.

    Incomplete blocks at the edge are dropped.
    """
    if resolution is None:
        return heights
    side = abs(float(heights["y"][1] - heights["y"][0])) * (_DEGREE if in_degrees else 1.0)
    factor = max(1, round(require_positive("resolution", resolution) / side))
    if min(heights.shape) < 2 * factor:
        raise TrustboError(
            f"{heights.name} has {heights.shape} pixels, too few to average {factor} x {factor}; "
            "lower resolution=."
        )
    squares: Any = heights.coarsen(y=factor, x=factor, boundary="trim")
    return squares.mean().where(2 * squares.count() >= factor**2)


# --- what is stored ---


def _stored(raster: RasterLike, role: str) -> xr.DataArray:
    """Stored values of any kind of raster, dims (y, x); its name, with `role`, is for messages."""
    if isinstance(raster, xr.DataArray):
        name = f"{role}: DataArray" + (f" {raster.name!r}" if raster.name else "")
        check_size(raster.shape, name)
        return _of_array(raster, name)
    if isinstance(raster, str | PathLike):
        name = f"{role}: {os.fspath(raster)!r}"
    elif isinstance(raster, DatasetReader | WarpedVRT):
        name = f"{role}: {raster.name!r}"
    else:
        raise TrustboError(
            f"{role} must be a path, an open rasterio dataset or an xarray.DataArray; got "
            f"{type(raster).__name__}."
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            is_open = isinstance(raster, DatasetReader | WarpedVRT)
            opened = nullcontext(raster) if is_open else rasterio.open(raster)
        with opened as file:
            check_size(file.shape, name)
            return _of_array(_of_file(file, name), name)
    except RasterioError as error:
        raise TrustboError(f"{name} cannot be read by GDAL: {error}.") from None


def check_size(shape: tuple[int, ...], name: str) -> None:
    """Check that a raster fits into memory."""
    if math.prod(shape) > _MOST_PIXELS:
        raise TrustboError(
            f"{name} has {shape} pixels, too many for the memory; take a part of it or a larger "
            "resolution, e.g. with gdalwarp -tr 5 5 -r average."
        )


def _of_file(file: DatasetReader | WarpedVRT, name: str) -> xr.DataArray:
    """Height band of a GDAL dataset: the band described as elevation, else the first.

    Pixels hidden by a mask or an alpha band are NaN. With these, GDAL's own mask ignores the nodata
    tag, so the tag is added to the declared fills.
    """
    if not file.count:
        parts = ", ".join(file.subdatasets) or "nothing"
        raise TrustboError(f"{name} has no band of its own; give one of its parts: {parts}.")
    t = file.transform
    # Less than a thousandth of a pixel over the whole raster is rounding.
    turned = abs(t.b) * file.height > 1e-3 * abs(t.a) or abs(t.d) * file.width > 1e-3 * abs(t.e)
    if t.is_identity or turned:
        raise TrustboError(
            f"{name} has no georeference, or one by control points or a rotated grid; warp it to a "
            "map, e.g. with gdalwarp -t_srs EPSG:32633, or declare its corners, e.g. with "
            "gdal_edit.py -a_ullr."
        )
    colours = dict(enumerate(file.colorinterp, 1))
    alpha = [k for k, colour in colours.items() if colour == ColorInterp.alpha]
    bands = [k for k in colours if k not in alpha] or [1]
    named = [k for k in bands if _HEIGHT_BANDS.search(file.descriptions[k - 1] or "")]
    band = named[0] if len(named) == 1 else bands[0]
    if colours[band] not in (ColorInterp.undefined, ColorInterp.gray):
        raise TrustboError(
            f"{name} is a picture: band {band} has the colour {colours[band].name!r}; give a "
            "raster of heights."
        )
    if len(named) != 1:
        _warn_of_bands(len(bands), name)
    if file.dtypes[band - 1].startswith("complex"):
        raise TrustboError(f"{name} holds complex numbers, no heights; give real numbers.")
    stored = file.read(band, masked=True)
    values = stored.astype(np.result_type(stored, np.float32)).filled(np.nan)
    for k in alpha:  # GDAL's mask knows no alpha band of floats
        values[file.read(k) == 0] = np.nan
    names = {
        "_FillValue": file.nodatavals, "scale_factor": file.scales, "add_offset": file.offsets,
        "units": file.units,
    }  # fmt: skip
    attrs = {key: of_bands[band - 1] for key, of_bands in names.items()}
    rows, cols = np.arange(file.height) + 0.5, np.arange(file.width) + 0.5
    coords = {"y": t.f + rows * t.e, "x": t.c + cols * t.a}
    array = xr.DataArray(values, coords, ("y", "x"), attrs=attrs)
    return array if file.crs is None else array.rio.write_crs(file.crs)


def _warn_of_bands(n: int, name: str) -> None:
    if n > 1:
        warn(f"{name} has {n} bands; the first is taken as heights.")


def _of_array(array: xr.DataArray, name: str) -> xr.DataArray:
    """Array of dims (y, x), evenly spaced; of several bands, the first."""
    try:
        y, x = array.rio.y_dim, array.rio.x_dim
    except MissingSpatialDimensionError:
        y, x = "lat", "lon"
    bands = [dim for dim in array.dims if dim not in (y, x)]
    if not {y, x} <= set(array.dims) & set(array.coords) or len(bands) > 1 or not array.size:
        raise TrustboError(
            f"{name} has axes {dict(array.sizes)}; need rows and columns, named (y, x), with "
            "coordinates, and one axis of bands at most."
        )
    _warn_of_bands(max([array.sizes[dim] for dim in bands], default=1), name)
    array = array.isel(dict.fromkeys(bands, 0)).transpose(y, x)
    rows, cols = (_even(array[axis].values, f"{name}'s {axis}") for axis in (y, x))
    return array.rename({y: "y", x: "x"}).assign_coords(y=rows, x=cols).rename(name)


def _declared_fills(array: xr.DataArray) -> tuple[float, ...]:
    """Values declared missing by attributes, and by an encoding without a scale."""
    notes = [array.attrs]
    # An encoding has been applied: with a scale, its fill value is no height.
    if not {"scale_factor", "add_offset", "scales", "offsets"} & set(array.encoding):
        notes.append(array.encoding)
    tags = [tag for note in notes for key in _FILL_NAMES for tag in np.ravel(note.get(key, []))]
    return tuple(_number("nodata", tag) for tag in tags if tag is not None)


def _even(values: np.ndarray, what: str) -> np.ndarray:
    """Evenly spaced coordinates; TrustboError if only one, or uneven by more than rounding.

    Coordinates that passed through float32 are rounded to 0.5 m in the north of a UTM zone.
    """
    given = values.astype(float)
    if len(given) < 2:
        raise TrustboError(f"{what} has one value; a terrain needs two rows and columns at least.")
    even = np.linspace(given[0], given[-1], len(given))
    step, off = abs(even[1] - even[0]), np.abs(given - even).max()
    single = (given.astype(np.float32) == given).all()
    rounding = 2.0 * np.finfo(np.float32).eps * np.abs(given).max() if single else 0.0
    if not off <= max(1e-3 * step, min(rounding, 0.5 * step)) or step == 0.0:
        raise TrustboError(f"{what} is not evenly spaced; resample it to a regular grid.")
    return given if off <= 1e-6 * step else even


def _number(what: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise TrustboError(f"{what} must be a number; got {value!r}.") from None


# --- the pair ---


def _paired(ground: xr.DataArray, surface: xr.DataArray) -> xr.Dataset:
    """Combine two rasters on one grid: common NaN, and no surface below the ground."""
    dem, dsm = ground.values, surface.values
    valid = np.isfinite(dem) & np.isfinite(dsm)
    if not valid.any():
        raise TrustboError(
            "no pixel has both a DEM and a DSM height: they are of two places, or one of them is "
            "all nodata where they overlap."
        )
    canopy = (dsm - dem)[valid]
    clipped = float((canopy < 0.0).mean())
    if clipped > _CLIPPED:
        warn(
            f"the DSM lies below the DEM on {clipped:.1%} of pixels; it is raised to the DEM "
            "there. Check that both share one vertical datum."
        )
    low, middle = np.quantile(canopy, [0.05, 0.5])
    if low > _RAISED or middle > _TALL:
        warn(
            f"the DSM lies {middle:.3g} m above the DEM in the median, and over {low:.3g} m nearly "
            "everywhere: check that both share one unit and one vertical datum."
        )
    heights = {"dem": ("ground", dem), "dsm": ("surface", np.fmax(dem, dsm))}
    maps = {
        name: (("y", "x"), np.where(valid, z, np.nan), {"long_name": long_name, "units": "m"})
        for name, (long_name, z) in heights.items()
    }
    coords = {axis: ground[axis].values for axis in ("y", "x")}
    terrain = xr.Dataset(maps, coords, {"clipped_share": clipped}).rio.write_crs(ground.rio.crs)
    return terrain.rio.write_transform(terrain.rio.transform(recalc=True))
