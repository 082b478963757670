"""Costs of paths on the unrolled graph, lower limits on them, and good paths to begin with.

An edge has a cost and possibly a loss, which decreases with trust. The cost of a path also includes
sum_m F_m (1 - exp(-r_m)), where r_m are the sums of the risks -log(1 - p), and its failure
probability sum_m w_m (1 - exp(-r_m)) must not exceed a limit.

The cost of a path is bounded from below by a sum over edges. The sum uses the largest possible
trust, and the chord of F_m (1 - exp(-r_m)) over the sums that can still be optimal. For the limit,
w_m (1 - exp(-r_m)) is also replaced by its chord. The limit is then relaxed with a Lagrange
multiplier, which is found by bisection (Handler and Zang 1980).

The kernels loop over elements. Numba takes half a minute longer to compile operations on arrays.
"""

import math
from typing import NamedTuple

import numpy as np

from trustbo.planning.unrolled import edges_from, fill_to_go, new_to_go, part

LOGISTIC = 0
"""Loss of a bound 1 - sigma(trust)."""
CLIPPED = 1
"""Loss of a bound 1 - E[y] for y ~ N(trust, sd^2) clipped to [0, 1]."""
LOSSES = {"logistic": LOGISTIC, "clipped": CLIPPED}
"""Loss of a bound for each nonlinear `Family.expected_rate`."""
TINY_SD = 1e-9
"""Smallest standard deviation of a contact rate; smaller values are replaced."""
_MAX_EXPONENT = 700.0  # exp(710) exceeds the range of a float
_N_PRICES = 16  # maximum number of prices of the limit for which the dual is computed


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


@part
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


@part
def lost_on(graph, costs, e, x, after) -> float:
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


@part
def least_costs(graph, costs, edge_cost) -> np.ndarray:
    """Compute the cost (edge,) of each edge, entered with the largest possible trust."""
    if len(costs.x0) == 0:
        return edge_cost

    cost = np.full(len(graph.head), np.inf)
    highest = np.full((len(graph.cell), len(costs.x0)), -np.inf)  # largest trust in each state
    after = np.empty(len(costs.x0))
    for s in graph.starts:
        for i in range(len(after)):
            highest[s, i] = costs.x0[i]

    # The order of states is topological, so the largest trust in a state is final when it is read.
    for s in range(len(graph.cell) - 1, 0, -1):
        if highest[s, 0] == -np.inf:  # every path to the state passes through the goal
            continue
        for e in range(graph.first[s], graph.first[s + 1]):
            cost[e] = edge_cost[e] + lost_on(graph, costs, e, highest[s], after)
            ahead = highest[graph.head[e]]
            for i in range(len(after)):
                ahead[i] = max(ahead[i], after[i])

    return cost


@part
def failing(weights, r) -> float:
    """Compute sum_m weights_m (1 - exp(-r_m)) for the sums r of the risks, shape (sum,).

    The sum is the expected cost of failure if the weights are F_m, and the failure probability if
    they are w_m.
    """
    total = 0.0
    for m in range(len(r)):
        total -= weights[m] * math.expm1(-r[m])
    return total


@part
def plus(a, factor, b) -> np.ndarray:
    """Return a + factor * b for arrays (sum,)."""
    total = np.empty(len(a))
    for m in range(len(a)):
        total[m] = a[m] + factor * b[m]
    return total


@part
def copy(values, out) -> None:
    """Copy an array to the beginning of another one."""
    for k in range(len(values)):
        out[k] = values[k]


@part
def is_beyond(costs, r) -> bool:
    """Check whether the failure probability for the sums r exceeds the limit."""
    return costs.limit < np.inf and failing(costs.share, r) > costs.limit


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


@part
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
        copy(costs.x0, x)
        for e in known.trial[:n]:
            cost += edge_cost[e] + lost_on(graph, costs, e, x, after)
            copy(after, x)
            for m in range(len(sums)):
                sums[m] += costs.risk[e, m]
        cost += failing(costs.failure, sums)

        if cost < known.cost[0] and not is_beyond(costs, sums):
            known.cost[0] = cost
            known.edges[:] = -1
            copy(known.trial[:n], known.edges)
        if value < least:
            least = value
            copy(sums, known.sums)

    return least


@part
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


@part
def limits_of(graph, costs, edge_cost, least_cost, known) -> Limits:
    """Find good paths and lower limits; no search is needed if the best path attains `lower`."""
    n_sums = len(costs.failure)
    to_go = new_to_go(len(graph.cell))
    safest = np.empty((len(graph.cell), n_sums))
    low = np.empty(n_sums)

    nothing = np.zeros(len(graph.head))
    for m in range(n_sums):
        only = np.zeros(n_sums)
        only[m] = 1.0
        _fill_priced(graph, costs, nothing, only, to_go)
        if costs.limit < np.inf:
            _try_paths(graph, costs, edge_cost, to_go, known)
        copy(to_go.least, safest[:, m])
        low[m] = np.inf
        for s in graph.starts:
            low[m] = min(low[m], to_go.least[s])

    if is_beyond(costs, low):  # even a path with the smallest value of each sum
        unknown = np.full(len(graph.cell), np.inf)
        return Limits(np.inf, safest, unknown, unknown, np.zeros(n_sums), 0.0)

    fill_to_go(graph, least_cost, to_go)
    free = to_go.least.copy()
    least = _try_paths(graph, costs, edge_cost, to_go, known)
    _follow_tangents(graph, costs, edge_cost, least_cost, to_go, known)

    # With chords as prices, a sum over edges is a lower bound on the cost (see the module
    # docstring).
    gap = known.cost[0] - least
    high = _highest(costs.failure, low, gap)
    within = _highest(costs.share, low, costs.limit)
    for m in range(n_sums):
        high[m] = min(high[m], within[m])

    chord, offset = _chords(costs.failure, low, high)
    slope, at_zero = _chords(costs.share, low, high)

    relaxed = Relaxed(chord, offset, slope, at_zero)
    lower, extra = _price_of_limit(graph, costs, edge_cost, least_cost, relaxed, to_go, known)
    price = plus(chord, extra, slope)
    _fill_priced(graph, costs, least_cost, price, to_go)
    if extra > 0.0:  # otherwise, the limit may be inf, and 0 times inf is NaN
        offset += extra * (at_zero - costs.limit)

    return Limits(lower, safest, free, to_go.least, price, offset)


@part
def _follow_tangents(graph, costs, edge_cost, least_cost, to_go, known):
    """Try the cheapest paths for tangents to the concave cost of failure, until none is better.

    Each tangent is at the sums of the cheapest path tried last.
    """
    price = np.empty(len(costs.failure))
    best = np.inf
    while known.cost[0] < best:
        best = known.cost[0]
        for m in range(len(price)):
            price[m] = costs.failure[m] * math.exp(-known.sums[m])
        _fill_priced(graph, costs, least_cost, price, to_go)
        _try_paths(graph, costs, edge_cost, to_go, known)


@part
def _highest(weights, low, most):
    """Return the largest value (sum,) of each sum for which the failure is at most `most`.

    Failure is sum_m weights_m (1 - exp(-r_m)); all sums are at least `low`.
    """
    high = np.full(len(low), np.inf)
    at_low = failing(weights, low)
    for m in range(len(low)):
        if weights[m] > 0.0:
            # The other sums are at their minimum, so this sum is as large as possible.
            share = (most - at_low) / weights[m] - math.expm1(-low[m])
            if share < 1.0:
                high[m] = -math.log1p(-max(share, 0.0))
    return high


@part
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


@part
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
        price = plus(relaxed.chord, extra, relaxed.slope)
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
