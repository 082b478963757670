"""Watch table: the posts from which bounds can be watched, and what would be seen from them.

Bound by bound, computed when it is asked for, and kept. The posts are those of the workspace's rule
and the next best (`Posts.candidates`); sight is that of each robot of T2, so that posts can be
given to robots that differ.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import Cell
from trustbo.team import Robot
from trustbo.workspace.line_of_sight import (
    N_SAMPLES,
    Geometry,
    Phases,
    geometry_along,
    over_bounds,
    phases,
)
from trustbo.workspace.moves import MOVES
from trustbo.workspace.routes import at_times
from trustbo.workspace.sight import Sight, detection_between, jittered, optics
from trustbo.workspace.ways import Ways

N_POSTS = 5
"""Posts to choose from for each bound, or as many as there are robots."""
_APART = 2.0
"""Distance of the points of an overwatch map, m."""


class Watch(NamedTuple):
    """Sight in a bound a -> c from each post in a, and of robots on the way to each post in c.

    Doubted, see `posts.doubted`: it is what posts are chosen by.
    """

    watched: np.ndarray  # share of the lead's way that a robot sees, (robot, post)
    closing: np.ndarray  # share of a robot's way that the lead sees, (robot, post, next post)
    waiting: np.ndarray  # chance that the lead sees a robot at its next post, (robot, next post)
    lead_time: float  # s
    times: np.ndarray  # s, of each way, (robot, post, next post)


class WatchTable:
    """Posts of bounds, and what is seen from them; positions are x, y in CRS metres."""

    def __init__(self, ways: Ways, sight: Sight) -> None:
        """Take posts and ways, and the assumed model of sight."""
        self._ways, self._sight = ways, sight
        self._n = max(N_POSTS, len(ways.posts.team.robots))
        # Dicts, which are pickled with the workspace; functions of `functools.cache` are not.
        self._posts: dict[tuple[Cell, Cell | None], np.ndarray] = {}
        self._watches: dict[tuple[Cell, Cell, Cell | None], Watch] = {}

    def along(self, path: tuple[Cell, ...]) -> tuple[list[np.ndarray], list[Watch]]:
        """Posts in each cell of a path, (post, 2) each, and what is seen in each bound.

        In the last cell T2 stands around the lead, by the workspace's rule: a post for each robot.
        """
        after = [*path[2:], None]
        posts = [self.posts(a, c) for a, c in zip(path, [*path[1:], None], strict=True)]
        bounds = zip(pairwise(path), after, strict=True)
        return posts, [self.watch(a, c, b) for (a, c), b in bounds]

    def rule(self, path: Sequence[Cell]) -> np.ndarray:
        """Posts of the workspace's rule along a path, (bound, robot, 2)."""
        return self._ways.posts.along(path)

    def seen_along(self, path: tuple[Cell, ...]) -> Phases:
        """Sight at times of both phases of a path's bounds."""
        rule = self._ways.posts
        return phases(rule.surface, self._sight, rule.team, geometry_along(rule, path))

    def unseen(self, passable: np.ndarray) -> np.ndarray:
        """Share of the time of bounds in which nobody sees anybody, (move, row, col).

        Between passable cells (row, col), NaN for others. T2 stands at the posts of the rule, and
        closes up to those for each of the cells that a path may go on to, as line of sight has it.
        """
        rule = self._ways.posts

        def work(given: Geometry) -> np.ndarray:
            return phases(rule.surface, self._sight, rule.team, given).unseen()

        shares = np.full((len(MOVES[8]), *passable.shape), np.nan)
        for bounds, some in over_bounds(self._ways, passable, work):
            shares[*bounds] = some
        return shares

    def posts(self, cell: Cell, next_cell: Cell | None) -> np.ndarray:
        """Posts in a cell to watch the bound to the next one from, (post, 2), see `along`."""
        rule, key = self._ways.posts, (cell, next_cell)
        if key not in self._posts:
            at_goal = next_cell is None  # where T2 stands around the lead, a post for each robot
            n = len(rule.team.robots) if at_goal else self._n
            self._posts[key] = rule.candidates(cell, next_cell, n)
        return self._posts[key]

    def watch(self, a: Cell, c: Cell, next_cell: Cell | None) -> Watch:
        """Sight in the bound a -> c, T2 closing up to its posts for the bound to the next cell."""
        key = a, c, next_cell
        if key not in self._watches:
            self._watches[key] = self._compute(*key)
        return self._watches[key]

    def _compute(self, a: Cell, c: Cell, next_cell: Cell | None) -> Watch:
        rule = self._ways.posts
        starts, ends = self.posts(a, c), self.posts(c, next_cell)
        pair, robot = (len(starts), len(ends)), len(rule.team.robots)
        i, j = (index.ravel() for index in np.indices(pair))
        ends = np.broadcast_to(ends[j, None, None], (len(j), N_SAMPLES, robot, 2))
        posts = np.repeat(starts[i, None], robot, axis=1)
        lines, stops = [rule.lead_line(a, c)] * len(i), np.tile(rule.stop(c), (len(i), 1))
        given = Geometry(lines, posts, ends, stops)
        seen = phases(rule.surface, self._sight, rule.team, given, doubt=True)

        def by_pair(values: np.ndarray) -> np.ndarray:
            return np.moveaxis(values.reshape(*pair, robot), -1, 0)

        watched, closing, waiting = (
            by_pair(one.mean(-1)) for one in (seen.watched, seen.closing, seen.waiting)
        )
        times = by_pair(seen.times)
        return Watch(watched[..., 0], closing, waiting[:, 0], float(seen.lead_time[0]), times)

    def overwatch(self, a: Cell, c: Cell, positions: np.ndarray, robot: Robot) -> np.ndarray:
        """Share of the lead's way a -> c that a robot sees from positions (..., 2), (...)."""
        surface, team = self._ways.posts.surface, self._ways.posts.team
        way = self._ways.posts.lead_line(a, c)
        aims, _ = at_times(surface, team.lead, way, np.array([0, len(way)]), N_SAMPLES)
        eyes = positions[..., None, :] + jittered(N_SAMPLES)
        seen = detection_between(surface, self._sight, eyes, aims[0], optics(robot, team.lead))
        return robot.detection * seen.mean(-1)

    def overwatch_map(self, a: Cell, c: Cell, name: str) -> xr.DataArray:
        """Map of `overwatch` of a robot near a bound, (y, x); NaN where robots cannot stand."""
        rule = self._ways.posts
        surface, window = rule.surface, rule.window(a, c)
        steps = [max(1, round(_APART / side)) for side in surface.pixel]
        # All maps are of one lattice, whatever their windows.
        rows, cols = (
            slice(-(-first // step) * step, end, step)
            for first, end, step in zip(window[::2], window[1::2], steps, strict=True)
        )
        y, x = surface.axes[0][rows], surface.axes[1][cols]
        free = surface.passable[rows, cols]
        positions = np.stack(np.meshgrid(x, y), axis=-1)
        shares = np.full(free.shape, np.nan)
        robot = rule.team.robots[rule.team.names.index(name)]
        shares[free] = self.overwatch(a, c, positions[free], robot)
        about = {"units": "1", "long_name": f"share of the lead's way {a} to {c} that {name} sees"}
        made = xr.DataArray(shares, {"y": y, "x": x}, ("y", "x"), "overwatch", about)
        return made if rule.grid.crs is None else made.rio.write_crs(rule.grid.require_crs())
