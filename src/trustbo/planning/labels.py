"""Label search on the unrolled graph, for objectives that are nonlinear in trust or include risk.

The method is a label-setting algorithm with dominance for the resource-constrained shortest path
(Martins 1984; Irnich and Desaulniers 2005). A label at a state contains the cost so far and the
sums r_m of the risks -log(1 - p). If the loss depends on trust, a label also contains trust. An
edge has a cost and possibly a loss, which decreases with trust. The cost of a path also includes
sum_m F_m (1 - exp(-r_m)), and its failure probability sum_m w_m (1 - exp(-r_m)) must not exceed a
limit.

A label is dropped if another label of its state has no higher cost, no larger sums and no lower
trust. Because B0 >= 0 preserves the order of trust, any path to the goal is at least as good from
the other label. If U-turns are forbidden, the other label must come from the same cell, or there
must be two such labels from different cells. A label is also dropped if no path that continues it
can be better than the best path found so far. To check this, the remaining cost is bounded from
below by a sum over edges. The sum uses the largest possible trust, and the chord of
F_m (1 - exp(-r_m)) over the sums that can still be optimal. For the limit, w_m (1 - exp(-r_m)) is
also replaced by its chord. The limit is then relaxed with a Lagrange multiplier, which is found by
bisection (Handler and Zang 1980).

The search is exact because no dropped label can lead to a better path than the one returned.
"""

import math
from typing import NamedTuple

import numpy as np

from trustbo.parallel import over_rows
from trustbo.planning.sums import costs_of_sums
from trustbo.planning.unrolled import Unrolled, edges_from, fill_to_go, kernel, new_to_go
from trustbo.workspace.moves import MOVES

MAX_LABELS = 300_000
"""Maximum number of labels. A search that needs more stops with the best path found so far and a
lower limit."""
LOGISTIC = 0
"""Loss of a bound 1 - sigma(trust)."""
CLIPPED = 1
"""Loss of a bound 1 - E[y] for y ~ N(trust, sd^2) clipped to [0, 1]."""
LOSSES = {"logistic": LOGISTIC, "clipped": CLIPPED}
"""Loss of a bound for each nonlinear `Family.expected_rate`."""
TINY_SD = 1e-9
"""Smallest standard deviation of a contact rate; smaller values are replaced."""
_N_MOVES = len(MOVES)  # largest number of labels that extend one label
_MAX_EXPONENT = 700.0  # exp(710) exceeds the range of a float
_N_TANGENTS = 8  # maximum number of tangents to the failure cost; few suffice to find good paths
_N_PRICES = 16  # maximum number of prices of the limit for which the dual is computed
_PRICE_TOLERANCE = 1e-9  # relative change below which the tangents have converged
_NO_CELL_YET = -2  # differs from all cells and from -1, the cell before the start


class Costs(NamedTuple):
    """Costs of paths for one draw.

    `loss` is a value of `LOSSES`. The cost of a bound is its loss plus `bound_cost` (bound,) minus
    `weight` (n_bounds_left, robot) times `drift` (robot, bound). `start` (n_bounds_left,) is the
    constant cost of paths with a given number of bounds. `transition` (robot, robot) and `x0`
    (robot,) define the recursion for trust, or are empty if there is no loss. `sd` is the sd of a
    rate. `risk` has the shape (edge, sum), because a risk depends on the bound before an edge.
    `failure` (sum,) contains F_m, `share` (sum,) contains w_m, and `limit` is the largest failure
    probability allowed.
    """

    loss: int
    drift: np.ndarray
    weight: np.ndarray
    start: np.ndarray
    transition: np.ndarray
    x0: np.ndarray
    sd: float | np.ndarray
    bound_cost: np.ndarray
    risk: np.ndarray
    failure: np.ndarray
    share: np.ndarray
    limit: float


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
        Costs (draw,), lower bounds on the cost of any path (draw,), and paths (draw, cell) as flat
        cell indices, padded with -1. A cost is inf if no path is within the limit.
    """
    searches = [graph]
    divisor = scale[graph.n_bounds_left[graph.starts]]
    if not (divisor == divisor[0]).all():  # one search for each number of bounds
        searches = [graph._replace(starts=graph.starts[k : k + 1]) for k in range(len(divisor))]

    n = len(costs.drift)
    max_labels = MAX_LABELS  # an argument, because a compiled kernel keeps its globals
    cost = np.empty((len(searches), n))
    lower = np.empty((len(searches), n))
    paths = np.full((len(searches), n, graph.longest + 1), -1, np.int32)

    for k, part in enumerate(searches):

        def work(begin: int, end: int, k: int = k, part: Unrolled = part) -> None:
            _best_labels(part, costs, max_labels, cost[k], lower[k], paths[k], begin, end)

        over_rows(work, n)
        cost[k] = cost[k] / divisor[k]
        lower[k] = lower[k] / divisor[k]

    best = cost.argmin(0)
    return cost.min(0), lower.min(0), paths[best, np.arange(n)]


@kernel
def _best_labels(graph, costs, max_labels, cost, lower, paths, begin, end):
    """Write the results of `_best_path` for the draws from `begin` to `end`."""
    loss, drift, weight, start, transition, x0, sd, bound_cost, risk, failure, share, limit = costs
    failing = bound_cost, risk, failure, share, limit
    for d in range(begin, end):
        trust = transition[d], x0[d], sd[d]
        one = Costs(loss, drift[d], weight[d], start[d], *trust, *failing)
        cost[d], lower[d] = _best_path(graph, one, max_labels, paths[d])


@kernel
def _lost(loss, x, sd):
    """Compute the expected contact lost in a bound after which trust is x."""
    if loss == LOGISTIC:
        return 1.0 / (1.0 + math.exp(min(x, _MAX_EXPONENT)))

    # One minus the mean of N(x, sd^2) clipped to [0, 1], as in `Censored.mean_rate`.
    low = -x / sd
    high = (1.0 - x) / sd
    root = math.sqrt(0.5)
    below = 0.5 * math.erfc(-low * root)
    above = 0.5 * math.erfc(high * root)
    density = (math.exp(-0.5 * low * low) - math.exp(-0.5 * high * high)) / math.sqrt(2.0 * math.pi)
    return 1.0 - (x * (1.0 - below - above) + sd * density + above)


@kernel
def _lost_on(graph, costs, e, x, after):
    """Compute the contact lost on edge e, entered with trust x; write the new trust to `after`."""
    n = len(costs.x0)
    if n == 0:
        return 0.0

    mean = 0.0
    for i in range(n):
        after[i] = costs.drift[i, graph.bound[e]]
        for j in range(n):
            after[i] += costs.transition[i, j] * x[j]
        mean += after[i] / n
    return _lost(costs.loss, mean, costs.sd)


@kernel
def _least_costs(graph, costs, edge_cost):
    """Compute the cost (edge,) of each edge, entered with the largest possible trust."""
    if len(costs.x0) == 0:
        return edge_cost

    cost = np.full(len(graph.head), np.inf)
    highest = np.full((len(graph.cell), len(costs.x0)), -np.inf)  # largest trust in each state
    after = np.empty(len(costs.x0))
    for s in graph.starts:
        highest[s] = costs.x0

    # The order of states is topological, so the largest trust in a state is final when it is read.
    for s in range(len(graph.cell) - 1, 0, -1):
        if highest[s, 0] == -np.inf:  # every path to the state passes through the goal
            continue
        for e in range(graph.first[s], graph.first[s + 1]):
            cost[e] = edge_cost[e] + _lost_on(graph, costs, e, highest[s], after)
            highest[graph.head[e]] = np.maximum(highest[graph.head[e]], after)

    return cost


@kernel
def _failing(weights, r):
    """Compute sum_m weights_m (1 - exp(-r_m)) for the sums r of the risks, shape (sum,).

    The sum is the expected cost of failure if the weights are F_m, and the failure probability if
    they are w_m.
    """
    total = 0.0
    for m in range(len(r)):
        total -= weights[m] * math.expm1(-r[m])
    return total


@kernel
def _is_beyond(costs, r):
    """Check whether the failure probability for the sums r exceeds the limit."""
    return costs.limit < np.inf and _failing(costs.share, r) > costs.limit


class Known(NamedTuple):
    """Best path found so far and the path tried last.

    The best path has `cost` (1,) and `edges` (bound,), padded with -1. The path tried last has the
    edges `trial` (bound,). `sums` (sum,) are the sums of the cheapest path that the last call of
    `_try_paths` tried.
    """

    cost: np.ndarray
    edges: np.ndarray
    trial: np.ndarray
    sums: np.ndarray


@kernel
def _try_paths(graph, costs, edge_cost, to_go, known):
    """Evaluate the cheapest path from each start according to `to_go`, and return the least cost.

    The best path within the limit and the sums of the cheapest path are written to `known`.
    """
    least = np.inf
    after = np.empty(len(costs.x0))
    x = np.empty(len(costs.x0))
    sums = np.empty(len(costs.failure))

    for s in graph.starts:
        cost = costs.start[graph.n_bounds_left[s]]
        value = cost + to_go.least[s]
        if value == np.inf:
            continue

        n = edges_from(graph, to_go, s, known.trial)
        sums[:] = 0.0
        x[:] = costs.x0
        for e in known.trial[:n]:
            cost += edge_cost[e] + _lost_on(graph, costs, e, x, after)
            x[:] = after
            sums += costs.risk[e]
        cost += _failing(costs.failure, sums)

        if cost < known.cost[0] and not _is_beyond(costs, sums):
            known.cost[0] = cost
            known.edges[:] = -1
            known.edges[:n] = known.trial[:n]
        if value < least:
            least = value
            known.sums[:] = sums

    return least


@kernel
def _fill_priced(graph, costs, least_cost, price, to_go):
    """Fill `to_go` for edge costs that include the risks multiplied by their prices (sum,)."""
    cost = least_cost.copy()
    for e in range(len(cost)):
        for m in range(len(price)):
            cost[e] += price[m] * costs.risk[e, m]

    fill_to_go(graph, cost, to_go)


class Limits(NamedTuple):
    """Lower limits on the cost of the rest of a path, used to drop labels.

    `lower` is a lower bound on the cost of all paths. For each state, `free` (state,) is the
    smallest remaining cost, excluding the cost of failure, and `safest` (state, sum) is the
    smallest sum of the remaining risks. The remaining cost, including failure and the relaxed
    limit, is at least `priced` (state,) plus `offset` plus `price` (sum,) times the sums so far.
    """

    lower: float
    safest: np.ndarray
    free: np.ndarray
    priced: np.ndarray
    price: np.ndarray
    offset: float


@kernel
def _limits(graph, costs, edge_cost, least_cost, known):
    """Find good paths and lower limits; no search is needed if the best path attains `lower`."""
    n_sums = len(costs.failure)
    to_go = new_to_go(len(graph.cell))
    safest = np.empty((len(graph.cell), n_sums))
    low = np.empty(n_sums)

    nothing = np.zeros(len(graph.head))
    for m in range(n_sums):
        _fill_priced(graph, costs, nothing, np.eye(n_sums)[m], to_go)
        safest[:, m] = to_go.least
        low[m] = to_go.least[graph.starts].min()

    if _is_beyond(costs, low):  # even a path with the smallest value of each sum
        unknown = np.full(len(graph.cell), np.inf)
        return Limits(np.inf, safest, unknown, unknown, np.zeros(n_sums), 0.0)
    if costs.limit < np.inf:
        _follow_tangents(graph, costs, edge_cost, nothing, costs.share, low, to_go, known)

    fill_to_go(graph, least_cost, to_go)
    free = to_go.least.copy()
    least = _try_paths(graph, costs, edge_cost, to_go, known)
    sums = known.sums.copy()
    _follow_tangents(graph, costs, edge_cost, least_cost, costs.failure, sums, to_go, known)

    # With chords as prices, a sum over edges is a lower bound on the cost (see the module
    # docstring).
    gap = known.cost[0] - least
    high = np.minimum(_highest(costs.failure, low, gap), _highest(costs.share, low, costs.limit))
    chord, offset = _chords(costs.failure, low, high)
    slope, at_zero = _chords(costs.share, low, high)

    relaxed = Relaxed(chord, offset, slope, at_zero)
    lower, extra = _price_of_limit(graph, costs, edge_cost, least_cost, relaxed, to_go, known)
    price = chord + extra * slope
    _fill_priced(graph, costs, least_cost, price, to_go)
    if extra > 0.0:  # otherwise, the limit may be inf, and 0 times inf is NaN
        offset += extra * (at_zero - costs.limit)

    return Limits(lower, safest, free, to_go.least, price, offset)


@kernel
def _follow_tangents(graph, costs, edge_cost, least_cost, weights, sums, to_go, known):
    """Try the cheapest paths for tangents to the concave sum_m weights_m (1 - exp(-r_m)).

    The first tangent is at `sums`, the next one at the sums of the path that was found, and so on.
    """
    price = np.zeros(len(weights))
    for _ in range(_N_TANGENTS):
        before = price
        price = weights * np.exp(-sums)
        if np.abs(price - before).max() <= _PRICE_TOLERANCE * weights.max():
            break
        _fill_priced(graph, costs, least_cost, price, to_go)
        _try_paths(graph, costs, edge_cost, to_go, known)
        sums = known.sums


@kernel
def _highest(weights, low, most):
    """Return the largest value (sum,) of each sum for which the failure is at most `most`.

    Failure is sum_m weights_m (1 - exp(-r_m)); all sums are at least `low`.
    """
    high = np.full(len(low), np.inf)
    at_low = _failing(weights, low)
    for m in range(len(low)):
        if weights[m] > 0.0:
            # The other sums are at their minimum, so this sum is as large as possible.
            share = (most - at_low) / weights[m] - math.expm1(-low[m])
            if share < 1.0:
                high[m] = -math.log1p(-max(share, 0.0))
    return high


@kernel
def _chords(weights, low, high):
    """Find the slopes (sum,) and the constant of a plane below sum_m weights_m (1 - exp(-r_m)).

    The plane is below this concave function where all sums are between `low` and `high`.
    """
    slopes = np.zeros(len(low))
    constant = 0.0

    for m in range(len(low)):
        if weights[m] == 0.0:
            continue
        here = -weights[m] * math.expm1(-low[m])
        if low[m] < high[m] < np.inf:
            slopes[m] = (-weights[m] * math.expm1(-high[m]) - here) / (high[m] - low[m])
        constant += here - slopes[m] * low[m]

    return slopes, constant


class Relaxed(NamedTuple):
    """Planes below the failure cost and below the failure probability.

    For sums r, the cost of failure is at least `offset` + `chord` . r, and the probability of
    failure is at least `at_zero` + `slope` . r; `chord` and `slope` have shape (sum,).
    """

    chord: np.ndarray
    offset: float
    slope: np.ndarray
    at_zero: float


@kernel
def _price_of_limit(graph, costs, edge_cost, least_cost, relaxed, to_go, known):
    """Find the price of the limit that maximises the lower limit on the cost of all paths.

    The lower limit (the Lagrangian dual) is concave in the price. Its slope is the excess of the
    cheapest path over the limit. The maximum is found by bisection (Handler and Zang 1980).
    """
    lower = -np.inf
    chosen = 0.0
    extra = 0.0
    under = 0.0  # the best price is between `under` and `over`
    over = np.inf

    for _ in range(_N_PRICES):
        price = relaxed.chord + extra * relaxed.slope
        _fill_priced(graph, costs, least_cost, price, to_go)
        dual = relaxed.offset + _try_paths(graph, costs, edge_cost, to_go, known)
        if extra > 0.0:  # otherwise, the limit may be inf, and 0 times inf is NaN
            dual += extra * (relaxed.at_zero - costs.limit)

        excess = relaxed.at_zero - costs.limit
        for m in range(len(price)):
            excess += relaxed.slope[m] * known.sums[m]
        if dual > lower:
            lower = dual
            chosen = extra
        if lower >= known.cost[0] or (extra == 0.0 and excess <= 0.0):
            break

        if excess > 0.0:
            under = extra
        else:
            over = extra
        extra = 2.0 * max(extra, 1.0) if over == np.inf else 0.5 * (under + over)

    return lower, chosen


@kernel
def _best_path(graph, costs, max_labels, path):
    """Write the cheapest path within the limit, and return its cost (or inf) and a lower limit."""
    n = len(path)
    n_sums = len(costs.failure)
    edge_cost = np.empty(len(graph.head))
    costs_of_sums(graph, costs.drift, costs.weight, costs.bound_cost, edge_cost)

    known = Known(np.full(1, np.inf), np.full(n, -1), np.full(n, -1), np.zeros(n_sums))
    least_cost = _least_costs(graph, costs, edge_cost)
    limits = _limits(graph, costs, edge_cost, least_cost, known)
    lower = limits.lower
    if lower < known.cost[0]:
        lower = _search(graph, costs, max_labels, edge_cost, limits, known)

    if known.cost[0] < np.inf:
        path[0] = graph.cell[graph.starts[0]]
    for k, e in enumerate(known.edges[: n - 1]):
        path[k + 1] = graph.cell[graph.head[e]] if e >= 0 else -1

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


@kernel
def _search(graph, costs, max_labels, edge_cost, limits, known):
    """Search for the best path; return its cost, or a lower limit if there are too many labels."""
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
        labels.number[n, 1 + len(costs.failure) :] = costs.x0
        n += 1

    # Edges lead to states of lower index. All labels of a state are therefore known when the state
    # is reached, and each label is extended at most once (label setting, Martins 1984).
    for s in range(len(graph.cell) - 1, 0, -1):
        label = labels.last[s]
        while label >= 0:
            if n + _N_MOVES > max_labels:
                return limits.lower
            if not _is_dominated(graph, labels, label, labels.last[s], len(costs.failure)):
                n = _extend(graph, costs, edge_cost, limits, known, labels, s, label, n)
            label = labels.before[label]

    return known.cost[0]


@kernel
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

        lost = _lost_on(graph, costs, e, number[1 + n_sums :], after)
        cost = number[0] + (edge_cost[e] + lost)
        sums[:] = number[1 : 1 + n_sums] + costs.risk[e]
        if _is_hopeless(costs, limits, h, cost, sums, known.cost[0]):
            continue

        labels.number[n, 0] = cost
        labels.number[n, 1 : 1 + n_sums] = sums
        labels.number[n, 1 + n_sums :] = after
        labels.edge[n] = e
        labels.came_from[n] = graph.cell[s]
        labels.parent[n] = label
        labels.before[n] = labels.last[h]
        labels.last[h] = n

        if h == 0:
            known.cost[0] = cost + _failing(costs.failure, sums)
            _write_edges(graph, labels, n, known.edges)
        n += 1

    return n


@kernel
def _is_hopeless(costs, limits, h, cost, sums, known):
    """Check whether no path that enters state h with this cost and these sums can be optimal."""
    smallest = sums + limits.safest[h]
    if _is_beyond(costs, smallest):
        return True

    # The first bound uses a plane below the failure cost and the relaxed limit.
    at_least = cost + limits.priced[h] + limits.offset
    for m in range(len(sums)):
        at_least += limits.price[m] * sums[m]
    if at_least >= known:
        return True

    # The second bound uses the failure cost itself, at the smallest sums that can still be reached.
    return cost + limits.free[h] + _failing(costs.failure, smallest) >= known


@kernel
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


@kernel
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
