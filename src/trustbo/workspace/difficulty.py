"""Difficulty of bounds, measured on the robots' routes relative to the robots' limits.

Each measure is 0 on easy routes and about 1 at the robots' limit. T2 leaves the bound a -> c for
the posts from which it watches the lead's next move, so its routes, and with them the difficulty,
depend on the next move. The measure of a bound with its next move is the maximum over the routes of
the lead and of T2.

In a bound, next moves with the same tilt share the steepest route, for example that of the lead.
They pass or fail together, so they are one unit of the hazard model; see `Difficulty.unit`.
"""

from collections.abc import Sequence
from itertools import batched
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.parallel import in_order
from trustbo.team import Robot
from trustbo.workspace import Workspace
from trustbo.workspace.moves import END, MOVES, NEXT_NAMES, possible_next
from trustbo.workspace.posts import TRAVERSABLE, Posts
from trustbo.workspace.pursuit import largest_tilt
from trustbo.workspace.surface import Surface

MEASURES = ("untraversable", "tilt", "narrowness", "tightness")
"""Measures of difficulty; see `difficulty_of`."""
_TILT = MEASURES.index("tilt")
_WIDTH = 2.0  # distance to an impassable pixel at which narrowness is 0.5, m
_UNKNOWN = 0.5  # difficulty of routes without known traversability
_BESIDE = 1.001  # pixels; a route this close to an impassable pixel is beside it
_MOST = 2.0  # largest value of the measure tilt
_TIGHT = 3.0  # log(1 + length in m) at which tightness is 1: 19 m
_BLOCK = 16  # bounds per task of a thread
_NONE = -1  # unit of a bound that does not exist


class Difficulty(NamedTuple):
    """Difficulty of the bounds of a workspace, with each next move.

    Attributes:
        measures: DataArray (move, row, col, next_move, measure), NaN where there is no bound or no
            next bound. Without a terrain, the dimension `measure` has length 0.
        unit: Index of the first next move of the same bound that has the same tilt, shape (move,
            row, col, next_move); -1 where there is no bound. Without a terrain, all next moves of a
            bound are one unit.
    """

    measures: xr.DataArray
    unit: np.ndarray


_cached: WeakKeyDictionary[Workspace, Difficulty] = WeakKeyDictionary()


def difficulty_of(workspace: Workspace) -> Difficulty:
    """Compute the difficulty of a workspace's bounds; the result is cached.

    `untraversable` is one minus the mean traversability of a route's pixels, or 0.5 if unknown.
    `tilt` is the largest tangent of pitch or roll on the curve that a robot drives along the route
    (see `pursuit.largest_tilt`), divided by the tangent of `max_slope`; it is at most 2.
    `narrowness` is 1 / (1 + w / 2 m), where w is the smallest distance to an impassable pixel.
    `tightness` is log(1 + l / 1 m) / 3, where l is the length of the route beside impassable
    pixels. All measures are averaged over the next moves of a unit, which have the same tilt.
    """
    if workspace not in _cached:
        exists = possible_next(workspace.passable_bounds.values)
        posts = workspace.posts
        names = () if posts is None else MEASURES

        values = np.full((*exists.shape, len(names)), np.nan)
        unit = np.where(exists, exists.argmax(-1)[..., None], _NONE)
        if posts is not None:
            _measure(workspace, posts, exists, values)
            unit = _units_of(values[..., _TILT], exists)
            _average(values, unit)

        bounds = workspace.passable_bounds
        coords = {**bounds.coords, "next_move": list(NEXT_NAMES), "measure": list(names)}
        dims = *bounds.dims, "next_move", "measure"
        measures = xr.DataArray(values, coords, dims, "difficulty")
        _cached[workspace] = Difficulty(measures, unit)
    return _cached[workspace]


def _measure(workspace: Workspace, posts: Posts, exists: np.ndarray, out: np.ndarray) -> None:
    """Write the measures of existing bounds to `out`, (move, row, col, next_move, measure)."""
    surface = posts.surface
    pixels = workspace.pixels

    room = np.full(surface.ground.shape, np.inf)  # distance to the nearest impassable pixel, m
    if not surface.passable.all():
        room = np.asarray(ndimage.distance_transform_edt(surface.passable, sampling=surface.pixel))

    easy = np.full(room.shape, np.nan)
    if pixels is not None and TRAVERSABLE in pixels:
        easy = pixels[TRAVERSABLE].values

    def work(block: Sequence[list[int]]) -> None:
        for m, row, col in block:
            down, right = MOVES[m]
            left = row - down, col - right
            follows = np.flatnonzero(exists[m, row, col]).tolist()
            measured: dict[tuple[int, bytes], np.ndarray] = {}  # keyed by the robot and its route
            for n in follows:
                onward = None if n == END else (row + MOVES[n][0], col + MOVES[n][1])
                routes = posts.bound_routes(left, (row, col), onward)
                out[m, row, col, n] = _of_bound(posts, easy, room, routes, measured)

    for _ in in_order(work, batched(np.argwhere(exists.any(-1)).tolist(), _BLOCK)):
        pass


def _of_bound(
    posts: Posts,
    easy: np.ndarray,
    room: np.ndarray,
    routes: Sequence[np.ndarray | None],
    measured: dict[tuple[int, bytes], np.ndarray],
) -> np.ndarray:
    """Compute the maximum of each measure over the robots' routes in a bound, shape (measure,).

    `measured` keeps the measures of each robot's routes, because next moves share many of them.
    """
    robots = posts.team.lead, *posts.team.robots

    worst = np.zeros(len(MEASURES))
    for i, (robot, route) in enumerate(zip(robots, routes, strict=True)):
        if route is None:
            continue
        key = i, route.tobytes()
        if key not in measured:
            measured[key] = _of_route(posts.surface, easy, room, robot, route)
        worst = np.maximum(worst, measured[key])
    return worst


def _of_route(
    surface: Surface, easy: np.ndarray, room: np.ndarray, robot: Robot, route: np.ndarray
) -> np.ndarray:
    """Compute the measures of one robot's route, shape (measure,)."""
    pixels = surface.nearest(*route.T)
    of_route = easy[pixels]
    gaps = room[pixels]
    of_route = of_route[np.isfinite(of_route)]
    tight = (gaps <= _BESIDE * max(surface.pixel)).sum() * min(surface.pixel)

    return np.array([
        1.0 - of_route.mean() if len(of_route) else _UNKNOWN,
        min(largest_tilt(surface, robot, route) / np.tan(robot.max_slope), _MOST),
        1.0 / (1.0 + gaps.min() / _WIDTH),
        np.log1p(tight) / _TIGHT,
    ])  # fmt: skip


def _units_of(tilt: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Return the first next move with the same tilt, (move, row, col, next_move); -1 if none."""
    same = tilt[..., None, :] == tilt[..., None]  # NaN equals nothing
    return np.where(exists, same.argmax(-1), _NONE)


def _average(values: np.ndarray, unit: np.ndarray) -> None:
    """Replace the measures (move, row, col, next_move, measure) by their means over each unit."""
    for n in range(unit.shape[-1]):
        member = unit == n
        alone = member[..., None] & np.isfinite(values)
        count = np.maximum(alone.sum(-2, keepdims=True), 1)
        mean = np.where(alone, values, 0.0).sum(-2, keepdims=True) / count
        values[member] = np.broadcast_to(mean, values.shape)[member]
