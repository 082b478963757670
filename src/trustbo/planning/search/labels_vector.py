"""Label setting with dominance and a heuristic: objectives that depend on the whole history.

Method: best-first label setting for multi-criteria shortest paths, in the order of an A* estimate
(Martins 1984; Mandow and Perez de la Cruz 2010, NAMOA*).

State of a label: cell, number of bounds, expected trust x of all states, cost so far, parent; the
last move where U-turns are forbidden.

Cost, to be minimised: the sum of losses of trust and tolls, or the largest loss, see `losses`; for
`terminal`, whose loss is `NONE`, the last -trust and tolls. Those of `NONE` and `LINEAR` are over
paths of exactly `max_bounds` bounds. None rises if trust rises.

Invariant: a label leaves the queue in the order of a lower limit on the cost of its completions
(`Heuristic`). It is expanded unless an expanded label of the same cell dominates it (see
`dominance`): fewer or as many bounds, no higher cost, and at least as much trust at every bound
still to come, through any cells, and no more of any risk. Every completion of the dominated
label is then a completion of the other, at no higher cost, so the first label that leaves the queue
at the goal is optimal.

With a tolerance, labels are dropped too that another dominates up to that amount (Warburton 1987).
The least estimate among those dropped is kept: no path costs less than the smaller of it and the
cost found, so the result is exact whenever these agree.
"""

import heapq
import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.errors import TrustboError
from trustbo.parallel import PART, over_rows, plain
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.search.dominance import Heuristic, build_heuristic, dominance_tests
from trustbo.planning.search.graph import Best, Resources
from trustbo.planning.search.losses import LEAST, NONE, TINY_SD, joined, loss_for, loss_of
from trustbo.planning.search.room import with_room
from trustbo.planning.tolls import tolls_of

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
_TOLERANCES = (0.0, 1e-3, 1e-2, 3e-2, 0.1)
MAX_LABELS = 300_000
"""Limit on the labels of a search."""


class LabelSearch(NamedTuple):
    """Data of one search, for one draw."""

    loss: int  # of `losses`
    transition: np.ndarray  # (state, state)
    drift: np.ndarray  # (state, move, cell); one move where all into a cell are alike
    start_state: np.ndarray  # (state,)
    views: np.ndarray  # (view, state)
    tests: np.ndarray  # (test, state)
    heuristic: Heuristic
    neighbours: np.ndarray  # (cell, move), -1 where none
    tolls: np.ndarray  # (move, cell), or (move, 1)
    to_goal: np.ndarray  # (cell,), -1 where there is no way
    start: int
    goal: int
    max_bounds: int  # for NONE and LINEAR, the exact number
    u_turns: bool
    noise_sd: float  # of a rate
    risk: Resources  # with the safest sums from each cell, (cell, resource)


def best_paths(
    admissible: AdmissiblePaths, dynamics: Dynamics, objective: Objective, resources: Resources
) -> Best:
    """Find the best path of every draw; no cells where none is feasible.

    The safest sums of `resources` are those from each cell to the goal, (cell, resource).
    TrustboError: more labels than the limit, even with the largest tolerance.
    """
    n_draws = len(dynamics.start)
    found: list[_OfDraw] = [_OfDraw(np.empty(0), np.inf, np.inf)] * n_draws

    def work(first: int, last: int) -> None:
        for d in range(first, last):
            found[d] = _best_of_draw(admissible, dynamics.take(d), objective, resources)

    work(0, n_draws) if n_draws == 1 else over_rows(work, n_draws)
    paths = np.full((n_draws, max(1, *(len(best.path) for best in found))), -1, np.int64)
    for row, best in zip(paths, found, strict=True):
        row[: len(best.path)] = best.path
    cost, lower = np.array([(best.cost, best.lower) for best in found]).T
    return Best(paths, cost, lower)


class _OfDraw(NamedTuple):
    """Best path of one draw, no cells without one; its cost and a lower limit on all costs."""

    path: np.ndarray
    cost: float
    lower: float


def _best_of_draw(
    admissible: AdmissiblePaths, dynamics: Dynamics, objective: Objective, resources: Resources
) -> _OfDraw:
    lengths = [admissible.longest]
    if not objective.has_labels:  # costs fall along a path, so that lengths are searched apart
        lengths = list(range(admissible.shortest, admissible.longest + 1))
    best = _OfDraw(np.empty(0, np.int64), np.inf, np.inf)
    for n_bounds in lengths:
        scale = n_bounds if objective.name == "mean" else 1
        path, cost, lower = _within_limit(
            _problem(admissible, dynamics, objective, n_bounds, scale, resources)
        )
        # Linear rates lose 1 - trust in each bound.
        lost = n_bounds if objective.name == "lost_contact" and not objective.has_labels else 0
        cost, lower = cost / scale + lost, lower / scale + lost
        if len(path) == 0 or cost >= best.cost:
            path, cost = best.path, best.cost
        best = _OfDraw(path, cost, min(lower, best.lower))
    return best


def _problem(
    admissible: AdmissiblePaths,
    dynamics: Dynamics,
    objective: Objective,
    n_bounds: int,
    scale: int,
    resources: Resources,
) -> LabelSearch:
    goal = admissible.flat(admissible.goal)
    at_goal = objective.name == "terminal"
    return LabelSearch(
        loss_for(objective),
        plain(dynamics.transition),
        plain(dynamics.drift.reshape(*dynamics.drift.shape[:2], -1)),
        plain(dynamics.start),
        dynamics.views,
        dominance_tests(dynamics, n_bounds),
        build_heuristic(dynamics, n_bounds, admissible.neighbours, goal, at_goal=at_goal),
        admissible.neighbours,
        scale * tolls_of(admissible, objective),
        admissible.bounds_to_goal.ravel(),
        admissible.flat(admissible.start),
        goal,
        n_bounds,
        admissible.u_turns,
        max(float(dynamics.noise_sd), TINY_SD),
        resources,
    )


def _within_limit(problem: LabelSearch) -> _OfDraw:
    """Search exactly, or with the least tolerance that stays within the limit on labels."""
    if not len(problem.heuristic.powers) and problem.loss >= NONE:
        raise TrustboError(
            f"a team's least trust over {problem.max_bounds} bounds on {len(problem.to_goal)} "
            "cells is too much for sums over paths; use larger cells, or team='mean'."
        )
    for tolerance in _TOLERANCES:
        path, cost, lower, complete = _search(problem, tolerance, MAX_LABELS)
        if complete:
            return _OfDraw(path, cost, lower)
    raise TrustboError(
        f"more than {MAX_LABELS} partial paths are worth keeping; lower max_bounds = "
        f"{problem.max_bounds}, use larger cells, or team='mean'."
    )


@_compiled
def _search(problem, tolerance, max_labels):
    """Find the path of least cost, a lower limit on all costs, and whether labels sufficed.

    A dropped label may be better by `tolerance` than the label that replaces it; 0 is exact.
    """
    loss, most, goal = problem.loss, problem.max_bounds, problem.goal
    neighbours, to_goal, u_turns = problem.neighbours, problem.to_goal, problem.u_turns
    (n_cells, n_moves), drift, tolls = neighbours.shape, problem.drift, problem.tolls
    fixed, n_before = loss >= NONE, 1 if u_turns else n_moves + 1
    heads = np.full(n_cells * n_before * (most + 1 if fixed else 1), -1, np.int64)
    size = min(max_labels, 1024)
    # Of a label: cell, bounds, parent, move, next.
    labels, cost = np.empty((size, 5), np.int64), np.empty((size, 1))
    n_tests, n_risks = len(problem.tests), len(problem.risk.limits)
    # Tests of trust, then minus the sums of risks.
    tested, state = np.zeros((size, n_tests + n_risks)), np.empty((size, len(problem.start_state)))
    _fill(labels[0], problem.start, 0, -1, -1)
    cost[0, 0] = -np.inf if loss == LEAST else 0.0
    _copy(problem.start_state, state[0])
    n, least_dropped = 1, np.inf
    queue = [(-np.inf, np.int64(0))]
    while queue:
        estimate, label = heapq.heappop(queue)
        cell, n_bounds, _, by, _ = labels[label]
        if cell == goal:
            return _path_of(labels, label), estimate, min(estimate, least_dropped), True
        _copy(problem.tests @ state[label], tested[label])
        key = (n_bounds * n_cells * fixed + cell) * n_before + (0 if u_turns else by + 1)
        verdict = _dominance(label, heads[key], labels, cost, tested, tolerance)
        if verdict:
            least_dropped = min(least_dropped, estimate) if verdict == 2 else least_dropped
            continue
        labels[label, 4], heads[key] = heads[key], label
        for m in range(n_moves):
            other = neighbours[cell, m]
            if not _is_open(problem, m, by, n_bounds + 1, other):
                continue
            if n == len(cost):
                if n >= max_labels:
                    return np.empty(0, np.int64), np.inf, -np.inf, False
                labels, cost = with_room(labels, n + 1), with_room(cost, n + 1)
                state, tested = with_room(state, n + 1), with_room(tested, n + 1)
            if n_risks > 0 and not _spend(
                problem.risk, tested, n, label, m * n_cells + other, other
            ):
                continue
            x = problem.transition @ state[label] + drift[:, m * (drift.shape[1] > 1), other]
            total = _add_cost(
                loss, cost[label, 0], _least(problem.views @ x),
                tolls[m, other * (tolls.shape[1] > 1)], problem.noise_sd,
            )  # fmt: skip
            left = most - n_bounds - 1 if fixed else to_goal[other]
            reach = _estimate(loss, problem.heuristic, x, total, other, left, problem.noise_sd)
            if n_risks > 0:
                for k in range(len(problem.risk.failure_costs)):
                    least = problem.risk.safest[other, k] - tested[n, n_tests + k]
                    reach -= problem.risk.failure_costs[k] * math.expm1(-least)
            if reach < np.inf:
                _fill(labels[n], other, n_bounds + 1, label, m)
                cost[n, 0] = total
                _copy(x, state[n])
                heapq.heappush(queue, (reach, np.int64(n)))
                n += 1
    return np.empty(0, np.int64), np.inf, least_dropped, True


@_part
def _least(values):
    """Least of some numbers; `min` of an array takes half a second to compile."""
    least = values[0]
    for value in values:
        least = min(least, value)
    return least


@_part
def _copy(source, target):
    """Copy numbers; the assignment of slices takes two seconds to compile, for its messages."""
    for i in range(len(source)):
        target[i] = source[i]


@_part
def _fill(label, cell, n_bounds, parent, move):
    """Write down a label that no other follows yet."""
    label[0], label[1], label[2], label[3], label[4] = cell, n_bounds, parent, move, -1


@_part
def _is_open(problem, move, by, n_bounds, other):
    """Whether a move, after the move `by`, may enter a cell as bound number `n_bounds`."""
    if other < 0 or (
        not problem.u_turns and by >= 0 and move == problem.neighbours.shape[1] - 1 - by
    ):
        return False
    to_goal = problem.to_goal[other]
    if to_goal < 0 or n_bounds + to_goal > problem.max_bounds:
        return False
    at_end = (other == problem.goal) == (n_bounds == problem.max_bounds)
    return problem.loss < NONE or at_end


@_part
def _spend(risk, tested, label, parent, bound, cell):
    """Write down a label's risks after a bound; whether enough can stay within their limits."""
    n_risks, within = len(risk.limits), 0
    first = tested.shape[1] - n_risks
    for k in range(n_risks):
        spent = tested[parent, first + k] - risk.of_bounds[bound, k]
        tested[label, first + k] = spent
        within += risk.safest[cell, k] - spent <= risk.limits[k]
    return within >= risk.needed


@_part
def _add_cost(loss, cost, trust, toll, noise_sd):
    """Cost of a label after one more bound."""
    return joined(loss, cost + toll, loss_of(loss, trust, noise_sd))


@_part
def _estimate(loss, heuristic, x, cost, cell, left, noise_sd):
    """Lower limit on the cost of a label's completions."""
    if loss == NONE:
        return cost - _max_trust(heuristic, x, left, cell)
    if len(heuristic.powers) == 0:
        return cost
    for j in range(1, left + 1):
        trust = _max_trust(heuristic, x, j, cell)
        cost = _add_cost(loss, cost, trust, 0.0, noise_sd)
    return cost


@_part
def _max_trust(heuristic, x, j, cell):
    """Upper limit on the team's trust after j more bounds."""
    powers, gains = heuristic.powers, heuristic.gains
    least = np.inf
    for view in range(len(powers)):
        total = gains[view, j, cell]
        for s in range(len(x)):
            total += powers[view, j, s] * x[s]
        least = min(least, total)
    return least


@_part
def _dominance(label, other, labels, cost, tested, tolerance):
    """1 if an expanded label dominates, 2 if one does up to the tolerance, 0 if none does."""
    verdict = 0
    while other >= 0:
        if labels[other, 1] <= labels[label, 1] and cost[other, 0] <= cost[label, 0] + tolerance:
            shortfall = 0.0
            for k in range(tested.shape[1]):
                shortfall = max(shortfall, tested[label, k] - tested[other, k])
            if shortfall <= tolerance:
                if shortfall == 0.0 and cost[other, 0] <= cost[label, 0]:
                    return 1
                if tolerance > 0.0:
                    verdict = 2
        other = labels[other, 4]
    return verdict


@_part
def _path_of(labels, label):
    n = labels[label, 1] + 1
    path = np.empty(n, np.int64)
    for k in range(n - 1, -1, -1):
        path[k] = labels[label, 0]
        label = labels[label, 2]
    return path
