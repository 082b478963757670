"""Label search on the unrolled graph, for objectives that are nonlinear in trust or include risk.

The method is a label-setting algorithm with dominance for the resource-constrained shortest path
(Martins 1984; Irnich and Desaulniers 2005). A label at a state contains the cost so far and the
sums r_m of the risks -log(1 - p). If the loss depends on trust, a label also contains trust. See
`planning.limits.Costs` for the cost of a path.

A label is dropped if another label of its state has no higher cost, no larger sums and no lower
trust. Because B0 >= 0 preserves the order of trust, any path to the goal is at least as good from
the other label. If U-turns are forbidden, the other label must come from the same cell, or there
must be two such labels from different cells. A label is also dropped if no path that continues it
can be better than the best path found so far, according to the lower limits of `planning.limits`.

The search is exact because no dropped label can lead to a better path than the one returned.
"""

from typing import NamedTuple

import numpy as np

from trustbo.parallel import over_rows
from trustbo.planning.limits import (
    Costs,
    Known,
    copy,
    failing,
    is_beyond,
    least_costs,
    limits_of,
    lost_on,
    plus,
)
from trustbo.planning.sums import costs_of_sums
from trustbo.planning.unrolled import Unrolled, kernel, part

MAX_LABELS = 300_000
"""Maximum number of labels. A search that needs more stops with the best path found so far and a
lower limit."""
_NO_CELL_YET = -2  # differs from all cells and from -1, the cell before the start


def best_labels(
    graph: Unrolled, costs: Costs, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the path of least cost for each draw.

    Args:
        graph: Unrolled graph.
        costs: Costs, in which drift, weight, start, transition, x0 and sd have a leading axis
            (draw,).
        scale: Divisor of the cost of paths with each number of bounds, shape (length,).

    Returns:
        Costs (draw,), lower bounds on the cost of any path (draw,), and paths (draw, cell) as
        indices of stations, padded with -1. A cost is inf if no path is within the limit.
    """
    n_bounds = graph.n_bounds_left[graph.starts]
    divisor = scale[n_bounds[:1]]
    searches = [graph]
    if not (scale[n_bounds] == divisor).all():  # one search for each number of bounds
        lengths = np.unique(n_bounds)
        divisor = scale[lengths]
        searches = [graph._replace(starts=graph.starts[n_bounds == n]) for n in lengths]

    n = len(costs.drift)
    max_labels = MAX_LABELS  # an argument, because a compiled kernel keeps its globals
    cost = np.empty((len(searches), n))
    lower = np.empty((len(searches), n))
    paths = np.full((len(searches), n, graph.longest + 1), -1, np.int32)

    for k, searched in enumerate(searches):

        def work(begin: int, end: int, k: int = k, searched: Unrolled = searched) -> None:
            _best_labels(searched, costs, max_labels, cost[k], lower[k], paths[k], begin, end)

        over_rows(work, n)
        cost[k] = cost[k] / divisor[k]
        lower[k] = lower[k] / divisor[k]

    best = cost.argmin(0)
    return cost.min(0), lower.min(0), paths[best, np.arange(n)]


@kernel
def _best_labels(graph, costs, max_labels, cost, lower, paths, begin, end):
    """Write the results of `_best_path` for the draws from `begin` to `end`."""
    loss, drift, weight, start, transition, x0, sd, bound_cost, risk, failure, share, limit = costs
    shared = bound_cost, risk, failure, share, limit
    for d in range(begin, end):
        trust = transition[d], x0[d], sd[d]
        one = Costs(loss, drift[d], weight[d], start[d], *trust, *shared)
        cost[d], lower[d] = _best_path(graph, one, max_labels, paths[d])


@part
def _best_path(graph, costs, max_labels, path):
    """Write the cheapest path within the limit, and return its cost (or inf) and a lower limit."""
    n = len(path)
    n_sums = len(costs.failure)
    edge_cost = np.empty(len(graph.head))
    costs_of_sums(graph, costs.drift, costs.weight, costs.bound_cost, edge_cost)

    known = Known(np.full(1, np.inf), np.full(n, -1), np.full(n, -1), np.zeros(n_sums))
    least_cost = least_costs(graph, costs, edge_cost)
    limits = limits_of(graph, costs, edge_cost, least_cost, known)
    lower = limits.lower
    if lower < known.cost[0]:
        lower = _search(graph, costs, max_labels, edge_cost, limits, known)

    if known.cost[0] < np.inf:
        for k, e in enumerate(known.edges[: n - 1]):
            if e >= 0:
                path[k] = graph.station[e]
                path[k + 1] = graph.cell[graph.head[e]]

    return known.cost[0], min(lower, known.cost[0])


class Labels(NamedTuple):
    """Table of labels.

    `number` (label, number) contains the cost, the sums and the trust of each label. The other
    columns have shape (label,): `edge` is the edge that led to the label, `came_from` the cell that
    this edge leaves, `parent` the previous label of the path, and `before` the previous label of
    the same state. `last` (state,) is the newest label of each state. Missing entries are -1.
    """

    number: np.ndarray
    edge: np.ndarray
    came_from: np.ndarray
    parent: np.ndarray
    before: np.ndarray
    last: np.ndarray


@part
def _search(graph, costs, max_labels, edge_cost, limits, known):
    """Search for the best path; return its cost, or a lower limit if there are too many labels."""
    if len(graph.starts) > max_labels:
        return limits.lower

    n_numbers = 1 + len(costs.failure) + len(costs.x0)
    made = np.empty((4, max_labels), np.int64)
    last = np.full(len(graph.cell), -1)
    labels = Labels(np.empty((max_labels, n_numbers)), made[0], made[1], made[2], made[3], last)

    n = 0
    for s in graph.starts:
        labels.edge[n] = -1
        labels.came_from[n] = -1
        labels.parent[n] = -1
        labels.before[n] = -1
        labels.last[s] = n
        labels.number[n] = 0.0
        labels.number[n, 0] = costs.start[graph.n_bounds_left[s]]
        copy(costs.x0, labels.number[n, 1 + len(costs.failure) :])
        n += 1

    # Edges lead to states of lower index. All labels of a state are therefore known when the state
    # is reached, and each label is extended at most once (label setting, Martins 1984).
    for s in range(len(graph.cell) - 1, 0, -1):
        label = labels.last[s]
        while label >= 0:
            if n + graph.first[s + 1] - graph.first[s] > max_labels:
                return limits.lower
            if not _is_dominated(graph, labels, label, labels.last[s], len(costs.failure)):
                n = _extend(graph, costs, edge_cost, limits, known, labels, s, label, n)
            label = labels.before[label]

    return known.cost[0]


@part
def _extend(graph, costs, edge_cost, limits, known, labels, s, label, n):
    """Add the successors of a label that may be optimal, and return the new number of labels."""
    n_sums = len(costs.failure)
    number = labels.number[label]
    after = np.empty(len(costs.x0))
    sums = np.empty(n_sums)

    for e in range(graph.first[s], graph.first[s + 1]):
        h = graph.head[e]
        if not graph.turns and graph.cell[h] == labels.came_from[label]:
            continue

        lost = lost_on(graph, costs, e, number[1 + n_sums :], after)
        cost = number[0] + (edge_cost[e] + lost)
        for m in range(n_sums):
            sums[m] = number[1 + m] + costs.risk[e, m]
        if _is_hopeless(costs, limits, h, cost, sums, known.cost[0]):
            continue

        labels.number[n, 0] = cost
        copy(sums, labels.number[n, 1 : 1 + n_sums])
        copy(after, labels.number[n, 1 + n_sums :])
        labels.edge[n] = e
        labels.came_from[n] = graph.cell[s]
        labels.parent[n] = label
        labels.before[n] = labels.last[h]
        labels.last[h] = n

        if h == 0:
            known.cost[0] = cost + failing(costs.failure, sums)
            _write_edges(graph, labels, n, known.edges)
        n += 1

    return n


@part
def _is_hopeless(costs, limits, h, cost, sums, known):
    """Check whether no path that enters state h with this cost and these sums can be optimal."""
    smallest = plus(sums, 1.0, limits.safest[h])
    if is_beyond(costs, smallest):
        return True

    # The first bound uses a plane below the failure cost and the relaxed limit.
    at_least = cost + limits.priced[h] + limits.offset
    for m in range(len(sums)):
        at_least += limits.price[m] * sums[m]
    if at_least >= known:
        return True

    # The second bound uses the failure cost itself, at the smallest sums that can still be reached.
    return cost + limits.free[h] + failing(costs.failure, smallest) >= known


@part
def _write_edges(graph, labels, label, edges):
    """Write the edges of the path that leads to a label, padded with -1, to `edges`."""
    n = label
    k = 0
    while labels.parent[n] >= 0:
        n = labels.parent[n]
        k += 1

    edges[:] = -1
    while labels.parent[label] >= 0:
        k -= 1
        edges[k] = labels.edge[label]
        label = labels.parent[label]


@part
def _is_dominated(graph, labels, label, other, n_sums):
    """Check whether other labels of the same state make a label unnecessary."""
    number = labels.number[label]
    by = _NO_CELL_YET  # cell before the label that dominates this one, if U-turns are forbidden

    while other >= 0:
        covers = other != label
        equal = True
        for k in range(len(number)):  # smaller costs and sums are better, and larger trust
            a = labels.number[other, k]
            b = number[k]
            worse = a > b if k <= n_sums else a < b
            if worse:
                covers = False
                break
            equal = equal and a == b

        if covers and (not equal or other < label):  # the first of several equal labels remains
            came_from = labels.came_from[other]
            if graph.turns or came_from == labels.came_from[label]:
                return True
            if by not in (_NO_CELL_YET, came_from):  # two labels, from different cells
                return True
            by = came_from
        other = labels.before[other]

    return False
