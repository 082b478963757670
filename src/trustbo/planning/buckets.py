"""Shortest paths over grids whose cells cost something to enter, compiled.

Dijkstra's order does not have to be kept exactly (delta-stepping, Meyer and Sanders 2003): cells
wait in buckets of equal width by the cost of reaching them, and one whose cost falls while it waits
moves to an earlier bucket. Costs are final once their bucket is empty, so the result is exact;
there is no heap, and cells that are near in cost lie near in memory. Where costs are so uneven that
cells are looked at again and again, a binary heap takes over.
"""

import heapq
from collections.abc import Callable

import numpy as np
from numba import njit

from trustbo.terrain.parallel import over_rows

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_MOST_BUCKETS = 1 << 16
_MOST_LOOKS = 4  # at each cell, on average, before the heap takes over
_SETTLED = -2
_CELLS = 1 << 16  # of some draws at once: what the cache holds


def best_stationary(
    level: Callable[[slice], np.ndarray],
    n_draws: int,
    passable: np.ndarray,
    toll: np.ndarray,
    steps: np.ndarray,
    start: int,
    goal: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The path of every draw with the least sum of softplus(-level) over the cells it enters.

    Args:
        level: Of some draws, the team's trust if it stayed in each cell for ever, (draw, row, col).
        n_draws: How many there are in all.
        passable: Shape (row, col).
        toll: What each move costs besides, shape (move,).
        steps: Moves, shape (move, 2).
        start: Flat index of the first cell.
        goal: Of the last.

    Returns:
        Costs, shape (draw,); inf where there is no path; and paths, flat indices of cells, shape
        (draw, length), filled with -1.
    """
    rows, cols = passable.shape
    # One draw may need all cells (a maze); many share a shorter table unless one of them does.
    room = rows * cols if n_draws == 1 else min(rows * cols, 4 * (rows + cols))
    totals, n_cells = np.empty(n_draws), np.zeros(n_draws, np.int64)
    paths = np.full((n_draws, room), -1, np.int32)

    step = max(1, _CELLS // (rows * cols))

    def work(first: int, last: int) -> None:
        for begin in range(first, max(last, first + 1), step):
            part = slice(begin, min(begin + step, last))
            cost = _with_margin(level(part), passable)
            _settle_draws(
                cost, toll, steps, cols, start, goal, totals[part], n_cells[part], paths[part]
            )

    over_rows(work, n_draws) if n_draws > 1 else work(0, 1)
    longest = int(n_cells.max())
    if longest > room:
        paths = np.full((n_draws, longest), -1, np.int32)
        over_rows(work, n_draws)
    return totals, paths[:, :longest]


def _with_margin(level: np.ndarray, passable: np.ndarray) -> np.ndarray:
    """softplus(-level), inf where none can go and around the grid; shape (draw, cell).

    With that margin, no move has to ask whether it leaves the grid. Written out, since NumPy's
    `logaddexp` takes five times as long.
    """
    rows, cols = passable.shape
    cost = np.full((len(level), rows + 2, cols + 2), np.inf)
    inside = np.abs(level)
    np.negative(inside, out=inside)
    np.exp(inside, out=inside)
    np.log1p(inside, out=inside)
    inside -= np.minimum(level, 0.0)
    np.copyto(cost[:, 1:-1, 1:-1], inside, where=passable)
    return cost.reshape(len(level), (rows + 2) * (cols + 2))


@_compiled
def _settle_draws(costs, toll, steps, cols, start, goal, totals, n_cells, paths):
    """The cheapest path of every draw, its cost and how many cells it has."""
    width = cols + 2
    offset = steps[:, 0] * width + steps[:, 1]
    a = (start // cols + 1) * width + start % cols + 1
    b = (goal // cols + 1) * width + goal % cols + 1
    n_all = costs.shape[1]
    known, came = np.empty(n_all), np.empty(n_all, np.int8)
    before, behind = np.empty(n_all, np.int32), np.empty(n_all, np.int32)
    for d in range(len(costs)):
        cost, high = costs[d], 0.0
        for c in cost:
            high = max(high, c) if c < np.inf else high
        longest_move = high + toll.max()
        # Wide enough that few are empty, narrow enough that few cells are looked at twice.
        delta = max(_usual(cost) + toll.min(), longest_move / (_MOST_BUCKETS - 3), 1e-300)
        if not _settle(cost, toll, offset, a, b, delta, longest_move, known, came, before, behind):
            _settle_by_heap(cost, toll, offset, a, b, known, came)
        totals[d] = known[b]
        n_cells[d] = _trace(known, came, offset, width, cols, a, b, paths[d])


@_compiled
def _usual(cost):
    """The median of some cells' costs, spread evenly; 0 if none of them can be entered."""
    step = len(cost) // 23 + 1
    some = cost[::step]
    some = some[some < np.inf]
    return np.median(some) if len(some) > 0 else 0.0


@_compiled
def _settle(cost, toll, offset, start, goal, delta, longest_move, known, came, before, behind):
    """The cost of reaching each cell as dear as the goal; False if it takes too many looks."""
    per_cost, n_buckets = 1.0 / delta, 4
    while n_buckets < longest_move * per_cost + 3.0:
        n_buckets *= 2  # a power of two: the rest of a division is then a mask
    mask = n_buckets - 1
    heads, tails = np.full(n_buckets, -1, np.int32), np.full(n_buckets, -1, np.int32)
    known[:] = np.inf
    known[start], came[start] = 0.0, -1
    before[start], behind[start] = -1, -1
    heads[0], tails[0] = start, start
    waiting, looks, k = 1, _MOST_LOOKS * len(cost), 0
    while waiting > 0:
        at = k & mask
        while heads[at] >= 0:
            c = heads[at]
            heads[at] = behind[c]
            if behind[c] >= 0:
                before[behind[c]] = -1
            before[c] = _SETTLED
            waiting -= 1
            looks -= 1
            if looks < 0:
                return False
            so_far = known[c]
            for m in range(len(offset)):
                other = c + offset[m]
                near = np.uint64(other)  # an index that may be negative would have to be asked
                reach = so_far + cost[near] + toll[m]
                if not reach < known[near]:
                    continue
                to = int(reach * per_cost) & mask
                if before[near] != _SETTLED and known[near] < np.inf:
                    old = int(known[near] * per_cost) & mask
                    if old == to:
                        known[near], came[near] = reach, m
                        continue
                    _remove(other, old, heads, tails, before, behind)
                    waiting -= 1
                known[near], came[near] = reach, m
                # At the end of the queue: last in, first out would look at some cells for ever.
                if heads[to] < 0:
                    heads[to], before[near] = other, -1
                else:
                    behind[tails[to]], before[near] = other, tails[to]
                behind[near], tails[to] = -1, other
                waiting += 1
        k += 1
        if known[goal] * per_cost < k:
            break
    return True


@_compiled
def _remove(c, bucket, heads, tails, before, behind):
    if before[c] >= 0:
        behind[before[c]] = behind[c]
    else:
        heads[bucket] = behind[c]
    if behind[c] >= 0:
        before[behind[c]] = before[c]
    else:
        tails[bucket] = before[c]


@_compiled
def _settle_by_heap(cost, toll, offset, start, goal, known, came):
    known[:] = np.inf
    known[start] = 0.0
    queue = [(0.0, np.int64(start))]
    while queue:
        total, c = heapq.heappop(queue)
        if c == goal:
            return
        if total > known[c]:
            continue
        for m in range(len(offset)):
            other = c + offset[m]
            reach = total + cost[other] + toll[m]
            if reach < known[other]:
                known[other], came[other] = reach, m
                heapq.heappush(queue, (reach, np.int64(other)))


@_compiled
def _trace(known, came, offset, width, cols, start, goal, path):
    """Write the path down if there is room; its number of cells, 0 where there is none."""
    if not known[goal] < np.inf:
        return 0
    n, c = 1, goal
    while c != start:
        c -= offset[came[c]]
        n += 1
    if n <= len(path):
        c = goal
        for k in range(n - 1, -1, -1):
            path[k] = (c // width - 1) * cols + c % width - 1
            if c != start:
                c -= offset[came[c]]
    return n
