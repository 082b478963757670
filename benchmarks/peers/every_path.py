"""Best plans without the planner, found by enumerating every admissible walk.

This module shares no code with `trustbo.planning`. A `World` contains a problem as plain arrays
over the ways into each cell: the eight moves with each set of posts, way = move + 8 set. All walks
of the same length are extended at once.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import expit, ndtr

STEPS = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
NONE = 8  # instead of a move: the walk begins here, or ends here


class World(NamedTuple):
    """A planning problem."""

    objective: str
    start: int
    goal: int
    into: np.ndarray  # (way, cell): the cell that the way leads to from a cell, -1 if it may not
    bound_cost: np.ndarray  # (move, cell entered), costs apart from trust
    u: np.ndarray  # (state, way, cell entered)
    B0: np.ndarray  # (state, state)
    x0: np.ndarray  # (state,)
    family: str
    sd: float
    longest: int
    turns: bool
    risk: np.ndarray  # (sum, move, cell entered, next move or NONE), -log(1 - p)
    failure: np.ndarray  # (sum,), cost of failing by each sum
    share: np.ndarray  # (sum,), probability of each sum
    limit: float  # on the probability to fail

    def loss(self, trust):
        """Contact lost in a bound, or what its trust takes from a sum."""
        if self.objective != "lost_contact":
            return -trust
        if self.family == "beta_binomial":
            return expit(-trust)
        if self.family == "gaussian":
            return 1.0 - trust
        sd = max(self.sd, 1e-9)
        a, b = (trust - 1.0) / sd, trust / sd
        pdf = [np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) for z in (a, b)]
        # 1 - E[rate]: P(rate = 0) + E[1 - rate; inside], by the symmetry of the normal.
        return ndtr(-b) + (1.0 - trust) * (ndtr(b) - ndtr(a)) + sd * (pdf[0] - pdf[1])

    def score(self, cost, last, bound_cost, risk, n_bounds):
        """Score of walks: sum of losses, loss of the last bound, bound costs, risks (sum, ...)."""
        cost = last if self.objective == "terminal" else cost
        scale = n_bounds if self.objective == "mean" else 1.0
        return -(cost + bound_cost) / scale + np.tensordot(self.failure, np.expm1(-risk), 1)


class TooManyError(Exception):
    """More walks than can be written out."""


def to_goal(into, goal):
    """Fewest bounds from each cell to the goal by ways (way, cell); 10^6 if it is unreachable."""
    far = np.full(into.shape[1] + 1, 10**6)
    far[goal] = 0
    for _ in range(into.shape[1]):
        far[:-1] = np.minimum(far[:-1], 1 + far[into].min(0))
    return far


def best_walk(world, most):
    """Best score within the limit, -inf without such a walk, and the least probability to fail.

    TooManyError: more than `most` walks. NaN if rounding decides which are within the limit.
    """
    far = to_goal(world.into, world.goal)
    cell, came = np.array([world.start]), np.array([NONE])
    x, risk = world.x0[:, None], np.zeros((len(world.risk), 1))
    cost, bound_cost, scores, sums, total = np.zeros(1), np.zeros(1), [], [], 0
    begun = np.pad(world.risk, ((0, 0), (0, 1), (0, 0), (0, 0)))  # nothing is at risk before NONE
    for k in range(1, world.longest + 1):
        way, walk = np.nonzero(world.into[:, cell] >= 0)
        other = world.into[way, cell[walk]]
        fits = far[other] <= world.longest - k
        if not world.turns:
            fits &= (came[walk] == NONE) | (way % 8 != 7 - came[walk])
        way, walk, other = way[fits], walk[fits], other[fits]
        m = way % 8
        total += len(m)
        if total > most:
            raise TooManyError
        x = world.B0 @ x[:, walk] + world.u[:, way, other]
        last = world.loss(x.mean(0))
        cost, bound_cost = cost[walk] + last, bound_cost[walk] + world.bound_cost[m, other]
        # What is at risk in a bound depends on the next move, which is known only now.
        risk = risk[:, walk] + begun[:, came[walk], cell[walk], m]
        cell, came, there = other, m, other == world.goal
        ended = risk + world.risk[:, m, other, NONE]
        scores.append(world.score(cost, last, bound_cost, ended, k)[there])
        sums.append(-np.tensordot(world.share, np.expm1(-ended[:, there]), 1))
        on = ~there
        cell, came, x, risk = cell[on], came[on], x[:, on], risk[:, on]
        cost, bound_cost = cost[on], bound_cost[on]
    score, limited = np.concatenate(scores), np.concatenate(sums)
    if (np.abs(limited - world.limit) < 1e-9 * max(1.0, world.limit)).any():
        return np.nan, limited.min()
    return score[limited <= world.limit].max(initial=-np.inf), limited.min(initial=np.inf)


def score_along(world, path):
    """Score of one path of (cell, set); -inf if it is not admissible or beyond the limit."""
    x, risk, costs, bound_cost, came = world.x0, np.zeros(len(world.risk)), [], 0.0, NONE
    cells = [cell for cell, _ in path]
    if cells[0] != world.start or cells[-1] != world.goal or world.goal in cells[:-1]:
        return -np.inf
    for (a, posts), (c, _) in pairwise(path):
        entering = np.flatnonzero(world.into[:8, a] == c)
        if not len(entering) or (not world.turns and came != NONE and entering[0] == 7 - came):
            return -np.inf
        if came != NONE:
            risk = risk + world.risk[:, came, a, entering[0]]
        came = entering[0]
        x = world.B0 @ x + world.u[:, came + 8 * posts, c]
        costs.append(world.loss(x.mean()))
        bound_cost = bound_cost + world.bound_cost[came, c]
    risk = risk + world.risk[:, came, cells[-1], NONE]
    if len(costs) > world.longest or -world.share @ np.expm1(-risk) > world.limit:
        return -np.inf
    return world.score(sum(costs), costs[-1], bound_cost, risk, len(costs))
