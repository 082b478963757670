"""Lagrangian dual of paths within limits on resources, and good paths that it finds on the way.

Lower limits on the cost of a path's completions (Handler and Zang 1980; Beasley and Christofides
1989), each by one `pass_back` with prices added to the tolls:

(a) at price 0, with the failure cost of the safest completion;
(b) at the price lambda that maximises the dual function

        root(lambda) = min over paths [cost + lambda r + sum_m chord_m(r_m)] - lambda limit,

    as a feasible path has lambda (r - limit) <= 0.

| symbol | name | meaning |
|---|---|---|
| r, limit | `priced`, `priced_limit` | sum of one resource whose limit every feasible path keeps |
| lambda | `price` | price of r, >= 0 |
| r_m | `total[m]` | sum of stratum m, one of the first resources; it costs c_m (1 - exp(-r_m)) |
| c_m | `failure_costs` | cost of a failure times the share of the stratum |
| low_m, high_m | `low`, `high` | least r_m of any path, and most of any that can still be best |
| mu_m, base_m | `mu`, `base` | chord_m(r_m) = base_m + mu_m r_m <= its cost on [low_m, high_m] |
| sum_m base_m - lambda limit | `offset` | what (b) adds to the priced cost of a completion |
| root | `root` | lower limit on the cost of every feasible path |

Each price has a best path; the feasible one of least cost is known before any label is made.
Without resources, price 0 is the only one, and (a) and (b) are the same.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import LEAF, PART
from trustbo.planning.search.costs_to_go import (
    Ahead,
    ToGo,
    can_be_feasible,
    pass_back,
)
from trustbo.planning.search.graph import Costs, Graph, Resources, filled
from trustbo.planning.search.losses import LEAST, NONE, joined, loss_of

_part = njit(nogil=True, error_model="numpy", **PART)
_leaf = njit(nogil=True, error_model="numpy", **LEAF)  # see README
_inlined = njit(nogil=True, error_model="numpy", inline="always")  # see README
_PRICES = 12
"""Number of prices that are tried."""


class Found(NamedTuple):
    """Best path known, flat indices of cells; none where there are no cells, and its cost."""

    path: np.ndarray
    cost: float


class Dual(NamedTuple):
    """Lower limits on the costs of completions and of all paths, and the best path seen."""

    known: Found
    free: ToGo  # (a), price 0
    priced: ToGo  # (b), best price
    offset: float  # of (b)
    root: float


class _Tried(NamedTuple):
    """Path of some costs to go: its cost, priced sum, feasibility and sums of the strata."""

    cost: float
    used: float
    feasible: bool
    total: np.ndarray


@_part
def failure(cost: float, total: float) -> float:
    """Failure cost of a stratum whose risk sums to `total`."""
    return -cost * math.expm1(-total)


@_part
def _failure_of(failure_costs, total):
    """Failure cost of a path with these sums of the strata."""
    cost = 0.0
    for m in range(len(failure_costs)):
        cost += failure(failure_costs[m], total[m])
    return cost


@_inlined
def maximise_dual(
    graph: Graph, costs: Costs, resources: Resources, ahead: Ahead, below: float
) -> Dual:
    """Find the price of the best lower limit, and on the way paths that cost less than `below`."""
    failure_costs = resources.failure_costs
    n_strata = len(failure_costs)
    path = np.empty(_most_cells(graph), np.int64)
    known = Found(np.empty(0, np.int64), below)
    free = pass_back(graph, costs, ahead, costs.toll)
    least, _ = _root(graph, costs, free)
    low = _safest_of_all(graph, costs, resources)
    safe = _failure_of(failure_costs, low)
    dual = Dual(known, free, free, 0.0, least + safe)  # (a)
    if len(resources.limits) == 0:  # a good path of every length, as this price is the only one
        for length in range(len(graph.starts)):
            start = graph.starts[length]
            if start >= 0 and costs.start_cost[length] + free.best[start] < known.cost:
                known, _ = _try(graph, costs, resources, ahead, free, start, known, path)
        return Dual(known, free, free, 0.0, dual.root)
    if n_strata > 0:
        known = _follow_tangents(graph, costs, resources, ahead, known, low, path)
        dual = Dual(known, free, free, 0.0, dual.root)
    high, mu = resources.limits[:n_strata].copy(), filled(n_strata, 0.0)
    # Two rounds: the paths of the first lower `high`, so that the chords of the second are closer.
    for _ in range(2 if n_strata > 0 else 1):
        base = 0.0
        for m in range(n_strata):
            c, at_low = failure_costs[m], failure(failure_costs[m], low[m])
            if dual.known.cost < np.inf:
                # least + c (1 - exp(-r_m)) + least of other strata <= known cost, if better.
                share = (dual.known.cost - least - (safe - at_low)) / c
                if share < 1.0:
                    high[m] = min(high[m], -math.log1p(-max(share, 0.0)))
            mu[m] = 0.0
            if low[m] < high[m] < np.inf:
                mu[m] = c * (math.exp(-low[m]) - math.exp(-high[m])) / (high[m] - low[m])
            base += at_low - mu[m] * low[m]
        dual = _raise_price(graph, costs, resources, ahead, dual, mu, base, path)
        if dual.root >= dual.known.cost:
            break
    return dual


@_inlined
def _most_cells(graph):
    """Largest number of cells of a path that `_follow` may find."""
    return graph.rank[-1] + 1 if graph.layered else len(graph.rank)


@_inlined
def _safest_of_all(graph, costs, resources):
    """Least sum of each stratum from the start."""
    low = filled(len(resources.failure_costs), np.inf)
    for length in range(len(graph.starts)):
        node = graph.starts[length]
        if node >= 0 and costs.start_cost[length] < np.inf:
            for m in range(len(low)):
                low[m] = min(low[m], resources.safest[node, m])
    return low


@_inlined
def _follow_tangents(graph, costs, resources, ahead, known, low, path):
    """Improve the best path known where each stratum is priced at the failure cost's slope.

    The tangent of the concave cost at the last path's sums, c_m exp(-r_m), makes it linear; its
    best path has other sums, and so on until they stay: no path then is worse than the last.
    """
    failure_costs = resources.failure_costs
    tangent = np.empty(len(low))
    for m in range(len(low)):
        tangent[m] = failure_costs[m] * math.exp(-low[m])
    for _ in range(_PRICES):
        to_go = pass_back(graph, costs, ahead, _tolls(graph, costs, resources, 0.0, tangent))
        _, start = _root(graph, costs, to_go)
        known, tried = _try(graph, costs, resources, ahead, to_go, start, known, path)
        settled = True
        for m in range(len(low)):
            following = failure_costs[m] * math.exp(-tried.total[m])
            settled = settled and abs(following - tangent[m]) <= 1e-9 * failure_costs[m]
            tangent[m] = following
        if settled:
            break
    return known


@_inlined
def _raise_price(graph, costs, resources, ahead, dual, mu, base, path):
    """Maximise the dual function over lambda for one chord; see its paths.

    It is concave and made of lines, one for each path: cost + sum_m mu_m r_m + lambda (r - limit).
    The next price is where the lines of the last paths within and beyond the limit meet, or a
    higher one while there is none within. The maximum is reached when a path comes again.
    """
    known, free, priced, offset, root = dual
    limit, price = resources.priced_limit, 0.0
    within = beyond = np.inf  # cost + sum_m mu_m r_m of the last paths
    within_used, beyond_used = np.inf, np.inf
    for _ in range(_PRICES if limit < np.inf else 1):
        to_go = free
        if price > 0.0 or len(mu) > 0:
            to_go = pass_back(graph, costs, ahead, _tolls(graph, costs, resources, price, mu))
        least, start = _root(graph, costs, to_go)
        # root(lambda): of the least line of all paths, at this price; any price is a lower limit.
        added = base - price * limit if price > 0.0 else base
        if least + added > root:
            priced, offset, root = to_go, added, least + added
        known, tried = _try(graph, costs, resources, ahead, to_go, start, known, path)
        if root >= known.cost or (tried.feasible and price == 0.0):
            break
        # The path is a line in lambda with slope r - limit: it falls where r is within the limit,
        # rises beyond. The next price is where the last of both meet.
        line = tried.cost
        for m in range(len(mu)):
            line += mu[m] * tried.total[m]
        if tried.used <= limit and (len(resources.limits) == 1 or tried.feasible):
            if line == within and tried.used == within_used:
                break
            within, within_used = line, tried.used
        else:
            if line == beyond and tried.used == beyond_used and within_used < np.inf:
                break
            beyond, beyond_used = line, tried.used
        price = _next_price(price, tried.used - limit, within, within_used, beyond, beyond_used)
        if not price > 0.0:
            break
    return Dual(known, free, priced, offset, root)


@_inlined
def _next_price(price, excess, within, within_used, beyond, beyond_used):
    """Price at which the last paths within and beyond the limit cost the same.

    Higher than `price` where there is no path within; `excess` is the use beyond the limit.
    """
    if within_used < beyond_used < np.inf:
        return (within - beyond) / (beyond_used - within_used)
    if price > 0.0:
        return 4.0 * price
    return 1.0 / max(excess, 1e-3) if excess < np.inf else 1.0


@_part
def _tolls(graph, costs, resources, price, mu):
    """Tolls of edges with prices on the priced resource and on the strata."""
    tolls = np.empty(len(costs.toll))
    for e in range(len(tolls)):
        b = graph.bound[e]
        paid = price * resources.priced[b]
        for m in range(len(mu)):
            paid += mu[m] * resources.of_bounds[b, m]
        tolls[e] = costs.toll[e] + paid
    return tolls


@_part
def _root(graph, costs, to_go):
    """Least cost to go from the start, and the start node that has it."""
    least, chosen = np.inf, -1
    for length in range(len(graph.starts)):
        node = graph.starts[length]
        if node >= 0 and costs.start_cost[length] + to_go.best[node] < least:
            least, chosen = costs.start_cost[length] + to_go.best[node], node
    return least, chosen


@_part
def _try(graph, costs, resources, ahead, to_go, start, known, path):
    """Follow some costs to go from a start node: the best path known, and this one's numbers."""
    first_cost = 0.0
    for length in range(len(graph.starts)):
        if graph.starts[length] == start:
            first_cost = costs.start_cost[length]
    total = filled(len(resources.limits), 0.0)
    cost, used, n = _follow(
        graph, costs, resources, ahead, to_go, start, first_cost, known.cost, total, path
    )
    if n == 0:
        return known, _Tried(np.inf, np.inf, False, filled(len(total), np.inf))
    feasible = can_be_feasible(resources, total, 0)  # node 0 is the goal
    whole = cost + _failure_of(resources.failure_costs, total)
    if feasible and whole < known.cost:
        copied = np.empty(n, np.int64)
        for k in range(n):
            copied[k] = path[k]
        known = Found(copied, whole)
    return known, _Tried(cost, used, feasible, total)


@_leaf
def _follow(graph, costs, resources, ahead, to_go, node, cost, below, total, path):
    """Follow the best edges to go; write the path and its sums, return its cost, use and cells.

    No cells where the last move leaves no edge, nor without resources beyond the cost `below`.
    """
    loss, x, came, n, used = costs.loss, costs.x0, -1, 1, 0.0
    first, head, move, cell, bound = graph.first, graph.head, graph.move, graph.cell, graph.bound
    drift = costs.drift
    toll, best, second, by = to_go
    hi, own, fall, slope, of_edge = ahead
    sd, beta0, by_bound = costs.noise_sd, costs.beta0, costs.by_bound
    u_turns, last = graph.u_turns, graph.n_moves - 1
    by_edge = len(of_edge) > 0  # else the line below the loss does, in a tenth of the time
    if loss == LEAST:
        cost = -np.inf
    path[0] = cell[node]
    while node > 0 and n < len(path):
        least, chosen, reached = np.inf, -1, 0.0
        for e in range(first[node], first[node + 1]):
            h, m = head[e], move[e]
            if not u_turns and came >= 0 and m == last - came:
                continue
            here, x_e = best[h] if u_turns or by[h] != last - m else second[h], x
            if loss != NONE:
                x_e = beta0 * x + (drift[bound[e]] if by_bound else drift[cell[h]])
                lack = hi[h] - x_e
                enters = loss_of(loss, x_e, sd) if by_edge else own[h] + fall[h] * lack
                here = joined(loss, enters, here + slope[h] * lack)
            here = toll[e] + (max(cost, here) if loss == LEAST else here)
            if here < least:
                least, chosen, reached = here, e, x_e
        if chosen < 0:
            return np.inf, np.inf, 0
        x, came, node = reached, move[chosen], head[chosen]
        cost = joined(loss, cost, loss_of(loss, x, sd)) + costs.toll[chosen]
        if len(total) == 0 and cost >= below:
            return np.inf, np.inf, 0
        b = bound[chosen]
        for k in range(len(total)):
            total[k] += resources.of_bounds[b, k]
        if len(total) > 0:
            used += resources.priced[b]
        path[n] = cell[node]
        n += 1
    return cost, used, n if node == 0 else 0
