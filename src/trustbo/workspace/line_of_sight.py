"""Line of sight of bounds: the share of its time in which robot and lead should see each other.

A bound a -> c has two phases (docs/concepts.md, "Why bounds"). T2 stands at its posts in a and
watches the lead drive to its waypoint in c; then the lead stands and watches T2 close up to posts
in c, from which each of the admissible next cells can be watched. Both phases are sampled at times
spread evenly over them, and weighted by their durations:

    line_of_sight_i = (T_1 mean_k p(post_i -> lead at t_k) + T_2 mean_k p(lead -> robot i at t_k))
                      / (T_1 + T_2),

p the probability of detection under the assumed sight, T_1 the lead's driving time and T_2 that of
the slowest robot; one that arrives before it is seen at its post until then. The next cell changes
from sample to sample, over all that a path may go on to; at the goal T2 stands around the lead.

The lead's way is the fastest route, as the simulator drives it. T2's is that route shifted to T2's
posts: it differs from T2's fastest route by some metres, over which sight hardly changes, and saves
the search of some 50 routes for each bound.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.data import Cell
from trustbo.team import Robot, Team
from trustbo.workspace.routes import speed_share
from trustbo.workspace.sight import Sight, detection_probability, optics
from trustbo.workspace.surface import Surface
from trustbo.workspace.ways import Ways

N_SAMPLES = 16
"""Times in each phase at which sight is computed."""
_compiled = njit(cache=True, nogil=True, error_model="numpy")


class Geometry(NamedTuple):
    """Posts and ways of the robots in some bounds; positions are x, y in CRS metres."""

    ways: list[np.ndarray]  # of the lead, (point, 2) each
    posts: np.ndarray  # (bound, robot, 2), from which T2 watches the lead
    ends: np.ndarray  # (bound, sample, robot, 2), to which T2 closes up


def geometry(ways: Ways, bounds: Sequence[tuple[Cell, Cell]], passable: np.ndarray) -> Geometry:
    """Collect posts and ways of bounds (a, c) between cells that are `passable`, (row, col)."""
    posts = ways.posts
    of_lead, starts, ends = [], [], []
    for a, c in bounds:
        route = ways.lead(a, c)
        straight = np.stack([posts.waypoint(a), posts.waypoint(c)])
        of_lead.append(straight if route is None else route)
        starts.append(posts.watching(a, c))
        ahead = [posts.watching(c, b) for b in _onward(passable, a, c)]
        ends.append([ahead[k % len(ahead)] for k in range(N_SAMPLES)])
    return Geometry(of_lead, np.array(starts), np.array(ends))


def _onward(passable: np.ndarray, a: Cell, c: Cell) -> list[Cell | None]:
    """Cells that a path may go on to, without a U-turn; None if there is none."""
    (rows, cols), near = passable.shape, [-1, 0, 1]
    cells = [(c[0] + i, c[1] + j) for i in near for j in near if i or j]
    inside = [b for b in cells if b != a and 0 <= b[0] < rows and 0 <= b[1] < cols]
    return [b for b in inside if passable[b]] or [None]


def bound_features(
    surface: Surface, sight: Sight, team: Team, given: Geometry, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute line of sight and traversability of bounds, each of shape (bound, robot), in [0, 1].

    Traversability is the mean of the map of pixels `index`, (row, col), along T2's ways; NaN where
    it has no data.
    """
    flat = np.concatenate(given.ways)
    first = np.cumsum([0, *(len(way) for way in given.ways)])
    stops = flat[first[1:] - 1]  # the lead's, (bound, 2)
    lead = _at_times(surface, team.lead, flat, first)
    share = ((np.arange(N_SAMPLES) + 0.5) / N_SAMPLES)[:, None]
    drives = [_at_times(surface, robot, flat, first) for robot in team.robots]
    slowest = np.max([time for _, time in drives], axis=0)
    los, easy = np.empty(given.posts.shape[:2]), np.empty(given.posts.shape[:2])
    for i, (robot, (route, time)) in enumerate(zip(team.robots, drives, strict=True)):
        post = given.posts[:, i, None]
        shift = (1.0 - share) * (post - flat[first[:-1], None])
        track = route + shift + share * (given.ends[:, :, i] - stops[:, None])
        watched = _seen(surface, sight, robot, team.lead, post, lead[0])
        closing = _seen(surface, sight, team.lead, robot, stops[:, None], track)
        waiting = _seen(surface, sight, team.lead, robot, stops[:, None], given.ends[:, :, i])
        total = lead[1] * watched + time * closing + (slowest - time) * waiting
        los[:, i] = total / (lead[1] + slowest)
        easy[:, i] = _mean(index[surface.nearest(track[..., 0], track[..., 1])])
    return los, easy


def _seen(
    surface: Surface,
    sight: Sight,
    watcher: Robot,
    watched: Robot,
    eye: np.ndarray,
    targets: np.ndarray,
) -> np.ndarray:
    """Mean probability of detection over the samples of bounds, shape (bound,)."""
    eye = np.broadcast_to(eye, targets.shape).reshape(-1, 2)
    lidar = optics(watcher, watched)
    detected = detection_probability(surface, sight, eye, targets.reshape(-1, 2), lidar)
    return watcher.detection * detected.reshape(targets.shape[:2]).mean(1)


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean of the values that are not NaN, shape (bound,); NaN where none is."""
    finite = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(finite, values, 0.0).sum(1) / finite.sum(1)


def _at_times(
    surface: Surface, robot: Robot, flat: np.ndarray, first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions of a robot at even times along routes, (bound, sample, 2), and durations, s."""
    return _resampled(
        surface.gradient,
        surface.pixel,
        surface.origin,
        flat,
        first,
        (robot.speed, robot.max_slope),
        N_SAMPLES,
    )


@_compiled
def _resampled(gradient, pixel, origin, flat, first, limits, n_samples):
    """Speed falls with the larger of pitch and roll, as in `simulation.motion`."""
    rows, cols = gradient.shape[1:]
    n = len(first) - 1
    points, duration = np.empty((n, n_samples, 2)), np.empty(n)
    longest = 0
    for b in range(n):
        longest = max(longest, first[b + 1] - first[b])
    clock = np.empty(longest)
    for b in range(n):
        way = flat[first[b] : first[b + 1]]
        clock[0] = 0.0
        for k in range(1, len(way)):
            dx, dy = way[k, 0] - way[k - 1, 0], way[k, 1] - way[k - 1, 1]
            length = max(np.hypot(dx, dy), 1e-9)
            i = min(rows - 1, max(0, int((origin[1] - way[k, 1]) / pixel[0] + 0.5)))
            j = min(cols - 1, max(0, int((way[k, 0] - origin[0]) / pixel[1] + 0.5)))
            gx, gy = gradient[0, i, j], gradient[1, i, j]
            pitch, roll = abs(gx * dx + gy * dy) / length, abs(gy * dx - gx * dy) / length
            tilt = np.arctan(max(pitch, roll))
            clock[k] = clock[k - 1] + length / (limits[0] * speed_share(tilt, limits[1]))
        duration[b] = clock[len(way) - 1]
        k = 1
        for s in range(n_samples):
            t = duration[b] * (s + 0.5) / n_samples
            while k < len(way) - 1 and clock[k] < t:
                k += 1
            share = (t - clock[k - 1]) / max(clock[k] - clock[k - 1], 1e-12)
            for axis in range(2):
                points[b, s, axis] = way[k - 1, axis] + share * (way[k, axis] - way[k - 1, axis])
    return points, duration
