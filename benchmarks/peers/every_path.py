"""Best plans without the planner: every walk written out, or a table over all states.

It shares no code with `trustbo.planning`. A `World` holds a problem as plain arrays over the eight
moves (n, ... row by row) into each cell. `every_walk` extends walks bound by bound, all of one
length at once. `dense_table` takes the problems whose cost adds up over bounds, with risks that are
whole multiples of a unit: cost over (cell, move by which it came, risk to come), for each number of
bounds left, so that hundreds of lengths are no more than as many tables.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import expit, ndtr

STEPS = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
NONE = 8  # instead of a move: the walk begins here


class World(NamedTuple):
    """A planning problem."""

    objective: str
    start: int
    goal: int
    into: np.ndarray  # (move, cell): the cell that the move leads to from a cell, -1 if it may not
    tolls: np.ndarray  # (move, cell entered), costs apart from trust
    u: np.ndarray  # (state, move, cell entered)
    B0: np.ndarray  # (state, state)
    x0: np.ndarray  # (state,)
    least: bool  # trust of the team: the least state, else their mean
    family: str
    sd: float
    longest: int
    u_turns: bool
    simple: bool
    risk: np.ndarray  # (resource, move, cell entered), -log(1 - p)
    limits: np.ndarray  # (resource,)
    needed: int
    failure_cost: float
    shares: np.ndarray  # (stratum,), of the resources after the first; a failure costs by these
    unit: float  # of all risks, 0 if there is none

    def failure(self, sums):
        """Cost of failures of walks with sums (resource, ...): by the first without strata."""
        if len(self.shares):
            chances = -np.expm1(-sums[1 : 1 + len(self.shares)])
            return self.failure_cost * np.tensordot(self.shares, chances, 1)
        return self.failure_cost * -np.expm1(-sums[0]) if len(sums) else 0.0

    def trust(self, x):
        """Trust of the team, of states (state, ...)."""
        return x.min(0) if self.least else x.mean(0)

    def loss(self, trust):
        """Contact lost in a bound, or what its trust costs in success and stationary."""
        if self.objective in ("success", "stationary"):
            return np.maximum(-trust, 0.0) + np.log1p(np.exp(-np.abs(trust)))
        if self.objective == "bottleneck":
            return -trust
        if self.family == "beta_binomial":
            return expit(-trust)
        if self.family == "censored":
            sd = max(self.sd, 1e-9)
            a, b = (trust - 1.0) / sd, trust / sd
            pdf = [np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) for z in (a, b)]
            # 1 - E[rate]: P(rate = 0) + E[1 - rate; inside], by the symmetry of the normal.
            return ndtr(-b) + (1.0 - trust) * (ndtr(b) - ndtr(a)) + sd * (pdf[0] - pdf[1])
        return 1.0 - trust


class Walks(NamedTuple):
    """All walks to the goal."""

    score: np.ndarray  # (walk,)
    risk: np.ndarray  # (resource, walk)


class TooManyError(Exception):
    """More walks than can be written out."""


def steady(world):
    """Trust of the team if all bounds were alike, (move, cell)."""
    gain = np.linalg.inv(np.eye(len(world.x0)) - world.B0)
    return world.trust(np.einsum("st,tmc->smc", gain, world.u))


def to_goal(into, goal):
    """Fewest bounds from each cell to the goal by moves (move, cell); 10^6 without a way."""
    far = np.full(into.shape[1] + 1, 10**6)
    far[goal] = 0
    for _ in range(into.shape[1]):
        far[:-1] = np.minimum(far[:-1], 1 + far[into].min(0))
    return far


def every_walk(world, most):
    """Scores and risks of all admissible walks; TooManyError if they are more than `most`."""
    far, additive = to_goal(world.into, world.goal), world.objective != "bottleneck"
    settled = steady(world) if world.objective == "stationary" else None
    cell, came = np.array([world.start]), np.array([NONE])
    x, risk = world.x0[:, None], np.zeros((len(world.limits), 1))
    cost, toll = np.full(1, 0.0 if additive else -np.inf), np.zeros(1)
    seen, scores, risks, total = np.left_shift(1, cell), [], [], 0
    for k in range(1, world.longest + 1):
        m, walk = np.nonzero(world.into[:, cell] >= 0)
        other = world.into[m, cell[walk]]
        fits = far[other] <= world.longest - k
        if not world.u_turns:
            fits &= (came[walk] == NONE) | (m != 7 - came[walk])
        if world.simple:
            fits &= (seen[walk] >> other & 1) == 0
        m, walk, other = m[fits], walk[fits], other[fits]
        total += len(m)
        if total > most:
            raise TooManyError
        x = world.B0 @ x[:, walk] + world.u[:, m, other]
        t = world.trust(x)
        if settled is not None:
            t = settled[m, other]
        if world.objective == "terminal":
            cost = -t
        elif world.objective == "mean":
            cost = cost[walk] - t
        else:
            now = world.loss(t)
            cost = cost[walk] + now if additive else np.maximum(cost[walk], now)
        toll = toll[walk] + world.tolls[m, other]
        risk = risk[:, walk] + world.risk[:, m, other]
        seen, cell, came = seen[walk] | np.left_shift(1, other), other, m
        there = cell == world.goal
        scale = k if world.objective == "mean" else 1
        scores.append(-cost[there] / scale - toll[there])
        risks.append(risk[:, there])
        on = ~there
        cell, came, x, risk = cell[on], came[on], x[:, on], risk[:, on]
        cost, toll, seen = cost[on], toll[on], seen[on]
    return Walks(np.concatenate(scores), np.concatenate(risks, axis=1))


def along(world, path):
    """Score and risks of one path, and whether it is admissible."""
    settled = steady(world) if world.objective == "stationary" else None
    x, risk, costs, toll, came = world.x0, np.zeros(len(world.limits)), [], 0.0, NONE
    admissible = path[0] == world.start and path[-1] == world.goal
    admissible &= world.goal not in path[:-1] and len(path) - 1 <= world.longest
    admissible &= not world.simple or len(set(path)) == len(path)
    for a, c in pairwise(path):
        entering = np.flatnonzero(world.into[:, a] == c)
        if not len(entering) or (not world.u_turns and came != NONE and entering[0] == 7 - came):
            return -np.inf, risk, False
        came = entering[0]
        x = world.B0 @ x + world.u[:, came, c]
        t = world.trust(x) if settled is None else settled[came, c]
        costs.append(-t if world.objective in ("terminal", "mean") else world.loss(t))
        risk, toll = risk + world.risk[:, came, c], toll + world.tolls[came, c]
    cost = {"terminal": costs[-1], "mean": np.mean(costs), "bottleneck": max(costs)}
    return -cost.get(world.objective, sum(costs)) - toll, risk, admissible


def best_of(walks, world):
    """Least risk of a walk, and best score less the cost of failures within the limits.

    Where no walk keeps them, within the least risk. NaN if rounding decides which do.
    """
    sums, limits = walks.risk, world.limits[:, None]
    if not len(limits):
        return 0.0, walks.score.max()
    least, values = sums[0].min(), walks.score - world.failure(sums)
    near = np.isfinite(limits) & (np.abs(sums - limits) < 1e-9 * np.maximum(1.0, limits))
    kept = (sums <= limits).sum(0) >= world.needed
    if not kept.any():
        above = (sums[0] - least) / max(1.0, least)
        near, kept = near | ((above > 1e-13) & (above < 1e-9)), above <= 1e-13
    return least, np.nan if near.any() else values[kept].max()


def is_dense(world):
    """Whether `dense_table` takes a problem: its cost is a sum over bounds."""
    return world.objective == "stationary" or is_linear(world) or not world.B0.any()


def is_linear(world):
    """Whether the score is linear in all drifts."""
    linear = world.objective in ("terminal", "mean", "lost_contact")
    return linear and world.family == "gaussian" and not (world.least and len(world.x0) > 1)


def dense_weights(world):
    """Weights w_j (bounds left, state) of u, and constants (bounds); None without memory."""
    if not is_linear(world):
        return None
    n = world.longest + 1
    w = np.empty((n, len(world.x0)))
    w[0] = 1.0 / len(world.x0)
    for j in range(1, n):
        w[j] = w[j - 1] @ world.B0
    constant = w @ world.x0
    if world.objective in ("mean", "lost_contact"):
        constant[0] = 0.0
        constant, w = constant.cumsum(), w.cumsum(0)
    return w, constant - (np.arange(n) if world.objective == "lost_contact" else 0.0)


def bound_costs(world, weights, left):
    """Costs of bounds (move, cell) after which so many bounds are left."""
    if weights is not None:
        return -np.einsum("s,smc->mc", weights[0][left], world.u) + world.tolls
    trust = steady(world) if world.objective == "stationary" else world.trust(world.u)
    if world.objective == "terminal":
        return (-trust if left == 0 else 0.0 * trust) + world.tolls
    cost = -trust if world.objective == "mean" else world.loss(trust)
    return cost + world.tolls


def dense_table(world):
    """Least risk of a walk and best score less the cost of failures, as `best_of`."""
    n_cells, weights = world.into.shape[1], dense_weights(world)
    units = np.zeros(world.u.shape[1:], int)
    if world.unit:
        units = np.rint(world.risk[0] / world.unit).astype(int)
    n_risks = 1 + _most_units(world, units)
    spent, cells = np.arange(n_risks), np.arange(n_cells)
    C = np.full((9, n_cells + 1, n_risks + 1), np.inf)  # the last cell and risk: none
    C[:, world.goal, 0] = -np.inf if world.objective == "bottleneck" else 0.0
    failures = world.failure_cost * np.expm1(-world.unit * spent)
    by_risk = np.full(n_risks, -np.inf)
    for k in range(1, world.longest + 1):
        on = _one_more(world, C, bound_costs(world, weights, k - 1), units, spent)
        C = np.full_like(C, np.inf)
        C[:, cells, :n_risks] = on.min(0)
        for came in range(0 if world.u_turns else 8):
            C[came, cells, :n_risks] = np.delete(on, 7 - came, axis=0).min(0)
        final = C[NONE, world.start, :n_risks]
        constant = 0.0 if weights is None else weights[1][k]
        score = (constant - final) / (k if world.objective == "mean" else 1) + failures
        by_risk = np.maximum(by_risk, np.where(final < np.inf, score, -np.inf))
    reached = by_risk > -np.inf
    safest = spent[reached][0] * world.unit if reached.any() else np.inf
    within = spent * world.unit <= world.limits[0] if len(world.limits) else reached
    return safest, by_risk[within].max(initial=-np.inf)


def _one_more(world, C, cost, units, spent):
    """Costs to go by the next move, (move, cell, risk), one bound further from the goal."""
    join = np.maximum if world.objective == "bottleneck" else np.add
    on = np.full((8, world.into.shape[1], len(spent)), np.inf)
    for m, other in enumerate(world.into):
        rest = spent[None] - units[m, other][:, None]
        ahead = C[m][other[:, None], np.where(rest >= 0, rest, len(spent))]
        there = (ahead < np.inf) & (other >= 0)[:, None]
        on[m][there] = join(ahead, cost[m, other][:, None])[there]
    on[:, world.goal] = np.inf  # the goal ends a walk
    return on


def _most_units(world, units):
    """Largest sum of risks that matters: within the limit, or of any walk."""
    if not world.unit:
        return 0
    most = int(units.max()) * world.longest
    if np.isfinite(world.limits[0]):
        most = min(most, max(int(world.limits[0] / world.unit), int(units.max()) * 30))
    return most
