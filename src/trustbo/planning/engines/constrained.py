"""Best path within a limit on risk, or with a cost of failure: scalar trust, or sums over bounds.

Method: label setting with dominance for the resource-constrained shortest path over the layered DAG
of `layers` (Martins 1984; Irnich and Desaulniers 2005), pruned by Lagrangian bounds (Handler and
Zang 1980; Beasley and Christofides 1989).

State: node (j, c) as in `layers`; a label there has its cost so far, the trust x of the team, which
follows x -> beta0 x + u, and the sums r of its bounds' risks -log(1 - p), one for each resource. A
bound costs its toll and a loss l(x) that falls in x; `NONE` has no loss and needs no trust, `LEAST`
takes the largest loss instead of the sum. A path is feasible if enough of its r are within their
limits, and costs a failure cost F times 1 - exp(-r) of the first resource besides.

Bounds on the cost of a label's completions, which let it be dropped if it cannot beat the best
path known: with a price on risk, W(node) is the least sum of tolls, losses and price times risk to
come, by dynamic programming from the goal, from the largest trust `hi` with which a node can be
entered; with less trust it grows by at least `slope` (as in `contact_loss`). (a) At price 0, with
the failure cost of the safest completion. (b) At the price lambda that maximises the bound: a
feasible completion has lambda (r - limit) <= 0; F (1 - exp(-r)), concave, is replaced by its chord
over the r that can still be best, which adds its slope to the price. A label is dropped too if the
safest completion, resource by resource, exceeds the limits.

Invariant: nodes are processed from the most bounds left to none, so all labels of a node are known.
A label is dropped if another one at its node costs no more, has no less trust and no more of every
risk that it could still keep within its limit. Where U-turns are forbidden, the other must have
come by the same move, or there must be two of these that came by different moves.

With `LEAST` a path is sought whose every loss is below an aim: the cost so far does not matter then
to what dominates, and the aim halves the interval between the bound and the best path known.

Exact because the labels that are left include the best path, unless it is the one known. Beyond
`max_labels` the best path known is returned, with the Lagrangian bound.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import PART
from trustbo.planning.engines.contact_loss import expected_loss, least_slope
from trustbo.planning.engines.layers import Layers

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
SOFTPLUS, LEAST, NONE = range(2, 5)
"""Losses beside those of `contact_loss`: -log sigma(x); the largest -x; and none."""
PRICES = 12
"""Number of prices of risk that are tried."""
_AIMS = 100
"""Number of costs that `LEAST` aims at."""


class Bounds(NamedTuple):
    """Costs of the edges of the DAG, under one draw."""

    toll: np.ndarray  # (edge,)
    drift: np.ndarray  # (edge,)
    start_cost: np.ndarray  # (length,), of a path by its number of bounds; inf: not admissible
    beta0: float
    x0: float
    noise_sd: float
    law: int


class EdgeRisk(NamedTuple):
    """Risk of the edges, and the least to come."""

    of_bounds: np.ndarray  # (bound, resource)
    bound: np.ndarray  # (edge,), index of its bound
    priced: np.ndarray  # (bound,), a sum that no feasible path has above
    priced_limit: float
    limits: np.ndarray  # (resource,)
    needed: int
    failure_cost: float
    safest: np.ndarray  # (node, resource), least sums from a node to the goal


class Best(NamedTuple):
    """Best path: flat indices of cells, none if there is no feasible one; cost and lower bound."""

    path: np.ndarray
    cost: float
    bound: float


class _Ahead(NamedTuple):
    """Trust with which nodes can be entered, and what its lack costs at least."""

    hi: np.ndarray  # (node,)
    slope: np.ndarray  # (node,), of the losses after the node
    after: np.ndarray  # (edge,), trust after the edge from `hi`
    loss: np.ndarray  # (edge,), its loss


class _ToGo(NamedTuple):
    """Least cost from each node to the goal at some price, (node,)."""

    price: np.ndarray  # (edge,), toll with the price of risk
    best: np.ndarray
    second: np.ndarray  # by another first move than that of `best`
    by: np.ndarray  # first move of `best`, -1 at the goal


@_compiled
def safest_to_go(layers: Layers, of_bounds: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Least sum of each risk (bound, resource) from each node to the goal, (node, resource)."""
    n_nodes, n_risks = len(layers.cell), of_bounds.shape[1]
    safest = np.empty((n_nodes, n_risks))
    for node in range(n_nodes):
        for k in range(n_risks):
            safest[node, k] = 0.0 if layers.left[node] == 0 else np.inf
        for e in range(layers.first[node], layers.first[node + 1]):
            h, b = layers.head[e], bound[e]
            for k in range(n_risks):
                safest[node, k] = min(safest[node, k], of_bounds[b, k] + safest[h, k])
    return safest


@_compiled
def best_within(
    layers: Layers, bounds: Bounds, risk: EdgeRisk, best: float, max_labels: int
) -> Best:
    """Find the feasible path of least cost; no path if none costs less than `best`."""
    none = np.empty(0, np.int64)
    if not _any_start(layers, bounds, risk):
        return Best(none, np.inf, np.inf)
    ahead = _look_ahead(layers, bounds)
    known, cheap, priced, offset, root = _lagrangian(layers, bounds, risk, ahead, best)
    if root >= known.cost:
        return known
    aim, complete = known.cost, True
    for _ in range(_AIMS if bounds.law == LEAST else 1):
        path, cost, complete = _search(
            layers, bounds, risk, ahead, cheap, priced, offset, aim, max_labels
        )
        if len(path) > 0:
            known = Best(path, cost, root)
            aim = 0.5 * (root + cost)
        elif not complete or aim == known.cost:
            break
        else:
            root, aim = aim, known.cost
    proven = complete and (bounds.law != LEAST or aim == known.cost or root >= known.cost)
    return Best(known.path, known.cost, known.cost if proven else root)


@_part
def _any_start(layers, bounds, risk):
    """Whether the safest path, resource by resource, could be feasible."""
    nothing = np.zeros(len(risk.limits))
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            if _can_be_feasible(risk, nothing, node):
                return True
    return False


@_part
def _can_be_feasible(risk, so_far, node):
    """Whether enough risks, summed up to a node, can stay within their limits."""
    within = 0
    for k in range(len(risk.limits)):
        if so_far[k] + risk.safest[node, k] <= risk.limits[k]:
            within += 1
    return within >= risk.needed


@_part
def _loss(law, x, sd):
    if law == NONE:
        return 0.0
    if law == LEAST:
        return -x
    if law == SOFTPLUS:
        return max(-x, 0.0) + math.log1p(math.exp(-abs(x)))
    return expected_loss(law, x, sd)


@_part
def _slope(law, lo, hi, sd):
    """Least fall of the loss with trust, between lo and hi."""
    if law == NONE or law == LEAST:
        return 0.0
    if law == SOFTPLUS:
        return 1.0 / (1.0 + math.exp(hi)) if hi < 700.0 else 0.0
    return least_slope(law, lo, hi, sd)


@_part
def _joined(law, loss, to_come):
    return max(loss, to_come) if law == LEAST else loss + to_come


@_part
def _look_ahead(layers, bounds):
    """Trust at the nodes, from the start on, then what its lack costs, from the goal on."""
    n_nodes, n_edges, law = len(layers.cell), len(layers.head), bounds.law
    hi, lo, slope = np.full(n_nodes, -np.inf), np.full(n_nodes, np.inf), np.zeros(n_nodes)
    after, loss = np.zeros(n_edges), np.zeros(n_edges)
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            hi[node] = lo[node] = bounds.x0
    for node in range(n_nodes - 1, -1, -1):
        if hi[node] == -np.inf:  # on no path
            continue
        for e in range(layers.first[node], layers.first[node + 1]):
            h = layers.head[e]
            after[e] = bounds.beta0 * hi[node] + bounds.drift[e]
            loss[e] = _loss(law, after[e], bounds.noise_sd)
            hi[h] = max(hi[h], after[e])
            lo[h] = min(lo[h], bounds.beta0 * lo[node] + bounds.drift[e])
    if law != NONE and law != LEAST:
        own = np.zeros(n_nodes)
        for node in range(n_nodes):
            if hi[node] == -np.inf:
                continue
            own[node] = _slope(law, lo[node], hi[node], bounds.noise_sd)
            least = 0.0 if layers.left[node] == 0 else np.inf
            for e in range(layers.first[node], layers.first[node + 1]):
                h = layers.head[e]
                least = min(least, own[h] + slope[h])
            slope[node] = bounds.beta0 * least if least < np.inf else 0.0
    return _Ahead(hi, slope, after, loss)


@_part
def _pass_back(layers, law, ahead, price):
    """Compute the least cost to go of every node at a price, in the order of the bounds left."""
    n_nodes = len(layers.cell)
    to_go = _ToGo(
        price, np.full(n_nodes, np.inf), np.full(n_nodes, np.inf), np.full(n_nodes, -1, np.int8)
    )
    for node in range(n_nodes):
        if layers.left[node] == 0:
            to_go.best[node] = to_go.second[node] = -np.inf if law == LEAST else 0.0
            continue
        if ahead.hi[node] == -np.inf:
            continue
        for e in range(layers.first[node], layers.first[node + 1]):
            h, m = layers.head[e], layers.move[e]
            to_come = _to_come(layers, to_go, h, m) + ahead.slope[h] * (
                ahead.hi[h] - ahead.after[e]
            )
            total = price[e] + _joined(law, ahead.loss[e], to_come)
            if total < to_go.best[node]:
                to_go.second[node] = to_go.best[node]
                to_go.best[node], to_go.by[node] = total, m
            elif total < to_go.second[node]:
                to_go.second[node] = total
    return to_go


@_part
def _to_come(layers, to_go, node, move):
    """Least cost after a node that was entered by a move, from the largest trust."""
    if layers.u_turns or to_go.by[node] != layers.n_moves - 1 - move:
        return to_go.best[node]
    return to_go.second[node]


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
            to_come = _to_come(layers, to_go, h, m) + ahead.slope[h] * (ahead.hi[h] - x_e)
            here = _joined(law, _loss(law, x_e, bounds.noise_sd), to_come)
            here = to_go.price[e] + (max(cost, here) if law == LEAST else here)
            if here < least:
                least, chosen, reached = here, e, x_e
        if chosen < 0:
            return np.inf, total, priced, 0
        x, came, node = reached, layers.move[chosen], layers.head[chosen]
        cost = _joined(law, cost, _loss(law, x, bounds.noise_sd)) + bounds.toll[chosen]
        for i in range(len(total)):
            total[i] += risk.of_bounds[risk.bound[chosen], i]
        priced += risk.priced[risk.bound[chosen]]
        path[k + 1] = layers.cell[node]
    return cost, total, priced, n + 1


@_part
def _failure(risk, total):
    return -risk.failure_cost * math.expm1(-total) if risk.failure_cost > 0.0 else 0.0


@_part
def _lagrangian(layers, bounds, risk, ahead, best):
    """Try prices of risk: the best path known, costs to go at price 0 and at the best price.

    Also what (b) adds to the latter, and the bound on all paths.
    """
    law, F = bounds.law, risk.failure_cost
    path = np.empty(len(layers.starts) + 1, np.int64)
    known = Best(np.empty(0, np.int64), best, best)
    cheap = _pass_back(layers, law, ahead, bounds.toll)
    least, _ = _root(layers, bounds, cheap)
    low = np.inf
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            low = min(low, risk.safest[node, 0])
    high = risk.limits[0]
    priced, offset, root = cheap, 0.0, least + _failure(risk, low)
    # Local improvement where the price of the first risk is the slope of the failure cost.
    tangent = F * math.exp(-low)
    for _ in range(PRICES if F > 0.0 else 0):
        to_go = _pass_back(layers, law, ahead, _prices(bounds, risk, 0.0, tangent))
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
        mu, base = 0.0, _failure(risk, low)
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
    feasible = _can_be_feasible(risk, total, 0)  # at the goal
    whole = cost + _failure(risk, total[0])
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
        to_go = _pass_back(layers, bounds.law, ahead, _prices(bounds, risk, price, mu))
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


class _Labels(NamedTuple):
    """Labels: node, move by which it came, parent, next of the node; cost, trust, priced; risks."""

    link: np.ndarray  # (label, 4)
    state: np.ndarray  # (label, 3)
    risk: np.ndarray  # (label, resource)


@_part
def _search(layers, bounds, risk, ahead, cheap, priced, offset, best, max_labels):
    """Find a path that costs less than `best`, empty if none; its cost, and if all was seen."""
    n_risks, law = len(risk.limits), bounds.law
    labels = _Labels(np.empty((256, 4), np.int64), np.empty((256, 3)), np.zeros((256, n_risks)))
    heads = np.full(len(layers.cell), -1, np.int64)
    n, found = np.int64(0), np.int64(-1)  # not literals, for which callees are compiled again
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            first = -np.inf if law == LEAST else bounds.start_cost[length]
            link, state = labels.link[n], labels.state[n]
            link[0], link[1], link[2], link[3] = node, -1, -1, -1
            state[0], state[1], state[2] = first, bounds.x0, 0.0
            heads[node] = n
            n += 1
    of_risk = priced.price - bounds.toll
    for node in range(len(heads) - 1, -1, -1):
        label = heads[node]
        while label >= 0:
            if layers.left[node] == 0:
                cost = labels.state[label, 0] + _failure(risk, labels.risk[label, 0])
                if cost < best:
                    best, found = cost, label
            elif not _is_dominated(layers, risk, labels, heads[node], label, law):
                if n + layers.n_moves > len(labels.state):
                    if n >= max_labels:
                        return _path_of(layers, labels, found), best, False
                    labels = _Labels(
                        np.concatenate((labels.link, labels.link)),
                        np.concatenate((labels.state, labels.state)),
                        np.concatenate((labels.risk, labels.risk)),
                    )
                n = _extend(
                    layers, bounds, risk, ahead, cheap, priced, of_risk, offset, best, label,
                    labels, heads, n,
                )  # fmt: skip
            label = labels.link[label, 3]
    return _path_of(layers, labels, found), best, True


@_part
def _extend(
    layers, bounds, risk, ahead, cheap, priced, of_risk, offset, best, label, labels, heads, n
):
    """Add the labels of one more bound that may lead to less than `best`; their number so far."""
    law, node, came = bounds.law, labels.link[label, 0], labels.link[label, 1]
    cost, x, so_far = labels.state[label]
    for e in range(layers.first[node], layers.first[node + 1]):
        h, m, b = layers.head[e], layers.move[e], risk.bound[e]
        if not layers.u_turns and came >= 0 and m == layers.n_moves - 1 - came:
            continue
        for k in range(len(risk.limits)):
            labels.risk[n, k] = labels.risk[label, k] + risk.of_bounds[b, k]
        if not _can_be_feasible(risk, labels.risk[n], h):
            continue
        after = bounds.beta0 * x + bounds.drift[e]
        now = _joined(law, cost, _loss(law, after, bounds.noise_sd)) + bounds.toll[e]
        lack = ahead.slope[h] * (ahead.hi[h] - after)
        least = _joined(law, now, _to_come(layers, cheap, h, m) + lack)
        if least + _failure(risk, labels.risk[n, 0] + risk.safest[h, 0]) >= best:
            continue
        paid = so_far + of_risk[e]
        least = _joined(law, now, _to_come(layers, priced, h, m) + lack)
        if least + paid + offset >= best:
            continue
        link, state = labels.link[n], labels.state[n]
        link[0], link[1], link[2], link[3] = h, m, label, heads[h]
        state[0], state[1], state[2] = now, after, paid
        heads[h] = n
        n += 1
    return n


@_part
def _is_dominated(layers, risk, labels, other, label, law):
    """True if labels of the same node have all the completions of one, at no higher cost."""
    came, by = labels.link[label, 1], -1
    while other >= 0:
        if other != label:
            verdict = _covers(risk, labels, other, label, labels.link[label, 0], law)
            # Of two that are equal, the earlier one stays.
            if verdict == 2 or (verdict == 1 and other < label):
                if layers.u_turns or labels.link[other, 1] == came:
                    return True
                if by >= 0 and labels.link[other, 1] != by:
                    return True
                by = labels.link[other, 1]
        other = labels.link[other, 3]
    return False


@_part
def _covers(risk, labels, a, b, node, law):
    """2 if label a is better than b, 1 if it is equal, in all that matters; else 0."""
    cost_a, x_a, _ = labels.state[a]
    cost_b, x_b, _ = labels.state[b]
    if law == LEAST:
        cost_a = cost_b
    if cost_a > cost_b or (law != NONE and x_a < x_b):
        return 0
    equal = cost_a == cost_b and (law == NONE or x_a == x_b)
    for k in range(len(risk.limits)):
        r_a, r_b = labels.risk[a, k], labels.risk[b, k]
        if risk.limits[k] < np.inf:  # a limit that is exceeded anyway matters no more
            most = risk.limits[k] - risk.safest[node, k]
            r_a, r_b = r_a if r_a <= most else np.inf, r_b if r_b <= most else np.inf
        if r_a > r_b:
            return 0
        equal = equal and r_a == r_b
    return 1 if equal else 2


@_part
def _path_of(layers, labels, label):
    """Cells of the path of a label; none for label -1."""
    n, at = 0, label
    while at >= 0:
        n, at = n + 1, labels.link[at, 2]
    path = np.empty(n, np.int64)
    for k in range(n - 1, -1, -1):
        path[k] = layers.cell[labels.link[label, 0]]
        label = labels.link[label, 2]
    return path
