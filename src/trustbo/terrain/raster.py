"""Reading a DEM and a DSM into one aligned, metric dataset."""

import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rioxarray
import xarray as xr
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioIOError
from rasterio.transform import from_origin

from trustbo.errors import TerrainError

CLIP_WARNING_SHARE = 0.02


def read_terrain(
    dem: str | PathLike[str],
    dsm: str | PathLike[str],
    *,
    crs: object = None,
    resolution: float | None = None,
) -> xr.Dataset:
    """Read a digital elevation model (ground) and a digital surface model (canopy, roofs).

    Both come out on the DEM's grid, or, where the DEM is in degrees, on a grid of square metres in
    its UTM zone. The surface is clipped to be nowhere below the ground.

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
    if ground.rio.crs.is_geographic:
        ground = ground.rio.reproject(
            ground.rio.estimate_utm_crs(), resampling=Resampling.bilinear, nodata=np.nan
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
        dem: Ground heights, dims (y, x), metres, with a CRS.
        dsm: Surface heights on the same grid.

    Raises:
        TerrainError: No pixel has both heights.
    """
    crs = dem.rio.crs
    ground, surface = (
        a.drop_vars("spatial_ref", errors="ignore").transpose("y", "x").sortby("x").sortby(
            "y", ascending=False
        ).astype(float)
        for a in (dem, dsm)
    )  # fmt: skip
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
    return terrain.rio.write_crs(crs).rio.write_transform()


def pixel_size(terrain: xr.Dataset) -> tuple[float, float]:
    """Pixel height and width in metres."""
    width, height = terrain.rio.resolution()
    return abs(height), abs(width)


def _open(
    path: str | PathLike[str], role: str, crs: object, resolution: float | None
) -> xr.DataArray:
    if not Path(path).exists():
        raise TerrainError(f"{role}: there is no file {str(path)!r}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                transform, georeferenced = source.transform, not source.transform.is_identity
            opened: Any = rioxarray.open_rasterio(path, masked=True)
            # Closed at once: what is still open when Python ends is reported as an error.
            with opened:
                raster = opened.isel(band=0, drop=True).load()
    except RasterioIOError as error:
        raise TerrainError(
            f"{role}: {str(path)!r} is no raster that GDAL can read ({error}); "
            "give a GeoTIFF or another raster format."
        ) from None
    if not georeferenced:
        if resolution is None or crs is None:
            raise TerrainError(
                f"{role}: {str(path)!r} carries no georeference; pass both crs= and resolution= "
                "(metres), on the command line --crs and --resolution."
            )
        height = raster.sizes["y"] * resolution
        transform = from_origin(0.0, height, resolution, resolution)
        raster = raster.rio.write_transform(transform)
        raster = raster.assign_coords(
            x=(np.arange(raster.sizes["x"]) + 0.5) * resolution,
            y=height - (np.arange(raster.sizes["y"]) + 0.5) * resolution,
        )
    if transform.b or transform.d:
        raise TerrainError(
            f"{role}: {str(path)!r} is on a rotated grid; warp it to north-up first, e.g. with "
            "gdalwarp."
        )
    if raster.rio.crs is None:
        if crs is None:
            raise TerrainError(
                f"{role}: {str(path)!r} has no coordinate reference system; pass crs=, e.g. "
                '"EPSG:32633" (--crs on the command line).'
            )
        try:
            raster = raster.rio.write_crs(CRS.from_user_input(crs))
        except CRSError:
            raise TerrainError(
                f"crs {crs!r} is not one PROJ knows; give e.g. 'EPSG:32633'."
            ) from None
    _require_metres(raster, role, path)
    if not np.isfinite(raster).any():
        raise TerrainError(f"{role}: {str(path)!r} is all nodata.")
    return raster


def _require_metres(raster: xr.DataArray, role: str, path: str | PathLike[str]) -> None:
    crs = raster.rio.crs
    if crs.is_projected and abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        raise TerrainError(
            f"{role}: {str(path)!r} is in {crs.linear_units}, but heights and distances must be in "
            "metres; warp it to a metric CRS and convert its heights."
        )


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
    return (
        a.shape == b.shape
        and a.rio.crs == b.rio.crs
        and a.rio.transform().almost_equals(b.rio.transform(), precision=1e-6)
    )
