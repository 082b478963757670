"""Reading of a DEM and a DSM onto one metric grid.

Whatever is wrong with a raster is refused or put right here, where it enters: the rest of the
package relies on heights in metres, NaN where missing, on a grid of metres with north at the top.
"""

import math
import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import rasterio
import rioxarray  # noqa: F401  # the accessor `rio`
import xarray as xr
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window
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

_MOST_PIXELS = 1e8  # of a raster in memory: 0.8 GB
_STRIP = 2**23  # pixels that are read together
_CLIPPED = 0.02  # share of pixels with the surface below the ground, above which a warning is due
_TALL, _RAISED = 60.0, 20.0  # m: unlikely medians and 5 % quantiles of canopy heights
_DEGREE = 111_195.0  # of latitude, m
_FILL_NAMES = ("_FillValue", "missing_value", "fill_value", "nodata")
_HEIGHT_BANDS = re.compile(r"elev|height|altitude|\b(dem|dsm|dtm)\b", re.IGNORECASE)


class _Source(NamedTuple):
    """A raster as it is stored."""

    name: str  # for messages
    y: np.ndarray  # of rows, in the CRS
    x: np.ndarray  # of columns
    crs: Any  # None if it has none
    coding: Coding
    unit: object  # as declared
    read: Callable[[slice], tuple[np.ndarray, np.ndarray | None]]  # rows: values, hidden pixels


class _Raster(NamedTuple):
    """Heights in metres, north up."""

    name: str
    heights: xr.DataArray  # dims (y, x), with a horizontal CRS
    datum: str | None  # vertical datum, if declared


def read_terrain(
    dem: RasterLike,
    dsm: RasterLike | None = None,
    *,
    crs: object = None,
    resolution: float | None = None,
    nodata: float | None = None,
) -> xr.Dataset:
    """Read a digital elevation model (ground) and a digital surface model (canopy, roofs).

    Both are put on the DEM's grid. If the DEM is in degrees, or its map is over 1 % off in lengths
    (as web maps' EPSG:3857 is) or turned from north, it is warped to its UTM zone, or beyond the
    zones to a transverse Mercator map of its own. The surface is raised to the ground where it is
    below. Heights in feet, by their band or their CRS, are converted to metres, with a warning;
    depths become negative heights.

    Args:
        dem: Heights: a path or an address of a raster that GDAL reads (`/vsizip/...`,
            `https://...`), an open rasterio dataset, or a DataArray with coordinates and a CRS of
            rioxarray. Of several bands, the one described as elevation is read, else the first.
            NaN, infinity, nodata values and pixels hidden by a mask or an alpha band are missing;
            scale and offset are applied.
        dsm: Heights of the surface, likewise, on any grid that overlaps the DEM's. Without one,
            the surface is the ground (a warning).
        crs: Coordinate reference system of rasters without one, e.g. `"EPSG:32633"`.
        resolution: Pixel size in metres: rasters with smaller pixels are averaged over whole
            numbers of pixels, to about this size.
        nodata: Another stored value that means missing.

    Returns:
        Dataset with `dem` and `dsm`, float64 in metres, dims (y, x) with north at the top, NaN
        where one of the two has no data; the CRS is in `spatial_ref`. The attribute
        `clipped_share` is the share of pixels whose surface was raised.

    Raises:
        TrustboError: A source that is no raster of heights, has no place on Earth, or is too large
            for the memory; values that are no heights on land; two vertical datums; no pixel with
            both heights.

    Example:
        >>> terrain = tb.terrain.read_terrain("dem.tif", "dsm.tif", resolution=1.0)
    """
    given = None if crs is None else known_crs(crs)
    ground = _heights(dem, "dem", given, resolution, nodata)
    heights = on_metric_grid(ground.heights)
    if dsm is None:
        warn("no surface (DSM) is given, so no canopy is known: only the ground blocks sight.")
        return _paired(heights, heights)
    surface = _heights(dsm, "dsm", given, resolution, nodata)
    if ground.datum and surface.datum and ground.datum != surface.datum:
        raise TrustboError(
            f"{ground.name} has heights above {ground.datum!r}, but {surface.name} above "
            f"{surface.datum!r}; transform one of them, e.g. with gdalwarp -t_srs."
        )
    above = surface.heights
    if same_grid(above, ground.heights):
        above = on_metric_grid(above)  # exactly as the ground was
    if not same_grid(heights, above):
        above = above.rio.reproject_match(heights, resampling=Resampling.bilinear, nodata=np.nan)
    return _paired(heights, above)


def require_terrain(terrain: xr.Dataset) -> xr.Dataset:
    """Check a user's dataset of `dem` and `dsm` as `read_terrain` does, and return what it gives.

    TrustboError: no `dem` or `dsm`, or what `read_terrain` refuses.
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
) -> _Raster:
    """Read the heights of one raster, dem or dsm, averaged to a resolution."""
    with _opened(raster, role) as source:
        crs, coding = require_map(source.name, source.crs, given), source.coding
        vertical = vertical_of(source.name, source.unit, vertical_axis(crs))
        if abs(vertical.metres) != 1.0:
            warn(f"{source.name} has heights in {vertical.unit!r}; they are converted to metres.")
        if nodata is not None:
            coding = coding._replace(fills=(*coding.fills, _number("nodata", nodata)))
        factor = _factor(source, crs.is_geographic, resolution)
        try:
            heights = _averaged(source, coding._replace(metres=vertical.metres), factor)
        except RasterioError as error:
            raise TrustboError(f"{source.name} is damaged or out of reach: {error}.") from None
    if not heights.notnull().any():
        raise TrustboError(f"{source.name} is all nodata; check its nodata value.")
    warn_of_zeros(heights.values, source.name)
    heights = heights.sortby("y", ascending=False).sortby("x")
    heights = placed(heights.rio.write_crs(horizontal(crs)), source.name)
    return _Raster(source.name, heights, vertical.datum)


def _averaged(source: _Source, coding: Coding, factor: int) -> xr.DataArray:
    """Means of `factor` x `factor` pixels, strip by strip; over half missing make one missing.

    Rows and columns at the edge that fill no such square are left out.
    """
    strips: list[xr.DataArray] = []
    step = factor * max(1, _STRIP // (factor * len(source.x)))
    for top in range(0, len(source.y) // factor * factor, step):
        rows = slice(top, top + step)
        stored, hidden = source.read(rows)
        coords = {"y": source.y[rows], "x": source.x}
        strip = xr.DataArray(decoded(stored, coding, hidden, top), coords, ("y", "x"))
        if factor > 1:
            squares: Any = strip.coarsen(y=factor, x=factor, boundary="trim")
            strip = squares.mean().where(2 * squares.count() >= factor**2)
        strips.append(strip)
    return xr.concat(strips, "y")


def _factor(source: _Source, is_geographic: bool, resolution: float | None) -> int:
    """Number of pixels along a side that are averaged to one; checks the number of pixels."""
    shape, factor = (len(source.y), len(source.x)), 1
    size = f"{source.name} has {shape[0]} x {shape[1]} pixels"
    if min(shape) < 2:
        raise TrustboError(f"{size}; a terrain needs at least two rows and two columns.")
    if resolution is not None:
        side = abs(source.y[1] - source.y[0]) * (_DEGREE if is_geographic else 1.0)
        factor = max(1, round(require_positive("resolution", resolution) / side))
    if min(shape) < 2 * factor:
        raise TrustboError(f"{size}, too few to average {factor} x {factor}; lower resolution=.")
    if math.prod(shape) > _MOST_PIXELS * factor**2:
        raise TrustboError(f"{size}, too many for the memory; average them by resolution=, in m.")
    return factor


# --- what is stored ---


@contextmanager
def _opened(raster: RasterLike, role: str) -> Iterator[_Source]:
    """Open a raster of any kind; `role`, dem or dsm, is for messages."""
    if isinstance(raster, xr.DataArray):
        yield _of_array(raster, f"{role}: DataArray" + (f" {raster.name!r}" if raster.name else ""))
    elif isinstance(raster, DatasetReader | WarpedVRT):
        yield _of_file(raster, f"{role}: {raster.name!r}")
    elif isinstance(raster, str | PathLike):
        path = os.fspath(raster)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                file = rasterio.open(path)
        except RasterioError as error:
            raise TrustboError(f"{role}: {path!r} is no raster that GDAL reads: {error}.") from None
        with file:
            yield _of_file(file, f"{role}: {path!r}")
    else:
        raise TrustboError(
            f"{role} must be a path, an open rasterio dataset or an xarray.DataArray; got "
            f"{type(raster).__name__}."
        )


def _of_file(file: DatasetReader | WarpedVRT, name: str) -> _Source:
    """Describe the band of heights of a GDAL dataset: that described as elevation, else the first.

    A mask or an alpha band hides the nodata tag from GDAL's own mask, so that all of them are read.
    """
    if not file.count:
        parts = ", ".join(file.subdatasets) or "nothing"
        raise TrustboError(f"{name} has no band of its own; give one of its parts: {parts}.")
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
    tag, dtype, scale, offset, unit = (
        of[band - 1] for of in (file.nodatavals, file.dtypes, file.scales, file.offsets, file.units)
    )
    if dtype.startswith("complex"):
        raise TrustboError(f"{name} holds {dtype}, which are no heights; give real numbers.")
    masked = MaskFlags.all_valid not in file.mask_flag_enums[band - 1]

    def read(rows: slice) -> tuple[np.ndarray, np.ndarray | None]:
        window = Window.from_slices(rows.indices(file.height)[:2], (0, file.width))
        hidden = [file.read_masks(band, window=window) == 0] if masked else []
        hidden += [file.read(k, window=window) == 0 for k in alpha]
        return file.read(band, window=window), np.any(hidden, axis=0) if hidden else None

    coding = Coding(name, () if tag is None else (tag,), scale, offset)
    return _Source(name, *_axes_of(file, name), file.crs, coding, unit, read)


def _warn_of_bands(n: int, name: str) -> None:
    if n > 1:
        warn(f"{name} has {n} bands; the first is taken as heights.")


def _axes_of(file: DatasetReader | WarpedVRT, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Y of the rows and x of the columns of a GDAL dataset."""
    t = file.transform
    if t.is_identity and (file.gcps[0] or file.rpcs):
        raise TrustboError(
            f"{name} is placed by ground control points or RPCs; warp it to a map first, e.g. with "
            "gdalwarp -t_srs EPSG:32633."
        )
    if t.is_identity:
        raise TrustboError(
            f"{name} has no georeference; add one, e.g. with gdal_translate -a_ullr -a_srs."
        )
    # Less than a thousandth of a pixel over the whole raster is rounding.
    if abs(t.b) * file.height > 1e-3 * abs(t.a) or abs(t.d) * file.width > 1e-3 * abs(t.e):
        raise TrustboError(f"{name} is on a rotated grid; warp it first, e.g. with gdalwarp.")
    rows, cols = np.arange(file.height) + 0.5, np.arange(file.width) + 0.5
    return t.f + rows * t.e, t.c + cols * t.a


def _of_array(array: xr.DataArray, name: str) -> _Source:
    """Describe a DataArray; of several bands, the first."""
    try:
        y, x = array.rio.y_dim, array.rio.x_dim
    except MissingSpatialDimensionError:
        y, x = "lat", "lon"
    bands = [dim for dim in array.dims if dim not in (y, x)]
    if not {y, x} <= set(array.dims) or len(bands) > 1 or not array.size:
        raise TrustboError(
            f"{name} has axes {dict(array.sizes)}; need rows and columns, named (y, x), and one "
            "axis of bands at most."
        )
    if not {y, x} <= set(array.coords):
        raise TrustboError(f"{name} has no coordinates along {y} and {x}; assign them, in m.")
    _warn_of_bands(max([array.sizes[dim] for dim in bands], default=1), name)
    array = array.isel(dict.fromkeys(bands, 0)).transpose(y, x)

    def note(default: float, *names: str) -> float:
        found = [array.attrs[one] for one in names if one in array.attrs]
        return _number(names[0], np.ravel(found[0])[0]) if found else default

    coding = Coding(
        name,
        _declared_fills(array),
        note(1.0, "scale_factor", "scales"),
        note(0.0, "add_offset", "offsets"),
    )
    rows, cols = (_even(array[axis].values, f"{name}'s {axis}") for axis in (y, x))

    def read(part: slice) -> tuple[np.ndarray, None]:
        return array[part].to_numpy(), None

    return _Source(name, rows, cols, array.rio.crs, coding, array.attrs.get("units"), read)


def _declared_fills(array: xr.DataArray) -> tuple[float, ...]:
    """Values declared missing by attributes, and by an encoding without a scale."""
    notes = [array.attrs]
    # An encoding has been applied: with a scale, its fill value is no height.
    if not {"scale_factor", "add_offset", "scales", "offsets"} & set(array.encoding):
        notes.append(array.encoding)
    tags = [tag for note in notes for key in _FILL_NAMES for tag in np.ravel(note.get(key, []))]
    return tuple(_number("nodata", tag) for tag in tags if tag is not None)


def _even(values: np.ndarray, what: str) -> np.ndarray:
    """Evenly spaced coordinates; TrustboError if they differ from even ones by over rounding.

    Coordinates that passed through float32 are rounded to 0.5 m in the north of a UTM zone.
    """
    given = values.astype(float)
    if len(given) < 2:
        return given
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
    """Make one dataset of two rasters on one grid: NaN in common, surface not below the ground."""
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
