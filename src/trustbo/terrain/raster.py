"""Reading a DEM and a DSM into one aligned, metric dataset."""

import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rioxarray
import xarray as xr
from pyproj import Proj
from pyproj.exceptions import ProjError
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioIOError
from rasterio.transform import from_origin
from rasterio.warp import transform as transform_points

from trustbo.errors import TerrainError, require_positive

CLIP_WARNING_SHARE = 0.02


def read_terrain(
    dem: str | PathLike[str],
    dsm: str | PathLike[str],
    *,
    crs: object = None,
    resolution: float | None = None,
) -> xr.Dataset:
    """Read a digital elevation model (ground) and a digital surface model (canopy, roofs).

    Both come out on the DEM's grid, or, where the DEM is in degrees or its projection distorts
    distances by over 1 % (as web maps' EPSG:3857 does), on a grid of square metres in its UTM zone.
    The surface is clipped to be nowhere below the ground.

    Args:
        dem: A raster GDAL can read, heights in metres, first band.
        dsm: Likewise; any grid that overlaps the DEM's.
        crs: Coordinate reference system of rasters that carry none, e.g. `"EPSG:32633"`.
        resolution: Pixel size in metres of rasters that carry no georeference at all.

    Returns:
        Dataset with `dem` and `dsm`, float64 in metres, dims (y, x) with north at the top, NaN
        where either raster has no data; the CRS is in `spatial_ref`.

    Raises:
        TerrainError: No raster, no CRS, a rotated grid, units other than metres, no overlap, or no
            data at all.
    """
    ground = _open(dem, "dem", crs, resolution)
    surface = _open(dsm, "dsm", crs, resolution)
    if ground.rio.crs.is_geographic or _distorts(ground):
        ground = ground.rio.reproject(
            _utm(ground, dem), resampling=Resampling.bilinear, nodata=np.nan
        )
    _require_overlap(ground, surface, dem, dsm)
    if not _same_grid(ground, surface):
        surface = surface.rio.reproject_match(
            ground, resampling=Resampling.bilinear, nodata=np.nan
        ).assign_coords(x=ground["x"], y=ground["y"])
    return assemble_terrain(ground, surface)


def assemble_terrain(dem: xr.DataArray, dsm: xr.DataArray) -> xr.Dataset:
    """One dataset of two aligned rasters: north up, NaN in common, surface not below ground.

    Args:
        dem: Ground heights, dims (y, x), metres, with a metric CRS.
        dsm: Surface heights on the same grid.

    Raises:
        TerrainError: No CRS, units other than metres, two different or irregular grids, or no
            pixel that has both heights.
    """
    _require_metric_crs(dem)
    ground, surface = (
        a.drop_vars("spatial_ref", errors="ignore").transpose("y", "x").astype(float)
        for a in (dem, dsm)
    )
    _require_regular(ground)
    if not _same_coordinates(ground, surface):
        raise TerrainError(
            f"dem {ground.shape} and dsm {surface.shape} are not on one grid; align them first, "
            "e.g. with dsm.rio.reproject_match(dem)."
        )
    surface = surface.assign_coords(x=ground["x"], y=ground["y"])
    ground, surface = (a.sortby("x").sortby("y", ascending=False) for a in (ground, surface))
    valid = np.isfinite(ground) & np.isfinite(surface)
    if not valid.any():
        raise TerrainError(
            "no pixel has both a DEM and a DSM height: one of them is all nodata where they "
            "overlap. Check the nodata value of the rasters."
        )
    below = float((surface < ground).where(valid).mean())
    if below > CLIP_WARNING_SHARE:
        warnings.warn(
            f"the DSM lies below the DEM on {below:.1%} of pixels; it is raised to the DEM there. "
            "Check that both share one vertical datum.",
            stacklevel=3,
        )
    terrain = xr.Dataset(
        {
            "dem": ground.where(valid).assign_attrs(long_name="ground", units="m"),
            "dsm": surface.where(surface > ground, ground)
            .where(valid)
            .assign_attrs(long_name="surface", units="m"),
        }
    )
    terrain.attrs = {"clipped_share": below}
    terrain = terrain.rio.write_crs(dem.rio.crs)
    # From the coordinates: a transform stored before the raster was coarsened or cut is stale.
    return terrain.rio.write_transform(terrain.rio.transform(recalc=True))


def require_terrain(terrain: xr.Dataset) -> xr.Dataset:
    """A user's own dataset in the form that `assemble_terrain` gives.

    Raises:
        TerrainError: No `dem` or `dsm`, or what `assemble_terrain` refuses.
    """
    if not isinstance(terrain, xr.Dataset) or not {"dem", "dsm"} <= set(terrain.data_vars):
        raise TerrainError(
            "a terrain is a Dataset with dem and dsm over (y, x), as read_terrain gives it; got "
            f"{type(terrain).__name__}."
        )
    crs = terrain.rio.crs
    if crs is None:
        raise TerrainError(
            "the terrain has no CRS; set it, e.g. terrain.rio.write_crs('EPSG:32633')."
        )
    known = terrain.attrs.get("clipped_share", 0.0)
    result = assemble_terrain(terrain["dem"].rio.write_crs(crs), terrain["dsm"])
    result.attrs["clipped_share"] = max(known, result.attrs["clipped_share"])
    return result


def pixel_size(terrain: xr.Dataset) -> tuple[float, float]:
    """Pixel height and width in metres."""
    width, height = terrain.rio.resolution(recalc=True)
    return abs(height), abs(width)


def _open(
    path: str | PathLike[str], role: str, crs: object, resolution: float | None
) -> xr.DataArray:
    """One raster in memory, with a CRS and a north-up grid."""
    name = f"{role}: {str(path)!r}"
    if not Path(path).exists():
        raise TerrainError(f"{role}: there is no file {str(path)!r}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                transform = source.transform
            opened: Any = rioxarray.open_rasterio(path, masked=True)
            # Closed at once: what is still open when Python ends is reported as an error.
            with opened:
                raster = opened.isel(band=0, drop=True).load()
    except RasterioIOError as error:
        raise TerrainError(
            f"{name} is no raster that GDAL can read ({error}); "
            "give a GeoTIFF or another raster format."
        ) from None
    if transform.is_identity:
        raster = _georeference(raster, name, crs, resolution)
    elif transform.b or transform.d:
        raise TerrainError(
            f"{name} is on a rotated grid; warp it to north-up first, e.g. with gdalwarp."
        )
    if raster.rio.crs is None:
        raster = raster.rio.write_crs(_given_crs(name, crs))
    if not raster.rio.crs.is_geographic:
        _require_metric_crs(raster, name)
    if not np.isfinite(raster).any():
        raise TerrainError(f"{name} is all nodata.")
    return raster


def _georeference(
    raster: xr.DataArray, name: str, crs: object, resolution: float | None
) -> xr.DataArray:
    """Put a bare image at the origin, with a pixel size its user knows."""
    if resolution is None or crs is None:
        raise TerrainError(
            f"{name} carries no georeference; pass both crs= and resolution= (metres), on the "
            "command line --crs and --resolution."
        )
    if _given_crs(name, crs).is_geographic:
        raise TerrainError(
            f"crs {crs!r} is in degrees, but resolution= is in metres; give a metric one."
        )
    step = require_positive("resolution", resolution)
    height = raster.sizes["y"] * step
    return raster.rio.write_transform(from_origin(0.0, height, step, step)).assign_coords(
        x=(np.arange(raster.sizes["x"]) + 0.5) * step,
        y=height - (np.arange(raster.sizes["y"]) + 0.5) * step,
    )


def _given_crs(name: str, crs: object) -> CRS:
    if crs is None:
        raise TerrainError(
            f"{name} has no coordinate reference system; pass crs=, e.g. "
            '"EPSG:32633" (--crs on the command line).'
        )
    try:
        return CRS.from_user_input(crs)
    except CRSError:
        raise TerrainError(f"crs {crs!r} is not one PROJ knows; give e.g. 'EPSG:32633'.") from None


def _require_metric_crs(raster: xr.DataArray, name: str = "the terrain") -> None:
    crs = raster.rio.crs
    if crs is None:
        raise TerrainError(f"{name} has no CRS; set it, e.g. dem.rio.write_crs('EPSG:32633').")
    if crs.is_geographic:
        raise TerrainError(
            f"{name} is in degrees; reproject it, e.g. with "
            "dem.rio.reproject(dem.rio.estimate_utm_crs())."
        )
    if abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        raise TerrainError(
            f"{name} is in {crs.linear_units}, but heights and distances must be in metres; warp "
            "it to a metric CRS and convert its heights."
        )


def _require_regular(raster: xr.DataArray) -> None:
    for axis in ("y", "x"):
        steps = np.diff(raster[axis].values)
        if not len(steps) or not np.allclose(steps, steps[0], rtol=1e-3) or steps[0] == 0.0:
            raise TerrainError(
                f"the raster's {axis} is not a regular axis of two pixels or more; resample it to "
                "evenly spaced, sorted coordinates."
            )


def _distorts(raster: xr.DataArray) -> bool:
    """Whether a metre on the map is more than 1 % off a metre on the ground."""
    crs = raster.rio.crs
    left, bottom, right, top = raster.rio.bounds()
    lon, lat = transform_points(
        crs, CRS.from_epsg(4326), [(left + right) / 2], [(bottom + top) / 2]
    )[:2]
    scale = Proj(crs.to_wkt()).get_factors(lon[0], lat[0]).areal_scale
    return abs(np.sqrt(scale) - 1.0) > 0.01


def _utm(raster: xr.DataArray, path: str | PathLike[str]) -> CRS:
    try:
        return raster.rio.estimate_utm_crs()
    except (RuntimeError, ProjError):
        bounds = ", ".join(f"{edge:.1f}" for edge in raster.rio.bounds())
        raise TerrainError(
            f"{str(path)!r} has CRS {raster.rio.crs.to_string()}, but its bounds ({bounds}) are no "
            "place on Earth in it; give the CRS its coordinates are in."
        ) from None


def _require_overlap(
    ground: xr.DataArray,
    surface: xr.DataArray,
    dem: str | PathLike[str],
    dsm: str | PathLike[str],
) -> None:
    left, bottom, right, top = ground.rio.bounds()
    box = surface.rio.transform_bounds(ground.rio.crs)
    if box[0] >= right or box[2] <= left or box[1] >= top or box[3] <= bottom:
        names = ", ".join(f"{e:.1f}" for e in (left, bottom, right, top))
        other = ", ".join(f"{e:.1f}" for e in box)
        raise TerrainError(
            f"dem {str(dem)!r} and dsm {str(dsm)!r} do not overlap: in "
            f"{ground.rio.crs.to_string()} they cover ({names}) and ({other}) as (left, bottom, "
            "right, top). Give two rasters of one place."
        )


def _same_grid(a: xr.DataArray, b: xr.DataArray) -> bool:
    return a.rio.crs == b.rio.crs and _same_coordinates(a, b)


def _same_coordinates(a: xr.DataArray, b: xr.DataArray) -> bool:
    """Whether two rasters' pixels coincide to a thousandth of a pixel."""
    return a.shape == b.shape and all(
        np.allclose(a[axis], b[axis], rtol=0.0, atol=1e-3 * abs(float(a[axis][1] - a[axis][0])))
        for axis in ("x", "y")
    )
