"""Alignment of two rasters on one metric grid, window by window."""

import dataclasses
import math

import numpy as np
from pyproj import Proj
from pyproj.exceptions import ProjError
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.transform import array_bounds
from rasterio.warp import calculate_default_transform, reproject, transform_bounds
from rasterio.warp import transform as transform_points

from trustbo.errors import TerrainError
from trustbo.terrain.raster import Raster

# A warp is computed in blocks, limited in columns of the result and in pixels of the source.
BLOCK = 2048
BLOCK_PIXELS = 2**23


def on_one_grid(ground: Raster, surface: Raster) -> tuple[Raster, Raster]:
    """Warp the ground to a metric grid, unless it is on one, and the surface to the same."""
    if ground.crs.is_geographic or _distorts(ground):
        ground = _to_utm(ground)
    _require_overlap(ground, surface)
    if not _same_grid(ground, surface):
        surface = _warped(surface, ground.crs, ground.transform, ground.shape)
    return ground, dataclasses.replace(surface, transform=ground.transform)


def _distorts(raster: Raster) -> bool:
    """Whether the scale of the map is more than 1 % off on the ground."""
    left, bottom, right, top = raster.bounds
    projection = Proj(raster.crs.to_wkt())
    lon, lat = projection((left + right) / 2, (bottom + top) / 2, inverse=True)
    if not np.isfinite([lon, lat]).all():
        raise _nowhere(raster)
    return abs(np.sqrt(projection.get_factors(lon, lat).areal_scale) - 1.0) > 0.01


def _to_utm(raster: Raster) -> Raster:
    """Raster warped to square pixels in its UTM zone."""
    try:
        crs = raster.array(np.float32).rio.estimate_utm_crs()
    except (RuntimeError, ProjError):
        raise _nowhere(raster) from None
    rows, cols = raster.shape
    transform, width, height = calculate_default_transform(
        raster.crs, crs, cols, rows, *raster.bounds
    )
    return _warped(raster, crs, transform, (height, width))


def _nowhere(raster: Raster) -> TerrainError:
    bounds = ", ".join(f"{edge:.8g}" for edge in raster.bounds)
    order = ", x being the longitude and y the latitude" if raster.crs.is_geographic else ""
    return TerrainError(
        f"{raster.name} has CRS {raster.crs.to_string()}, but its bounds ({bounds}) are no place "
        f"on Earth in it; give the CRS its coordinates are in{order}."
    )


def _require_overlap(ground: Raster, surface: Raster) -> None:
    left, bottom, right, top = ground.bounds
    box = transform_bounds(surface.crs, ground.crs, *surface.bounds)
    if not np.isfinite(box).all():
        raise _nowhere(surface)
    if box[0] >= right or box[2] <= left or box[1] >= top or box[3] <= bottom:
        names = ", ".join(f"{e:.1f}" for e in (left, bottom, right, top))
        other = ", ".join(f"{e:.1f}" for e in box)
        raise TerrainError(
            f"{ground.name} and {surface.name} do not overlap: in "
            f"{ground.crs.to_string()} they cover ({names}) and ({other}) as (left, bottom, "
            "right, top). Give two rasters of one place."
        )


def _same_grid(a: Raster, b: Raster) -> bool:
    """Whether two rasters' pixels coincide to a thousandth of a pixel."""
    tolerance = 1e-3 * np.array([a.transform.a, -a.transform.e] * 2)
    return (
        a.crs == b.crs
        and a.shape == b.shape
        and bool((abs(np.subtract(a.bounds, b.bounds)) <= tolerance).all())
    )


def _warped(raster: Raster, crs: CRS, transform: Affine, shape: tuple[int, int]) -> Raster:
    """Raster warped to another grid, bilinear, computed when it is read.

    A pixel has the same value in every window that is read: GDAL's kernel keeps one width, and its
    transformer, which interpolates along rows, always gets whole blocks of columns.
    """
    scale = _scale(raster, crs, transform, shape)
    depth = max(1, min(BLOCK, int(BLOCK_PIXELS * scale[0] * scale[1] / BLOCK)))

    def block(rows: slice, cols: slice) -> np.ndarray:
        corner = transform * Affine.translation(cols.start, rows.start)
        heights = np.full((rows.stop - rows.start, cols.stop - cols.start), np.nan)
        window = _window_under(raster, crs, array_bounds(*heights.shape, corner), scale)
        if window is not None:
            reproject(
                np.ascontiguousarray(raster.read(*window)),
                heights,
                src_transform=raster.transform
                * Affine.translation(window[1].start, window[0].start),
                src_crs=raster.crs,
                src_nodata=np.nan,
                dst_transform=corner,
                dst_crs=crs,
                dst_nodata=np.nan,
                resampling=Resampling.bilinear,
                tolerance=1e-3,  # pixels
                warp_mem_limit=512,
                XSCALE=scale[0],
                YSCALE=scale[1],
            )
        return heights

    def read(rows: slice, cols: slice) -> np.ndarray:
        left, right = cols.start // BLOCK * BLOCK, min(-(-cols.stop // BLOCK) * BLOCK, shape[1])
        heights = np.empty((rows.stop - rows.start, right - left))
        for r in range(0, len(heights), depth):
            for c in range(0, right - left, BLOCK):
                piece = heights[r : r + depth, c : c + BLOCK]
                row, col = rows.start + r, left + c
                piece[:] = block(slice(row, row + piece.shape[0]), slice(col, col + piece.shape[1]))
        return heights[:, cols.start - left : cols.stop - left]

    return Raster(raster.name, crs, transform, shape, read)


def _scale(
    raster: Raster, crs: CRS, transform: Affine, shape: tuple[int, int]
) -> tuple[float, float]:
    """Pixels of the new grid per pixel of the raster, along columns and along rows."""
    middle = transform * (shape[1] / 2, shape[0] / 2)
    u, v = (points[0] for points in transform_points(crs, raster.crs, [middle[0]], [middle[1]])[:2])
    t = raster.transform
    x, y = transform_points(raster.crs, crs, [u, u + t.a, u], [v, v, v + t.e])[:2]
    steps = [[(x[1] - x[0]) / transform.a, (x[2] - x[0]) / transform.a]]
    steps += [[(y[1] - y[0]) / transform.e, (y[2] - y[0]) / transform.e]]
    along_columns, along_rows = 1.0 / np.linalg.norm(np.linalg.inv(steps), axis=0)
    return float(along_columns), float(along_rows)


def _window_under(
    raster: Raster, crs: CRS, box: tuple[float, float, float, float], scale: tuple[float, float]
) -> tuple[slice, slice] | None:
    """Rows and columns of the raster that a box in another CRS needs, None off the raster."""
    left, bottom, right, top = transform_bounds(crs, raster.crs, *box)
    if raster.crs.is_geographic:
        # The raster may count longitudes past 180 degrees, or from 0 to 360.
        right += 360.0 * (right < left)
        middle = (raster.bounds[0] + raster.bounds[2]) / 2
        turn = 360.0 * round((middle - (left + right) / 2) / 360.0)
        left, right = left + turn, right + turn
    t = raster.transform
    edges = ((top - t.f) / t.e, (bottom - t.f) / t.e), ((left - t.c) / t.a, (right - t.c) / t.a)
    window = []
    for (low, high), size, shrink in zip(edges, raster.shape, scale[::-1], strict=True):
        margin = 2 + math.ceil(1.0 / min(shrink, 1.0))
        start, stop = max(math.floor(low) - margin, 0), min(math.ceil(high) + margin, size)
        if start >= stop:
            return None
        window.append(slice(start, stop))
    return window[0], window[1]
