"""Georeference of rasters: place on Earth, and direction of the axes."""

import dataclasses

import numpy as np
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.transform import from_origin

from trustbo.errors import TerrainError, require_positive
from trustbo.terrain.metric import metric_heights, require_metric_crs
from trustbo.terrain.raster import Raster


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
    place = metric_heights(raster.crs or _given_crs(raster.name, crs))
    raster = dataclasses.replace(raster, crs=place)
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
