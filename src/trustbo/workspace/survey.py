"""Survey of a terrain: the grid, and the cells without data or too steep, before awareness."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError
from trustbo.team import Team
from trustbo.terrain.dataset import is_lazy, pixel_size, require_terrain
from trustbo.terrain.pixel_feature import FEATURES
from trustbo.terrain.strips import Strip, strip_of, strips
from trustbo.workspace.grid import CellMeans, Grid
from trustbo.workspace.location import Location, cell_of, crs_name, name_of_crs, spans

MAX_MISSING = 0.5
"""Largest share of missing or too steep pixels in a passable cell."""
_MOST_PIXELS = 1 << 22
"""Pixels above which rows of a lazily read terrain are sampled."""
_BANDS = 4
"""Bands of rows that are read of each row of cells then."""


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
        warped: CRSs that heights were warped from, "dem from EPSG:4326"; none where both rasters
            are in that of the grid.
    """

    grid: Grid
    team: Team
    cells: xr.Dataset
    heights: tuple[float, float]
    pixel: tuple[float, float]
    shape: tuple[int, int]
    warped: tuple[str, ...] = ()

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
        warped = f", to which are warped: {', '.join(self.warped)}" if self.warped else ""
        rows_of = [
            ("CRS", crs_name(grid) + warped),
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

    Of a lazily read terrain of over 4 million pixels, bands of rows are read, whose shares stand
    for those of their cells.

    Args:
        terrain: Dataset of `read_terrain` or `synthetic_terrain`, in memory or lazy.
        shape: Rows and columns of the planning grid.
        team: Lead and robots; by default a lead and three robots.

    Raises:
        TerrainError: A dataset that is no terrain, or a grid too fine for it.
    """
    terrain, team = require_terrain(terrain), Team.of(team)
    grid = Grid.over(terrain, shape)
    cells = CellMeans(grid.shape, *grid.cells_along(terrain["y"].values, terrain["x"].values))
    low, high = np.inf, -np.inf
    for strip in _strips(terrain, grid):
        dem = strip.window.variables["dem"].values[strip.core]
        slope = FEATURES["slope"].of_rows(strip.window, strip.core)
        values = {"valid": np.isfinite(dem), "even": slope <= team.max_slope, "height": dem}
        cells.merge(cells.sums(values, strip.rows.start))
        low, high = np.nanmin(dem, initial=low), np.nanmax(dem, initial=high)
    valid, even, height = (cells[name] for name in ("valid", "even", "height"))
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
    heights = float(low), float(high)
    sources = {
        str(name): means.attrs.get("warped_from") for name, means in terrain.data_vars.items()
    }
    warped = tuple(f"{name} from {name_of_crs(crs)}" for name, crs in sources.items() if crs)
    return Survey(grid, team, dataset, heights, pixel_size(terrain), pixels, warped)


def reason_impassable(missing: float, team: Team) -> str:
    """Text of the reason why a cell is impassable, given its share of pixels without data."""
    if missing > MAX_MISSING:
        return f": {missing:.0%} of it has no data"
    steep = np.rad2deg(team.max_slope)
    return f": over half of it is missing or steeper than the {steep:.0f} degrees the team stands"


def _strips(terrain: xr.Dataset, grid: Grid) -> Iterator[Strip]:
    """Strips of the whole terrain; of a large one read lazily, bands of each row of cells."""
    n_rows, n_cols = terrain["dem"].shape
    edges = np.linspace(0, n_rows, _BANDS * grid.shape[0] + 1).astype(int)
    depth = max(1, _MOST_PIXELS // (n_cols * (len(edges) - 1)))
    if not is_lazy(terrain) or n_rows * n_cols <= _MOST_PIXELS or (np.diff(edges) <= depth).any():
        yield from strips(terrain, 1)
        return
    for top, bottom in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        first = (top + bottom - depth) // 2
        yield strip_of(terrain, first, first + depth, 1)
