"""Best path within a limit on risk, or with a cost of failure: scalar trust, or sums over bounds.

Method: label setting with dominance for the resource-constrained shortest path over the layered DAG
of `layers` (Martins 1984; Irnich and Desaulniers 2005), pruned by Lagrangian bounds (Handler and
Zang 1980; Beasley and Christofides 1989).

State: node (j, c) as in `layers`; a label there has its cost so far, the trust x of the team, which
follows x -> beta0 x + u, and the sums r of its bounds' risks -log(1 - p), one for each resource. A
bound costs its toll and a loss l(x) that falls in x; `NONE` has no loss and needs no trust, `LEAST`
takes the largest loss instead of the sum. A path is feasible if enough of its r are within their
limits, and costs a failure cost F times 1 - exp(-r) of the first resource besides.

A label is dropped if its cost with a bound on that of its completions, (a) or (b) of `dual`,
cannot beat the best path known, or if the safest completion, resource by resource, exceeds the
limits.

Invariant: nodes are processed from the most bounds left to none, so all labels of a node are known.
A label is dropped if another one at its node costs no more, has no less trust and no more of every
risk that it could still keep within its limit. Where U-turns are forbidden, the other must have
come by the same move, or there must be two of these that came by different moves.

With `LEAST` a path is sought whose every loss is below an aim: the cost so far does not matter then
to what dominates, labels with less trust than every completion needs are dropped, and the safest
completion is that over edges which the largest trust can take. The lower the aim, the fewer labels:
it rises from the bound until there is a path, then halves the interval between both.

Exact because the labels that are left include the best path, unless it is the one known. Beyond
`max_labels` the best path known is returned, with the Lagrangian bound.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import PART
from trustbo.planning.search.costs_to_go import (
    LEAST,
    NONE,
    Bounds,
    EdgeRisk,
    any_start,
    can_be_feasible,
    joined,
    least_to_come,
    least_trust,
    look_ahead,
    loss_of,
    with_safest,
)
from trustbo.planning.search.dual import Best, failure, lagrangian
from trustbo.planning.search.layers import Layers
from trustbo.planning.search.room import with_room

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
_AIMS = 100
"""Number of costs that `LEAST` aims at."""


@_compiled
def best_within(
    layers: Layers, bounds: Bounds, risk: EdgeRisk, best: float, max_labels: int
) -> Best:
    """Find the feasible path of least cost; no path if none costs less than `best`."""
    none = np.empty(0, np.int64)
    if not any_start(layers, bounds, risk):
        return Best(none, np.inf, np.inf)
    ahead = look_ahead(layers, bounds)
    known, cheap, priced, offset, root = lagrangian(layers, bounds, risk, ahead, best)
    if root >= known.cost:
        return known
    aim, complete, need = known.cost, True, np.full(len(layers.cell), -np.inf)
    gap = known.cost - root if known.cost < np.inf else 1.0
    step = gap / 32.0
    if bounds.law == LEAST:
        aim = root + step
    for _ in range(_AIMS if bounds.law == LEAST else 1):
        if bounds.law == LEAST:
            need = least_trust(layers, bounds, aim)
            risk = with_safest(layers, bounds, risk, need)
        path, cost, complete = _search(
            layers, bounds, risk, ahead, need, cheap, priced, offset, aim, max_labels
        )
        if len(path) > 0:
            known = Best(path, cost, root)
            aim, step = 0.5 * (root + cost), np.inf
        elif not complete or aim == known.cost:
            break
        else:
            step = 1.1 * step if step < 0.25 * gap else np.inf
            root, aim = aim, min(aim + step, known.cost)
    proven = complete and (bounds.law != LEAST or aim == known.cost or root >= known.cost)
    return Best(known.path, known.cost, known.cost if proven else root)


class _Labels(NamedTuple):
    """Labels: node, move by which it came, parent, next of the node; cost, trust, priced; risks."""

    link: np.ndarray  # (label, 4)
    state: np.ndarray  # (label, 3)
    risk: np.ndarray  # (label, resource)


@_part
def _search(layers, bounds, risk, ahead, need, cheap, priced, offset, best, max_labels):
    """Find a path that costs less than `best`, empty if none; its cost, and if all was seen."""
    n_risks, law = len(risk.limits), bounds.law
    labels = _Labels(np.empty((256, 4), np.int64), np.empty((256, 3)), np.zeros((256, n_risks)))
    heads = np.full(len(layers.cell), -1, np.int64)
    n, found = np.int64(0), np.int64(-1)  # not literals, for which callees are compiled again
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            labels = _with_room(labels, n + 1)
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
                cost = labels.state[label, 0] + failure(risk, labels.risk[label, 0])
                if cost < best:
                    best, found = cost, label
            elif not _is_dominated(layers, risk, labels, heads[node], label, law):
                if n + layers.n_moves > len(labels.state):
                    if n >= max_labels:
                        return _path_of(layers, labels, found), best, False
                    labels = _with_room(labels, n + layers.n_moves)
                n = _extend(
                    layers, bounds, risk, ahead, need, cheap, priced, of_risk, offset, best, label,
                    labels, heads, n,
                )  # fmt: skip
            label = labels.link[label, 3]
    return _path_of(layers, labels, found), best, True


@_part
def _with_room(labels, n):
    """Labels with room for `n` of them."""
    return _Labels(with_room(labels.link, n), with_room(labels.state, n), with_room(labels.risk, n))


@_part
def _extend(
    layers, bounds, risk, ahead, need, cheap, priced, of_risk, offset, best, label, labels, heads, n
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
        if not can_be_feasible(risk, labels.risk[n], h):
            continue
        after = bounds.beta0 * x + bounds.drift[e]
        if after < need[h]:
            continue
        now = joined(law, cost, loss_of(law, after, bounds.noise_sd)) + bounds.toll[e]
        lack = ahead.slope[h] * (ahead.hi[h] - after)
        least = joined(law, now, least_to_come(layers, cheap, h, m) + lack)
        if least + failure(risk, labels.risk[n, 0] + risk.safest[h, 0]) >= best:
            continue
        paid = so_far + of_risk[e]
        least = joined(law, now, least_to_come(layers, priced, h, m) + lack)
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
