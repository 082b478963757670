"""Label search on the unrolled graph, for paths whose cost depends on history or risk.

Method: labels with dominance for the resource-constrained shortest path (Martins 1984; Irnich and
Desaulniers 2005). A label at a state has the cost so far, the sums r_m of risks -log(1 - p), and
the trust of each distinct robot (none where the cost is a weighted sum). An edge has a cost and,
where trust matters, a loss that decreases with trust. The cost of a path also includes sum_m F_m (1
- exp(-r_m)), and its last sum must not exceed a limit.

A label is dropped if another label of its state costs no more, has no larger sums and no less trust
of any robot. B0 >= 0 preserves the order of trust, so every completion of the former is at least as
good for the latter. Where a path may not turn back, the other must have come from the same cell, or
there must be two that came from different cells. A label is also dropped if it cannot beat the best
path known: the remaining cost is bounded by a sum over edges, with the largest possible trust and
with F_m (1 - exp(-r_m)) replaced by its chord over the sums that can still be optimal. The limit is
relaxed with a Lagrange multiplier, found by bisection (Handler and Zang 1980).

The search is exact: the remaining labels include the best path unless it is already known.
"""

import math
from typing import NamedTuple

import numpy as np

from trustbo.parallel import over_rows
from trustbo.planning.sums import costs_of_sums
from trustbo.planning.unrolled import Unrolled, edges_from, fill_to_go, kernel, new_to_go

MAX_LABELS = 300_000
"""Maximum number of labels; a search then returns the best path found and a lower limit."""
LOGISTIC, CLIPPED = range(2)
"""Losses of a bound: 1 - sigma(trust), or 1 - E[y] with normal y clipped to [0, 1]."""
LOSSES = {"logistic": LOGISTIC, "clipped": CLIPPED}
"""Loss by `Family.expected_rate`."""
TINY_SD = 1e-9
"""Least sd of a rate, instead of 0."""


class Costs(NamedTuple):
    """Costs of paths under one draw.

    Fields: loss, one of `LOSSES`; drift (robot, bound) and its weight in the value (left, robot);
    start, cost by the number of bounds (left,); transition (robot, robot) and x0 (robot,) of trust,
    without robots where no loss depends on it; sd of a rate; toll (bound,); risk (bound, sum);
    failure, the cost F_m of each sum (sum,); and the limit of the last sum.
    """

    loss: int
    drift: np.ndarray
    weight: np.ndarray
    start: np.ndarray
    transition: np.ndarray
    x0: np.ndarray
    sd: float | np.ndarray
    toll: np.ndarray
    risk: np.ndarray
    failure: np.ndarray
    limit: float


def best_labels(
    graph: Unrolled, costs: Costs, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the path of least cost under every draw.

    Args:
        graph: Unrolled graph.
        costs: Costs with a leading axis (draw,) of drift, weight, start, transition, x0 and sd.
        scale: Divisor of a path's cost by its number of bounds, (length,).

    Returns:
        Costs (draw,), inf where no path is within the limit; lower limits on the costs, equal where
        exact; and paths as flat cells, (draw, cell), filled with -1.
    """
    searches = [graph]
    divisor = scale[graph.left[graph.starts]]
    if not (divisor == divisor[0]).all():  # one search for each number of bounds
        searches = [graph._replace(starts=graph.starts[k : k + 1]) for k in range(len(divisor))]
    n, most = len(costs.drift), MAX_LABELS
    cost, lower = np.empty((2, len(searches), n))
    paths = np.full((len(searches), n, graph.longest + 1), -1, np.int32)
    for k, part in enumerate(searches):

        def work(begin: int, end: int, k: int = k, part: Unrolled = part) -> None:
            _best_labels(part, costs, most, cost[k], lower[k], paths[k], begin, end)

        over_rows(work, n) if n > 1 else work(0, n)
        cost[k], lower[k] = cost[k] / divisor[k], lower[k] / divisor[k]
    best = cost.argmin(0)
    return cost.min(0), lower.min(0), paths[best, np.arange(n)]


@kernel
def _best_labels(graph, costs, most, cost, lower, paths, begin, end):
    loss, drift, weight, start, transition, x0, sd, toll, risk, failure, limit = costs
    for d in range(begin, end):
        trust = transition[d], x0[d], sd[d]
        one = Costs(loss, drift[d], weight[d], start[d], *trust, toll, risk, failure, limit)
        cost[d], lower[d] = _best_path(graph, one, most, paths[d])


@kernel
def _lost(loss, x, sd):
    """Compute the expected contact lost in a bound that leaves trust x."""
    if loss == LOGISTIC:
        return 1.0 / (1.0 + math.exp(min(x, 700.0)))
    low, high, root = -x / sd, (1.0 - x) / sd, math.sqrt(0.5)
    below, above = 0.5 * math.erfc(-low * root), 0.5 * math.erfc(high * root)
    density = (math.exp(-0.5 * low * low) - math.exp(-0.5 * high * high)) / math.sqrt(2.0 * math.pi)
    return 1.0 - (x * (1.0 - below - above) + sd * density + above)


@kernel
def _lost_on(graph, costs, e, x, after):
    """Compute the contact lost on an edge entered with trust x; writes the trust after it."""
    mean, n = 0.0, len(costs.x0)
    if n == 0:
        return 0.0
    for i in range(n):
        after[i] = costs.drift[i, graph.bound[e]]
        for j in range(n):
            after[i] += costs.transition[i, j] * x[j]
        mean += after[i] / n
    return _lost(costs.loss, mean, costs.sd)


@kernel
def _least_costs(graph, costs, edge_cost):
    """Compute the cost of each edge at the largest trust with which it can be entered, (edge,)."""
    if len(costs.x0) == 0:
        return edge_cost
    cost = np.full(len(graph.head), np.inf)
    most, after = np.full((len(graph.cell), len(costs.x0)), -np.inf), np.empty(len(costs.x0))
    for s in graph.starts:
        most[s] = costs.x0
    for s in range(len(graph.cell) - 1, 0, -1):
        if most[s, 0] == -np.inf:  # only beyond the goal
            continue
        for e in range(graph.first[s], graph.first[s + 1]):
            cost[e] = edge_cost[e] + _lost_on(graph, costs, e, most[s], after)
            most[graph.head[e]] = np.maximum(most[graph.head[e]], after)
    return cost


@kernel
def _failing(failure, r):
    """Compute the cost of failing with sums r (sum,)."""
    total = 0.0
    for m in range(len(r)):
        total -= failure[m] * math.expm1(-r[m])
    return total


class Known(NamedTuple):
    """Best path known and its cost, and the path tried last.

    Fields: cost (1,); edges of the path (bound,), -1 beyond its end; those of the path tried
    (bound,), and its sums (sum,).
    """

    cost: np.ndarray
    edges: np.ndarray
    trial: np.ndarray
    sums: np.ndarray


@kernel
def _try_paths(graph, costs, edge_cost, to_go, known):
    """Try the cheapest path by `to_go` from each start; returns the least cost to go.

    Keeps the best path within the limit, and the sums of the cheapest path.
    """
    least, after, x = np.inf, np.empty(len(costs.x0)), np.empty(len(costs.x0))
    sums = np.empty(len(costs.failure))
    for s in graph.starts:
        cost = costs.start[graph.left[s]]
        value = cost + to_go.least[s]
        if value == np.inf:
            continue
        n = edges_from(graph, to_go, s, known.trial)
        sums[:], x[:] = 0.0, costs.x0
        for e in known.trial[:n]:
            cost += edge_cost[e] + _lost_on(graph, costs, e, x, after)
            x[:] = after
            sums += costs.risk[graph.bound[e]]
        cost += _failing(costs.failure, sums)
        if sums[-1] <= costs.limit and cost < known.cost[0]:
            known.cost[0], known.edges[:] = cost, -1
            known.edges[:n] = known.trial[:n]
        if value < least:
            least = value
            known.sums[:] = sums
    return least


@kernel
def _fill_priced(graph, costs, least_cost, price, to_go):
    """Write the costs to go with a price for each risk, (sum,)."""
    cost = least_cost.copy()
    for e in range(len(cost)):
        for m in range(len(price)):
            cost[e] += price[m] * costs.risk[graph.bound[e], m]
    fill_to_go(graph, cost, to_go)


class Limits(NamedTuple):
    """Lower limits on the cost of the rest of a path, used to drop labels.

    Fields: lower limit on the cost of all paths; safest, least sums to go (state, sum); free, least
    cost to go without risk (state,); priced, with the `price` of each sum (sum,), to which the
    offset is to be added.
    """

    lower: float
    safest: np.ndarray
    free: np.ndarray
    priced: np.ndarray
    price: np.ndarray
    offset: float


@kernel
def _limits(graph, costs, edge_cost, least_cost, known):
    """Find good paths and lower limits; the search is over where their costs are equal."""
    to_go, n_sums = new_to_go(len(graph.cell)), len(costs.failure)
    safest, low = np.empty((len(graph.cell), n_sums)), np.empty(n_sums)
    for m in range(n_sums):
        _fill_priced(graph, costs, np.zeros(len(graph.head)), np.eye(n_sums)[m], to_go)
        safest[:, m] = to_go.least
        low[m] = to_go.least[graph.starts].min()
    _try_paths(graph, costs, edge_cost, to_go, known)  # the safest by the sum that is limited
    fill_to_go(graph, least_cost, to_go)
    free, price = to_go.least.copy(), np.zeros(n_sums)
    least = _try_paths(graph, costs, edge_cost, to_go, known)
    if known.cost[0] == np.inf:
        return Limits(np.inf, safest, free, free, price, 0.0)
    for _ in range(8):  # tangents of the concave cost of failing give good paths
        before, price = price, costs.failure * np.exp(-known.sums)
        if np.abs(price - before).max() <= 1e-9 * costs.failure.max():
            break
        _fill_priced(graph, costs, least_cost, price, to_go)
        _try_paths(graph, costs, edge_cost, to_go, known)
    chord, offset = _chords(costs, low, known.cost[0] - least)
    of_edges = edge_cost, least_cost
    lower, extra = _price_of_limit(graph, costs, *of_edges, chord, offset, to_go, known)
    chord[-1] += extra
    _fill_priced(graph, costs, least_cost, chord, to_go)
    offset -= extra * costs.limit if extra > 0.0 else 0.0
    return Limits(lower, safest, free, to_go.least, chord, offset)


@kernel
def _chords(costs, low, gap):
    """Find a plane below the failure cost of paths that can be optimal: slopes (sum,), constant.

    These have sums of at least `low` and a failure cost of at most `gap`, the difference between
    the cost of the best path known and the least cost without risk.
    """
    failure, slopes, constant = costs.failure, np.zeros(len(low)), 0.0
    at_low = _failing(failure, low)
    for m in range(len(low)):
        if failure[m] == 0.0:
            continue
        here = -failure[m] * math.expm1(-low[m])
        share = (gap - at_low + here) / failure[m]
        high = -math.log1p(-max(share, 0.0)) if share < 1.0 else np.inf
        if m == len(low) - 1:
            high = min(high, costs.limit)
        if low[m] < high < np.inf:
            slopes[m] = (-failure[m] * math.expm1(-high) - here) / (high - low[m])
        constant += here - slopes[m] * low[m]
    return slopes, constant


@kernel
def _price_of_limit(graph, costs, edge_cost, least_cost, chord, offset, to_go, known):
    """Find the price of the limited sum with the best lower limit on the cost of all paths.

    The dual is concave in the price; its slope is the excess of the cheapest path's sum.
    """
    limit, price = costs.limit, chord.copy()
    lower, chosen, extra, under, over = -np.inf, 0.0, 0.0, 0.0, np.inf
    for _ in range(16):
        price[-1] = chord[-1] + extra
        _fill_priced(graph, costs, least_cost, price, to_go)
        dual = offset + _try_paths(graph, costs, edge_cost, to_go, known)
        dual -= extra * limit if extra > 0.0 else 0.0
        if dual > lower:
            lower, chosen = dual, extra
        if lower >= known.cost[0] or (extra == 0.0 and known.sums[-1] <= limit):
            break
        under, over = (extra, over) if known.sums[-1] > limit else (under, extra)
        extra = 2.0 * max(extra, 1.0) if over == np.inf else 0.5 * (under + over)
    return lower, chosen


@kernel
def _best_path(graph, costs, most, path):
    """Write the cheapest path within the limit; returns its cost (or inf) and a lower limit."""
    edge_cost, n, n_sums = np.empty(len(graph.head)), len(path), len(costs.failure)
    costs_of_sums(graph, costs.drift, costs.weight, costs.toll, edge_cost)
    known = Known(np.full(1, np.inf), np.full(n, -1), np.full(n, -1), np.zeros(n_sums))
    limits = _limits(graph, costs, edge_cost, _least_costs(graph, costs, edge_cost), known)
    lower = limits.lower
    if lower < known.cost[0]:
        lower = _search(graph, costs, most, edge_cost, limits, known)
    if known.cost[0] < np.inf:
        path[0] = graph.cell[graph.starts[0]]
    for k, e in enumerate(known.edges[: n - 1]):
        path[k + 1] = graph.cell[graph.head[e]] if e >= 0 else -1
    return known.cost[0], min(lower, known.cost[0])


class Labels(NamedTuple):
    """Table of labels: cost, sums and trust of each (label, number), and its predecessor.

    Fields: number; edge by which it came, the cell that this left, its parent and the label of its
    state that was made before it, (label,), -1 where there is none; and last, that of each state
    (state,).
    """

    number: np.ndarray
    edge: np.ndarray
    left: np.ndarray
    parent: np.ndarray
    before: np.ndarray
    last: np.ndarray


@kernel
def _search(graph, costs, most, edge_cost, limits, known):
    """Search for the best path; returns a lower limit on its cost, equal where exact."""
    n_numbers = 1 + len(costs.failure) + len(costs.x0)
    made, last = np.empty((4, most), np.int64), np.full(len(graph.cell), -1)
    labels = Labels(np.empty((most, n_numbers)), made[0], made[1], made[2], made[3], last)
    n = 0
    for s in graph.starts:
        labels.number[n], labels.last[s] = 0.0, n
        labels.edge[n], labels.left[n], labels.parent[n], labels.before[n] = -1, -1, -1, -1
        labels.number[n, 0] = costs.start[graph.left[s]]
        labels.number[n, 1 + len(costs.failure) :] = costs.x0
        n += 1
    for s in range(len(graph.cell) - 1, 0, -1):
        label = labels.last[s]
        while label >= 0:
            if n + 8 > most:
                return limits.lower
            if not _is_dominated(graph, labels, label, labels.last[s], len(costs.failure)):
                n = _extend(graph, costs, edge_cost, limits, known, labels, s, label, n)
            label = labels.before[label]
    return known.cost[0]


@kernel
def _extend(graph, costs, edge_cost, limits, known, labels, s, label, n):
    """Make the successors of a label that can be optimal; returns the number of all labels."""
    n_sums = len(costs.failure)
    number, after, sums = labels.number[label], np.empty(len(costs.x0)), np.empty(n_sums)
    for e in range(graph.first[s], graph.first[s + 1]):
        h = graph.head[e]
        if not graph.turns and graph.cell[h] == labels.left[label]:
            continue
        lost = _lost_on(graph, costs, e, number[1 + n_sums :], after)
        cost = number[0] + (edge_cost[e] + lost)
        sums[:] = number[1 : 1 + n_sums] + costs.risk[graph.bound[e]]
        if _is_hopeless(costs, limits, h, cost, sums, known.cost[0]):
            continue
        labels.number[n, 0], labels.number[n, 1 : 1 + n_sums] = cost, sums
        labels.number[n, 1 + n_sums :] = after
        labels.edge[n], labels.left[n], labels.parent[n] = e, graph.cell[s], label
        labels.before[n], labels.last[h] = labels.last[h], n
        if h == 0:
            known.cost[0] = cost + _failing(costs.failure, sums)
            _write_edges(graph, labels, n, known.edges)
        n += 1
    return n


@kernel
def _is_hopeless(costs, limits, h, cost, sums, known):
    """Check whether no path that enters a state with this cost and these sums can be best."""
    if sums[-1] + limits.safest[h, -1] > costs.limit:
        return True
    at_least = cost + limits.priced[h] + limits.offset
    for m in range(len(sums)):
        at_least += limits.price[m] * sums[m]
    if at_least >= known:
        return True
    return cost + limits.free[h] + _failing(costs.failure, sums + limits.safest[h]) >= known


@kernel
def _write_edges(graph, labels, label, edges):
    """Write the edges of the path of a label."""
    n, k = label, 0
    while labels.parent[n] >= 0:
        n, k = labels.parent[n], k + 1
    edges[:] = -1
    while labels.parent[label] >= 0:
        k -= 1
        edges[k], label = labels.edge[label], labels.parent[label]


@kernel
def _is_dominated(graph, labels, label, other, n_sums):
    """Check whether other labels of a state have all completions of a label at no higher cost."""
    number, by = labels.number[label], -2
    while other >= 0:
        covers, equal = other != label, True
        for k in range(len(number)):  # cost and sums should be small, trust large
            a, b = labels.number[other, k], number[k]
            if (a > b) if k <= n_sums else (a < b):
                covers = False
                break
            equal = equal and a == b
        if covers and (not equal or other < label):
            left = labels.left[other]
            if graph.turns or left == labels.left[label] or by not in (-2, left):
                return True
            by = left
        other = labels.before[other]
    return False
