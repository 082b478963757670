"""Objectives of the whole history, compiled: labels in the order of what they can still become.

Best-first search over partial paths (labels), with the admissible estimate of `Outlook` and the
dominance of `tests`. With a tolerance, a label is dropped too if another is nearly as good in every
respect; what the best of those dropped could have become at most is the bound that comes with the
result, so it is exact whenever that bound is not better than the path that was found.
"""

import heapq
import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.planning.dominance import Outlook

_compiled = njit(cache=True, nogil=True, error_model="numpy")
SUCCESS, BOTTLENECK, TERMINAL, MEAN = range(4)
MODES = {"success": SUCCESS, "bottleneck": BOTTLENECK, "terminal": TERMINAL, "mean": MEAN}


class Problem(NamedTuple):
    """One search, for one draw."""

    mode: int
    transition: np.ndarray  # (state, state)
    drift: np.ndarray  # (state, cell)
    start_state: np.ndarray  # (state,)
    views: np.ndarray  # (view, state)
    tests: np.ndarray  # (test, state)
    outlook: Outlook
    neighbours: np.ndarray  # (cell, move), -1 where none
    toll: np.ndarray  # (move,)
    to_goal: np.ndarray  # (cell,), -1 where there is no way
    start: int
    goal: int
    most_bounds: int  # exactly so many for TERMINAL and MEAN
    u_turns: bool
    revisit: bool


class Found(NamedTuple):
    """The best label at the goal; `path` is None if there was no room, empty if there is none."""

    path: np.ndarray | None  # flat indices of cells
    cost: float
    bound: float
    """No path costs less than this."""


def search(problem: Problem, tolerance: float, room: int) -> Found:
    """The path of least cost.

    success: sum of softplus(-trust). bottleneck: largest -trust. terminal: the last -trust. mean:
    sum of -trust. Tolls are added to the last two.

    Args:
        problem: What is asked.
        tolerance: Labels that are at most so much better than another are dropped; 0 for exact.
        room: Give up after so many labels.
    """
    path, cost, bound, complete = _search(
        *problem[:6], *problem.outlook, *problem[7:], tolerance, room
    )
    return Found(path if complete else None, cost, bound)


@_compiled
def _search(
    mode, transition, drift, start_state, views, tests, powers, gains, neighbours, toll, to_goal,
    start, goal, most, u_turns, revisit, tolerance, room,
):  # fmt: skip
    n_cells, n_moves = neighbours.shape
    fixed = mode >= TERMINAL
    n_before = 1 if u_turns else n_moves + 1
    heads = np.full(n_cells * n_before * (most + 1 if fixed else 1), -1, np.int64)
    size = min(room, 1024)
    whole, cost = np.empty((size, 5), np.int64), np.empty(size)  # cell, bounds, parent, move, next
    state, mark = np.empty((size, len(start_state))), np.empty((size, len(tests)))
    seen = np.zeros((size, 1 if revisit else n_cells // 64 + 1), np.uint64)
    whole[0] = (start, 0, -1, -1, -1)
    cost[0], state[0] = -np.inf if mode == BOTTLENECK else 0.0, start_state
    n, least_dropped = 1, np.inf
    queue = [(-np.inf, np.int64(0))]
    while queue:
        estimate, label = heapq.heappop(queue)
        cell, n_bounds, _, by, _ = whole[label]
        if cell == goal:
            return _path_of(whole, label), estimate, min(estimate, least_dropped), True
        if not revisit:
            seen[label, cell // 64] |= np.uint64(1) << np.uint64(cell % 64)
        mark[label] = tests @ state[label]
        key = (cell * n_before + (0 if u_turns else by + 1)) + (
            n_bounds * n_cells * n_before if fixed else 0
        )
        verdict = _compare(label, heads[key], whole, cost, mark, seen, tolerance, revisit)
        if verdict == 2:
            least_dropped = min(least_dropped, estimate)
        if verdict:
            continue
        whole[label, 4], heads[key] = heads[key], label
        for m in range(n_moves):
            other = neighbours[cell, m]
            if other < 0 or (not u_turns and by >= 0 and m == n_moves - 1 - by):
                continue
            if to_goal[other] < 0 or n_bounds + 1 + to_goal[other] > most:
                continue
            if fixed and (other == goal) != (n_bounds + 1 == most):
                continue
            if not revisit and seen[label, other // 64] >> np.uint64(other % 64) & np.uint64(1):
                continue
            if n == len(cost):
                if n >= room:
                    return np.empty(0, np.int64), np.inf, -np.inf, False
                whole, cost = np.concatenate((whole, whole)), np.concatenate((cost, cost))
                state, mark = np.concatenate((state, state)), np.concatenate((mark, mark))
                seen = np.concatenate((seen, seen))
            x = transition @ state[label] + drift[:, other]
            paid = _pay(mode, cost[label], (views @ x).min(), toll[m])
            left = most - n_bounds - 1 if fixed else to_goal[other]
            reach = _estimate(mode, powers, gains, x, paid, other, left)
            if reach < np.inf:
                whole[n] = (other, n_bounds + 1, label, m, -1)
                cost[n], state[n], seen[n] = paid, x, seen[label]
                heapq.heappush(queue, (reach, np.int64(n)))
                n += 1
    return np.empty(0, np.int64), np.inf, least_dropped, True


@_compiled
def _pay(mode, cost, trust, toll):
    if mode == SUCCESS:
        return cost + _softplus(-trust)
    if mode == BOTTLENECK:
        return max(cost, -trust)
    return cost + toll - (trust if mode == MEAN else 0.0)


@_compiled
def _estimate(mode, powers, gains, x, cost, cell, left):
    """What a label can still become at best: never more than it will be."""
    if mode == TERMINAL:
        return cost - _most(powers, gains, x, left, cell)
    if len(powers) == 0:
        return cost
    for j in range(1, left + 1):
        trust = _most(powers, gains, x, j, cell)
        cost = _pay(mode, cost, trust, 0.0)
    return cost


@_compiled
def _most(powers, gains, x, j, cell):
    """The most the team's trust can be in j bounds."""
    least = np.inf
    for view in range(len(powers)):
        total = gains[view, j, cell]
        for s in range(len(x)):
            total += powers[view, j, s] * x[s]
        least = min(least, total)
    return least


@_compiled
def _compare(label, other, whole, cost, mark, seen, tolerance, revisit):
    """1 if another label is as good in every respect, 2 if nearly so, 0 if none is."""
    verdict = 0
    while other >= 0:
        if whole[other, 1] <= whole[label, 1] and cost[other] <= cost[label] + tolerance:
            shortfall = 0.0
            for k in range(mark.shape[1]):
                shortfall = max(shortfall, mark[label, k] - mark[other, k])
            if shortfall <= tolerance:
                same = shortfall == 0.0 and cost[other] <= cost[label]
                if same and not revisit:
                    for w in range(seen.shape[1]):
                        same = same and (seen[other, w] & ~seen[label, w]) == 0
                if same:
                    return 1
                if tolerance > 0.0:
                    verdict = 2
        other = whole[other, 4]
    return verdict


@_compiled
def _softplus(x):
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


@_compiled
def _path_of(whole, label):
    n = whole[label, 1] + 1
    path = np.empty(n, np.int64)
    for k in range(n - 1, -1, -1):
        path[k] = whole[label, 0]
        label = whole[label, 2]
    return path
