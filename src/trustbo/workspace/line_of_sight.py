"""Line of sight of bounds: the share of its time in which robot and lead should see each other.

A bound a -> c has two phases (docs/concepts.md, "Why bounds"). T2 stands at its posts in a and
watches the lead drive to its stop in c; then the lead stands and watches T2 close up to posts
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

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import batched, pairwise
from typing import NamedTuple

import numpy as np

from trustbo.data import Cell
from trustbo.parallel import in_order
from trustbo.team import Robot, Team
from trustbo.workspace.moves import MOVES, existing_bounds
from trustbo.workspace.posts import Posts, doubted
from trustbo.workspace.routes import at_times
from trustbo.workspace.sight import Sight, detection_between, jittered, optics
from trustbo.workspace.surface import Surface
from trustbo.workspace.ways import Ways

_BLOCK = 256  # bounds computed at a time: they share calls, and bound the memory
N_SAMPLES = 16
"""Times in each phase at which sight is computed."""
_AHEAD = 0.5  # cosine of the largest turn that is expected: turns lead to other posts


class Geometry(NamedTuple):
    """Places and ways of the robots in some bounds; positions are x, y in CRS metres."""

    ways: list[np.ndarray]  # of the lead, (point, 2) each
    posts: np.ndarray  # (bound, robot, 2), from which T2 watches the lead
    ends: np.ndarray  # (bound, sample, robot, 2), to which T2 closes up
    stops: np.ndarray  # (bound, 2), from which the lead watches T2


def geometry(ways: Ways, bounds: Sequence[tuple[Cell, Cell]], passable: np.ndarray) -> Geometry:
    """Collect the bounds (a, c) between cells that are `passable`, (row, col)."""
    posts, ends = ways.posts, []
    for a, c in bounds:
        ahead = [posts.watching(c, b) for b in _cells_ahead(passable, a, c)]
        ends.append([ahead[k % len(ahead)] for k in range(N_SAMPLES)])
    return Geometry(
        [posts.lead_line(a, c) for a, c in bounds],
        np.array([posts.watching(a, c) for a, c in bounds]),
        np.array(ends),
        np.array([posts.stop(c) for _, c in bounds]),
    )


def geometry_along(posts: Posts, path: Sequence[Cell]) -> Geometry:
    """Collect the bounds of a path."""
    lead, t2 = posts.places(path)
    lines = [posts.lead_line(a, c) for a, c in pairwise(path)]
    ends = np.repeat(t2[1:, None], N_SAMPLES, axis=1)
    return Geometry(lines, t2[:-1], ends, lead[1:])


def over_bounds[R](
    ways: Ways, passable: np.ndarray, work: Callable[[Geometry], R]
) -> Iterator[tuple[np.ndarray, R]]:
    """Compute something of all bounds between passable cells, (row, col), some at a time.

    Also their moves, rows and columns, (3, bound).
    """
    steps = np.array(MOVES[8])

    def of_block(block: Sequence[np.ndarray]) -> tuple[np.ndarray, R]:
        index = np.array(block)  # (bound, (move, row, col))
        left = (index[:, 1:] - steps[index[:, 0]]).tolist()
        pairs = [((i, j), (k, n)) for (i, j), (_, k, n) in zip(left, index.tolist(), strict=True)]
        return index.T, work(geometry(ways, pairs, passable))

    return in_order(of_block, batched(np.argwhere(existing_bounds(passable)), _BLOCK))


def _cells_ahead(passable: np.ndarray, a: Cell, c: Cell) -> list[Cell | None]:
    """Cells expected after the bound a -> c: without sharp turns if there are some; else None."""
    (rows, cols), (down, right) = passable.shape, (c[0] - a[0], c[1] - a[1])
    onward: list[Cell | None] = []
    ahead: list[Cell | None] = []
    for i, j in MOVES[8]:
        b = c[0] + i, c[1] + j
        if b != a and 0 <= b[0] < rows and 0 <= b[1] < cols and passable[b]:
            onward.append(b)
            if i * down + j * right >= _AHEAD * math.hypot(i, j) * math.hypot(down, right):
                ahead.append(b)
    return ahead or onward or [None]


class Phases(NamedTuple):
    """Sight at times of both phases of bounds: chances of detection in [0, 1]."""

    watched: np.ndarray  # the lead by each robot, (bound, robot, sample)
    closing: np.ndarray  # each robot by the lead, on its way, (bound, robot, sample)
    waiting: np.ndarray  # each robot by the lead, at its next post, (bound, robot, sample)
    lead_time: np.ndarray  # s, (bound,)
    times: np.ndarray  # s, until each robot has closed up, (bound, robot)
    tracks: np.ndarray  # ways of T2, (bound, robot, sample, 2)

    def line_of_sight(self) -> np.ndarray:
        """Share of the time in which a robot and the lead should see each other, (bound, robot)."""
        watched, closing, waiting = (
            seen.mean(-1) for seen in (self.watched, self.closing, self.waiting)
        )
        lead_time, slowest = self.lead_time[:, None], self.times.max(1)[:, None]
        total = lead_time * watched + self.times * closing + (slowest - self.times) * waiting
        return total / (lead_time + slowest)

    def unseen(self) -> np.ndarray:
        """Share of the time in which nobody sees anybody, (bound,)."""
        lead_time, slowest = self.lead_time[:, None], self.times.max(1)[:, None]
        of_lead = 1.0 - np.clip(self.watched, 0.0, 1.0)
        share = (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES
        arrived = (share * slowest)[:, None] >= self.times[..., None]  # and waits at its post
        seen = np.where(arrived, self.waiting, self.closing)
        of_t2 = 1.0 - np.clip(seen, 0.0, 1.0)
        both = lead_time * of_lead.prod(-2) + slowest * of_t2.prod(-2)
        return (both / (lead_time + slowest)).mean(-1)


def phases(
    surface: Surface, sight: Sight, team: Team, given: Geometry, *, doubt: bool = False
) -> Phases:
    """Compute sight at times of both phases of bounds, as predicted or as `doubted`."""
    lead = _timed(surface, team.lead, given.ways)
    first = np.stack([way[0] for way in given.ways])
    last = np.stack([way[-1] for way in given.ways])
    share = ((np.arange(N_SAMPLES) + 0.5) / N_SAMPLES)[:, None]
    drives = [_timed(surface, robot, given.ways) for robot in team.robots]
    # T2's ways may be much longer or shorter than the lead's.
    bound = np.linalg.norm(last - first, axis=1)
    gaps = np.linalg.norm(given.ends - given.posts[:, None], axis=-1).mean(1)
    longer = gaps / np.maximum(bound, 1.0)[:, None]
    drives = [(route, time * longer[:, i]) for i, (route, time) in enumerate(drives)]
    shape = (*given.posts.shape[:2], N_SAMPLES)
    watched, closing, waiting = (np.empty(shape) for _ in range(3))
    tracks = np.empty((*shape, 2))
    for i, (robot, (route, _)) in enumerate(zip(team.robots, drives, strict=True)):
        shift = (1.0 - share) * (given.posts[:, i, None] - first[:, None])
        tracks[:, i] = route + shift + share * (given.ends[:, :, i] - last[:, None])
        stop, end = given.stops[:, None], given.ends[:, :, i]
        seen = partial(_seen, surface, sight, doubt)
        eyes = given.posts[:, i, None] + jittered(N_SAMPLES)
        watched[:, i] = seen(robot, team.lead, eyes, lead[0])
        closing[:, i] = seen(team.lead, robot, stop, tracks[:, i])
        waiting[:, i] = seen(team.lead, robot, stop, end)
    times = np.stack([time for _, time in drives], axis=1)
    return Phases(watched, closing, waiting, lead[1], times, tracks)


def _timed(
    surface: Surface, robot: Robot, ways: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    first = np.cumsum([0, *(len(way) for way in ways)])
    return at_times(surface, robot, np.concatenate(ways), first, N_SAMPLES)


def bound_features(
    surface: Surface, sight: Sight, team: Team, given: Geometry, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute line of sight and traversability of bounds, each of shape (bound, robot), in [0, 1].

    Traversability is the mean of the map of pixels `index`, (row, col), along T2's ways; NaN where
    it has no data.
    """
    seen = phases(surface, sight, team, given)
    easy = index[surface.nearest(seen.tracks[..., 0], seen.tracks[..., 1])]
    return seen.line_of_sight(), _mean(easy)


def _seen(
    surface: Surface,
    sight: Sight,
    doubt: bool,
    watcher: Robot,
    watched: Robot,
    eye: np.ndarray,
    targets: np.ndarray,
) -> np.ndarray:
    """Probability of detection at the samples of bounds, shape (bound, sample)."""
    seen = detection_between(surface, sight, eye, targets, optics(watcher, watched))
    if doubt:
        seen = doubted(seen, np.linalg.norm(targets - eye, axis=-1))
    return watcher.detection * seen


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis of the values that are not NaN; NaN where none is."""
    finite = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(finite, values, 0.0).sum(-1) / finite.sum(-1)
