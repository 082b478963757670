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


class World(NamedTuple):
    """A planning problem."""

    objective: str
    start: int
    goal: int
    into: np.ndarray  # (way, cell): the cell that the way leads to from a cell, -1 if it may not
    bound_cost: np.ndarray  # (move, cell entered), costs apart from trust
    u: np.ndarray  # (state, way, cell entered, next way or the number of ways)
    B0: np.ndarray  # (state, state)
    x0: np.ndarray  # (state,)
    family: str
    sd: float
    longest: int
    turns: bool
    risk: np.ndarray  # (sum, way, cell entered, next way or the number of ways), -log(1 - p)
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
    cell, came = np.array([world.start]), np.array([-1])  # -1: no way led here
    x, risk = world.x0[:, None], np.zeros((len(world.risk), 1))
    cost, bound_cost, scores, sums, total = np.zeros(1), np.zeros(1), [], [], 0
    for k in range(1, world.longest + 1):
        way, walk = np.nonzero(world.into[:, cell] >= 0)
        other = world.into[way, cell[walk]]
        fits = far[other] <= world.longest - k
        if not world.turns:
            fits &= (came[walk] < 0) | (way % 8 != 7 - came[walk] % 8)
        way, walk, other = way[fits], walk[fits], other[fits]
        m = way % 8
        total += len(m)
        if total > most:
            raise TooManyError
        x, cost, risk = x[:, walk], cost[walk], risk[:, walk]
        if k > 1:  # what happens in a bound depends on the next way, which is known only now
            x = world.B0 @ x + world.u[:, came[walk], cell[walk], way]
            cost = cost + world.loss(x.mean(0))
            risk = risk + world.risk[:, came[walk], cell[walk], way]
        bound_cost = bound_cost[walk] + world.bound_cost[m, other]
        cell, came, there = other, way, other == world.goal
        last = world.loss((world.B0 @ x + world.u[:, way, other, -1]).mean(0))
        ended = risk + world.risk[:, way, other, -1]
        scores.append(world.score(cost + last, last, bound_cost, ended, k)[there])
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
    x, risk, costs, bound_cost, ways = world.x0, np.zeros(len(world.risk)), [], 0.0, []
    cells = [cell for cell, _ in path]
    if cells[0] != world.start or cells[-1] != world.goal or world.goal in cells[:-1]:
        return -np.inf
    for (a, posts), (c, _) in pairwise(path):
        entering = np.flatnonzero(world.into[:8, a] == c)
        if not len(entering) or (not world.turns and ways and entering[0] == 7 - ways[-1] % 8):
            return -np.inf
        ways.append(entering[0] + 8 * posts)
        bound_cost = bound_cost + world.bound_cost[entering[0], c]
    for way, c, after in zip(ways, cells[1:], [*ways[1:], -1], strict=True):
        x = world.B0 @ x + world.u[:, way, c, after]
        costs.append(world.loss(x.mean()))
        risk = risk + world.risk[:, way, c, after]
    if len(costs) > world.longest or -world.share @ np.expm1(-risk) > world.limit:
        return -np.inf
    return world.score(sum(costs), costs[-1], bound_cost, risk, len(costs))
