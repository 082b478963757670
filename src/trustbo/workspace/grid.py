"""Planning grid: conversion between cells, positions and pixels, and means over cells."""

import math
import operator
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from rasterio.transform import from_origin

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, one_line, require_pair
from trustbo.terrain.pixels import index_within, order_along, row_and_col
from trustbo.terrain.place import converted, quiet_affine, require_proj

type Location = Cell | Mapping[str, float] | str
"""A cell (row, col), a position with named coordinates, or the name of a place of a workspace; see
`Grid.locate` and `Workspace.with_places`."""
WGS84 = "EPSG:4326"
MAX_MISSING = 0.5
"""Maximum fraction of a passable cell's pixels that may be missing or too steep."""


@dataclass(frozen=True, repr=False)
class Grid(Summary):
    """A regular grid of cells; row 0 is at the top (north).

    Attributes:
        shape: Number of rows and columns.
        left: x coordinate of the left edge, in CRS metres.
        top: y coordinate of the top edge, in CRS metres.
        cell_height: North-south size of a cell, in metres.
        cell_width: East-west size of a cell, in metres.
        crs: Coordinate reference system as WKT; None without a terrain.
    """

    shape: tuple[int, int]
    left: float
    top: float
    cell_height: float
    cell_width: float
    crs: str | None = None

    @classmethod
    def over(cls, terrain: xr.Dataset, shape: tuple[int, int]) -> "Grid":
        """Make a grid of the given shape that covers a terrain.

        Raises:
            TrustboError: The grid has fewer than 2 cells, or cells smaller than 2 x 2 pixels.
        """
        rows, cols = require_pair("shape", shape)
        pixels = terrain["dem"].shape
        if min(rows, cols) < 1 or rows * cols < 2:
            raise TrustboError(f"shape must be (rows, cols) with at least two cells; got {shape}.")

        if pixels[0] < 2 * rows or pixels[1] < 2 * cols:
            raise TrustboError(
                f"a grid of {rows} x {cols} cells needs at least 2 x 2 pixels per cell, but the "
                f"terrain has {pixels[0]} x {pixels[1]} pixels. Use fewer cells or a finer raster."
            )

        with quiet_affine():
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
        return [
            ("cells", f"{self.shape[0]} rows x {self.shape[1]} columns"),
            ("cell", f"{self.cell_height:.4g} m (north-south) x {self.cell_width:.4g} m"),
            ("corner", f"x {left:.10g}, y {bottom:.10g} m, lower left"),
            ("CRS", self.crs_name),
        ]

    def center(self, cell: Cell) -> tuple[float, float]:
        """Return the coordinates x and y of a cell's centre, in CRS metres."""
        row, col = require_pair("cell", cell)
        x = self.left + (col + 0.5) * self.cell_width
        return x, self.top - (row + 0.5) * self.cell_height

    @property
    def corner(self) -> tuple[float, float]:
        """Coordinates x and y of the lower left corner, in CRS metres."""
        return self.left, self.top - self.shape[0] * self.cell_height

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top edges, in CRS metres."""
        left, bottom = self.corner
        return left, bottom, left + self.shape[1] * self.cell_width, self.top

    @property
    def x(self) -> np.ndarray:
        """Coordinate x of the centre of each column, shape (col,), in CRS metres."""
        return self.left + (np.arange(self.shape[1]) + 0.5) * self.cell_width

    @property
    def y(self) -> np.ndarray:
        """Coordinate y of the centre of each row, shape (row,), in CRS metres."""
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
        """Find the cell at a location, whether or not it is passable.

        Args:
            location: Cell (row, col), or a position such as `{"x": 1748000.0, "y": 5427000.0}` in
                CRS metres or `{"lon": 174.7, "lat": -41.3}` in degrees (WGS 84).
            what: Name of the location in error messages.

        Raises:
            TrustboError: The location is invalid or off the grid, or is in degrees although the
                grid has no CRS.
        """
        try:
            row, col = self._row_and_col(location)
        except TrustboError:  # no CRS; a TrustboError is also a ValueError
            raise
        except (TypeError, ValueError, KeyError, OverflowError):
            raise TrustboError(
                f"{what} must be a cell (row, col) of whole numbers, or a position "
                '{"x": ..., "y": ...} in metres or {"lon": ..., "lat": ...} in degrees; '
                f"got {location!r}."
            ) from None

        rows, cols = self.shape
        if not (0 <= row < rows and 0 <= col < cols):
            raise TrustboError(
                f"{what} {location!r} is outside the grid, which covers rows 0 (top) to {rows - 1} "
                f"and columns 0 to {cols - 1}{self._extent_text()}."
            )

        return int(row), int(col)

    def _row_and_col(self, location: Any) -> tuple[float, float]:
        """Convert a location to a row and column, which are fractional for a position."""
        if not isinstance(location, Mapping):
            row, col = (operator.index(i) for i in location)
            return row, col

        return self.to_cell(*self.position(location))

    def position(self, location: Any) -> tuple[float, float]:
        """Return the coordinates x and y of a location, in CRS metres; see `locate`.

        A cell stands for its centre.
        """
        if not isinstance(location, Mapping):
            return self.center(location)

        names = ("lon", "lat") if "lon" in location else ("x", "y")
        x, y = (float(location[name]) for name in names)
        if len(location) > 2 or not math.isfinite(x + y):
            raise ValueError

        if names == ("lon", "lat"):
            x, y = converted(WGS84, self.require_crs(), x, y)
        return float(x), float(y)

    def to_cell(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Convert positions in CRS metres to fractional rows and columns of cells."""
        return row_and_col(x, y, (self.left, self.top), (self.cell_height, self.cell_width))

    def cells_at(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rows and columns of positions, each (position,), and which are on the grid."""
        rows, cols = self.shape
        row, col = self.to_cell(x, y)
        inside = (row >= 0.0) & (row < rows) & (col >= 0.0) & (col < cols)
        return index_within(row, rows), index_within(col, cols), inside

    def _extent_text(self) -> str:
        """Describe the extent of the grid for error messages; empty without a CRS."""
        if self.crs is None:
            return ""

        left, bottom, right, top = self.bounds
        to_degrees = Transformer.from_crs(self.require_crs(), WGS84, always_xy=True)
        west, south, east, north = to_degrees.transform_bounds(*self.bounds)

        return (
            f" (x {left:.1f} to {right:.1f} m and y {bottom:.1f} to {top:.1f} m in "
            f"{self.crs_name}; longitude {west:.5f} to {east:.5f}, latitude {south:.5f} to "
            f"{north:.5f})"
        )

    def lonlat(self, cell: Cell) -> tuple[float, float]:
        """Return the longitude and latitude of a cell's centre, in degrees (WGS 84).

        Raises:
            TrustboError: The cell is not a pair of whole numbers, the grid has no CRS, or the CRS
                is not valid at the cell.
        """
        x, y = self.center(cell)
        lon, lat = converted(self.require_crs(), WGS84, x, y)

        if not math.isfinite(lon + lat):
            raise TrustboError(
                f"({x:.10g}, {y:.10g}) is not a point on Earth in {self.crs_name}; correct the "
                "CRS of the terrain."
            )
        return lon, lat

    def place(self, maps: xr.Dataset) -> xr.Dataset:
        """Rename the dimensions (row, col) of maps to (y, x), and set the transform and the CRS."""
        placed = maps.drop_vars(["row", "col", "y", "x"], errors="ignore").rename(row="y", col="x")
        placed = placed.assign_coords(y=self.y, x=self.x)
        for axis in ("y", "x"):
            placed[axis].attrs = {"axis": axis.upper(), "units": "m"}

        if self.crs is not None:
            require_proj()
            placed = placed.rio.write_crs(self.crs)

        step = self.cell_width, self.cell_height
        return placed.rio.write_transform(from_origin(self.left, self.top, *step))

    def over_cells(self, what: str, values: xr.DataArray) -> xr.DataArray:
        """Return a map of the cells with the dims (row, col), in the order of the grid.

        Args:
            what: Name of the map in error messages.
            values: Map with the dims (row, col), or (y, x) as in `Result.maps`, in any order. Axes
                with coordinates are aligned by them, and other axes by position.

        Raises:
            TrustboError: The map has other dims or another shape, or its coordinates are not those
                of the cells.
        """
        dims = ("y", "x") if {"y", "x"} <= set(values.dims) else ("row", "col")
        others = [str(dim) for dim in values.dims if dim not in dims]
        if not set(dims) <= set(values.dims):
            raise TrustboError(
                f"{what} must have the dims (row, col) or (y, x); got {tuple(values.dims)}."
            )
        if others:
            raise TrustboError(
                f"{what} has one map for each {others[0]}; select one, e.g. with "
                f"{_selection(values, others[0])}."
            )

        values = values.transpose(*dims)
        if values.shape != self.shape:
            raise TrustboError(
                f"{what} must have the shape of the grid, {self.shape}; got {values.shape}."
            )

        rows, cols = (np.arange(n) for n in self.shape)
        centres = {
            "row": (dims[0], rows, 1.0),
            "col": (dims[1], cols, 1.0),
            "y": (dims[0], self.y, self.cell_height),
            "x": (dims[1], self.x, self.cell_width),
        }
        for name, (dim, expected, step) in centres.items():
            if name not in values.coords or values[name].dims != (dim,):
                continue
            order = order_along(expected, values[name].values, step)
            if order is None:
                raise TrustboError(
                    f"{what} has the {name} coordinates {one_line(values[name].values.tolist())}, "
                    f"but the cells have {one_line(expected.tolist())}; give a map of these cells, "
                    "or values without coordinates."
                )
            values = values.isel({dim: order})

        unlabelled = values.drop_vars(["y", "x", "row", "col"], errors="ignore")
        return unlabelled.rename(dict(zip(dims, ("row", "col"), strict=True)))

    def cell_means(self, values: xr.DataArray) -> np.ndarray:
        """Average the finite pixel values of each cell.

        Args:
            values: Pixel values, dims (y, x), on a raster that the grid covers.

        Returns:
            Means, shape (row, col); NaN where a cell has no finite value.
        """
        rows, cols = self.cells_along(values["y"].values, values["x"].values)
        total = np.zeros(self.shape)
        count = np.zeros(self.shape)
        for row, z in zip(rows, values.transpose("y", "x").values, strict=True):
            valid = np.isfinite(z)
            np.add.at(total[row], cols[valid], z[valid])
            np.add.at(count[row], cols[valid], 1.0)

        with np.errstate(invalid="ignore"):
            return total / count

    def cells_along(self, y: ArrayLike, x: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the row of the cell at each `y` and the column of the cell at each `x`."""
        row, col = self.to_cell(np.asarray(x), np.asarray(y))
        return index_within(row, self.shape[0]), index_within(col, self.shape[1])

    def require_crs(self) -> CRS:
        """Return the CRS; raises TrustboError if the grid has none."""
        if self.crs is None:
            raise TrustboError(
                "the grid has no coordinate reference system, because the workspace was not made "
                "from a terrain; give positions as x and y in metres."
            )
        return CRS.from_user_input(self.crs)


def _selection(values: xr.DataArray, dim: str) -> str:
    """Return the code that selects the first entry of an axis, such as `.sel(robot='r1')`."""
    if dim in values.coords and values.sizes[dim]:
        return f".sel({dim}={values[dim].values.tolist()[0]!r})"
    return f".isel({dim}=0)"
