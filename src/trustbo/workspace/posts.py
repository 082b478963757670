"""Posts: where the lead stops in a cell, and where T2 stands to watch it go to the next.

The lead stops at a traversable pixel near the cell's centre, its waypoint. T2 stands around it, at
most `radius` metres away, each robot where it sees the lead's next waypoint best.
"""

from typing import Any

import numpy as np
from scipy import ndimage

from trustbo.data import Cell
from trustbo.errors import TerrainError, TrustboError, require_positive
from trustbo.team import Team
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import MOVES
from trustbo.workspace.regions import are_linked, largest_region, linked_to
from trustbo.workspace.sight import Sight, detection_probability, optics
from trustbo.workspace.surface import Surface

SPACING = 2.0
"""Least distance between two robots of T2, m."""
FORMATION_RADIUS = 8.0
"""Largest distance of T2 from the lead's waypoint, m, by default."""


def require_formation(radius: float) -> None:
    """Refuse a formation radius below the robots' least distance: TrustboError."""
    if require_positive("formation_radius", radius) < SPACING:
        raise TrustboError(
            f"formation_radius must be at least {SPACING:g} m, the least distance between two "
            f"robots; got {radius:g}."
        )


class Posts:
    """Waypoints of the lead and posts of T2 in the cells of a grid, x and y in CRS metres."""

    def __init__(
        self,
        grid: Grid,
        team: Team,
        surface: Surface,
        sight: Sight,
        traversability: np.ndarray,
        radius: float,
    ) -> None:
        """Prepare the maps of pixels; `traversability` has shape (row, col) of pixels."""
        self.grid, self.team, self.surface = grid, team, surface
        self._sight, self._radius = sight, radius
        self._traversability = _smoothed(traversability, surface.pixel)
        self._standable = largest_region(surface.passable)
        self._waypoints: dict[Cell, np.ndarray] = {}
        self._cached: dict[Cell, dict[Cell | None, np.ndarray]] = {}
        # Row and column of the cell that each row and column of pixels belongs to, ascending.
        self._cells = grid.cells_along(*surface.axes)

    def window(self, a: Cell, c: Cell) -> tuple[int, int, int, int]:
        """Window of pixels of two cells and half a cell around: first and end row, then col."""
        (rows, cols), shape = self.surface.ground.shape, self.grid.shape
        per_row, per_col = rows / shape[0], cols / shape[1]
        top, bottom = min(a[0], c[0]) - 0.5, max(a[0], c[0]) + 1.5
        left, right = min(a[1], c[1]) - 0.5, max(a[1], c[1]) + 1.5
        return (
            max(0, int(top * per_row)),
            min(rows, int(np.ceil(bottom * per_row))),
            max(0, int(left * per_col)),
            min(cols, int(np.ceil(right * per_col))),
        )

    def are_linked(self, a: Cell, c: Cell) -> bool:
        """Whether the robots have a route from cell to cell: their posts are in one region.

        T2's posts in a cell are linked to its waypoint within half a cell around, so that one test,
        of the waypoints, holds for all robots and any next cell.
        """
        ends = [self.surface.pixel_at(*self.waypoint(cell).tolist()) for cell in (a, c)]
        return are_linked(self.surface.passable, self.window(a, c), ends[0], ends[1])

    def waypoint(self, cell: Cell) -> np.ndarray:
        """Stop of the lead in a cell, shape (2,): a traversable pixel near the centre."""
        if cell not in self._waypoints:
            row, col = self._pixels_of(cell)
            position = self._position(row, col)
            size = np.hypot(self.grid.cell_height, self.grid.cell_width)
            off_center = np.linalg.norm(position - self.grid.center(cell), axis=1) / size
            chosen = np.argmax(self._traversability[row, col] - off_center)
            self._waypoints[cell] = position[chosen]
        return self._waypoints[cell]

    def watching(self, cell: Cell, next_cell: Cell | None) -> np.ndarray:
        """Posts of T2 in a cell, shape (robot, 2), from which it watches the next waypoint.

        Without a next cell, around the lead at the goal.
        """
        posts = self._cached.setdefault(cell, {})
        if next_cell not in posts:  # those of all neighbours cost little more than one
            rows, cols = self.grid.shape
            near = [(cell[0] + down, cell[1] + right) for down, right in MOVES[8]]
            inside = [c for c in near if 0 <= c[0] < rows and 0 <= c[1] < cols]
            posts |= self._aimed(cell, list({None: 0} | dict.fromkeys([*inside, next_cell])))
        return posts[next_cell]

    def _aimed(self, cell: Cell, ahead: list[Cell | None]) -> dict[Cell | None, np.ndarray]:
        """Posts of T2 by the next cell, of equal sight the closer one, with a least distance."""
        here, robots = self.waypoint(cell), self.team.robots
        position = self._position(*self._linked(cell))
        distance = np.linalg.norm(position - here, axis=1)
        near = np.flatnonzero((distance <= self._radius) & (distance >= SPACING))
        if len(near) < len(robots):  # few passable pixels, or large ones
            order = np.argsort(distance, kind="stable")
            near = order[distance[order] > 0.0][: len(robots)]
            near = near if len(near) else order
        position, distance = position[near], distance[near]
        goals = np.stack([here if c is None else self.waypoint(c) for c in ahead])
        seen = self._seen(position, goals)
        posts = np.empty((len(ahead), len(robots), 2))
        score = np.empty((len(ahead), len(position)))
        for i in range(len(robots)):
            score[:] = seen[i] - 1e-3 * distance
            if i:
                gaps = np.linalg.norm(position - posts[:, :i, None], axis=-1).min(1)
                score -= 10.0 * (gaps < SPACING)
            posts[:, i] = position[np.argmax(score, axis=1)]
        return dict(zip(ahead, posts, strict=True))

    def _seen(self, position: np.ndarray, goals: np.ndarray) -> list[np.ndarray]:
        """Detection of the lead at each goal from each position, (goal, position) per robot."""
        sensor = np.tile(position, (len(goals), 1))
        target = np.repeat(goals, len(position), axis=0)
        cached: dict[bytes, np.ndarray] = {}
        rows = []
        for robot in self.team.robots:
            lidar = optics(robot, self.team.lead)
            if (key := lidar.tobytes()) not in cached:
                seen = detection_probability(self.surface, self._sight, sensor, target, lidar)
                cached[key] = seen.reshape(len(goals), len(position))
            rows.append(cached[key])
        return rows

    def require_room(self, cell: Cell) -> None:
        """Refuse a cell without a pixel for each robot: TerrainError that names cell and robot."""
        n_pixels, names = len(self._pixels_of(cell)[0]), self.team.names
        if n_pixels <= len(names):
            raise TerrainError(
                f"cell {cell} has {n_pixels} passable pixels, on which robot "
                f"{names[max(0, n_pixels - 1)]!r} finds no post beside the lead; take larger "
                "cells, a finer raster or fewer robots."
            )

    def _pixels_of(self, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of a cell's passable pixels, in the largest region where possible.

        All of its pixels if none is passable; no route leads there.
        """
        rows, cols = self._cells
        top, bottom = np.searchsorted(rows, (cell[0], cell[0] + 1))
        left, right = np.searchsorted(cols, (cell[1], cell[1] + 1))
        anywhere = np.ones_like(self._standable)
        for allowed in (self._standable, self.surface.passable, anywhere):
            row, col = np.nonzero(allowed[top:bottom, left:right])
            if len(row):
                break
        return row + top, col + left

    def _linked(self, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of a cell's pixels that are linked to its waypoint.

        Linked within half a cell around, which the window of every bound contains.
        """
        row, col = self._pixels_of(cell)
        start = self.surface.pixel_at(*self.waypoint(cell).tolist())
        window = self.window(cell, cell)
        linked = linked_to(self.surface.passable, window, start)[row - window[0], col - window[2]]
        return (row[linked], col[linked]) if linked.any() else (row, col)

    def _position(self, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        y, x = self.surface.axes
        return np.stack([x[col], y[row]], axis=-1)


def _smoothed(values: np.ndarray, pixel: tuple[float, float], width: float = 5.0) -> np.ndarray:
    size = [max(1, round(width / step)) for step in pixel]
    window: dict[str, Any] = {"size": size, "mode": "nearest"}
    return ndimage.uniform_filter(np.nan_to_num(values), **window)
