"""Best path within a limit on risk where costs are free of history: the objective `stationary`.

Method: label setting for the resource-constrained shortest path (Martins 1984), best first, with
the bound of `dual`.

State of a label: cell, cost so far, sums of risks, parent. Costs are positive and risks not
negative, so the best feasible walk is a simple path. Estimate of the cost of its completions: the
larger of cost + least cost to the goal, and of the same with a price on risk, less the price of
the limit.

Invariant: labels leave the queue in the order of their estimates; one is expanded unless an
expanded label of its cell costs no more and has no more of every risk that it can still keep within
its limit. Exact because the first label that leaves the queue at the goal then costs least.
"""

import heapq
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import PART
from trustbo.planning.search.dual import PRICES, Best, next_price
from trustbo.planning.search.room import with_room

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)


class Network(NamedTuple):
    """Cells and bounds between them, with their costs and risks."""

    neighbours: np.ndarray  # (cell, move), -1 where none
    start: int
    goal: int
    cost: np.ndarray  # (bound,), index move * cells + cell entered
    of_bounds: np.ndarray  # (bound, resource)
    priced: np.ndarray  # (bound,), a sum that no feasible path has above
    priced_limit: float
    limits: np.ndarray  # (resource,)
    needed: int
    safest: np.ndarray  # (cell, resource), least sums from a cell to the goal


@_compiled
def least_to_goal(neighbours: np.ndarray, of_bounds: np.ndarray, goal: int) -> np.ndarray:
    """Least sum of each column of (bound, column) from each cell to the goal, (cell, column).

    Sweeps in alternate directions until nothing changes (Bellman 1958).
    """
    n_cells, n_moves = neighbours.shape
    least = np.full((n_cells, of_bounds.shape[1]), np.inf)
    least[goal] = 0.0
    changed, backwards = True, False
    while changed:
        changed = False
        for i in range(n_cells):
            c = n_cells - 1 - i if backwards else i
            for m in range(n_moves):
                other = neighbours[c, m]
                if other < 0 or c == goal:
                    continue
                for k in range(of_bounds.shape[1]):
                    value = of_bounds[m * n_cells + other, k] + least[other, k]
                    if value < least[c, k]:
                        least[c, k], changed = value, True
        backwards = not backwards
    return least


@_compiled
def best_within(network: Network, max_labels: int) -> Best:
    """Find the feasible path of least cost."""
    known, cheap, priced, price, root = _dual(network)
    if root >= known.cost:
        return known
    return _search(network, cheap, priced, price, root, known, max_labels)


@_part
def _dual(network):
    """Maximise the Lagrangian bound over the price of risk, see `labels`.

    The best path known, least costs to go at price 0 and at the best price, this price, the bound.
    """
    known, price, limit = Best(np.empty(0, np.int64), np.inf, np.inf), 0.0, network.priced_limit
    cheap = _to_go(network, 0.0)
    priced, best_price, root = cheap, 0.0, cheap[network.start]
    within_cost, within_used, beyond_cost, beyond_used = np.inf, np.inf, -np.inf, np.inf
    for _ in range(PRICES):
        to_go = _to_go(network, price)
        if to_go[network.start] - price * limit > root:
            priced, best_price, root = to_go, price, to_go[network.start] - price * limit
        path, cost, used, feasible = _follow(network, to_go, price)
        if feasible and cost < known.cost:
            known = Best(path, cost, cost)
        again = (cost == within_cost and used == within_used) or (
            cost == beyond_cost and used == beyond_used and within_used < np.inf
        )
        if root >= known.cost or again or (feasible and price == 0.0):
            break
        if feasible:
            within_cost, within_used = cost, used
        else:
            beyond_cost, beyond_used = cost, used
        price = next_price(price, used - limit, within_cost, within_used, beyond_cost, beyond_used)
        if not price > 0.0:
            break
    return known, cheap, priced, best_price, root


@_part
def _to_go(network, price):
    """Least cost with a price on risk from each cell to the goal, (cell,)."""
    tolls = network.cost + price * network.priced
    return least_to_goal(network.neighbours, tolls.reshape(-1, 1), network.goal)[:, 0]


@_part
def _follow(network, to_go, price):
    """Follow the least costs to go: the path, its cost, priced risk, and if it is feasible."""
    n_cells, n_moves = network.neighbours.shape
    path, cell, n = np.empty(n_cells, np.int64), network.start, 1
    cost, used, total = 0.0, 0.0, np.zeros(len(network.limits))
    path[0] = cell
    while cell != network.goal and n < n_cells:
        least, chosen = np.inf, -1
        for m in range(n_moves):
            other = network.neighbours[cell, m]
            if other < 0:
                continue
            b = m * n_cells + other
            here = network.cost[b] + price * network.priced[b] + to_go[other]
            if here < least:
                least, chosen = here, m
        if chosen < 0:
            break
        cell = network.neighbours[cell, chosen]
        b = chosen * n_cells + cell
        cost, used = cost + network.cost[b], used + network.priced[b]
        for k in range(len(total)):
            total[k] += network.of_bounds[b, k]
        path[n] = cell
        n += 1
    feasible = cell == network.goal and (total <= network.limits).sum() >= network.needed
    return path[:n].copy(), cost, used, feasible


@_part
def _search(network, cheap, priced, price, root, known, max_labels):
    """Find the best path by labels, or return the best one known with the least estimate left."""
    link = np.empty((256, 3), np.int64)  # cell, parent, next of the cell
    state = np.zeros((256, 2))  # cost, priced risk
    risks = np.zeros((256, len(network.limits)))
    heads = np.full(len(network.neighbours), -1, np.int64)
    link[0, 0], link[0, 1], link[0, 2] = network.start, -1, -1
    n, queue = np.int64(1), [(root, np.int64(0))]  # no literal, for which callees are compiled
    while queue:
        estimate, label = heapq.heappop(queue)
        cell = link[label, 0]
        if estimate >= known.cost:
            return known
        if cell == network.goal:
            return Best(_path_of(link, label), state[label, 0], state[label, 0])
        if _is_dominated(network, link, state, risks, heads[cell], label):
            continue
        link[label, 2], heads[cell] = heads[cell], label
        most = n + network.neighbours.shape[1]
        if most > len(link):
            if n >= max_labels:
                return Best(known.path, known.cost, min(estimate, known.cost))
            link, state = with_room(link, most), with_room(state, most)
            risks = with_room(risks, most)
        for m in range(network.neighbours.shape[1]):
            reach = _extend(network, cheap, priced, price, link, state, risks, label, m, n)
            if reach < known.cost:
                heapq.heappush(queue, (reach, np.int64(n)))
                n += 1
    return Best(known.path, known.cost, known.cost)


@_part
def _extend(network, cheap, priced, price, link, state, risks, label, move, n):
    """Write down label n, one more bound; the estimate of its cost, inf if there is no path on."""
    other = network.neighbours[link[label, 0], move]
    if other < 0:
        return np.inf
    b, within = move * len(network.neighbours) + other, 0
    for k in range(len(network.limits)):
        risks[n, k] = risks[label, k] + network.of_bounds[b, k]
        within += risks[n, k] + network.safest[other, k] <= network.limits[k]
    if within < network.needed:
        return np.inf
    cost, used = state[label, 0] + network.cost[b], state[label, 1] + network.priced[b]
    link[n, 0], link[n, 1], link[n, 2] = other, label, -1
    state[n, 0], state[n, 1] = cost, used
    paid = price * (used - network.priced_limit)
    return max(cost + cheap[other], cost + paid + priced[other])


@_part
def _is_dominated(network, link, state, risks, other, label):
    """True if an expanded label of the cell costs no more and keeps every limit as well."""
    cell = link[label, 0]
    while other >= 0:
        if state[other, 0] <= state[label, 0]:
            covers = True
            for k in range(len(network.limits)):
                r = risks[label, k]
                if risks[other, k] > r and r + network.safest[cell, k] <= network.limits[k]:
                    covers = False
            if covers:
                return True
        other = link[other, 2]
    return False


@_part
def _path_of(link, label):
    n, at = 0, label
    while at >= 0:
        n, at = n + 1, link[at, 1]
    path = np.empty(n, np.int64)
    for k in range(n - 1, -1, -1):
        path[k] = link[label, 0]
        label = link[label, 1]
    return path
