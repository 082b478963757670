"""Shortest paths on grids with a cost per bound: the objective `stationary`, compiled.

Method: Dijkstra's algorithm with cyclic buckets (Dial 1969) of real width delta, in which a cell
may be scanned again: sequential delta-stepping (Meyer and Sanders 2003).

State: tentative distance of each cell and the move that gave it; bucket floor(distance / delta)
holds the cells to be scanned, as a doubly linked list. A cell whose distance falls while it waits
moves to an earlier bucket.

Invariant: buckets before the current one are empty, and their cells' distances are final. Costs are
positive, so scanning a cell of bucket k puts others into k or later, never more than the largest
cost ahead; buckets may hence be reused in a cycle that is longer than that.

Exact because a bucket is left only when empty: each distance below its upper end has then been
scanned at its final value. The order within a bucket is free, so no heap is needed, and cells of
similar cost stay near in memory. Where costs are so uneven that cells are scanned again and again,
Dijkstra's algorithm with a binary heap takes over.
"""

import heapq
from collections.abc import Callable

import numpy as np
from numba import njit

from trustbo.parallel import PART, over_rows

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
_MAX_BUCKETS = 1 << 16
_MAX_SCANS = 4  # of each cell, on average, before the heap takes over
_SETTLED = -2
_SOME = 23  # cells whose costs give the width of buckets
_CELLS = 1 << 16  # of several draws at once, to fit the cache


def best_stationary(
    steady_state: Callable[[slice], np.ndarray],
    n_draws: int,
    passable: np.ndarray,
    tolls: np.ndarray,
    steps: np.ndarray,
    start: int,
    goal: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the path of every draw with the least sum of softplus(-steady_state) over its bounds.

    `steady_state` maps a slice of the draws to the team's trust if all bounds were as each one,
    (draw, move, row, col), of one move where all into a cell are alike. A move of `steps` (move, 2)
    must enter a `passable` cell (row, col), and adds its toll, of `tolls` (move, cell), of one cell
    where all bounds by a move are alike. `start` and `goal` are flat indices.

    Returns costs (draw,), inf where there is no path; and paths, flat indices of cells, shape
    (draw, length), filled with -1.
    """
    rows, cols = passable.shape
    # A path may need all cells (a maze); many draws share a shorter table unless one of them does.
    capacity = rows * cols if n_draws == 1 else min(rows * cols, 4 * (rows + cols))
    totals, n_cells = np.empty(n_draws), np.zeros(n_draws, np.int64)
    paths = np.full((n_draws, capacity), -1, np.int32)

    step = max(1, _CELLS // (rows * cols))
    of_moves, of_cells = tolls[:, 0], None
    if tolls.shape[1] > 1:  # what depends on the cell too is a cost of the bound
        of_moves = np.zeros(len(steps))
        of_cells = np.pad(tolls.reshape(-1, rows, cols), ((0, 0), (1, 1), (1, 1)))
        of_cells = of_cells.reshape(len(steps), -1)

    def work(first: int, last: int) -> None:
        for begin in range(first, max(last, first + 1), step):
            part = slice(begin, min(begin + step, last))
            cost = _with_margin(steady_state(part), passable)
            if of_cells is not None:
                cost = cost + of_cells
            found = totals[part], n_cells[part], paths[part]
            _settle_draws(cost, of_moves, steps, cols, start, goal, *found)

    over_rows(work, n_draws) if n_draws > 1 else work(0, 1)
    longest = int(n_cells.max())
    if longest > capacity:
        paths = np.full((n_draws, longest), -1, np.int32)
        over_rows(work, n_draws)
    return totals, paths[:, :longest]


def _with_margin(trust: np.ndarray, passable: np.ndarray) -> np.ndarray:
    """softplus(-trust), inf into impassable cells and a margin around them; (draw, move, cell).

    The margin saves the test whether a move leaves the grid. Written out, since NumPy's
    `logaddexp` takes five times as long.
    """
    rows, cols = passable.shape
    cost = np.full((*trust.shape[:2], rows + 2, cols + 2), np.inf)
    inside = np.abs(trust)
    np.negative(inside, out=inside)
    np.exp(inside, out=inside)
    np.log1p(inside, out=inside)
    inside -= np.minimum(trust, 0.0)
    np.copyto(cost[..., 1:-1, 1:-1], inside, where=passable)
    return cost.reshape(*trust.shape[:2], (rows + 2) * (cols + 2))


@_compiled
def _settle_draws(costs, toll, steps, cols, start, goal, totals, n_cells, paths):
    """Find the cheapest path of every draw, its cost and its number of cells."""
    width = cols + 2
    offset = steps[:, 0] * width + steps[:, 1]
    a = (start // cols + 1) * width + start % cols + 1
    b = (goal // cols + 1) * width + goal % cols + 1
    n_drifts, n_all = costs.shape[1:]
    # Index of a bound's cost, less that of the cell entered.
    plane = np.arange(len(steps)) * (n_all if n_drifts > 1 else 0)
    distance, by = np.empty(n_all), np.empty(n_all, np.int8)
    previous, following = np.empty(n_all, np.int32), np.empty(n_all, np.int32)
    for d in range(len(costs)):
        cost, high = costs[d].ravel(), 0.0
        for c in cost:
            high = max(high, c) if c < np.inf else high
        largest = high + toll.max()
        # Wide enough that few are empty, narrow enough that few cells are scanned twice.
        delta = max(_usual(cost) + toll.min(), largest / (_MAX_BUCKETS - 3), 1e-300)
        if not _settle(
            cost,
            plane,
            toll,
            offset,
            a,
            b,
            delta,
            largest,
            distance,
            by,
            previous,
            following,
        ):
            _settle_by_heap(cost, plane, toll, offset, a, b, distance, by)
        totals[d] = distance[b]
        n_cells[d] = _trace(distance, by, offset, width, cols, a, b, paths[d])


@_part
def _usual(cost):
    """Median cost of evenly spaced cells; 0 if none of them can be entered."""
    some, n = np.empty(_SOME), 0
    for i in range(0, len(cost), len(cost) // _SOME + 1):
        if cost[i] < np.inf:  # sorted in place: np.median takes a second to compile
            j = n
            while j > 0 and some[j - 1] > cost[i]:
                some[j] = some[j - 1]
                j -= 1
            some[j] = cost[i]
            n += 1
    return 0.5 * (some[(n - 1) // 2] + some[n // 2]) if n > 0 else 0.0


@_part
def _settle(
    cost, plane, toll, offset, start, goal, delta, largest, distance, by, previous, following
):
    """Compute all distances up to that of the goal; False if it takes too many scans."""
    per_cost, n_buckets = 1.0 / delta, 4
    while n_buckets < largest * per_cost + 3.0:
        n_buckets *= 2  # a power of two, so that the remainder is a mask
    mask = n_buckets - 1
    heads, tails = np.full(n_buckets, -1, np.int32), np.full(n_buckets, -1, np.int32)
    distance[:] = np.inf
    distance[start], by[start] = 0.0, -1
    previous[start], following[start] = -1, -1
    heads[0], tails[0] = start, start
    waiting, scans, k = 1, _MAX_SCANS * len(distance), 0
    while waiting > 0:
        at = k & mask
        while heads[at] >= 0:
            c = heads[at]
            heads[at] = following[c]
            if following[c] >= 0:
                previous[following[c]] = -1
            previous[c] = _SETTLED
            waiting -= 1
            scans -= 1
            if scans < 0:
                return False
            so_far = distance[c]
            for m in range(len(offset)):
                other = c + offset[m]
                near = np.uint64(other)  # unsigned: no test for a negative index
                reach = so_far + cost[np.uint64(other + plane[m])] + toll[m]
                if not reach < distance[near]:
                    continue
                to = int(reach * per_cost) & mask
                if previous[near] != _SETTLED and distance[near] < np.inf:
                    old = int(distance[near] * per_cost) & mask
                    if old == to:
                        distance[near], by[near] = reach, m
                        continue
                    _remove(other, old, heads, tails, previous, following)
                    waiting -= 1
                distance[near], by[near] = reach, m
                # Appended: last in, first out would scan some cells for ever.
                if heads[to] < 0:
                    heads[to], previous[near] = other, -1
                else:
                    following[tails[to]], previous[near] = other, tails[to]
                following[near], tails[to] = -1, other
                waiting += 1
        k += 1
        if distance[goal] * per_cost < k:
            break
    return True


@_part
def _remove(c, bucket, heads, tails, previous, following):
    """Remove a cell from its bucket."""
    if previous[c] >= 0:
        following[previous[c]] = following[c]
    else:
        heads[bucket] = following[c]
    if following[c] >= 0:
        previous[following[c]] = previous[c]
    else:
        tails[bucket] = previous[c]


@_part
def _settle_by_heap(cost, plane, toll, offset, start, goal, distance, by):
    """Compute distances up to that of the goal with a binary heap."""
    distance[:] = np.inf
    distance[start] = 0.0
    queue = [(0.0, np.int64(start))]
    while queue:
        total, c = heapq.heappop(queue)
        if c == goal:
            return
        if total > distance[c]:
            continue
        for m in range(len(offset)):
            other = c + offset[m]
            reach = total + cost[other + plane[m]] + toll[m]
            if reach < distance[other]:
                distance[other], by[other] = reach, m
                heapq.heappush(queue, (reach, np.int64(other)))


@_part
def _trace(distance, by, offset, width, cols, start, goal, path):
    """Write down the path if it fits; return its number of cells, 0 without a path."""
    if not distance[goal] < np.inf:
        return 0
    n, c = 1, goal
    while c != start:
        c -= offset[by[c]]
        n += 1
    if n <= len(path):
        c = goal
        for k in range(n - 1, -1, -1):
            path[k] = (c // width - 1) * cols + c % width - 1
            if c != start:
                c -= offset[by[c]]
    return n
