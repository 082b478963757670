"""Stops and posts: where the lead stops in a cell, and where T2 stands to watch it go to the next.

All of a bound a -> c counts (docs/concepts.md, "Why bounds"): T2 watches the lead's way from its
posts in a, then the lead watches from its stop in c how T2 leaves them; and in the bound before, it
has watched from its stop in a how T2 closed up to them. Of positions p on a lattice around the
stop, those are taken with the largest

    1/2 mean_k s(p, lead at t_k) + 1/4 s(stop in a, p) + 1/4 s(stop in c, p),

s the probability of detection under the assumed sight. T2 is within `RADIUS` of the stop, also
beyond the edge of the cell, out of the lead's way, on ground that is well below the slope limit and
linked to the stop over such ground. The lead stops where the ways from the cell to the stops around
are seen best.

Maps lack things that block sight, and have things that do not. Where posts and stops are chosen,
and nowhere else, sight is therefore doubted (`_doubted`); the line of sight is as predicted.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from scipy import ndimage

from trustbo.data import Cell
from trustbo.errors import TerrainError
from trustbo.team import Robot, Team
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import MOVES
from trustbo.workspace.regions import Window, largest_region, linked_to
from trustbo.workspace.routes import Routes, at_times
from trustbo.workspace.sight import Sight, detection_between, jittered, optics
from trustbo.workspace.surface import Surface

SPACING, RADIUS = 2.0, 25.0
"""Least distance between two robots of T2, and largest distance of T2 from the lead's stop, m."""
_DISCOUNT = 0.005  # 1/m, rate at which sight is taken to fall with distance
_DOUBT, _DOUBT_REACH = 0.1, 40.0  # share of the unexpected that is seen at 0 m; its reach, m
_SAFE = 0.7
"""Steepest ground of posts and of the ways to them, as a share of the slope limit."""
_STEP, _STOP_RADIUS = 4.0, 16.0  # m: of the lattice; of the lead's stop from the centre's
_GAP = 0.16  # distance between two robots as a share of the radius, `SPACING` at least
_NEARER = 1e-3  # of sight, that a metre nearer is worth
_IN_THE_WAY = 5.0  # of sight: no other is as bad but standing on another robot
_N_WATCHED = 30  # positions, best seen from the stops, from which the lead's way is looked at
_N_AIMS = 6  # times on the lead's way at which it is aimed at
_SHARES = np.array([0.25, 0.5, 0.75, 1.0])  # of the way to a stop around


class Posts:
    """Stops of the lead and posts of T2 in the cells of a grid, x and y in CRS metres."""

    def __init__(
        self,
        grid: Grid,
        team: Team,
        surface: Surface,
        sight: Sight,
        traversability: np.ndarray,
    ) -> None:
        """Prepare the maps of pixels; `traversability` has shape (row, col) of pixels."""
        self.grid, self.team, self.surface = grid, team, surface
        self.routes = Routes(surface, clear=True)
        self.sight = sight
        self._traversability = _smoothed(traversability, surface.pixel)
        self._standable = largest_region(surface.passable)
        steep = np.arctan(np.hypot(*surface.gradient))
        self._safe = self._standable & (steep <= _SAFE * team.max_slope)
        self._central: dict[Cell, np.ndarray] = {}
        self._stops: dict[Cell, np.ndarray] = {}
        self._cached: dict[Cell, dict[Cell | None, np.ndarray]] = {}
        # Row and column of the cell that each row and column of pixels belongs to, ascending.
        self._cells = grid.cells_along(*surface.axes)

    def window(self, *cells: Cell) -> Window:
        """Window of pixels of cells and half a cell around: first and end row, then col."""
        (rows, cols), shape = self.surface.ground.shape, self.grid.shape
        per_row, per_col = rows / shape[0], cols / shape[1]
        of_rows, of_cols = zip(*cells, strict=True)
        return (
            max(0, int((min(of_rows) - 0.5) * per_row)),
            min(rows, int(np.ceil((max(of_rows) + 1.5) * per_row))),
            max(0, int((min(of_cols) - 0.5) * per_col)),
            min(cols, int(np.ceil((max(of_cols) + 1.5) * per_col))),
        )

    def linked_bounds(self, exists: np.ndarray) -> np.ndarray:
        """Bounds (move, row, col) that robots have a route for, of those that `exists`.

        T2's posts in a cell are linked to its stop within half a cell around, so that one test,
        of the stops of both cells, holds for all robots, either way and any next cell.
        """
        linked, n_moves = np.zeros_like(exists), len(exists)
        for m, (down, right) in enumerate(MOVES[8][: n_moves // 2]):
            for row, col in np.argwhere(exists[m]).tolist():
                a, c = (row - down, col - right), (row, col)
                start, end = (self.surface.pixel_at(*self.stop(cell).tolist()) for cell in (a, c))
                top, _, left, _ = window = self.window(a, c)
                region = linked_to(self.surface.passable, window, start)
                linked[m, *c] = linked[n_moves - 1 - m, *a] = region[end[0] - top, end[1] - left]
        return linked

    def lead_way(self, a: Cell, c: Cell) -> np.ndarray | None:
        """Way of the lead from stop to stop, (point, 2); None if none."""
        return self.routes.find(self.team.lead, self.stop(a), self.stop(c), self.window(a, c))

    def lead_line(self, a: Cell, c: Cell) -> np.ndarray:
        """Way of the lead, or the straight line where there is none, (point, 2)."""
        way = self.lead_way(a, c)
        return np.stack([self.stop(a), self.stop(c)]) if way is None else way

    # --- stops of the lead ---

    def stop(self, cell: Cell) -> np.ndarray:
        """Stop of the lead in a cell, shape (2,): a traversable pixel."""
        if cell not in self._stops:
            self._stops[cell] = self._seeing_stop(cell)
        return self._stops[cell]

    def _central_stop(self, cell: Cell) -> np.ndarray:
        """Easy ground near the cell's centre."""
        if cell not in self._central:
            row, col = self._pixels_of(cell)
            position = self._position(row, col)
            size = np.hypot(self.grid.cell_height, self.grid.cell_width)
            off_center = np.linalg.norm(position - self.grid.center(cell), axis=1) / size
            chosen = np.argmax(self._traversability[row, col] - off_center)
            self._central[cell] = position[chosen]
        return self._central[cell]

    def _seeing_stop(self, cell: Cell) -> np.ndarray:
        """Position from which the ways of the central stop to those around are seen best."""
        here = self._central_stop(cell)
        around = [c for c in self._around(cell) if self._is_in_region(self._central_stop(c))]
        lattice = self._lattice(cell, here, _STOP_RADIUS)
        row, col = self.surface.nearest(*lattice.T)
        inside = (self._cells[0][row] == cell[0]) & (self._cells[1][col] == cell[1])
        position = np.concatenate([here[None], lattice[inside]])
        if not around or len(position) == 1:
            return here
        goals = np.array([self._central_stop(c) for c in around])
        aims = (here + _SHARES[:, None, None] * (goals - here)).reshape(-1, 2)
        lidar = optics(self.team.lead, self.team.robots[0])
        seen = self._seen(position[:, None], aims, lidar).mean(1)
        return position[np.argmax(seen - _NEARER * np.linalg.norm(position - here, axis=1))]

    # --- posts of T2 ---

    def watching(self, cell: Cell, next_cell: Cell | None) -> np.ndarray:
        """Posts of T2 in a cell, shape (robot, 2), from which it watches the lead's next move.

        Without a next cell, T2 is around the lead at the goal.
        """
        posts = self._cached.setdefault(cell, {})
        if next_cell not in posts:  # those of all neighbours cost little more than one
            around = [c for c in self._around(cell) if self._is_in_region(self.stop(c))]
            ahead = list(dict.fromkeys([None, *around, next_cell]))
            posts |= dict(zip(ahead, self._aimed(cell, ahead), strict=True))
        return posts[next_cell]

    def along(self, path: Sequence[Cell]) -> np.ndarray:
        """Posts of T2 before each bound of a path, (bound, robot, 2)."""
        return self.places(path)[1][:-1]

    def places(self, path: Sequence[Cell]) -> tuple[np.ndarray, np.ndarray]:
        """Places of the lead, (bound + 1, 2), and of T2, (bound + 1, robot, 2).

        Before each bound of a path, and at the goal.
        """
        lead = [self.stop(cell) for cell in path]
        t2 = [self.watching(a, c) for a, c in zip(path, [*path[1:], None], strict=True)]
        return np.stack(lead), np.stack(t2)

    def _aimed(self, cell: Cell, ahead: list[Cell | None]) -> np.ndarray:
        """Posts of T2 by the next cell, (next cell, robot, 2), with a least distance."""
        here, n_robots = self.stop(cell), len(self.team.robots)
        position, gap = self._standing(cell)
        posts = np.empty((len(ahead), n_robots, 2))
        for i, score in enumerate(self._scores(cell, ahead, position)):
            if i:
                gaps = np.linalg.norm(position - posts[:, :i, None], axis=-1).min(1)
                score = score - 10.0 * (gaps < gap)
            posts[:, i] = position[np.argmax(score, axis=1)]
        for of_next, c in zip(posts, ahead, strict=True):
            self._abreast(of_next, np.array([0.0, 1.0]) if c is None else self.stop(c) - here)
        return posts

    def _standing(self, cell: Cell) -> tuple[np.ndarray, float]:
        """Positions around a stop where T2 may stand, (position, 2), and their least distance."""
        here = self.stop(cell)
        position = self._lattice(cell, here, RADIUS)
        if len(position) >= len(self.team.robots):
            return position, max(SPACING, _GAP * RADIUS)
        return self._pixels_near(cell, here), SPACING

    def _scores(self, cell: Cell, ahead: list[Cell | None], position: np.ndarray) -> np.ndarray:
        """Sight from positions, the nearer the better, (robot, next cell, position)."""
        distance = np.linalg.norm(position - self.stop(cell), axis=1)
        return np.array(self._seen_in_phases(cell, ahead, position)) - _NEARER * distance

    def _seen_in_phases(
        self, cell: Cell, ahead: list[Cell | None], position: np.ndarray
    ) -> list[np.ndarray]:
        """Sight that counts in all phases, (next cell, position) for each robot."""
        here, lead = self.stop(cell), self.team.lead
        goals = [here if c is None else self.stop(c) for c in ahead]
        routes = [np.stack([here, here]) if c is None else self.lead_line(cell, c) for c in ahead]
        first = np.cumsum([0, *map(len, routes)])
        aims, _ = at_times(self.surface, lead, np.concatenate(routes), first, _N_AIMS)
        far = np.linalg.norm(position - here, axis=1)
        rows: dict[Robot, np.ndarray] = {}
        for robot in dict.fromkeys(self.team.robots):
            stops = np.stack([here, *goals])[:, None]
            closing = 0.25 * self._seen(stops, position, optics(lead, robot))
            seen = closing[0] + closing[1:]
            best = np.argsort(_NEARER * far - seen, axis=1, kind="stable")[:, :_N_WATCHED]
            eyes = position[best][:, :, None] + jittered(_N_AIMS)
            watched = self._seen(eyes, aims[:, None], optics(robot, lead)).mean(-1)
            rows[robot] = seen - 1.0  # of positions from which the way was not looked at
            of_best = np.take_along_axis(seen, best, 1) + 0.5 * watched
            np.put_along_axis(rows[robot], best, of_best, 1)
        in_the_way = np.array([_is_near(position, here, route) for route in routes])
        return [rows[robot] - _IN_THE_WAY * in_the_way for robot in self.team.robots]

    def _abreast(self, posts: np.ndarray, direction: np.ndarray) -> None:
        """Sort equal robots from left to right, so that they keep their sides: shorter ways."""
        robots = self.team.robots
        to_right = posts @ np.array([direction[1], -direction[0]])
        for robot in dict.fromkeys(robots):
            members = np.array([i for i, other in enumerate(robots) if other == robot])
            posts[members] = posts[members[np.argsort(to_right[members], kind="stable")]]

    def _seen(self, eye: np.ndarray, target: np.ndarray, lidar: np.ndarray) -> np.ndarray:
        """Probability of detection of targets (..., 2) where maps may be wrong; broadcasts."""
        seen = detection_between(self.surface, self.sight, eye, target, lidar)
        return _doubted(seen, np.linalg.norm(target - eye, axis=-1))

    # --- pixels ---

    def _around(self, cell: Cell) -> list[Cell]:
        """Neighbours on the grid."""
        rows, cols = self.grid.shape
        near = [(cell[0] + down, cell[1] + right) for down, right in MOVES[8]]
        return [c for c in near if 0 <= c[0] < rows and 0 <= c[1] < cols]

    def _is_in_region(self, position: np.ndarray) -> bool:
        """Whether a position is in the region that robots can drive in."""
        return bool(self._standable[self.surface.pixel_at(*position.tolist())])

    def _lattice(self, cell: Cell, here: np.ndarray, radius: float) -> np.ndarray:
        """Positions around one, (position, 2), linked to it over safe ground near the cell.

        Linked within half a cell around, which the window of every bound contains.
        """
        steps = np.arange(-radius, radius + 1e-9, _STEP)
        offset = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        distance = np.linalg.norm(offset, axis=1)
        offset = offset[(distance <= radius) & (distance >= SPACING)]
        row, col = (np.rint(i).astype(int) for i in self.surface.to_pixel(*(here + offset).T))
        window, start = self.window(cell, cell), self.surface.pixel_at(*here.tolist())
        top, bottom, left, right = window
        inside = (row >= top) & (row < bottom) & (col >= left) & (col < right)
        pixels = np.unique(np.stack([row, col], axis=1)[inside], axis=0)
        linked = linked_to(self._safe, window, start)
        row, col = pixels[linked[pixels[:, 0] - top, pixels[:, 1] - left]].T
        return self._position(row, col)

    def _pixels_near(self, cell: Cell, here: np.ndarray) -> np.ndarray:
        """Positions in a cell that are linked to its stop, near it where there are enough."""
        position = self._position(*self._linked(cell))
        distance = np.linalg.norm(position - here, axis=1)
        near = np.flatnonzero((distance <= RADIUS) & (distance >= SPACING))
        if len(near) < len(self.team.robots):  # few passable pixels, or large ones
            order = np.argsort(distance, kind="stable")
            near = order[distance[order] > 0.0][: len(self.team.robots)]
            near = near if len(near) else order
        return position[near]

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
        """Rows and columns of a cell's pixels that are linked to its stop near the cell."""
        row, col = self._pixels_of(cell)
        start = self.surface.pixel_at(*self.stop(cell).tolist())
        window = self.window(cell, cell)
        linked = linked_to(self.surface.passable, window, start)[row - window[0], col - window[2]]
        return (row[linked], col[linked]) if linked.any() else (row, col)

    def _position(self, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        y, x = self.surface.axes
        return np.stack([x[col], y[row]], axis=-1)


def _doubted(seen: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Chance of detection where maps may be wrong, from that of the map and the distance, m.

    A share exp(-discount x distance) of what is expected to be seen is, and of the rest a share
    that falls with distance.
    """
    kept = seen * np.exp(-_DISCOUNT * distance)
    return kept + _DOUBT * np.exp(-distance / _DOUBT_REACH) * (1.0 - kept)


def _is_near(position: np.ndarray, here: np.ndarray, route: np.ndarray) -> np.ndarray:
    """Whether positions around a stop, `here`, are in the way of a robot on a route."""
    far = np.linalg.norm(position - here, axis=1).max(initial=0.0)
    reach = np.linalg.norm(route - here, axis=1) <= far + SPACING
    near = np.empty(len(position), bool)
    _are_within(position, route[reach], SPACING**2, near)
    return near


@njit(cache=True, nogil=True)
def _are_within(position, points, limit, near):
    """Whether positions (position, 2) are nearer than sqrt(limit) to one of points (point, 2)."""
    for p in range(len(position)):
        near[p] = False
        for k in range(len(points)):
            dx, dy = position[p, 0] - points[k, 0], position[p, 1] - points[k, 1]
            if dx * dx + dy * dy < limit:
                near[p] = True
                break


def _smoothed(values: np.ndarray, pixel: tuple[float, float], width: float = 5.0) -> np.ndarray:
    size = [max(1, round(width / step)) for step in pixel]
    window: dict[str, Any] = {"size": size, "mode": "nearest"}
    return ndimage.uniform_filter(np.nan_to_num(values), **window)
