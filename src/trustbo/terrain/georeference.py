"""Georeference of rasters: place on Earth, direction of the axes, units."""

import dataclasses
from collections.abc import Hashable

import numpy as np
import xarray as xr
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.transform import from_origin

from trustbo.errors import TerrainError, require_positive
from trustbo.terrain.raster import Raster
from trustbo.terrain.units import METRE, height_unit, metric_heights


def placed(raster: Raster, referenced: bool, crs: object, resolution: float | None) -> Raster:
    """Raster with its place on Earth, north up; refused if that is unknown."""
    if min(raster.shape) < 2:
        raise TerrainError(
            f"{raster.name} has {raster.shape[0]} x {raster.shape[1]} pixels; a terrain needs at "
            "least two rows and two columns."
        )
    if not referenced:
        raster = _georeference(raster, crs, resolution)
    elif raster.transform.b or raster.transform.d:
        raise TerrainError(
            f"{raster.name} is on a rotated grid; warp it to north-up first, e.g. with gdalwarp."
        )
    if raster.crs is None:
        raster = dataclasses.replace(raster, crs=_given_crs(raster.name, crs))
    raster = dataclasses.replace(raster, crs=metric_heights(raster.crs))
    if not raster.crs.is_geographic:
        require_metric_crs(raster.crs, raster.name)
    return _north_up(raster)


def _georeference(raster: Raster, crs: object, resolution: float | None) -> Raster:
    """Put an image without a georeference at the origin, with the given pixel size."""
    if resolution is None or crs is None:
        raise TerrainError(
            f"{raster.name} carries no georeference; pass both crs= and resolution= (metres)."
        )
    given = _given_crs(raster.name, crs)
    if given.is_geographic:
        raise TerrainError(
            f"crs {crs!r} is in degrees, but resolution= is in metres; give a metric one."
        )
    step = require_positive("resolution", resolution)
    transform = from_origin(0.0, raster.shape[0] * step, step, step)
    return dataclasses.replace(raster, crs=raster.crs or given, transform=transform)


def _given_crs(name: str, crs: object) -> CRS:
    if crs is None:
        raise TerrainError(
            f"{name} has no coordinate reference system; pass crs=, e.g. EPSG:32633."
        )
    return known_crs(crs)


def known_crs(crs: object) -> CRS:
    """Coordinate reference system that a user gave; refused if unknown to PROJ."""
    try:
        return CRS.from_user_input(crs)
    except CRSError:
        raise TerrainError(f"crs {crs!r} is not one PROJ knows; give e.g. 'EPSG:32633'.") from None


def _north_up(raster: Raster) -> Raster:
    """Turn the first row to the north and the first column to the west."""
    t, (height, width) = raster.transform, raster.shape
    south_first, east_first = t.e > 0.0, t.a < 0.0
    if not (south_first or east_first):
        return raster

    def read(rows: slice, cols: slice) -> np.ndarray:
        if south_first:
            rows = slice(height - rows.stop, height - rows.start)
        if east_first:
            cols = slice(width - cols.stop, width - cols.start)
        return raster.read(rows, cols)[:: -1 if south_first else 1, :: -1 if east_first else 1]

    left, bottom, right, top = raster.bounds
    transform = Affine(abs(t.a), 0.0, min(left, right), 0.0, -abs(t.e), max(bottom, top))
    return dataclasses.replace(raster, transform=transform, read=read)


def require_metres(heights: xr.DataArray, name: str) -> None:
    """Refuse heights not in metres, by attributes and vertical axis of their CRS: TerrainError."""
    unit = height_unit(name, heights.attrs.get("units"), heights.rio.crs)
    if unit != METRE:
        raise TerrainError(
            f"{name} has heights in {unit.name!r}, not metres; read it with read_terrain, which "
            "converts them."
        )


def require_metric_crs(crs: CRS | None, name: str) -> None:
    """Refuse a map without CRS, or with one in another unit than metres: TerrainError."""
    if crs is None:
        raise TerrainError(f"{name} has no CRS; set it, e.g. dem.rio.write_crs('EPSG:32633').")
    if crs.is_geographic:
        raise TerrainError(
            f"{name} is in degrees; reproject it, e.g. with "
            "dem.rio.reproject(dem.rio.estimate_utm_crs())."
        )
    try:
        metres = crs.linear_units_factor[1]
    except CRSError:
        raise TerrainError(
            f"{name} is in a CRS that is no map of the Earth; give it a projected one, e.g. "
            "'EPSG:32633'."
        ) from None
    if abs(metres - 1.0) > 1e-9:
        raise TerrainError(
            f"{name} is in {crs.linear_units}, but heights and distances must be in metres; warp "
            "it to a metric CRS and convert its heights."
        )


def require_regular(values: np.ndarray, axis: Hashable, name: str) -> None:
    """Refuse coordinates that are fewer than two, or not evenly spaced: TerrainError."""
    steps = np.diff(values)
    if not len(steps) or not np.allclose(steps, steps[0], rtol=1e-3) or steps[0] == 0.0:
        raise TerrainError(
            f"{name}'s {axis} is not a regular axis of two pixels or more; resample it to evenly "
            "spaced, sorted coordinates."
        )
