"""Aligned, metric dataset of a DEM and a DSM."""

import hashlib
import math
import warnings
from contextlib import ExitStack

import numpy as np
import xarray as xr
from rasterio.crs import CRS

from trustbo.errors import TerrainError, require_positive
from trustbo.terrain.align import on_one_grid
from trustbo.terrain.metric import METRE, require_metric
from trustbo.terrain.open_raster import RasterLike, open_raster
from trustbo.terrain.raster import Raster

CLIP_WARNING_SHARE = 0.02
_ROWS = 256  # checked together
_MOST_IN_MEMORY, _MOST_AVERAGED = 4e8, 1e10  # pixels of one raster: 3.2 GB; some 20 minutes
_DEGREE = 111_195.0  # of latitude, m


def read_terrain(
    dem: RasterLike,
    dsm: RasterLike | None = None,
    *,
    crs: object = None,
    resolution: float | None = None,
    nodata: float | None = None,
    lazy: bool = False,
    max_pixels: float | None = None,
    progress: bool = False,
) -> xr.Dataset:
    """Read a digital elevation model (ground) and a digital surface model (canopy, roofs).

    Both are put on the DEM's grid, or, if the DEM is in degrees or its projection distorts
    distances by over 1 % (as web maps' EPSG:3857 does), on a grid of square pixels in its UTM zone.
    The surface is raised to the ground where it is below. Heights in feet, by their band or their
    CRS, are converted to metres, with a warning and the variable's attribute `stored_units`.

    Args:
        dem: Heights, first band: a path or an address of a raster that GDAL reads
            (`/vsizip/...`, `https://...`); an open rasterio dataset, which stays open; a DataArray
            of rioxarray, in memory or lazy; or a Dataset of one such array. NaN, infinity, the
            nodata value and pixels hidden by a mask or an alpha band are missing; scale and offset
            are applied.
        dsm: Heights of the surface, likewise, on any grid that overlaps the DEM's. Without one, no
            canopy is known, and the surface is the ground (a warning and the terrain's attribute
            `surface` state it).
        crs: Coordinate reference system of rasters without one, e.g. `"EPSG:32633"`.
        resolution: Pixel size in metres of rasters without a georeference; others with smaller
            pixels are averaged over whole numbers of pixels, to about this size.
        max_pixels: Number of pixels above which a raster is averaged likewise, with a warning,
            unless `resolution` is given. None: no limit up to 4e8 pixels, the most that are read
            into memory then.
        nodata: Another stored value that means missing.
        lazy: Leave the heights in the files, for rasters larger than the memory. Both variables
            are then float32 and read when a window of them is loaded, e.g. by
            `terrain.isel(y=slice(0, 512)).load()`; `clean` puts NaN in common and clips the
            surface of a window. Close the files with `terrain.close()`.
        progress: Show a bar while a raster is averaged.

    Returns:
        Dataset with `dem` and `dsm`, float64 in metres (float32 if lazy), dims (y, x) with north
        at the top, NaN where a raster has no data; the CRS is in `spatial_ref`.

    Raises:
        TerrainError: A raster too large for the memory, or to be averaged; no raster, no CRS, a
            rotated grid, a map in other units than metres or degrees, heights in other units than
            metres or feet, no overlap, no data at all, or a height of -999 m or beyond +-9000 m: an
            undeclared fill value. With `lazy`, the last two are checked when a window is loaded:
            loading raises for a fill value, and `clean` counts the valid pixels.
    """
    with ExitStack() as closing:
        sources = {"dem": dem} if dsm is None else {"dem": dem, "dsm": dsm}
        rasters = [
            open_raster(source, role, closing, crs=crs, resolution=resolution, nodata=nodata)
            for role, source in sources.items()
        ]
        _warn_of(rasters)
        rasters = _averaged(rasters, resolution, max_pixels, progress)
        ground, surface = on_one_grid(rasters[0], rasters[-1])
        surface = ground if dsm is None else surface
        if lazy:
            terrain = _dataset(ground.array(np.float32), surface.array(np.float32))
            terrain.set_close(closing.pop_all().close)
            return _noted(terrain, rasters, ground.crs)
        heights = _load(list({ground: 0, surface: 0}), limited=max_pixels is None)
    for raster, array in zip((ground, surface), heights, strict=False):
        if not np.isfinite(array).any():
            where = "" if raster is ground else " in the area of the DEM"
            raise TerrainError(f"{raster.name} is all nodata{where}.")
    return _noted(assemble_terrain(heights[0], heights[-1]), rasters, ground.crs)


def _warn_of(rasters: list[Raster]) -> None:
    """Warn of heights that are converted, and of a missing surface."""
    for raster in rasters:
        if raster.unit != METRE:
            warnings.warn(
                f"{raster.name} has heights in {raster.unit.name!r}; they are converted to metres.",
                stacklevel=3,
            )
    if len(rasters) == 1:
        warnings.warn(
            "no surface (DSM) is given, so no canopy is known: only the ground blocks sight.",
            stacklevel=3,
        )


def _load(rasters: list[Raster], *, limited: bool) -> list[xr.DataArray]:
    """Read the heights of rasters; TerrainError where the memory is, or would be, too small.

    The files may be small: a compressed or sparse one of a megabyte unpacks to gigabytes.
    """
    for raster in rasters:
        if limited and math.prod(raster.shape) > _MOST_IN_MEMORY:
            raise _too_large(raster)
    try:
        return [raster.array(np.float64).load() for raster in rasters]
    except MemoryError:
        raise _too_large(max(rasters, key=lambda raster: math.prod(raster.shape))) from None


def _too_large(raster: Raster) -> TerrainError:
    rows, cols = raster.shape
    return TerrainError(
        f"{raster.name} has {rows} x {cols} pixels, {8e-9 * rows * cols:.3g} GB in memory; give "
        "max_pixels=9e6 or resolution= (metres) to average them, or lazy=True to leave them there."
    )


def _averaged(
    rasters: list[Raster], resolution: float | None, max_pixels: float | None, progress: bool
) -> list[Raster]:
    """Coarsen rasters to a resolution, else to a number of pixels; rasters of one CRS alike."""
    ground = rasters[0]
    if resolution is not None:
        sides = [_side(raster) for raster in rasters]
        factors = [max(1, round(require_positive("resolution", resolution) / s)) for s in sides]
    elif max_pixels is None:
        return rasters
    else:
        limit = require_positive("max_pixels", max_pixels)
        factors = [math.ceil(math.sqrt(math.prod(raster.shape) / limit)) for raster in rasters]
        if rasters[-1].crs == ground.crs:
            factors[-1] = max(1, round(factors[0] * _side(ground) / _side(rasters[-1])))
    for raster, factor in zip(rasters, factors, strict=True):
        if min(raster.shape) < 2 * factor:
            raise TerrainError(
                f"{raster.name} has {raster.shape[0]} x {raster.shape[1]} pixels, too few to "
                f"average {factor} x {factor} of them; give a smaller resolution or more pixels."
            )
        if factor > 1 and math.prod(raster.shape) > _MOST_AVERAGED:
            raise TerrainError(
                f"{raster.name} has {raster.shape[0]} x {raster.shape[1]} pixels, too many to "
                "average; cut the area out first, e.g. with gdal_translate -projwin."
            )
    if resolution is None and max(factors) > 1:
        averaged = (
            f"{r.name} has {r.shape[0]} x {r.shape[1]} pixels, {k} x {k} of them are averaged to "
            f"one of {_side(r) * k:.3g} m"
            for r, k in zip(rasters, factors, strict=True)
        )
        sentence = "; ".join(averaged)
        warnings.warn(f"{sentence}. For another size, give resolution=.", stacklevel=3)
    return [
        raster if factor == 1 else raster.coarsened(factor, progress)
        for raster, factor in zip(rasters, factors, strict=True)
    ]


def _side(raster: Raster) -> float:
    """Height of a pixel, m."""
    return -raster.transform.e * (_DEGREE if raster.crs.is_geographic else 1.0)


def _noted(terrain: xr.Dataset, rasters: list[Raster], crs: CRS) -> xr.Dataset:
    """Record in a terrain's attributes the warnings of `_warn_of`, and the CRSs warped from."""
    for name, raster in zip(("dem", "dsm"), (rasters[0], rasters[-1]), strict=True):
        if raster.unit != METRE:
            terrain[name].attrs["stored_units"] = raster.unit.name
        if raster.crs != crs:
            terrain[name].attrs["warped_from"] = raster.crs.to_string()
    if len(rasters) == 1:
        terrain.attrs["surface"] = "the ground, as no DSM is known"
    return terrain


def assemble_terrain(dem: xr.DataArray, dsm: xr.DataArray) -> xr.Dataset:
    """Make one dataset of two aligned rasters: north up, NaN in common, surface not below ground.

    Args:
        dem: Ground heights, dims (y, x), metres, with a metric CRS.
        dsm: Surface heights on the same grid.

    Raises:
        TerrainError: No CRS, units other than metres, two different or irregular grids, or no
            pixel that has both heights.
    """
    crs = dem.rio.crs
    require_metric({"dem": dem, "dsm": dsm}, crs)
    ground, surface = (
        a.drop_vars("spatial_ref", errors="ignore").transpose("y", "x").astype(float, copy=False)
        for a in (dem, dsm)
    )
    if not _same_coordinates(ground, surface):
        raise TerrainError(
            f"dem {ground.shape} and dsm {surface.shape} are not on one grid; align them first, "
            "e.g. with dsm.rio.reproject_match(dem)."
        )
    surface = surface.assign_coords(x=ground["x"], y=ground["y"])
    return _assembled(xr.Dataset({"dem": ground, "dsm": surface}), crs)


def _assembled(terrain: xr.Dataset, crs: CRS) -> xr.Dataset:
    terrain, clipped, valid = clean(_north_up(terrain))
    if not valid:
        raise TerrainError(
            "no pixel has both a DEM and a DSM height: one of them is all nodata where they "
            "overlap. Check the nodata value of the rasters."
        )
    warn_if_clipped(clipped, valid, stacklevel=5)
    terrain.attrs = {"clipped_share": clipped / valid}
    return _with_crs(terrain, crs)


def clean(terrain: xr.Dataset) -> tuple[xr.Dataset, int, int]:
    """Put NaN in common and raise the surface to the ground, of a lazy terrain or a window of it.

    The terrain of `read_terrain(..., lazy=True)` is not changed. Returns a terrain in memory, in
    floats; the number of raised pixels; the number of pixels with both heights.
    """
    ground, surface = (terrain[name].compute() for name in ("dem", "dsm"))
    valid = np.isfinite(ground) & np.isfinite(surface)
    clipped = int(((surface < ground) & valid).sum())
    surface = surface.where(surface > ground, ground)
    cleaned = terrain.assign(
        dem=ground.where(valid).assign_attrs(long_name="ground", units="m"),
        dsm=surface.where(valid).assign_attrs(long_name="surface", units="m"),
    )
    return cleaned, clipped, int(valid.sum())


def warn_if_clipped(clipped: int, valid: int, stacklevel: int = 2) -> None:
    """Warn if `clean` raised over 2 % of the valid pixels, both numbers summed over windows."""
    if clipped > CLIP_WARNING_SHARE * valid:
        warnings.warn(
            f"the DSM lies below the DEM on {clipped / valid:.1%} of pixels; it is raised to the "
            "DEM there. Check that both share one vertical datum.",
            stacklevel=stacklevel,
        )


def require_terrain(terrain: xr.Dataset) -> xr.Dataset:
    """Check a user's dataset, and convert it to the form of `assemble_terrain`.

    TerrainError: no `dem` or `dsm`, or what `assemble_terrain` refuses.
    """
    if not isinstance(terrain, xr.Dataset) or not {"dem", "dsm"} <= set(terrain.data_vars):
        raise TerrainError(
            "a terrain is a Dataset with dem and dsm over (y, x), as read_terrain gives it; got "
            f"{type(terrain).__name__}."
        )
    crs = terrain.rio.crs
    require_metric(terrain, crs)
    if is_lazy(terrain):
        return _with_crs(_north_up(terrain.transpose("y", "x")), crs)
    if _is_in_order(terrain):
        return _with_crs(terrain.copy(), crs)
    clipped = terrain.attrs.get("clipped_share", 0.0)
    heights = terrain[["dem", "dsm"]].drop_vars("spatial_ref", errors="ignore")
    result = _assembled(heights.transpose("y", "x").astype(float), crs)
    result.attrs["clipped_share"] = max(clipped, result.attrs["clipped_share"])
    return result


def is_lazy(terrain: xr.Dataset) -> bool:
    """Whether heights of a terrain are still in files."""
    return not all(terrain[name].variable._in_memory for name in ("dem", "dsm"))


def _north_up(terrain: xr.Dataset) -> xr.Dataset:
    """Turn rows from north to south, columns from west to east."""
    turned = {"y": terrain["y"][0] < terrain["y"][-1], "x": terrain["x"][0] > terrain["x"][-1]}
    return terrain.isel({axis: slice(None, None, -1) for axis, turn in turned.items() if turn})


def _is_in_order(terrain: xr.Dataset) -> bool:
    """Whether a terrain has the form of `assemble_terrain`: then it is not copied."""
    dem, dsm = terrain["dem"], terrain["dsm"]
    if not dem.dims == dsm.dims == ("y", "x") or {dem.dtype.kind, dsm.dtype.kind} != {"f"}:
        return False
    if terrain["y"][0] < terrain["y"][-1] or terrain["x"][0] > terrain["x"][-1]:
        return False
    has_data = False
    for first in range(0, len(dem), _ROWS):
        g, s = (a.values[first : first + _ROWS] for a in (dem, dsm))
        valid = np.isfinite(g)
        if (valid != np.isfinite(s)).any() or (s < g).any() or np.isinf(g).any():
            return False
        has_data |= bool(valid.any())
    return has_data


def pixel_size(terrain: xr.Dataset) -> tuple[float, float]:
    """Pixel height and width in metres."""
    y, x = (terrain.variables[axis].values for axis in ("y", "x"))
    return abs(float(y[-1] - y[0])) / (len(y) - 1), abs(float(x[-1] - x[0])) / (len(x) - 1)


def _dataset(dem: xr.DataArray, dsm: xr.DataArray) -> xr.Dataset:
    """Lazy dataset, with the attributes and the CRS that `assemble_terrain` writes."""
    terrain = xr.Dataset(
        {
            "dem": dem.assign_attrs(long_name="ground", units="m"),
            "dsm": dsm.assign_attrs(long_name="surface", units="m"),
        }
    )
    return _with_crs(terrain, dem.rio.crs)


def _with_crs(terrain: xr.Dataset, crs: CRS) -> xr.Dataset:
    # In place, as rioxarray would copy the heights.
    terrain.rio.write_crs(crs, inplace=True)
    # From the coordinates: a transform stored before the raster was coarsened or cut is stale.
    return terrain.rio.write_transform(terrain.rio.transform(recalc=True), inplace=True)


def _same_coordinates(a: xr.DataArray, b: xr.DataArray) -> bool:
    """Whether two arrays' pixels coincide to a thousandth of a pixel."""
    return a.shape == b.shape and all(
        np.allclose(a[axis], b[axis], rtol=0.0, atol=1e-3 * abs(float(a[axis][1] - a[axis][0])))
        for axis in ("x", "y")
    )


def digest_of(terrain: xr.Dataset) -> str:
    """Hash of a terrain's heights and positions, the same wherever it was read from."""
    digest = hashlib.sha256()
    for name in ("y", "x", "dem", "dsm"):
        digest.update(np.ascontiguousarray(terrain[name].values, dtype=float).tobytes())
    return digest.hexdigest()
