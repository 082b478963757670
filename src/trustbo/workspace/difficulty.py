"""Difficulty of bounds, measured on the robots' routes relative to the robots' limits.

Each measure is 0 on easy routes and about 1 at the robots' limit. In the bound a -> c, T2 drives
from its posts in a to the posts from which it watches the lead's next move. Its routes, and with
them the difficulty, depend on the next move and on the sets of posts in both cells, which together
are an option of the bound; see `moves`. The measure of a bound with an option is the maximum over
the routes of the lead and of T2.

In a bound, options with the same tilt share the steepest route, for example that of the lead. They
pass or fail together, so they are one unit of the hazard model; see `Measured.unit`.

Only plans that depend on failures need the difficulty of all bounds. Bounds are therefore measured
when they are first asked for.
"""

import math
from functools import cached_property
from itertools import batched
from typing import NamedTuple, cast

import numpy as np

from trustbo.data import POST_SETS
from trustbo.display import announced, slow_bar
from trustbo.kernels import kernel, part
from trustbo.parallel import in_order, plain
from trustbo.team import Robot
from trustbo.workspace.moves import MOVES, by_option, by_way, options_of, possible_next
from trustbo.workspace.posts import Posts
from trustbo.workspace.pursuit import Driving, tilts_along
from trustbo.workspace.routes import SLACK, framed, same_way, search

MEASURES = ("untraversable", "tilt", "narrowness", "tightness")
"""Measures of difficulty; see `Difficulty`."""
TILT = "tilt"
"""Name of the measure that is compared with the robots' slope limit."""
_WIDTH = 2.0  # distance to an impassable pixel at which narrowness is 0.5, m
_UNKNOWN = 0.5  # difficulty of routes without known traversability
_BESIDE = 1.001  # pixels; a route this close to an impassable pixel is beside it
_MOST = 2.0  # largest value of the measure tilt
_TIGHT = 3.0  # log(1 + length in m) at which tightness is 1: 19 m
_BLOCK = 64  # bounds per task of a thread
_NONE = -1  # unit of a bound that does not exist
_compiled = kernel()
_part = part()


class Measured(NamedTuple):
    """Difficulty of bounds, by option or, from `Difficulty.whole`, by way and next way."""

    values: np.ndarray
    """Measures, shape (..., option, measure), NaN where there is no bound or no next bound. Without
    a terrain, there are no measures."""
    unit: np.ndarray
    """Number of the first option of the same move and cell that has the same tilt, shape (...,
    option); -1 where there is no bound or no next bound. Without a terrain, all options of a move
    and a cell are one unit."""


class Difficulty:
    """Difficulty of the bounds of a workspace, measured when it is first asked for.

    `untraversable` is one minus the mean traversability of a route's pixels, or 0.5 if unknown.
    `tilt` is the largest tangent of pitch or roll on the curve that a robot drives along the route
    (see `pursuit.tilts_along`), divided by the tangent of `max_slope`; it is at most 2.
    `narrowness` is 1 / (1 + w / 2 m), where w is the smallest distance to an impassable pixel.
    `tightness` is log(1 + l / 1 m) / 3, where l is the length of the route beside impassable
    pixels. All measures are averaged over the options of a unit, which have the same tilt.

    Attributes:
        exists: Whether each bound exists and can be followed by the next way, shape (way, row, col,
            next_way).
        measures: Names of the measures; none without a terrain.
    """

    def __init__(
        self,
        bounds: np.ndarray,
        posts: Posts | None,
        traversability: np.ndarray | None = None,
        n_posts: int = 1,
    ) -> None:
        """Prepare the difficulty of bounds.

        Args:
            bounds: Whether each bound exists, shape (move, row, col).
            posts: The robots' posts and routes; None without a terrain.
            traversability: Traversability of each pixel, shape (row, col); None if unknown.
            n_posts: Number of sets of posts.
        """
        self.exists = possible_next(bounds, n_posts)
        self.measures = () if posts is None else MEASURES
        self._posts = posts
        self._traversability = traversability
        self._n_posts = n_posts

        self._options = by_option(self.exists)  # whether each option exists
        unit = np.where(self._options, self._options.argmax(-1)[..., None], _NONE)
        self._maps = Measured(np.full((*unit.shape, len(self.measures)), np.nan), unit)
        self._is_measured = np.full(bounds.shape, posts is None)

    @property
    def is_whole(self) -> bool:
        """Whether all bounds are measured."""
        return bool(self._is_measured[self._options.any(-1)].all())

    def of(self, bounds: np.ndarray) -> Measured:
        """Return the difficulty of bounds (bound, 3), given by move, row and column, by option."""
        index = tuple(bounds.T)
        missing = ~self._is_measured[index] & self._options[index].any(-1)
        if missing.any():
            self._measure(np.unique(bounds[missing], axis=0))
        return Measured(self._maps.values[index], self._maps.unit[index])

    def units_of(self, pairs: np.ndarray) -> np.ndarray:
        """Return the units of bounds with their next ways: move, row, column and first option.

        Args:
            pairs: Way, row, column and next way, shape (bound, 4); see `moves.pairs_along`.

        Returns:
            Units, shape (bound, 4). A bound that is not on the map is a unit of its own.
        """
        options = options_of(pairs, self._n_posts)
        unit = self.of(options[:, :3]).unit[np.arange(len(options)), options[:, 3]]
        options[:, 3] = np.where(unit >= 0, unit, options[:, 3])
        return options

    def whole(self) -> Measured:
        """Return the difficulty of all bounds, shape (way, row, col, next_way[, measure])."""
        self.of(np.argwhere(self._options.any(-1)))
        values, unit = self._maps
        by_measure = by_way(np.moveaxis(values, -1, 0), self._n_posts)
        return Measured(np.moveaxis(by_measure, 0, -1), by_way(unit, self._n_posts))

    def restore(self, measured: Measured) -> None:
        """Use the result of `whole` for the same workspace, instead of measuring again."""
        values, unit = measured
        if values.shape != (*self.exists.shape, len(self.measures)):
            raise ValueError("the difficulty is that of another workspace")
        by_measure = by_option(np.moveaxis(values, -1, 0))
        self._maps = Measured(np.moveaxis(by_measure, 0, -1).copy(), by_option(unit))
        self._is_measured[:] = True

    def _measure(self, bounds: np.ndarray) -> None:
        """Measure the given bounds (bound, 3), which exist and have a terrain."""
        blocks = [np.array(block) for block in batched(bounds, _BLOCK)]
        shown = slow_bar("difficulty of bounds", "bound", True, total=len(bounds))
        with (
            announced("Measuring the difficulty of bounds (minutes on large grids)."),
            shown as progress,
        ):
            measured = in_order(self._of_block, blocks)
            for block, values in zip(blocks, measured, strict=True):
                index = tuple(block.T)
                unit = _units_of(values[..., MEASURES.index(TILT)], self._options[index])
                self._maps.values[index] = _averaged(values, unit)
                self._maps.unit[index] = unit
                self._is_measured[index] = True  # last, for other threads
                progress.update(len(block))

    def _of_block(self, bounds: np.ndarray) -> np.ndarray:
        """Compute the measures of bounds (bound, 3) before averaging, (bound, option, measure).

        The lead has one route. Each robot of T2 has routes from its post of each set to those of
        all next ways.
        """
        posts = cast("Posts", self._posts)
        team = posts.team
        sets = POST_SETS[: self._n_posts]
        follows = self.exists[*bounds.T]  # with the standard set, as with any other

        n_bounds, n_next = follows.shape
        windows = np.empty((n_bounds, 4), int)
        stops = np.empty((2, n_bounds, 1, 2))
        starts = np.empty((len(team.robots), n_bounds, len(sets), 2))
        goals = np.full((len(team.robots), n_bounds, n_next, 2), np.nan)
        for k, (move, row, col) in enumerate(bounds.tolist()):
            a = row - MOVES[move][0], col - MOVES[move][1]
            c = row, col
            windows[k] = posts.window(a, c)
            stops[:, k, 0] = posts.stop(a), posts.stop(c)
            for number, name in enumerate(sets):
                starts[:, k, number] = posts.watching((*a, name), c)
            for n in np.flatnonzero(follows[k, :-1]).tolist():
                number, onward = divmod(n, len(MOVES))
                b = row + MOVES[onward][0], col + MOVES[onward][1]
                goals[:, k, n] = posts.watching((*c, sets[number]), b)
            goals[:, k, -1] = posts.watching(c, None)

        one = np.ones((n_bounds, 1), bool)
        of_lead = self._of_robot(team.lead, windows, stops[0], stops[1], one)
        worst = np.fmax(0.0, of_lead)  # NaN where the robot has no route
        for robot, start, goal in zip(team.robots, starts, goals, strict=True):
            worst = np.fmax(worst, self._of_robot(robot, windows, start, goal, follows))
        worst = worst.reshape(n_bounds, -1, len(MEASURES))
        worst[~self._options[*bounds.T]] = np.nan
        return worst

    def _of_robot(
        self,
        robot: Robot,
        windows: np.ndarray,
        starts: np.ndarray,
        goals: np.ndarray,
        exists: np.ndarray,
    ) -> np.ndarray:
        """Compute the measures of a robot's routes; see `_of_routes`."""
        posts = cast("Posts", self._posts)
        surface = posts.surface
        rasters = self._easy, posts.routes.room, surface.gradient
        place = surface.pixel, surface.origin
        ends = [
            (at, np.stack(surface.nearest(*np.moveaxis(at, -1, 0)), axis=-1))
            for at in (starts, goals)
        ]
        pace = posts.routes.pace(robot.max_slope)
        return _of_routes(pace, rasters, place, Driving.of(robot), windows, *ends, exists)

    @cached_property
    def _easy(self) -> np.ndarray:
        """Traversability of each pixel, NaN where unknown."""
        if self._traversability is not None:
            return plain(self._traversability)
        return np.full_like(cast("Posts", self._posts).routes.room, np.nan)


@_compiled
def _of_routes(pace, rasters, place, driving, windows, starts, goals, exists):
    """Compute the measures of a robot's routes in bounds, shape (bound, start, goal, measure).

    Args:
        pace: Inverse of the robot's speed on each pixel; see `Routes.pace`.
        rasters: Traversability, distance to impassable pixels, and gradient of each pixel.
        place: Size of a pixel, and position of the centre of pixel (0, 0).
        driving: Parameters of the robot.
        windows: Pixel window of each bound, shape (bound, 4).
        starts: Positions from which the routes lead, shape (bound, start, 2), and their pixels.
        goals: Positions to which the routes lead, shape (bound, goal, 2), and their pixels.
        exists: Whether a bound has each goal, shape (bound, goal).

    Returns:
        The measures; NaN where there is no goal or no route.
    """
    start, from_pixel = starts
    goal, to_pixel = goals
    measured = np.full((*start.shape[:2], exists.shape[1], 4), np.nan)

    for b in range(len(exists)):
        within = framed(pace, windows[b])
        corner = windows[b, 0] - 1, windows[b, 2] - 1
        # Sets of posts and next ways share many routes.
        nexts = [n for n in range(exists.shape[1]) if exists[b, n] and _first(goal[b], n) == n]
        ends = np.empty((len(nexts), 2), np.int64)
        for k in range(len(nexts)):
            ends[k, 0] = to_pixel[b, nexts[k], 0] - corner[0]
            ends[k, 1] = to_pixel[b, nexts[k], 1] - corner[1]

        for s in range(start.shape[1]):
            same = _first(start[b], s)
            if same == s:
                begin = from_pixel[b, s, 0] - corner[0], from_pixel[b, s, 1] - corner[1]
                ways = _ways(within, place[0], begin, ends)
                across = start[b, s], goal[b]
                _of_ways(ways, nexts, corner, across, rasters, place, driving, measured[b, s])
            for n in range(exists.shape[1]):
                if exists[b, n]:
                    _copy(measured[b, same, _first(goal[b], n)], measured[b, s, n])
    return measured


@_part
def _first(positions, k):
    """Return the index of the first position (position, 2) that equals position `k`."""
    for i in range(k):
        if positions[i, 0] == positions[k, 0] and positions[i, 1] == positions[k, 1]:
            return i
    return k


@_part
def _copy(values, out):
    """Copy an array; numba compiles an assignment of slices for three seconds."""
    for i in range(len(out)):
        out[i] = values[i]


@_part
def _ways(pace, pixel, start, goals):
    """Return the pixels (point, 2) of the routes to all goals, empty if there is none."""
    best, came = search(pace, pixel, start, goals, SLACK)
    return [
        same_way(pace, pixel, best, came, start, (goals[k, 0], goals[k, 1]))
        for k in range(len(goals))
    ]


@_part
def _of_ways(ways, nexts, corner, across, rasters, place, driving, out):
    """Write the measures of a robot's routes from one position to `out` (goal, measure).

    Args:
        ways: Pixels of the routes, in a window that begins at the pixel `corner`.
        nexts: Index of the goal of each route.
        corner: Row and column.
        across: First position of all routes, and the positions of the goals.
        rasters: See `_of_routes`.
        place: See `_of_routes`.
        driving: Parameters of the robot.
        out: Measures.
    """
    pixel, origin = place
    first = np.zeros(len(ways) + 1, np.int64)
    for k in range(len(ways)):  # a route within a pixel has two points
        first[k + 1] = first[k] + (2 if len(ways[k]) == 1 else len(ways[k]))

    flat = np.empty((first[-1], 2))
    for k in range(len(ways)):
        way = ways[k]
        for i in range(1, len(way) - 1):
            flat[first[k] + i, 0] = origin[0] + (way[i, 1] + corner[1]) * pixel[1]
            flat[first[k] + i, 1] = origin[1] - (way[i, 0] + corner[0]) * pixel[0]
        if len(way) > 0:
            _copy(across[0], flat[first[k]])
            _copy(across[1][nexts[k]], flat[first[k + 1] - 1])

    tilts = tilts_along(rasters[2], pixel, origin, flat, first, driving)
    for k in range(len(ways)):
        if len(ways[k]) > 0:
            tilt = min(tilts[k] / math.tan(driving[3]), _MOST)
            _of_way(ways[k], corner, rasters, pixel, tilt, out[nexts[k]])


@_part
def _of_way(way, corner, rasters, pixel, tilt, out):
    """Write the measures of a robot's route to `out` (measure,).

    Args:
        way: Pixels of the route, shape (point, 2), in a window that begins at the pixel `corner`.
        corner: Row and column.
        rasters: See `_of_routes`.
        pixel: Size of a pixel.
        tilt: The measure tilt.
        out: Measures.
    """
    easy, room, _ = rasters
    known = 0
    total = 0.0
    gap = np.inf
    n_beside = 0
    for k in range(max(len(way), 2)):  # a route within a pixel has two points
        r = way[min(k, len(way) - 1), 0] + corner[0]
        c = way[min(k, len(way) - 1), 1] + corner[1]
        if math.isfinite(easy[r, c]):
            known += 1
            total += easy[r, c]
        gap = min(gap, room[r, c])
        n_beside += room[r, c] <= _BESIDE * max(pixel[0], pixel[1])

    out[0] = 1.0 - total / known if known > 0 else _UNKNOWN
    out[1] = tilt
    out[2] = 1.0 / (1.0 + gap / _WIDTH)
    out[3] = math.log1p(n_beside * min(pixel[0], pixel[1])) / _TIGHT


def _units_of(tilt: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Return the first option with the same tilt, (bound, option); -1 if none."""
    same = tilt[..., None, :] == tilt[..., None]  # NaN equals nothing
    return np.where(exists, same.argmax(-1), _NONE)


def _averaged(values: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return the measures (bound, option, measure) as means over each unit."""
    means = values.copy()
    for n in range(unit.shape[-1]):
        member = unit == n
        count = np.maximum(member.sum(-1), 1)[:, None]
        mean = np.where(member[..., None], values, 0.0).sum(-2) / count
        means[member] = np.broadcast_to(mean[:, None], values.shape)[member]
    return means
