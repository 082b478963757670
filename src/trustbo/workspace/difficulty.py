"""Difficulty of bounds, measured on the robots' routes relative to the robots' limits.

Each measure is 0 on easy routes and about 1 at the robots' limit. The measure of a bound is the
maximum over the routes of the lead and of T2. The routes of T2 depend on the next bound, which is
assumed to have the same direction.
"""

import math
from collections.abc import Sequence
from itertools import batched
from weakref import WeakKeyDictionary

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.kernels import kernel
from trustbo.parallel import in_order
from trustbo.terrain.pixels import nearest_pixel
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES
from trustbo.workspace.posts import TRAVERSABLE, Posts

MEASURES = ("untraversable", "tilt", "narrowness", "tightness")
"""Measures of difficulty; see `difficulty_of`."""
_AHEAD = 1.5  # distance to the point of the route that a robot faces, m
_STEP = 0.25  # distance between samples of a route, m
_SUSTAINED = 4  # number of samples over which the tilt is averaged
_WIDTH = 2.0  # distance to an impassable pixel at which narrowness is 0.5, m
_UNKNOWN = 0.5  # difficulty of routes without known traversability
_BESIDE = 1.001  # pixels; a route this close to an impassable pixel is beside it
_MOST = 2.0  # largest value of the measure tilt
_TIGHT = 3.0  # log(1 + length in m) at which tightness is 1: 19 m
_BLOCK = 16  # bounds per task of a thread
_compiled = kernel()

_cached: WeakKeyDictionary[Workspace, xr.DataArray] = WeakKeyDictionary()


def difficulty_of(workspace: Workspace) -> xr.DataArray:
    """Compute the difficulty of a workspace's bounds; the result is cached.

    `untraversable` is one minus the mean traversability of a route's pixels, or 0.5 if unknown.
    `tilt` is the largest tangent of pitch or roll along the route, averaged over 1 m, divided by
    the tangent of `max_slope`; it is at most 2. The robot faces a point 1.5 m ahead. `narrowness`
    is 1 / (1 + w / 2 m), where w is the smallest distance to an impassable pixel. `tightness` is
    log(1 + l / 1 m) / 3, where l is the length of the route beside impassable pixels.

    Returns:
        DataArray (move, row, col, measure), NaN where there is no bound. Without a terrain, the
        dimension `measure` has length 0.
    """
    if workspace not in _cached:
        exists = workspace.passable_bounds
        posts = workspace.posts
        names = () if posts is None else MEASURES
        values = np.full((*exists.shape, len(names)), np.nan)
        if posts is not None:
            _measure(workspace, posts, exists.values, values)

        coords = {**exists.coords, "measure": list(names)}
        difficulty = xr.DataArray(values, coords, (*exists.dims, "measure"), "difficulty")
        _cached[workspace] = difficulty
    return _cached[workspace]


def _measure(workspace: Workspace, posts: Posts, exists: np.ndarray, out: np.ndarray) -> None:
    """Write the measures of existing bounds to `out`, shape (move, row, col, measure)."""
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
            cell = row, col
            left = row - down, col - right
            ahead = row + down, col + right

            inside = 0 <= ahead[0] < exists.shape[1] and 0 <= ahead[1] < exists.shape[2]
            onward = ahead if inside and exists[m, *ahead] else None
            out[m, row, col] = _of_bound(posts, easy, room, posts.bound_routes(left, cell, onward))

    for _ in in_order(work, batched(np.argwhere(exists).tolist(), _BLOCK)):
        pass


def _of_bound(
    posts: Posts, easy: np.ndarray, room: np.ndarray, routes: Sequence[np.ndarray | None]
) -> np.ndarray:
    """Compute the maximum of each measure over the robots' routes in a bound, shape (measure,)."""
    surface = posts.surface
    team = posts.team
    ground = surface.gradient, surface.pixel, surface.origin
    robots = team.lead, *team.robots

    worst = np.zeros(len(MEASURES))
    for robot, route in zip(robots, routes, strict=True):
        if route is None:
            continue

        pixels = surface.nearest(*route.T)
        of_route = easy[pixels]
        gaps = room[pixels]
        of_route = of_route[np.isfinite(of_route)]

        tight = (gaps <= _BESIDE * max(surface.pixel)).sum() * min(surface.pixel)
        measures = (
            1.0 - of_route.mean() if len(of_route) else _UNKNOWN,
            min(_tilt(route, *ground) / np.tan(robot.max_slope), _MOST),
            1.0 / (1.0 + gaps.min() / _WIDTH),
            np.log1p(tight) / _TIGHT,
        )

        worst = np.maximum(worst, measures)
    return worst


@_compiled
def _tilt(way, gradient, pixel, origin):
    """Compute the largest tangent of pitch or roll on a route (point, 2), averaged over 1 m."""
    along = np.zeros(len(way))
    for k in range(1, len(way)):
        along[k] = along[k - 1] + math.hypot(way[k, 0] - way[k - 1, 0], way[k, 1] - way[k - 1, 1])

    n = int(along[-1] / _STEP) + 1
    tilt = np.empty(n)
    sums = np.zeros(n + 1)

    for k in range(n):
        x, y = _point(way, along, k * _STEP)
        ahead_x, ahead_y = _point(way, along, k * _STEP + _AHEAD)
        i, j = nearest_pixel(x, y, origin, pixel, gradient.shape[1:])

        gx = gradient[0, i, j]
        gy = gradient[1, i, j]
        heading = math.atan2(ahead_y - y, ahead_x - x)

        east = math.cos(heading)
        north = math.sin(heading)
        tilt[k] = max(abs(gx * east + gy * north), abs(gy * east - gx * north))
        sums[k + 1] = sums[k] + tilt[k]

    m = min(n, _SUSTAINED)
    return ((sums[m:] - sums[:-m]) / m).max()


@_compiled
def _point(way, along, s):
    """Return the position at distance s along a route, or the end of a shorter route."""
    k = min(np.searchsorted(along, s, side="right"), len(way) - 1)
    length = along[k] - along[k - 1]
    share = min(1.0, (s - along[k - 1]) / length) if length > 0.0 else 1.0

    x = way[k - 1, 0] + share * (way[k, 0] - way[k - 1, 0])
    return x, way[k - 1, 1] + share * (way[k, 1] - way[k - 1, 1])
