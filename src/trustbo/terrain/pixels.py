"""Pixels of a raster with north at the top: their size, and the pixels at given positions.

The functions of positions accept NumPy arrays, or numbers in kernels, into which they are compiled.
They also apply to planning grids, whose cells are large pixels. Kernels that are cached on disk do
not notice changes to these functions: after a change, delete `__pycache__/*.nb?`.
"""

from typing import Any

import numpy as np
import xarray as xr
from numba.extending import register_jitable

from trustbo.errors import require_kind

_TOLERANCE = 0.01
"""Largest distance of a coordinate from the centre of its pixel, as a fraction of the pixel."""


def pixel_size(terrain: xr.Dataset) -> tuple[float, float]:
    """Return pixel height and width in metres.

    Example:
        >>> tb.terrain.pixel_size(tb.terrain.example())
        (1.0, 1.0)
    """
    require_kind("terrain", terrain, xr.Dataset, "give a Dataset as from read_terrain")
    y, x = (terrain.variables[axis].values for axis in ("y", "x"))
    return abs(float(y[-1] - y[0])) / (len(y) - 1), abs(float(x[-1] - x[0])) / (len(x) - 1)


@register_jitable(error_model="numpy")
def row_and_col(x: Any, y: Any, origin: Any, pixel: Any) -> Any:
    """Convert positions to fractional rows and columns.

    `origin` is the position (x, y) of row 0 and column 0; `pixel` is the size (height, width).
    """
    return (origin[1] - y) / pixel[0], (x - origin[0]) / pixel[1]


@register_jitable(error_model="numpy")
def nearest_pixel(x: Any, y: Any, origin: Any, pixel: Any, shape: Any) -> Any:
    """Return the row and the column of the pixels nearest to positions.

    `origin` is the centre of pixel (0, 0). A position on the edge of two pixels is in the southern
    or eastern one; a position off the raster belongs to a pixel at its edge.
    """
    row, col = row_and_col(x, y, origin, pixel)
    return index_within(row + 0.5, shape[0]), index_within(col + 0.5, shape[1])


@register_jitable
def index_within(x: Any, n: Any) -> Any:
    """Round down to indices from 0 to n - 1; NaN becomes 0, so that kernels stay in the raster."""
    return np.int64(np.fmin(np.fmax(np.floor(x), 0.0), n - 1.0))


def order_along(centres: np.ndarray, coordinates: np.ndarray, step: float) -> np.ndarray | None:
    """Return which of the coordinates is at each centre; None if they are not those of the centres.

    Args:
        centres: Centres of the pixels along an axis, shape (pixel,), in any order.
        coordinates: Coordinates of the user's values, in any order.
        step: Size of a pixel.
    """
    if coordinates.shape != centres.shape or coordinates.dtype.kind not in "iuf":
        return None

    of_centres = np.argsort(centres)
    of_coordinates = np.argsort(coordinates)
    away = np.abs(coordinates[of_coordinates] - centres[of_centres])
    if not (away <= _TOLERANCE * step).all():  # also NaN
        return None

    order = np.empty(len(centres), dtype=int)
    order[of_centres] = of_coordinates
    return order
