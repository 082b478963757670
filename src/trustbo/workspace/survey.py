"""Survey of a terrain: the grid, and the cells without data or too steep, before awareness."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError
from trustbo.team import Team
from trustbo.terrain.features import slope
from trustbo.terrain.read import pixel_size, require_terrain
from trustbo.workspace.grid import MAX_MISSING, Grid
from trustbo.workspace.location import Location, cell_of, crs_name, spans


@dataclass(frozen=True, eq=False, repr=False)
class Survey(Summary):
    """Grid of a terrain, and the cells that robots can stand in, from heights alone.

    Attributes:
        grid: Positions of the cells.
        team: Lead and robots, whose `max_slope` makes cells impassable.
        cells: Dataset (row, col) of `missing`, the share of pixels without data; `steep`, the share
            of those with data that is too steep; the mean `height`, m; and `passable`.
        heights: Least and greatest height, m.
        pixel: Height and width of a pixel, m.
        shape: Rows and columns of pixels.
    """

    grid: Grid
    team: Team
    cells: xr.Dataset
    heights: tuple[float, float]
    pixel: tuple[float, float]
    shape: tuple[int, int]

    @property
    def passable(self) -> np.ndarray:
        """Whether robots can stand in each cell, (row, col)."""
        return self.cells["passable"].values

    @property
    def ends(self) -> tuple[Cell, Cell]:
        """Suggested start and goal: the passable cells nearest to the south-west and north-east."""
        free = np.argwhere(self.passable)
        if len(free) < 2:
            raise TrustboError(
                "fewer than two cells are passable: the rest is missing or too steep. Use other "
                "cells, or a team with a larger max_slope."
            )
        place = free / np.maximum(np.array(self.grid.shape) - 1, 1)
        start, goal = (
            tuple(free[np.argmin(((place - corner) ** 2).sum(1))].tolist())
            for corner in ((1, 0), (0, 1))
        )
        return start, goal

    def require_cell(self, what: str, location: Location) -> Cell:
        """Check that a location is in a passable cell, and return the cell as a pair of ints.

        Raises:
            TrustboError: It is no location, off the grid, without data, or too steep.
        """

        def why(row: int, col: int) -> str:
            return reason_impassable(float(self.cells["missing"][row, col]), self.team)

        return cell_of(what, location, self.grid, self.passable, why)

    def _rows(self) -> Rows:
        grid, (low, high), free = self.grid, self.heights, self.passable
        (height, width), (rows, cols) = self.pixel, grid.shape
        x, y, longitude, latitude = spans(grid)
        rows_of = [
            ("CRS", crs_name(grid)),
            ("extent", f"{x}, {y} m"),
            ("", f"{longitude}, {latitude}"),
            ("pixels", f"{self.shape[0]} x {self.shape[1]} of {height:.3g} m x {width:.3g} m"),
            ("cells", f"{grid.cell_height:.4g} m (north-south) x {grid.cell_width:.4g} m"),
            ("names", f"0,0 is north-west, {rows - 1},{cols - 1} south-east: row,col"),
            ("heights", f"{low:.1f} to {high:.1f} m"),
            ("no data", f"{self.cells['missing'].mean().item():.1%} of the area"),
            ("impassable", f"{(~free).sum()} of {free.size} cells ({(~free).mean():.0%})"),
        ]
        if free.sum() > 1:
            for name, (row, col) in zip(("start", "goal"), self.ends, strict=True):
                (east, north), (lon, lat) = grid.center((row, col)), grid.lonlat((row, col))
                text = f"{row},{col} or x={east:.1f},y={north:.1f} or lon={lon:.6f},lat={lat:.6f}"
                rows_of.append((f"e.g. {name}", text))
        return rows_of


def survey(
    terrain: xr.Dataset, shape: tuple[int, int] = (10, 10), team: Team | None = None
) -> Survey:
    """Survey a terrain; fast, as no awareness is computed.

    Args:
        terrain: Dataset of `read_terrain` or `synthetic_terrain`.
        shape: Rows and columns of the planning grid.
        team: Lead and robots; by default a lead and three robots.

    Raises:
        TerrainError: A dataset that is no terrain, or a grid too fine for it.
    """
    terrain, team = require_terrain(terrain), Team.of(team)
    grid = Grid.over(terrain, shape)
    dem = terrain["dem"]
    low, high = float(dem.min()), float(dem.max())
    even = dem.copy(data=(slope(terrain) <= team.max_slope).astype(float))
    maps = dem.notnull().astype(float), even, dem
    valid, even, height = (grid.cell_means(values) for values in maps)
    with np.errstate(invalid="ignore"):
        steep = 1.0 - even / valid
    dims = ("row", "col")
    dataset = xr.Dataset(
        {
            "missing": (dims, 1.0 - valid, {"units": "1"}),
            "steep": (dims, steep, {"units": "1"}),
            "height": (dims, height, {"units": "m"}),
            "passable": (dims, even >= 1.0 - MAX_MISSING),
        },
        {"y": ("row", grid.y, {"units": "m"}), "x": ("col", grid.x, {"units": "m"})},
    )
    pixels = terrain.sizes["y"], terrain.sizes["x"]
    return Survey(grid, team, dataset, (low, high), pixel_size(terrain), pixels)


def reason_impassable(missing: float, team: Team) -> str:
    """Text of the reason why a cell is impassable, given its share of pixels without data."""
    if missing > MAX_MISSING:
        return f": {missing:.0%} of it has no data"
    steep = np.rad2deg(team.max_slope)
    return f": over half of it is missing or steeper than the {steep:.0f} degrees the team stands"
