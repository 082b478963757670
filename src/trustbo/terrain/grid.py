"""The planning grid: which cell a position or a pixel belongs to, and means over cells."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from trustbo.data import Cell
from trustbo.errors import TerrainError, TrustboError, require_pair


@dataclass(frozen=True)
class Grid:
    """A regular grid of cells; row 0 at the top (north).

    Attributes:
        shape: Number of rows and columns.
        left: x of the left edge, CRS metres.
        top: y of the top edge, CRS metres.
        cell_height: North-south size of a cell, m.
        cell_width: East-west size of a cell, m.
    """

    shape: tuple[int, int]
    left: float
    top: float
    cell_height: float
    cell_width: float

    @classmethod
    def over(cls, terrain: xr.Dataset, shape: tuple[int, int]) -> "Grid":
        """The grid of a given shape that covers a terrain.

        Raises:
            TerrainError: Fewer than 2 cells, or cells smaller than 2 pixels.
        """
        rows, cols = require_pair("shape", shape)
        pixels = terrain["dem"].shape
        if min(rows, cols) < 1 or rows * cols < 2:
            raise TerrainError(f"shape must be (rows, cols) with at least two cells; got {shape}.")
        if pixels[0] < 2 * rows or pixels[1] < 2 * cols:
            raise TerrainError(
                f"a grid of {rows} x {cols} cells needs at least 2 x 2 pixels per cell; the "
                f"terrain has {pixels[0]} x {pixels[1]} pixels. Take a smaller shape or a finer "
                "raster."
            )
        left, bottom, right, top = terrain.rio.bounds(recalc=True)
        return cls((rows, cols), left, top, (top - bottom) / rows, (right - left) / cols)

    def center(self, cell: Cell) -> tuple[float, float]:
        """X and y of a cell's centre, CRS metres."""
        row, col = cell
        x = self.left + (col + 0.5) * self.cell_width
        return x, self.top - (row + 0.5) * self.cell_height

    @property
    def x(self) -> np.ndarray:
        """X of the columns' centres, CRS metres, shape (col,)."""
        return self.left + (np.arange(self.shape[1]) + 0.5) * self.cell_width

    @property
    def y(self) -> np.ndarray:
        """Y of the rows' centres, CRS metres, shape (row,)."""
        return self.top - (np.arange(self.shape[0]) + 0.5) * self.cell_height

    def cell_at(self, x: float, y: float) -> Cell:
        """The cell that holds a position in CRS metres.

        Raises:
            TrustboError: The position is off the grid.
        """
        row = int(np.floor((self.top - y) / self.cell_height))
        col = int(np.floor((x - self.left) / self.cell_width))
        if not (0 <= row < self.shape[0] and 0 <= col < self.shape[1]):
            raise TrustboError(f"position ({x:g}, {y:g}) is off the grid.")
        return row, col

    def cell_means(self, values: xr.DataArray) -> np.ndarray:
        """Mean over each cell's pixels that have data.

        Args:
            values: Dims (y, x), on a raster that the grid covers.

        Returns:
            Shape (row, col); NaN where a cell has no data.
        """
        array = values.transpose("y", "x").values.astype(float)
        known = np.isfinite(array)
        total = self._sums(values, np.where(known, array, 0.0))
        with np.errstate(invalid="ignore"):
            return total / self._sums(values, known.astype(float))

    def cell_share(self, condition: xr.DataArray) -> np.ndarray:
        """Share of each cell's pixels where a condition holds, shape (row, col)."""
        array = condition.transpose("y", "x").values.astype(float)
        return self._sums(condition, array) / self._sums(condition, np.ones_like(array))

    def cells_along(self, y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row of the cells that pixels at `y` are in, and column of those at `x`."""
        rows, cols = self.shape
        row = np.clip(((self.top - y) / self.cell_height).astype(int), 0, rows - 1)
        return row, np.clip(((x - self.left) / self.cell_width).astype(int), 0, cols - 1)

    def _sums(self, like: xr.DataArray, array: np.ndarray) -> np.ndarray:
        rows, cols = self.shape
        row, col = self.cells_along(like["y"].values, like["x"].values)
        label = row[:, None] * cols + col[None, :]
        return np.bincount(label.ravel(), array.ravel(), rows * cols).reshape(rows, cols)
