"""Lagrangian bounds on paths within a limit on risk, and good paths that they find on the way.

Bounds on the cost of a path's completions (Handler and Zang 1980; Beasley and Christofides 1989):
with a price on risk, W(node) is the least sum of tolls, losses and price times risk to come, by
dynamic programming from the goal, from the largest trust `hi` with which a node can be entered;
with less trust it grows by at least `slope` (as in `contact_loss`). (a) At price 0, with the
failure cost of the safest completion. (b) At the price lambda that maximises the bound: a feasible
completion has lambda (r - limit) <= 0; F (1 - exp(-r)), concave, is replaced by its chord over the
r that can still be best, which adds its slope to the price.

Each price has a best path; the feasible one of least cost is known before any label is made.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import PART
from trustbo.planning.search.costs_to_go import (
    LEAST,
    Ahead,
    Bounds,
    EdgeRisk,
    ToGo,
    can_be_feasible,
    joined,
    least_to_come,
    loss_of,
    pass_back,
)
from trustbo.planning.search.layers import Layers

_part = njit(nogil=True, error_model="numpy", **PART)
PRICES = 12
"""Number of prices of risk that are tried."""


class Best(NamedTuple):
    """Best path: flat indices of cells, none if there is no feasible one; cost and lower bound."""

    path: np.ndarray
    cost: float
    bound: float


@_part
def _prices(bounds, risk, on_priced, on_first):
    """Tolls of edges with prices on the priced risk and on that of the first resource."""
    price = bounds.toll.copy()
    for e in range(len(price)):
        b = risk.bound[e]
        price[e] += on_priced * risk.priced[b] + on_first * risk.of_bounds[b, 0]
    return price


@_part
def _root(layers, bounds, to_go):
    """Start node from which the cost to go is least, and that cost."""
    least, at = np.inf, -1
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] + to_go.best[node] < least:
            least, at = bounds.start_cost[length] + to_go.best[node], node
    return least, at


@_part
def _follow(layers, bounds, risk, ahead, to_go, node, cost, path):
    """Follow the best edges to go; write down the path. Return its cost, risks and priced risk."""
    law, x, came = bounds.law, bounds.x0, -1
    total, priced, n = np.zeros(len(risk.limits)), 0.0, layers.left[node]
    if law == LEAST:
        cost = -np.inf
    path[0] = layers.cell[node]
    for k in range(n):
        least, chosen, reached = np.inf, -1, 0.0
        for e in range(layers.first[node], layers.first[node + 1]):
            h, m = layers.head[e], layers.move[e]
            if not layers.u_turns and came >= 0 and m == layers.n_moves - 1 - came:
                continue
            x_e = bounds.beta0 * x + bounds.drift[e]
            to_come = least_to_come(layers, to_go, h, m) + ahead.slope[h] * (ahead.hi[h] - x_e)
            here = joined(law, loss_of(law, x_e, bounds.noise_sd), to_come)
            here = to_go.price[e] + (max(cost, here) if law == LEAST else here)
            if here < least:
                least, chosen, reached = here, e, x_e
        if chosen < 0:
            return np.inf, total, priced, 0
        x, came, node = reached, layers.move[chosen], layers.head[chosen]
        cost = joined(law, cost, loss_of(law, x, bounds.noise_sd)) + bounds.toll[chosen]
        for i in range(len(total)):
            total[i] += risk.of_bounds[risk.bound[chosen], i]
        priced += risk.priced[risk.bound[chosen]]
        path[k + 1] = layers.cell[node]
    return cost, total, priced, n + 1


@_part
def failure(risk: EdgeRisk, total: float) -> float:
    """Cost of the failures of a path whose bounds' risks of the first kind sum to `total`."""
    return -risk.failure_cost * math.expm1(-total) if risk.failure_cost > 0.0 else 0.0


@_part
def lagrangian(
    layers: Layers, bounds: Bounds, risk: EdgeRisk, ahead: Ahead, best: float
) -> tuple[Best, ToGo, ToGo, float, float]:
    """Try prices of risk: the best path known, costs to go at price 0 and at the best price.

    Also what (b) adds to the latter, and the bound on all paths.
    """
    law, F = bounds.law, risk.failure_cost
    path = np.empty(len(layers.starts) + 1, np.int64)
    known = Best(np.empty(0, np.int64), best, best)
    cheap = pass_back(layers, law, ahead, bounds.toll)
    least, _ = _root(layers, bounds, cheap)
    low = np.inf
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            low = min(low, risk.safest[node, 0])
    high = risk.limits[0]
    priced, offset, root = cheap, 0.0, least + failure(risk, low)
    # Local improvement where the price of the first risk is the slope of the failure cost.
    tangent = F * math.exp(-low)
    for _ in range(PRICES if F > 0.0 else 0):
        to_go = pass_back(layers, law, ahead, _prices(bounds, risk, 0.0, tangent))
        _, start = _root(layers, bounds, to_go)
        known, _, first, _, _ = _tried(layers, bounds, risk, ahead, to_go, start, known, path)
        next_tangent = F * math.exp(-first)
        if abs(next_tangent - tangent) <= 1e-9 * F:
            break
        tangent = next_tangent
    for _ in range(2 if F > 0.0 else 1):
        # A better path has at most this much of the first risk.
        if F > 0.0 and known.cost < np.inf:
            share = (known.cost - least) / F
            if share < 1.0:
                high = min(high, -math.log1p(-max(share, 0.0)))
        mu, base = 0.0, failure(risk, low)
        if F > 0.0 and low < high < np.inf:
            mu = F * (math.exp(-low) - math.exp(-high)) / (high - low)
            base = -F * math.expm1(-low) - mu * low
        known, priced, offset, root = _dual(
            layers, bounds, risk, ahead, known, mu, base, priced, offset, root, path
        )
        if root >= known.cost:
            break
    return known, cheap, priced, offset, root


@_part
def _tried(layers, bounds, risk, ahead, to_go, start, known, path):
    """Try the path of some costs to go: the best path known; its cost, risks and if feasible."""
    cost = 0.0
    for length in range(len(layers.starts)):
        if layers.starts[length] == start:
            cost = bounds.start_cost[length]
    cost, total, priced, n = _follow(layers, bounds, risk, ahead, to_go, start, cost, path)
    if n == 0:
        return known, np.inf, np.inf, np.inf, False
    feasible = can_be_feasible(risk, total, 0)  # at the goal
    whole = cost + failure(risk, total[0])
    if feasible and whole < known.cost:
        known = Best(path[:n].copy(), whole, whole)
    return known, cost, total[0], priced, feasible


@_part
def _dual(layers, bounds, risk, ahead, known, mu, base, priced, offset, root, path):
    """Maximise the Lagrangian bound over the price of the limited risk; and see its paths.

    The price is where the lines of the last paths within and beyond the limit meet, or else rises.
    """
    limit, price = risk.priced_limit, 0.0
    within_cost, within_used, beyond_cost, beyond_used = np.inf, np.inf, -np.inf, np.inf
    for _ in range(PRICES if limit < np.inf else 1):
        to_go = pass_back(layers, bounds.law, ahead, _prices(bounds, risk, price, mu))
        least, start = _root(layers, bounds, to_go)
        added = base - price * limit if price > 0.0 else base
        if least + added > root:
            priced, offset, root = to_go, added, least + added
        known, cost, first, used, feasible = _tried(
            layers, bounds, risk, ahead, to_go, start, known, path
        )
        if root >= known.cost or (feasible and price == 0.0):
            break
        if used <= limit and (len(risk.limits) == 1 or feasible):
            if cost + mu * first == within_cost and used == within_used:
                break
            within_cost, within_used = cost + mu * first, used
        else:
            if cost + mu * first == beyond_cost and used == beyond_used and within_used < np.inf:
                break
            beyond_cost, beyond_used = cost + mu * first, used
        price = next_price(price, used - limit, within_cost, within_used, beyond_cost, beyond_used)
        if not price > 0.0:
            break
    return known, priced, offset, root


@_part
def next_price(
    price: float,
    excess: float,
    within_cost: float,
    within_used: float,
    beyond_cost: float,
    beyond_used: float,
) -> float:
    """Price at which the last paths within and beyond a limit are worth the same.

    Higher than `price` where there is no path within; `excess` is what the last one has too much.
    """
    if within_used < beyond_used < np.inf:
        return (within_cost - beyond_cost) / (beyond_used - within_used)
    if price > 0.0:
        return 4.0 * price
    return 1.0 / max(excess, 1e-3) if excess < np.inf else 1.0
