"""Planning grid: conversion between cells, positions and pixels, and means over cells."""

import math
import operator
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from rasterio.crs import CRS
from rasterio.transform import from_origin
from rasterio.warp import transform as transform_points
from rasterio.warp import transform_bounds

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_pair

type Location = Cell | Mapping[str, float]
"""A cell (row, col), or a position with named coordinates, see `Grid.locate`."""
WGS84 = CRS.from_epsg(4326)
MAX_MISSING = 0.5
"""Maximum fraction of missing or too steep pixels in a passable cell."""


@dataclass(frozen=True, repr=False)
class Grid(Summary):
    """A regular grid of cells; row 0 is at the top (north).

    Attributes:
        shape: Number of rows and columns.
        left: x of the left edge, CRS metres.
        top: y of the top edge, CRS metres.
        cell_height: North-south size of a cell, m.
        cell_width: East-west size of a cell, m.
        crs: Coordinate reference system, as WKT; None without a terrain.
    """

    shape: tuple[int, int]
    left: float
    top: float
    cell_height: float
    cell_width: float
    crs: str | None = None

    @classmethod
    def over(cls, terrain: xr.Dataset, shape: tuple[int, int]) -> "Grid":
        """Make a grid of a given shape that covers a terrain.

        Raises:
            TrustboError: There are fewer than 2 cells, or cells are smaller than 2 pixels.
        """
        rows, cols = require_pair("shape", shape)
        pixels = terrain["dem"].shape
        if min(rows, cols) < 1 or rows * cols < 2:
            raise TrustboError(f"shape must be (rows, cols) with at least two cells; got {shape}.")
        if pixels[0] < 2 * rows or pixels[1] < 2 * cols:
            raise TrustboError(
                f"a grid of {rows} x {cols} cells needs at least 2 x 2 pixels per cell; the "
                f"terrain has {pixels[0]} x {pixels[1]} pixels. Take a smaller shape or a finer "
                "raster."
            )
        left, bottom, right, top = terrain.rio.bounds(recalc=True)
        crs = terrain.rio.crs
        return cls(
            (rows, cols),
            left,
            top,
            (top - bottom) / rows,
            (right - left) / cols,
            None if crs is None else crs.to_wkt(),
        )

    def _rows(self) -> Rows:
        left, bottom = self.corner
        rows = [
            ("cells", f"{self.shape[0]} rows x {self.shape[1]} columns"),
            ("cell", f"{self.cell_height:.4g} m (north-south) x {self.cell_width:.4g} m"),
            ("corner", f"x {left:.10g}, y {bottom:.10g} m, lower left"),
            ("CRS", self.crs_name),
        ]
        return rows

    def center(self, cell: Cell) -> tuple[float, float]:
        """Return x and y of a cell's centre, CRS metres."""
        row, col = require_pair("cell", cell)
        x = self.left + (col + 0.5) * self.cell_width
        return x, self.top - (row + 0.5) * self.cell_height

    @property
    def corner(self) -> tuple[float, float]:
        """X and y of the lower left corner, CRS metres."""
        return self.left, self.top - self.shape[0] * self.cell_height

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top, CRS metres."""
        left, bottom = self.corner
        return left, bottom, left + self.shape[1] * self.cell_width, self.top

    @property
    def x(self) -> np.ndarray:
        """X of the centre of each column, CRS metres, shape (col,)."""
        return self.left + (np.arange(self.shape[1]) + 0.5) * self.cell_width

    @property
    def y(self) -> np.ndarray:
        """Y of the centre of each row, CRS metres, shape (row,)."""
        return self.top - (np.arange(self.shape[0]) + 0.5) * self.cell_height

    @property
    def crs_name(self) -> str:
        """Short name of the CRS, such as EPSG:2193."""
        if self.crs is None:
            return "no CRS"
        crs = self.require_crs()
        code = crs.to_epsg()
        return f"EPSG:{code}" if code else re.findall(r'"(.*?)"', crs.to_wkt())[0]

    def locate(self, location: Location, what: str = "location") -> Cell:
        """Find the cell of a location, which may be impassable.

        Args:
            location: Cell (row, col); or a position, `{"x": 1748000.0, "y": 5427000.0}` in metres
                of the CRS, or `{"lon": 174.7, "lat": -41.3}` in degrees (WGS 84).
            what: Name of the location in messages.

        Raises:
            TrustboError: The location is invalid, off the grid, or in degrees on a grid without a
                CRS.
        """
        try:
            row, col = self._row_and_col(location)
        except TrustboError:  # no CRS
            raise
        except (TypeError, ValueError, KeyError, OverflowError):
            raise TrustboError(
                f"{what} must be a cell (row, col), whole numbers; or a position, "
                '{"x": ..., "y": ...} in metres or {"lon": ..., "lat": ...} in degrees; '
                f"got {location!r}."
            ) from None
        rows, cols = self.shape
        if not (0 <= row < rows and 0 <= col < cols):
            raise TrustboError(
                f"{what} {location!r} is outside the grid of {rows} rows and {cols} columns; rows "
                f"are 0..{rows - 1} from the top, columns 0..{cols - 1}{self._extent_text()}."
            )
        return int(row), int(col)

    def _row_and_col(self, location: Location) -> tuple[float, float]:
        """Return the row and column of a location, fractional for a position, even off the grid."""
        if not isinstance(location, Mapping):
            row, col = (operator.index(i) for i in location)
            return row, col
        names = ("lon", "lat") if "lon" in location else ("x", "y")
        x, y = (float(location[name]) for name in names)
        if len(location) > 2 or not math.isfinite(x + y):
            raise ValueError
        if names == ("lon", "lat"):
            x, y = _moved(WGS84, self.require_crs(), x, y)
        return (self.top - y) / self.cell_height, (x - self.left) / self.cell_width

    def _extent_text(self) -> str:
        """Describe the extent in the CRS and in degrees; empty without a CRS."""
        if self.crs is None:
            return ""
        left, bottom, right, top = self.bounds
        west, south, east, north = transform_bounds(self.require_crs(), WGS84, *self.bounds)
        return (
            f", x {left:.1f} to {right:.1f} and y {bottom:.1f} to {top:.1f} m in {self.crs_name}, "
            f"longitude {west:.5f} to {east:.5f} and latitude {south:.5f} to {north:.5f}"
        )

    def lonlat(self, cell: Cell) -> tuple[float, float]:
        """Return the longitude and latitude of a cell's centre, degrees (WGS 84).

        Raises:
            TrustboError: There is no such cell, the grid has no CRS, or the cell is not on Earth in
                it.
        """
        x, y = self.center(cell)
        lon, lat = _moved(self.require_crs(), WGS84, x, y)
        if not math.isfinite(lon + lat):
            raise TrustboError(
                f"({x:.10g}, {y:.10g}) is not on Earth in {self.crs_name}; give the terrain "
                "the CRS that its coordinates are in."
            )
        return lon, lat

    def place(self, maps: xr.Dataset) -> xr.Dataset:
        """Georeference maps of the cells (row, col): dims (y, x), with transform and CRS."""
        placed = maps.drop_vars(["row", "col", "y", "x"], errors="ignore").rename(row="y", col="x")
        placed = placed.assign_coords(y=self.y, x=self.x)
        for axis in ("y", "x"):
            placed[axis].attrs = {"axis": axis.upper(), "units": "m"}
        if self.crs is not None:
            placed = placed.rio.write_crs(self.require_crs())
        step = self.cell_width, self.cell_height
        return placed.rio.write_transform(from_origin(self.left, self.top, *step))

    def cell_means(self, values: xr.DataArray) -> np.ndarray:
        """Average over each cell's pixels with data.

        Args:
            values: Values of pixels, dims (y, x), on a raster that the grid covers.

        Returns:
            Shape (row, col); NaN where a cell has no data.
        """
        row, col = self.cells_along(values["y"].values, values["x"].values)
        cell, z = row[:, None] * self.shape[1] + col, values.transpose("y", "x").values
        valid = np.isfinite(z)
        total, count = (
            np.bincount(cell[valid], weights, math.prod(self.shape)) for weights in (z[valid], None)
        )
        with np.errstate(invalid="ignore"):
            return (total / count).reshape(self.shape)

    def cells_along(self, y: ArrayLike, x: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Find the row of the cell of each pixel at `y`, and the column for each pixel at `x`."""
        rows, cols = self.shape
        row = ((self.top - np.asarray(y)) / self.cell_height).astype(int)
        col = ((np.asarray(x) - self.left) / self.cell_width).astype(int)
        return np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)

    def require_crs(self) -> CRS:
        """Return the CRS of the grid; TrustboError if it has none."""
        if self.crs is None:
            raise TrustboError(
                "this grid has no coordinate reference system: its workspace was not made from a "
                "terrain. Give positions as x and y, in metres."
            )
        return CRS.from_user_input(self.crs)


def _moved(source: CRS, target: CRS, x: float, y: float) -> tuple[float, float]:
    """Convert a position to another CRS; infinite if it is not on Earth in one of them."""
    try:
        (u,), (v,) = transform_points(source, target, [x], [y])[:2]
    except Exception:  # PROJ's errors are GDAL's, without a common base
        return math.inf, math.inf
    return u, v


def over_cells[Map: (xr.Dataset, xr.DataArray)](maps: Map) -> Map:
    """Rename the dimensions (y, x) of `Result.maps` to (row, col)."""
    if not {"y", "x"} <= set(maps.dims):
        return maps
    return maps.drop_vars(["y", "x"], errors="ignore").rename(y="row", x="col")
