"""Line of sight: predicted fraction of a bound in which a robot and the lead see each other.

A bound a -> c has two phases (docs/concepts.md, "Why bounds"). First, T2 watches from its posts
in a while the lead drives to its stop in c. Then the lead watches from this stop while T2 closes up
to its posts in c, which depend on the next cell. Sight is computed at evenly spaced times in each
phase, and the phases are weighted by their durations:

    line_of_sight_i = (T_1 mean_k p(post_i -> lead at t_k) + T_2 mean_k p(lead -> robot i at t_k))
                      / (T_1 + T_2),

where p is the detection probability under the assumed model of sight, T_1 is the lead's driving
time and T_2 is the driving time of the slowest robot. A robot that arrives earlier waits at its
post. The assumed next cell changes with k, so that all cells ahead are represented.

Each set of posts in a has its own line of sight, in which T2 closes up to the standard posts in c.
`onward_maps` computes how line of sight changes with the next cell and with the set chosen there.

The lead takes the fastest route, as in the simulator. T2 is assumed to follow that route, shifted
to T2's posts. Finding T2's own fastest routes would take about 50 searches for each bound. These
routes differ from the assumed routes by a few metres, over which sight hardly changes.
"""

import math
from collections.abc import Sequence
from itertools import batched
from typing import NamedTuple

import numpy as np

from trustbo.data import POST_SETS, Cell, Station
from trustbo.parallel import in_order
from trustbo.team import Robot, Team
from trustbo.workspace.moves import MOVES, existing_bounds, for_sets, possible_next
from trustbo.workspace.posts import Posts
from trustbo.workspace.routes import at_times
from trustbo.workspace.sight import Sight, detection_between, jittered, optics
from trustbo.workspace.surface import Surface

_BLOCK = 256  # bounds computed together, to limit memory use
N_SAMPLES = 16
"""Number of times at which sight is computed in each phase of a bound."""
_N_OF_PAIRS = 12  # number of these times in each phase, for each next way
_PAIRS = 4096  # pairs of a bound and a next way computed together
_AHEAD = 0.5  # cosine of the largest turn after which a cell counts as ahead


class Geometry(NamedTuple):
    """Stops, posts and routes of the robots in given bounds; x and y are in CRS metres."""

    routes: list[np.ndarray]  # of the lead, each (point, 2)
    posts: np.ndarray  # (bound, robot, 2), from which T2 watches the lead
    ends: np.ndarray  # (bound, sample, robot, 2), to which T2 closes up
    stops: np.ndarray  # (bound, 2), from which the lead watches T2


def bound_maps(
    posts: Posts, passable: np.ndarray, traversability: np.ndarray, n_posts: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the line of sight and the traversability of all bounds between passable cells.

    The traversability of a bound is the mean of a pixel map, shape (row, col), along T2's tracks.

    Returns:
        Two arrays of shape (robot, way, row, col), in [0, 1], for the first `n_posts` sets of
        posts; NaN where there is no bound or no data along the tracks.
    """
    exists = for_sets(existing_bounds(passable), n_posts)
    maps = np.full((2, len(posts.team.robots), *exists.shape), np.nan)

    def of_block(block: Sequence[np.ndarray]) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        index = np.array(block)  # (bound, (way, row, col))
        given = geometry(posts, index, passable)
        return index.T, bound_features(
            posts.surface, posts.sight, posts.team, given, traversability
        )

    for bounds, features in in_order(of_block, batched(np.argwhere(exists), _BLOCK)):
        for one, values in zip(maps, features, strict=True):
            one[:, *bounds] = values.T
    return maps[0], maps[1]


def onward_maps(posts: Posts, passable: np.ndarray, n_posts: int) -> np.ndarray:
    """Compute the change of line of sight by the next way, for several sets of posts.

    Returns:
        Line of sight if T2 closes up to the posts of the next way, minus the mean over the cells
        ahead with standard posts, shape (robot, way, row, col, next way), in single precision; NaN
        where the bound or the next bound does not exist.
    """
    exists = existing_bounds(passable)
    watching = _posts_of_ways(posts, exists, n_posts)
    waiting = _sight_of_waiting(posts, watching)
    pairs = np.argwhere(possible_next(exists, n_posts)[..., :-1])
    n_ways = len(MOVES) * n_posts
    robots = posts.team.robots
    maps = np.full((len(robots), n_ways, *passable.shape, n_ways), np.nan, np.float32)

    def of_block(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return block.T, _sight_of_pairs(posts, watching, waiting, block)

    blocks = [pairs[i : i + _PAIRS] for i in range(0, len(pairs), _PAIRS)]
    for where, seen in in_order(of_block, blocks):
        maps[:, *where] = seen.T

    for move, row, col in np.argwhere(exists).tolist():
        down, right = MOVES[move]
        a = row - down, col - right
        ahead = [b for b in _cells_ahead(passable, a, (row, col)) if b is not None]
        moves = [MOVES.index((b[0] - row, b[1] - col)) for b in ahead]
        if moves:
            of_sets = maps[:, move :: len(MOVES), row, col]  # (robot, set, next way)
            of_sets -= of_sets[..., moves].mean(-1, keepdims=True)
    return maps


def _posts_of_ways(posts: Posts, exists: np.ndarray, n_posts: int) -> np.ndarray:
    """Return the posts from which T2 watches each way out of a cell, (way, row, col, robot, 2)."""
    n_robots = len(posts.team.robots)
    places = np.full((len(MOVES) * n_posts, *exists.shape[1:], n_robots, 2), np.nan)
    for move, row, col in np.argwhere(exists).tolist():
        down, right = MOVES[move]
        a = row - down, col - right
        for number, name in enumerate(POST_SETS[:n_posts]):
            places[move + len(MOVES) * number, *a] = posts.watching((*a, name), (row, col))
    return places


def _sight_of_waiting(posts: Posts, watching: np.ndarray) -> np.ndarray:
    """Compute how well the lead sees T2 at its posts of each way out, (way, row, col, robot)."""
    seen = np.full(watching.shape[:-1], np.nan)
    ways = np.argwhere(np.isfinite(watching[..., 0, 0]))
    stops = np.array([posts.stop((row, col)) for _, row, col in ways.tolist()]).reshape(-1, 2)
    for i, robot in enumerate(posts.team.robots):
        places = watching[*ways.T, i]
        view = optics(posts.team.lead, robot)
        found = detection_between(posts.surface, posts.sight, stops, places, view)
        seen[*ways.T, i] = posts.team.lead.detection * found
    return seen


def _sight_of_pairs(
    posts: Posts, watching: np.ndarray, waiting: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Compute the line of sight (pair, robot) of ways, rows, columns and next ways (pair, 4)."""
    # What does not depend on the next way is computed once for each bound and set of posts.
    bounds, index = np.unique(pairs[:, :3], axis=0, return_inverse=True)
    way = bounds[:, 0]
    left = bounds[:, 1:] - np.array(MOVES)[way % len(MOVES)]
    from_posts = watching[way, *left.T]  # (bound, robot, 2)
    cells = [
        (tuple(a), tuple(c)) for a, c in zip(left.tolist(), bounds[:, 1:].tolist(), strict=True)
    ]
    routes = [posts.lead_line(*bound) for bound in cells]

    surface, sight, lead = posts.surface, posts.sight, posts.team.lead
    lead_route, lead_time = _timed(surface, lead, routes, _N_OF_PAIRS)
    drives = [_timed(surface, robot, routes, _N_OF_PAIRS) for robot in posts.team.robots]
    watched = []
    for i, robot in enumerate(posts.team.robots):
        eye = from_posts[:, i, None] + jittered(_N_OF_PAIRS)
        view = optics(robot, lead)
        found = detection_between(surface, sight, eye, lead_route, view).mean(1)
        watched.append(robot.detection * lead_time * found)

    start = from_posts[index]
    onward = pairs[:, 3], *pairs[:, 1:3].T
    end, at_end = watching[onward], waiting[onward]
    stop = np.array([posts.stop(c) for _, c in cells])[index]
    first, last = (np.stack([route[k] for route in routes])[index] for k in (0, -1))

    distance = np.linalg.norm(end - start, axis=-1).mean(1)
    longer = distance / np.maximum(np.linalg.norm(last - first, axis=1), 1.0)
    times = np.stack([time[index] for _, time in drives], axis=1) * longer[:, None]
    slowest = times.max(1)
    share = ((np.arange(_N_OF_PAIRS) + 0.5) / _N_OF_PAIRS)[:, None]

    seen = np.empty(times.shape)
    for i, (robot, (route, _)) in enumerate(zip(posts.team.robots, drives, strict=True)):
        shift = (1.0 - share) * (start[:, i] - first)[:, None] + share * (end[:, i] - last)[:, None]
        view = optics(lead, robot)
        found = detection_between(surface, sight, stop[:, None], route[index] + shift, view)
        closing = (lead.detection * found).mean(1)
        seen[:, i] = times[:, i] * closing + (slowest - times[:, i]) * at_end[:, i]
        seen[:, i] += watched[i][index]
    return seen / (lead_time[index] + slowest)[:, None]


def geometry(posts: Posts, index: np.ndarray, passable: np.ndarray) -> Geometry:
    """Collect the geometry of bounds; `index` (bound, 3) contains their (way, row, col)."""
    numbers, moves = np.divmod(index[:, 0], len(MOVES))
    left = (index[:, 1:] - np.array(MOVES)[moves]).tolist()
    bounds: list[tuple[Station, Cell]] = [
        ((i, j, POST_SETS[number]), (row, col))
        for (i, j), (_, row, col), number in zip(left, index.tolist(), numbers, strict=True)
    ]

    ends = []
    for a, c in bounds:
        ahead = [posts.watching(c, b) for b in _cells_ahead(passable, a[:2], c)]
        ends.append([ahead[k % len(ahead)] for k in range(N_SAMPLES)])

    return Geometry(
        [posts.lead_line(a, c) for a, c in bounds],
        np.array([posts.watching(a, c) for a, c in bounds]),
        np.array(ends),
        np.array([posts.stop(c) for _, c in bounds]),
    )


def _cells_ahead(passable: np.ndarray, a: Cell, c: Cell) -> list[Cell | None]:
    """Return the cells that may follow the bound a -> c, without sharp turns if possible."""
    rows, cols = passable.shape
    down = c[0] - a[0]
    right = c[1] - a[1]

    onward: list[Cell | None] = []
    ahead: list[Cell | None] = []
    for i, j in MOVES:
        b = c[0] + i, c[1] + j
        if b != a and 0 <= b[0] < rows and 0 <= b[1] < cols and passable[b]:
            onward.append(b)
            if i * down + j * right >= _AHEAD * math.hypot(i, j) * math.hypot(down, right):
                ahead.append(b)
    return ahead or onward or [None]


def bound_features(
    surface: Surface, sight: Sight, team: Team, given: Geometry, traversability: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute line of sight and traversability, each (bound, robot); see `bound_maps`."""
    lead, lead_time = _timed(surface, team.lead, given.routes)
    drives = [_timed(surface, robot, given.routes) for robot in team.robots]
    first, last = (np.stack([route[end] for route in given.routes]) for end in (0, -1))

    # Scale T2's times by the ratio of the straight distances of T2 and of the lead.
    distance = np.linalg.norm(given.ends - given.posts[:, None], axis=-1).mean(1)
    longer = distance / np.maximum(np.linalg.norm(last - first, axis=1), 1.0)[:, None]
    times = np.stack([time for _, time in drives], axis=1) * longer  # (bound, robot)

    slowest = times.max(1)
    share = ((np.arange(N_SAMPLES) + 0.5) / N_SAMPLES)[:, None]

    def seen(watcher: Robot, watched: Robot, eye: np.ndarray, target: np.ndarray) -> np.ndarray:
        view = optics(watcher, watched)
        return (watcher.detection * detection_between(surface, sight, eye, target, view)).mean(-1)

    line_of_sight = np.empty(times.shape)
    easy = np.empty(times.shape)
    for i, (robot, (route, _)) in enumerate(zip(team.robots, drives, strict=True)):
        post = given.posts[:, i, None]
        end = given.ends[:, :, i]
        stop = given.stops[:, None]

        track = route + (1.0 - share) * (post - first[:, None]) + share * (end - last[:, None])
        watched = seen(robot, team.lead, post + jittered(N_SAMPLES), lead)
        closing, waiting = (seen(team.lead, robot, stop, place) for place in (track, end))

        t2_time = times[:, i]
        total = lead_time * watched + t2_time * closing + (slowest - t2_time) * waiting
        line_of_sight[:, i] = total / (lead_time + slowest)

        values = traversability[surface.nearest(track[..., 0], track[..., 1])]
        known = np.isfinite(values)
        with np.errstate(invalid="ignore"):  # NaN if no value is known
            easy[:, i] = np.where(known, values, 0.0).sum(-1) / known.sum(-1)

    return line_of_sight, easy


def _timed(
    surface: Surface, robot: Robot, routes: Sequence[np.ndarray], n_samples: int = N_SAMPLES
) -> tuple[np.ndarray, np.ndarray]:
    """Return a robot's positions (bound, sample, 2) on routes, and the durations (bound,), s."""
    first = np.cumsum([0, *(len(route) for route in routes)])
    return at_times(surface, robot, np.concatenate(routes), first, n_samples)
