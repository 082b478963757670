"""Longest path in a layered DAG: `terminal`, `mean`, `lost_contact` of a scalar view of trust.

Method: dynamic programming backwards over the time-expanded graph (Bellman 1958; Ahuja, Magnanti
and Orlin 1993, chapter 4), for all admissible lengths in one pass.

Unrolled, x^K = B0^K x^0 + sum_k B0^{K-k} u(bound k). With j = K - k bounds left after a bound, it
adds w_j . u to the value, w_j = view . B0^j for `terminal` and the sum of these up to j for `mean`
and `lost_contact`: a weight that depends on j alone, not on the path nor on its length K.

State: node (j, c), if the goal can be reached from c in j bounds and c from the start in at most
`longest` - j. Edges lead from (j, c) to (j - 1, c') for each move c -> c'. The goal is node j = 0.

Invariant: nodes are processed in the order of j, so the best sums of all heads of a node's edges
are final. Where U-turns are forbidden, each node holds the best sum and the best by another first
move: a predecessor excludes one first move at most, the one back to itself.

Exact because the value is a sum of edge weights in a DAG, of either sign. The length K is then
chosen by the start's nodes: (constant_K + sum) / scale_K.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import over_rows
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.search.graph import Graph

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_inlined = njit(nogil=True, error_model="numpy", inline="always")  # see README


@_compiled
def build_layers(to_goal, from_start, steps, longest, u_turns) -> Graph:
    """Unroll a grid over the bounds left, for paths of at most `longest` bounds.

    Fewest bounds `to_goal` and `from_start`, (row, col), -1 where there is no way; moves `steps`
    (move, 2), each the reverse of the one as far from the other end. With `u_turns` a bound may
    lead back to the cell that the last one left.
    """
    rows, cols = to_goal.shape
    # base: number of nodes of earlier cells; the goal is entered by the last bound only.
    base, place = np.empty(rows * cols + 1, np.int64), np.empty(longest + 2, np.int64)
    base[0] = start = 0
    for k in range(longest + 2):
        place[k] = 0
    for c in range(rows * cols):
        near, far = to_goal[c // cols, c % cols], from_start[c // cols, c % cols]
        n = 0
        if near >= 0 and far >= 0:
            n = 1 if near == 0 else max(0, longest - far - near + 1)
        if far == 0:
            start = c
        base[c + 1] = base[c] + n
        for k in range(n):
            place[near + k + 1] += 1
    for k in range(longest + 1):  # from the numbers of nodes by bounds left to the first of each
        place[k + 1] += place[k]
    n_nodes = base[rows * cols]
    node_of = np.empty(n_nodes, np.int32)  # in the order of cells, then of bounds left
    cell, left = np.empty(n_nodes, np.int32), np.empty(n_nodes, np.int32)
    for c in range(rows * cols):
        near = to_goal[c // cols, c % cols]
        for k in range(base[c + 1] - base[c]):
            node = place[near + k]
            place[near + k] += 1
            node_of[base[c] + k] = node
            cell[node], left[node] = c, near + k
    first = np.empty(n_nodes + 1, np.int64)
    head, move, bound = np.empty(0, np.int32), np.empty(0, np.int8), np.empty(0, np.int32)
    for fill in range(2):  # first count, then write
        n = 0
        for node in range(n_nodes):
            first[node] = n
            c = cell[node]
            for m in range(len(steps) if left[node] > 0 else 0):
                i, j = c // cols + steps[m, 0], c % cols + steps[m, 1]
                if not (0 <= i < rows and 0 <= j < cols):
                    continue
                b = i * cols + j
                k = left[node] - 1 - to_goal[i, j]
                if to_goal[i, j] >= 0 and 0 <= k < base[b + 1] - base[b]:
                    if fill == 1:
                        head[n], move[n] = node_of[base[b] + k], m
                        bound[n] = m * rows * cols + b
                    n += 1
        first[n_nodes] = n
        if fill == 0:
            head, move, bound = np.empty(n, np.int32), np.empty(n, np.int8), np.empty(n, np.int32)
    starts = np.empty(longest + 1, np.int64)
    near = to_goal[start // cols, start % cols]
    for length in range(longest + 1):
        k = length - near
        starts[length] = node_of[base[start] + k] if 0 <= k < base[start + 1] - base[start] else -1
    return Graph(first, head, left, cell, move, bound, starts, len(steps), u_turns, True)


class Weights(NamedTuple):
    """Weights of u in a path's score by the bounds left; leading axis (draw,)."""

    per_bound: np.ndarray  # (draw, left, state)
    constant: np.ndarray  # (draw, length)
    scale: np.ndarray  # (length,), divisor of a path's sum


def additive_weights(
    dynamics: Dynamics, view: np.ndarray, objective: Objective, longest: int
) -> Weights:
    """Compute the weights of an additive objective for one view (state,) of the states.

    terminal: view . x^K = view . B0^K x0 + sum_j (view . B0^j) . u, with j bounds left. mean: the
    average of view . x^k over k = 1..K. lost_contact: their sum less K. For dynamics with a leading
    axis (draw,), up to `longest` bounds.
    """
    n_draws, n_states = dynamics.start.shape
    powers = np.empty((n_draws, longest + 1, n_states))
    powers[:, 0] = view
    for j in range(longest):
        powers[:, j + 1] = (powers[:, j, None, :] @ dynamics.transition)[:, 0]
    constant = (powers @ dynamics.start[..., None])[..., 0]
    scale = np.ones(longest + 1)
    n_bounds = np.arange(longest + 1.0)
    if objective.name in ("mean", "lost_contact"):
        constant[:, 0] = 0.0
        constant = constant.cumsum(1)
        powers = powers.cumsum(1)
    if objective.name == "lost_contact":
        constant = constant - n_bounds
    elif objective.name == "mean":
        scale = np.maximum(1.0, n_bounds)
    return Weights(powers, constant, scale)


def best_additive(
    layers: Graph,
    drift: np.ndarray,
    weights: Weights,
    tolls: np.ndarray,
    lengths: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the best path of every draw over admissible numbers of bounds, `lengths`.

    Drift u (draw, state, move, cell), of one move where all into a cell are alike, and its weights;
    tolls of bounds (move, cell), of one cell where all by a move are alike. Returns scores (draw,),
    -inf where there is no path; and paths, flat indices of cells, (draw, length), filled with -1.
    """
    n_draws = len(drift)
    scores = np.full(n_draws, -np.inf)
    paths = np.full((n_draws, len(layers.starts)), -1, np.int32)
    drift, lengths = np.ascontiguousarray(drift), np.asarray(lengths)

    def work(first: int, last: int) -> None:
        _best_paths(layers, drift, weights, tolls, lengths, scores, paths, first, last)

    over_rows(work, n_draws) if n_draws > 1 else work(0, n_draws)
    return scores, paths


class _Best(NamedTuple):
    """Best sum from each node to the goal, shape (node,)."""

    best: np.ndarray
    second: np.ndarray  # best by another first move than that of `best`
    edge: np.ndarray  # first edge of `best`, -1 at the goal
    by: np.ndarray  # its move


@_compiled
def _best_paths(layers, drift, weights, tolls, lengths, scores, paths, begin, end):
    n_nodes, (n_states, n_drifts) = len(layers.cell), drift.shape[1:3]
    left, cell, per_bound = layers.rank, layers.cell, weights.per_bound
    u = drift.reshape(len(drift), n_states, n_drifts * drift.shape[3])
    # Gain of each edge, or of each node where all edges into it are alike.
    by_edge, costly = n_drifts > 1, False
    for cost in tolls.flat:
        costly = costly or cost > 0.0
    gain = np.empty(len(layers.head) if by_edge else n_nodes)
    # Its bounds left, and the index of its drift; unsigned: no test for a negative index.
    gain_left, gain_drift = np.empty(len(gain), np.uint64), np.empty(len(gain), np.uint64)
    for i in range(len(gain)):
        n = layers.head[i] if by_edge else i
        gain_left[i] = left[n]
        gain_drift[i] = cell[n] + (layers.move[i] * drift.shape[3] if by_edge else 0)
    found = _Best(
        np.empty(n_nodes),
        np.empty(n_nodes),
        np.empty(n_nodes, np.int64),
        np.empty(n_nodes, np.int8),
    )
    for d in range(begin, end):
        gain[:] = 0.0
        for s in range(n_states):
            w, u_s = per_bound[d, :, s], u[d, s]
            for i in range(len(gain)):
                gain[i] += w[gain_left[i]] * u_s[gain_drift[i]]
        _pass_back(layers, gain, tolls, costly, by_edge, found)
        chosen = -1
        for length in lengths:
            node = layers.starts[length]
            if node >= 0 and found.best[node] > -np.inf:
                score = (weights.constant[d, length] + found.best[node]) / weights.scale[length]
                if score > scores[d]:
                    scores[d], chosen = score, length
        if chosen >= 0:
            _trace(layers, gain, tolls, by_edge, found, layers.starts[chosen], paths[d])


@_inlined
def _pass_back(layers, gain, tolls, costly, by_edge, found):
    """Compute the best and second-best sum of every node, in the order of the bounds left."""
    left, first, head, move = layers.rank, layers.first, layers.head, layers.move
    n_moves, u_turns, cell = layers.n_moves, layers.u_turns, layers.cell
    by_cell = tolls.shape[1] > 1
    best, second, edge, by = found
    for n in range(len(left)):
        if left[n] == 0:
            best[n], second[n], edge[n], by[n] = 0.0, 0.0, -1, -1
            continue
        high, next_high, at, m_high = -np.inf, -np.inf, -1, -1
        for e in range(first[n], first[n + 1]):
            b, m = head[e], move[e]
            on = best[b] if u_turns or by[b] != n_moves - 1 - m else second[b]
            value = gain[e if by_edge else b] + on
            if costly:
                value -= tolls[m, cell[b] * by_cell]
            if value > high:
                next_high = high
                high, at, m_high = value, e, m
            elif value > next_high:
                next_high = value
        best[n], second[n], edge[n], by[n] = high, next_high, at, m_high


@_inlined
def _trace(layers, gain, tolls, by_edge, found, node, path):
    """Write down the path from a start node; second-best edges are searched again."""
    cell, first, head, move = layers.cell, layers.first, layers.head, layers.move
    best, second, edge, by = found
    k, came, by_cell = 0, -1, tolls.shape[1] > 1
    path[0] = cell[node]
    while edge[node] >= 0:
        e = edge[node]
        if not layers.u_turns and came >= 0 and by[node] == layers.n_moves - 1 - came:
            high = -np.inf
            for x in range(first[node], first[node + 1]):
                b, m = head[x], move[x]
                if m == by[node]:
                    continue
                on = best[b] if by[b] != layers.n_moves - 1 - m else second[b]
                value = gain[x if by_edge else b] + on - tolls[m, cell[b] * by_cell]
                if value > high:
                    high, e = value, x
        node, came = head[e], move[e]
        k += 1
        path[k] = cell[node]
