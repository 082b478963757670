"""Reading of a DEM and a DSM onto one metric grid.

Whatever is wrong with a raster is refused or put right here, where it enters: the rest of the
package relies on heights in metres, NaN where missing, on a grid of metres with north at the top.
"""

import math
import os
import re
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import pyproj
import rasterio
import rioxarray  # noqa: F401  # the accessor `rio`
import xarray as xr
from pyproj.exceptions import CRSError
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window
from rioxarray.exceptions import MissingSpatialDimensionError

from trustbo.errors import TrustboError, require_positive
from trustbo.files import FilePath
from trustbo.terrain.heights import Coding, decoded, vertical_of, warn, warn_of_zeros

type RasterLike = FilePath | DatasetReader | WarpedVRT | xr.DataArray

_MOST_PIXELS = 1e8  # of a raster in memory: 0.8 GB
_STRIP = 2**23  # pixels that are read together
_CLIPPED = 0.02  # share of pixels with the surface below the ground, above which a warning is due
_TALL, _RAISED = 60.0, 20.0  # m: unlikely medians and 5 % quantiles of canopy heights
_DEGREE = 111_195.0  # of latitude, m
_NORTH = 22.5  # degrees between columns and north, half the angle between two of the eight moves
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
    """
    given = None if crs is None else _known_crs(crs)
    ground = _heights(dem, "dem", given, resolution, nodata)
    heights = _on_metric_grid(ground.heights)
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
    if _same_grid(above, ground.heights):
        above = _on_metric_grid(above)  # exactly as the ground was
    if not _same_grid(heights, above):
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
    given: pyproj.CRS | None,
    resolution: float | None,
    nodata: float | None,
) -> _Raster:
    """Read the heights of one raster, dem or dsm, averaged to a resolution."""
    with _opened(raster, role) as source:
        crs = _crs_of(source, given)
        vertical = vertical_of(source.name, source.unit, crs)
        if abs(vertical.metres) != 1.0:
            warn(f"{source.name} has heights in {vertical.unit!r}; they are converted to metres.")
        own = source.coding
        fills = own.fills if nodata is None else (*own.fills, _number("nodata", nodata))
        factor = _factor(source, crs, resolution)
        try:
            values = _averaged(source, own._replace(fills=fills, vertical=vertical), factor)
        except RasterioError as error:
            raise TrustboError(f"{source.name} is damaged or out of reach: {error}.") from None
    if not np.isfinite(values).any():
        raise TrustboError(f"{source.name} is all nodata; check its nodata value.")
    warn_of_zeros(values, source.name)
    y, x = (
        axis[: len(axis) // factor * factor].reshape(-1, factor).mean(1) if factor > 1 else axis
        for axis in (source.y, source.x)
    )
    heights = xr.DataArray(values, {"y": y, "x": x}, ("y", "x"))
    turned = {"y": y[0] < y[-1], "x": x[0] > x[-1]}
    heights = heights.isel({axis: slice(None, None, -1) for axis, turn in turned.items() if turn})
    placed = _placed(heights.rio.write_crs(crs.to_2d().to_wkt()), source.name)
    return _Raster(source.name, placed, vertical.datum)


def _averaged(source: _Source, coding: Coding, factor: int) -> np.ndarray:
    """Means of `factor` x `factor` pixels, strip by strip; over half missing make one missing.

    Rows and columns at the edge that fill no such square are left out.
    """
    n_rows, n_cols = len(source.y) // factor, len(source.x) // factor
    strips = []
    step = max(1, _STRIP // (factor * len(source.x)))
    for top in range(0, n_rows, step):
        rows = slice(top * factor, min(top + step, n_rows) * factor)
        stored, hidden = source.read(rows)
        fine = decoded(stored, coding, hidden, rows.start)
        if factor > 1:
            blocks = fine[:, : n_cols * factor].reshape(-1, factor, n_cols, factor)
            n = np.isfinite(blocks).sum((1, 3))
            total = np.nansum(blocks, axis=(1, 3))
            fine = np.where(2 * n >= factor**2, total / np.maximum(n, 1), np.nan)
        strips.append(fine)
    return np.concatenate(strips)


def _factor(source: _Source, crs: pyproj.CRS, resolution: float | None) -> int:
    """Number of pixels along a side that are averaged to one; checks the number of pixels."""
    shape = len(source.y), len(source.x)
    size = f"{source.name} has {shape[0]} x {shape[1]} pixels"
    if min(shape) < 2:
        raise TrustboError(f"{size}; a terrain needs at least two rows and two columns.")
    factor = 1
    if resolution is not None:
        side = abs(source.y[1] - source.y[0]) * (_DEGREE if crs.is_geographic else 1.0)
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
        if raster.closed:
            raise TrustboError(f"{role}: {raster.name!r} is closed; open it again.")
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
    """Describe the band of heights of a GDAL dataset."""
    if not file.count:
        parts = ", ".join(file.subdatasets) or "nothing"
        raise TrustboError(f"{name} has no band of its own; give one of its parts: {parts}.")
    colours = file.colorinterp
    alpha = [k for k, colour in enumerate(colours, 1) if colour == ColorInterp.alpha]
    bands = [k for k in range(1, file.count + 1) if k not in alpha] or [1]
    named = _band_of_heights([file.descriptions[k - 1] for k in bands])
    band = bands[named or 0]
    if (colour := colours[band - 1]) not in (ColorInterp.undefined, ColorInterp.gray):
        raise TrustboError(
            f"{name} is a picture: band {band} has the colour {colour.name!r}; give a raster of "
            "heights."
        )
    if named is None:
        _warn_of_bands(len(bands), name)
    if (dtype := file.dtypes[band - 1]).startswith("complex"):
        raise TrustboError(f"{name} holds {dtype}, which are no heights; give real numbers.")
    masked = MaskFlags.all_valid not in file.mask_flag_enums[band - 1]

    def read(rows: slice) -> tuple[np.ndarray, np.ndarray | None]:
        window = Window.from_slices(rows, slice(0, file.width))
        hidden = file.read_masks(band, window=window) == 0 if masked else None
        for k in alpha:  # GDAL makes no mask of an alpha band of floats
            clear = file.read(k, window=window) == 0
            hidden = clear if hidden is None else hidden | clear
        return file.read(band, window=window), hidden

    # A mask or an alpha band hides the tag from GDAL's own mask.
    tag = file.nodatavals[band - 1]
    scale, offset, unit = (of[band - 1] for of in (file.scales, file.offsets, file.units))
    coding = Coding(name, () if tag is None else (tag,), scale, offset)
    return _Source(name, *_axes_of(file, name), file.crs, coding, unit, read)


def _band_of_heights(descriptions: Sequence[str | None]) -> int | None:
    """Index of the one band that is described as elevation; None if there is none, or several."""
    named = [k for k, text in enumerate(descriptions) if text and _HEIGHT_BANDS.search(text)]
    return named[0] if len(named) == 1 else None


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

    def read(rows: slice) -> tuple[np.ndarray, None]:
        return array.isel({y: rows}).to_numpy(), None

    axes = (_even(array[axis].values, axis, name) for axis in (y, x))
    scale, offset = (
        _number(
            names[0], np.ravel([array.attrs[n] for n in names if n in array.attrs] or default)[0]
        )
        for names, default in ((("scale_factor", "scales"), 1.0), (("add_offset", "offsets"), 0.0))
    )
    coding = Coding(name, _declared_fills(array), scale, offset)
    return _Source(name, *axes, array.rio.crs, coding, array.attrs.get("units"), read)  # pyright: ignore[reportCallIssue]


def _declared_fills(array: xr.DataArray) -> tuple[float, ...]:
    """Values declared missing by attributes, and by an encoding without a scale."""
    notes = [array.attrs]
    # An encoding has been applied: with a scale, its fill value is no height.
    if not {"scale_factor", "add_offset", "scales", "offsets"} & set(array.encoding):
        notes.append(array.encoding)
    tags = [tag for note in notes for key in _FILL_NAMES for tag in np.ravel(note.get(key, []))]
    return tuple(_number("nodata", tag) for tag in tags if tag is not None)


def _even(values: np.ndarray, axis: Hashable, name: str) -> np.ndarray:
    """Evenly spaced coordinates; TrustboError if they differ from even ones by over rounding.

    Coordinates that passed through float32 are rounded to 0.5 m in the north of a UTM zone.
    """
    given = values.astype(float)
    n = len(given)
    if n < 2:
        return given
    even = np.linspace(given[0], given[-1], n)
    step, off = abs(even[1] - even[0]), np.abs(given - even).max()
    single = (given.astype(np.float32) == given).all()
    rounding = 2.0 * np.finfo(np.float32).eps * np.abs(given).max() if single else 0.0
    if not off <= max(1e-3 * step, min(rounding, 0.5 * step)) or step == 0.0:
        raise TrustboError(f"{name}'s {axis} is not evenly spaced; resample it to a regular grid.")
    return given if off <= 1e-6 * step else even


def _number(what: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise TrustboError(f"{what} must be a number; got {value!r}.") from None


# --- place on Earth ---


def _known_crs(crs: Any) -> pyproj.CRS:
    try:
        return pyproj.CRS.from_user_input(crs)
    except CRSError:
        raise TrustboError(f"crs {crs!r} is not one PROJ knows; give e.g. 'EPSG:32633'.") from None


def _crs_of(source: _Source, given: pyproj.CRS | None) -> pyproj.CRS:
    """CRS of a raster, in degrees or metres; the given one if it has none of its own."""
    if source.crs is None and given is None:
        raise TrustboError(f"{source.name} has no coordinate reference system; pass crs=.")
    crs = given if source.crs is None else _known_crs(source.crs)
    assert crs is not None  # noqa: S101
    if given is not None and not crs.to_2d().equals(given.to_2d(), ignore_axis_order=True):
        raise TrustboError(
            f"{source.name} is in {crs.name!r}, but crs= is {given.name!r}; leave crs= out, or "
            "correct the raster's own CRS, e.g. with gdal_edit.py -a_srs."
        )
    flat = crs.to_2d()
    if flat.is_geographic:
        return crs
    if not flat.is_projected:
        raise TrustboError(f"{source.name} is in {crs.name!r}, no map of the Earth; reproject it.")
    if any(abs(axis.unit_conversion_factor - 1.0) > 1e-9 for axis in flat.axis_info):
        raise TrustboError(
            f"{source.name} has a map in {flat.axis_info[0].unit_name}, not metres; warp it, e.g. "
            "with gdalwarp -t_srs EPSG:32633."
        )
    return crs


def _placed(heights: xr.DataArray, name: str) -> xr.DataArray:
    """Check that a raster is somewhere on Earth; count longitudes from -180 to 180."""
    crs, (y, x) = heights.rio.crs, (heights[axis].values for axis in ("y", "x"))
    middle = 0.5 * (x[0] + x[-1])
    if crs.is_geographic:
        if max(abs(y[0]), abs(y[-1])) <= 90.0 and abs(middle) <= 540.0:
            return heights.assign_coords(x=x - 360.0 * round(middle / 360.0))
    else:
        if min(abs(x[1] - x[0]), abs(y[1] - y[0])) < 0.01:
            raise TrustboError(
                f"{name} has pixels of {abs(x[1] - x[0]):.2g} m in {crs.to_string()}: its "
                "coordinates look like degrees; correct its CRS."
            )
        if np.isfinite(_lonlat(heights)).all():
            return heights
    raise TrustboError(
        f"{name} has coordinates around ({middle:.8g}, {y[len(y) // 2]:.8g}), no place on Earth in "
        f"its CRS, {crs.to_string()}; correct the CRS."
    )


def _lonlat(heights: xr.DataArray, east: float = 0.0, north: float = 0.0) -> tuple[float, float]:
    """Longitude and latitude of the middle, or of a point some metres of the map away."""
    x, y = (0.5 * float(heights[axis][0] + heights[axis][-1]) for axis in ("x", "y"))
    convert = pyproj.Transformer.from_crs(heights.rio.crs.to_wkt(), "EPSG:4326", always_xy=True)
    return convert.transform(x + east, y + north)


def _on_metric_grid(heights: xr.DataArray) -> xr.DataArray:
    """Warp heights to a metric map with north at the top, unless they are on one."""
    lon, lat = _lonlat(heights)
    if not heights.rio.crs.is_geographic:
        geod, step = pyproj.Geod(ellps="WGS84"), 100.0
        to_east = geod.inv(lon, lat, *_lonlat(heights, east=step))
        to_north = geod.inv(lon, lat, *_lonlat(heights, north=step))
        turned = [(to_east[0] - 90.0 + 180.0) % 360.0 - 180.0, to_north[0]]
        lengths = np.array([to_east[2], to_north[2]]) / step
        if (abs(lengths - 1.0) < 0.01).all() and np.abs(turned).max() < _NORTH:
            return heights
    zone = f"EPSG:{(32600 if lat >= 0.0 else 32700) + int((lon + 180.0) // 6.0) % 60 + 1}"
    if not -80.0 <= lat <= 84.0:  # no UTM zone
        zone = f"+proj=tmerc +lat_0={lat} +lon_0={lon} +datum=WGS84 +units=m"
    return heights.rio.reproject(zone, resampling=Resampling.bilinear, nodata=np.nan)


def _same_grid(a: xr.DataArray, b: xr.DataArray) -> bool:
    """Whether two rasters' pixels coincide to a thousandth of a pixel."""
    return (
        a.shape == b.shape
        and a.rio.crs == b.rio.crs
        and all(
            np.allclose(a[axis], b[axis], rtol=0.0, atol=1e-3 * abs(float(a[axis][1] - a[axis][0])))
            for axis in ("x", "y")
        )
    )


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
    coords = {"y": ground["y"].values, "x": ground["x"].values}
    heights = {"dem": dem, "dsm": np.fmax(dem, dsm)}
    arrays = {n: np.ascontiguousarray(np.where(valid, z, np.nan)) for n, z in heights.items()}
    terrain = xr.Dataset(
        {
            name: (("y", "x"), arrays[name], {"long_name": long_name, "units": "m"})
            for name, long_name in (("dem", "ground"), ("dsm", "surface"))
        },
        coords,
        {"clipped_share": clipped},
    )
    terrain = terrain.rio.write_crs(ground.rio.crs)
    return terrain.rio.write_transform(terrain.rio.transform(recalc=True))
