"""Square pixels along the axes of a frame, as maps for robots have them."""

import math
from typing import NamedTuple

import numpy as np

from trustbo.errors import TrustboError, require_positive
from trustbo.export.frame import PlacedFrame
from trustbo.workspace import Workspace

_MOST_PIXELS = 100_000_000


class Raster(NamedTuple):
    """Map in the layout of ROS."""

    values: np.ndarray  # (..., row, col), the southern row first
    resolution: float  # m
    corner: tuple[float, float]  # lower left, x and y in the frame, m


def sampled(
    cells: np.ndarray,
    fill: float,
    workspace: Workspace,
    resolution: float | None,
    frame: PlacedFrame,
) -> Raster:
    """Map of values of cells (..., row, col), the northern row first, `fill` beyond the grid.

    A pixel has the value of the cell at its centre. TrustboError: a resolution that is not
    positive, or far too fine.
    """
    grid = workspace.grid
    rows, cols = grid.shape
    side = _resolution(workspace, resolution, turned=frame.rotation != 0.0)
    left, bottom, right, top = grid.bounds
    if frame.rotation:
        corners = frame.of_crs(np.array([[a, b] for a in (left, right) for b in (bottom, top)]))
        corner, extent = corners.min(0), np.ptp(corners, axis=0)
    else:
        corner = frame.of_crs(np.array(grid.corner))
        extent = np.array([cols * grid.cell_width, rows * grid.cell_height])
    width, height = extent / side
    if height * width > _MOST_PIXELS:
        raise TrustboError(
            f"resolution={side:g} m gives {height * width:.1e} pixels; take a coarser one."
        )
    # The quotient may be whole up to rounding.
    n_x, n_y = (math.ceil(n - 1e-6) for n in (width, height))
    values = np.full((*cells.shape[:-2], n_y, n_x), fill, cells.dtype)
    # From the lower left corner on: along a row of pixels, and from row to row.
    axes = frame.axes
    offset = frame.to_crs(corner) - grid.corner if frame.rotation else np.zeros(2)
    along = (np.arange(n_x)[:, None] + 0.5) * side * axes[0]
    for i in range(n_y):
        x, y = (offset + along + (i + 0.5) * side * axes[1]).T
        row, col = rows - 1 - np.floor(y / grid.cell_height), np.floor(x / grid.cell_width)
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        values[..., i, inside] = cells[..., row[inside].astype(int), col[inside].astype(int)]
    x, y = corner.tolist()
    return Raster(values, side, (x, y))


def _resolution(workspace: Workspace, resolution: float | None, *, turned: bool) -> float:
    """Side of a pixel, m; by default a number that one can read."""
    if resolution is not None:
        return require_positive("resolution", resolution)
    height, width = workspace.grid.cell_height, workspace.grid.cell_width
    is_round = math.isclose(width, round(width, 2), rel_tol=1e-9)
    if math.isclose(height, width, rel_tol=1e-6) and is_round and not turned:
        return round(width, 2)
    # Pixels of ROS are square; with ten per cell, its edges are off by a twentieth at most.
    return float(f"{min(height, width) / 10.0:.2g}")
