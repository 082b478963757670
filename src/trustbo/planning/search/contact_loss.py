"""Least contact lost where its expectation is no linear function of trust: counts, censored rates.

Method: label setting with dominance over the layered DAG of `layers` (Martins 1984), pruned by a
lower bound on the loss to come and the loss of a known path (branch and bound).

State: node (j, c) as in `layers`; a label there has the trust x of the team, a single number that
follows x -> beta0 x + u, the loss so far, the move by which it came, and its parent. The loss of a
bound is l(x) = 1 - E[rate | x], which falls in x; beta0 >= 0.

Bound: let hi and lo be the largest and least trust with which a node can be entered, m the least
-l'(x) between them (at one of them, as -l' has a single mode). Then the loss of entering the node
at x <= hi and of all that follows is at least

    W + t (hi - x),    W = l(hi) + V,    t = m + s,

where V + s (hi - x) bounds the loss after the node: V is the least of W' + t' (hi' - x') over its
edges, with x' = beta0 hi + u, and s = beta0 times their least t'. By induction from the goal, where
V = s = 0; U-turns are allowed in it, which can only lower it.

Invariant: nodes are processed from the most bounds left to none, so all labels of a node are known.
A label is dropped if it cannot beat the best path known, or if another one at its node has lost no
more and has no less trust. Every completion of it is then one of the other, at no higher loss,
because trust stays ordered (beta0 >= 0) and l falls. Where U-turns are forbidden, the other must
have come by the same move, or there must be two others that came by different moves: a completion
is forbidden to one of them at most.

Exact because the labels that are left include the best path, unless it is the one known.
"""

import math

import numpy as np
from numba import njit

from trustbo.parallel import PART, over_rows
from trustbo.planning.search.layers import Layers
from trustbo.planning.search.room import with_room

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
LOGISTIC, CLIPPED = range(2)
LAWS = {"logistic": LOGISTIC, "clipped": CLIPPED}
"""Expected rates that are not linear in trust; see `Family.expected_rate`."""
TINY_SD = 1e-9
"""Least sd of a rate, instead of 0."""


def least_loss(
    layers: Layers,
    drift: np.ndarray,
    beta0: np.ndarray,
    x0: np.ndarray,
    noise_sd: np.ndarray,
    length_cost: np.ndarray,
    law: int,
    max_labels: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the path of every draw along which the least contact is lost, over all lengths.

    Drift u (draw, move, cell), of one move where all into a cell are alike; beta0, x0 and the sd of
    a rate, (draw,); cost of each move (move,). Returns losses (draw,), inf where there is no path
    and NaN where more than `max_labels` labels are worth keeping; and paths, flat indices of cells,
    (draw, length), filled with -1.
    """
    n_draws = len(drift)
    losses, paths = np.empty(n_draws), np.full((n_draws, len(layers.starts)), -1, np.int32)
    noise_sd = np.maximum(noise_sd, TINY_SD)
    data = [np.ascontiguousarray(values) for values in (drift, beta0, x0, noise_sd)]

    def work(first: int, last: int) -> None:
        u, b0, x, sd = (values[first:last] for values in data)
        found = losses[first:last], paths[first:last]
        _least_losses(layers, u, b0, x, sd, length_cost, law, max_labels, *found)

    over_rows(work, n_draws) if n_draws > 1 else work(0, 1)
    return losses, paths


@_part
def expected_loss(law: int, x: float, sd: float) -> float:
    """1 - E[rate] of a bound with trust x: `Family.rate_moments`, one number at a time."""
    if law == LOGISTIC:
        return 1.0 / (1.0 + math.exp(x)) if x < 700.0 else 0.0
    low, high = -x / sd, (1.0 - x) / sd
    below, above = _normal_cdf(low), _normal_cdf(-high)
    mean = x * (1.0 - below - above) + sd * (_normal_pdf(low) - _normal_pdf(high)) + above
    return 1.0 - mean


@_part
def least_slope(law: int, lo: float, hi: float, sd: float) -> float:
    """Least fall of the expected loss with trust, between lo and hi."""
    middle = 0.0 if law == LOGISTIC else 0.5
    x = lo if middle - lo > hi - middle else hi
    if law == LOGISTIC:
        p = expected_loss(law, x, sd)
        return p * (1.0 - p)
    return max(0.0, 1.0 - _normal_cdf(-x / sd) - _normal_cdf((x - 1.0) / sd))


@_part
def _normal_cdf(z):
    return 0.5 * math.erfc(-z * math.sqrt(0.5))


@_part
def _normal_pdf(z):
    return math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)


@_compiled
def _least_losses(layers, drift, beta0, x0, noise_sd, length_cost, law, max_labels, losses, paths):
    n_nodes = len(layers.cell)
    # Of a node: largest and least trust, W and t of the bound, and its last label.
    hi, lo, W, t = np.empty(n_nodes), np.empty(n_nodes), np.empty(n_nodes), np.empty(n_nodes)
    heads = np.empty(n_nodes, np.int64)
    for d in range(len(drift)):
        u, b0, x, sd, best = drift[d], beta0[d], x0[d], noise_sd[d], np.inf
        _ranges(layers, u, b0, x, hi, lo)
        _bounds(layers, u, b0, hi, lo, length_cost, law, sd, W, t)
        for start in layers.starts:
            if start >= 0:
                best = _follow_bound(
                    layers, u, b0, x, hi, W, t, length_cost, law, sd, start, best, paths[d]
                )
        labels, found, losses[d] = _search(
            layers, u, b0, x, hi, W, t, length_cost, law, sd, best, max_labels, heads
        )
        if found >= 0:
            _write_path(layers, labels, found, paths[d])


@_part
def _search(layers, u, beta0, x0, hi, W, t, length_cost, law, sd, best, max_labels, heads):
    """Find a path that loses less than `best`: all labels, its last label or -1, and its loss."""
    # Of a label: node, move by which it came, parent, next label of the node; trust and loss.
    labels, state = np.empty((512, 4), np.int64), np.empty((512, 2))
    heads[:] = -1
    n, found = np.int64(0), np.int64(-1)  # not literals, for which callees are compiled again
    for start in layers.starts:
        if start >= 0:
            labels, state = with_room(labels, n + 1), with_room(state, n + 1)
            labels[n, 0], labels[n, 1], labels[n, 2], labels[n, 3] = start, -1, -1, -1
            state[n, 0], state[n, 1], heads[start] = x0, 0.0, n
            n += 1
    for node in range(len(heads) - 1, -1, -1):
        label = heads[node]
        while label >= 0:
            if layers.left[node] == 0 and state[label, 1] < best:
                best, found = state[label, 1], label
            if not _is_dominated(labels, state, heads[node], label, layers.u_turns):
                if n + layers.n_moves > len(state):
                    if len(state) >= max_labels:
                        return labels, -1, np.nan
                    labels = with_room(labels, n + layers.n_moves)
                    state = with_room(state, n + layers.n_moves)
                n = _extend(
                    layers, u, beta0, hi, W, t, length_cost, law, sd, best, label, labels, state,
                    heads, n,
                )  # fmt: skip
            label = labels[label, 3]
    return labels, found, best


@_part
def _extend(layers, u, beta0, hi, W, t, length_cost, law, sd, best, label, labels, state, heads, n):
    """Add the labels of one more bound that may lead to less than `best`; their number so far."""
    node, came, x, loss = labels[label, 0], labels[label, 1], state[label, 0], state[label, 1]
    for e in range(layers.first[node], layers.first[node + 1]):
        h, m = layers.head[e], layers.move[e]
        if not layers.u_turns and came >= 0 and m == layers.n_moves - 1 - came:
            continue
        after = beta0 * x + u[m if len(u) > 1 else 0, layers.cell[h]]
        so_far = loss + length_cost[m]
        if so_far + W[h] + t[h] * (hi[h] - after) >= best:
            continue
        labels[n, 0], labels[n, 1], labels[n, 2], labels[n, 3] = h, m, label, heads[h]
        state[n, 0], state[n, 1] = after, so_far + expected_loss(law, after, sd)
        heads[h] = n
        n += 1
    return n


@_part
def _write_path(layers, labels, label, path):
    """Write down the path of a label at the goal."""
    k, first = 0, label
    while labels[first, 2] >= 0:
        k, first = k + 1, labels[first, 2]
    path[k + 1 :] = -1
    for i in range(k, -1, -1):
        path[i] = layers.cell[labels[label, 0]]
        label = labels[label, 2]


@_part
def _ranges(layers, u, beta0, x0, hi, lo):
    """Compute the largest and least trust with which each node can be entered."""
    hi[:], lo[:] = -np.inf, np.inf
    for start in layers.starts:
        if start >= 0:
            hi[start] = lo[start] = x0
    for node in range(len(hi) - 1, -1, -1):
        for e in range(layers.first[node], layers.first[node + 1]):
            h = layers.head[e]
            step = u[layers.move[e] if len(u) > 1 else 0, layers.cell[h]]
            hi[h] = max(hi[h], beta0 * hi[node] + step)
            lo[h] = min(lo[h], beta0 * lo[node] + step)


@_part
def _bounds(layers, u, beta0, hi, lo, length_cost, law, sd, W, t):
    """Compute W and t of each node, from the goal on."""
    for node in range(len(hi)):
        V = s = 0.0 if layers.left[node] == 0 else np.inf
        for e in range(layers.first[node], layers.first[node + 1]):
            h, m = layers.head[e], layers.move[e]
            if W[h] < np.inf:
                after = beta0 * hi[node] + u[m if len(u) > 1 else 0, layers.cell[h]]
                V = min(V, W[h] + t[h] * (hi[h] - after) + length_cost[m])
                s = min(s, beta0 * t[h])
        if V == np.inf or hi[node] == -np.inf:  # on no path
            W[node], t[node] = np.inf, 0.0
            continue
        W[node] = expected_loss(law, hi[node], sd) + V
        t[node] = least_slope(law, lo[node], hi[node], sd) + s


@_part
def _follow_bound(layers, u, beta0, x, hi, W, t, length_cost, law, sd, node, best, path):
    """Follow the bound's best edges; write the path down if it loses less than `best`."""
    start, loss, came, n = node, 0.0, -1, layers.left[node]
    edges = np.empty(n, np.int64)
    for k in range(n):
        least, chosen, reached = np.inf, -1, 0.0
        for e in range(layers.first[node], layers.first[node + 1]):
            h, m = layers.head[e], layers.move[e]
            if not layers.u_turns and came >= 0 and m == layers.n_moves - 1 - came:
                continue
            after = beta0 * x + u[m if len(u) > 1 else 0, layers.cell[h]]
            ahead = W[h] + t[h] * (hi[h] - after) + length_cost[m]
            if ahead < least:
                least, chosen, reached = ahead, e, after
        if chosen < 0:
            return best
        x, came, node, edges[k] = reached, layers.move[chosen], layers.head[chosen], chosen
        loss += expected_loss(law, x, sd) + length_cost[came]
        if loss >= best:
            return best
    path[0], path[n + 1 :] = layers.cell[start], -1
    for k in range(n):
        path[k + 1] = layers.cell[layers.head[edges[k]]]
    return loss


@_part
def _is_dominated(labels, state, other, label, u_turns):
    """True if labels of the same node have all the completions of one, at no higher loss."""
    x, loss, came = state[label, 0], state[label, 1], labels[label, 1]
    by = -1
    while other >= 0:
        if other != label and state[other, 1] <= loss and state[other, 0] >= x:
            # Of two that are equal, the earlier one stays.
            equal = state[other, 1] == loss and state[other, 0] == x
            if not equal or other < label:
                if u_turns or labels[other, 1] == came:
                    return True
                if by >= 0 and labels[other, 1] != by:
                    return True
                by = labels[other, 1]
        other = labels[other, 3]
    return False
