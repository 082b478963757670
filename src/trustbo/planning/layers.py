"""Additive objectives, compiled: the grid unrolled over the bounds that are left.

With j bounds left after cell c is entered, c adds w_j . u(c) to a path's value, whatever its
length. So one backward pass over the nodes (j, c) from which the goal can be reached, and that the
start can reach, serves all admissible lengths at once. A path that may not turn straight back needs
of each node only its best two ways on: the second serves those who came from where the best leads.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.planning.dynamics import Dynamics
from trustbo.terrain.parallel import over_rows

_compiled = njit(cache=True, nogil=True, error_model="numpy")


class Layers(NamedTuple):
    """Nodes in the order of the bounds that are left, and the ways on from each."""

    cell: np.ndarray  # (node,), flat index
    left: np.ndarray  # (node,), bounds left
    first: np.ndarray  # (node + 1,), where its ways on begin
    onward: np.ndarray  # (way,), the node it leads to
    move: np.ndarray  # (way,), its number in `MOVES`
    starts: np.ndarray  # (length,), the node of the start with that many bounds left
    n_moves: int
    u_turns: bool


def build_layers(
    to_goal: np.ndarray,
    from_start: np.ndarray,
    steps: np.ndarray,
    longest: int,
    *,
    u_turns: bool,
) -> Layers:
    """Unroll a grid over the bounds that are left.

    Args:
        to_goal: Fewest bounds to the goal, shape (row, col); -1 where there is no way.
        from_start: Fewest bounds from the start, likewise.
        steps: Moves, shape (move, 2), each the reverse of the one as far from the other end.
        longest: Most bounds a path may have.
        u_turns: Whether a bound may lead back to the cell that the last one left.
    """
    cell, left, first, onward, move, starts = _build(to_goal, from_start, steps, longest)
    return Layers(cell, left, first, onward, move, starts, len(steps), u_turns)


@_compiled
def _build(to_goal, from_start, steps, longest):
    rows, cols = to_goal.shape
    # How many values of `left` each cell can have; the goal is entered by the last bound only.
    base = np.empty(rows * cols + 1, np.int64)
    base[0] = 0
    per_layer = np.zeros(longest + 2, np.int64)
    for c in range(rows * cols):
        i, j = c // cols, c % cols
        near, far = to_goal[i, j], from_start[i, j]
        n = 0
        if near >= 0 and far >= 0:
            n = 1 if near == 0 else max(0, longest - far - near + 1)
        base[c + 1] = base[c] + n
        for k in range(n):
            per_layer[near + k + 1] += 1
    place = np.cumsum(per_layer)
    n_nodes = base[rows * cols]
    node_of = np.empty(n_nodes, np.int32)  # in the order of cells, then of bounds left
    cell, left = np.empty(n_nodes, np.int32), np.empty(n_nodes, np.int32)
    start = 0
    for c in range(rows * cols):
        near = to_goal[c // cols, c % cols]
        if from_start[c // cols, c % cols] == 0:
            start = c
        for k in range(base[c + 1] - base[c]):
            node = place[near + k]
            place[near + k] += 1
            node_of[base[c] + k] = node
            cell[node], left[node] = c, near + k
    first = np.empty(n_nodes + 1, np.int64)
    onward, move = np.empty(0, np.int32), np.empty(0, np.int8)
    for fill in range(2):  # first count, then write
        if fill == 1:
            onward, move = np.empty(first[n_nodes], np.int32), np.empty(first[n_nodes], np.int8)
        n = 0
        for node in range(n_nodes):
            first[node] = n
            c = cell[node]
            if left[node] > 0:
                for m in range(len(steps)):
                    i, j = c // cols + steps[m, 0], c % cols + steps[m, 1]
                    if not (0 <= i < rows and 0 <= j < cols):
                        continue
                    b = i * cols + j
                    k = left[node] - 1 - to_goal[i, j]
                    if to_goal[i, j] >= 0 and 0 <= k < base[b + 1] - base[b]:
                        if fill == 1:
                            onward[n], move[n] = node_of[base[b] + k], m
                        n += 1
        first[n_nodes] = n
    starts = np.full(longest + 1, -1, np.int64)
    near = to_goal[start // cols, start % cols]
    for k in range(base[start + 1] - base[start]):
        starts[near + k] = node_of[base[start] + k]
    return cell, left, first, onward, move, starts


class Weights(NamedTuple):
    """What each cell adds to a path's score, by the bounds that are left; leading axis (draw,)."""

    per_bound: np.ndarray  # (draw, left, state)
    constant: np.ndarray  # (draw, length)
    scale: np.ndarray  # (length,): what a path's sum is divided by


def additive_weights(moves: Dynamics, view: np.ndarray, objective: str, longest: int) -> Weights:
    """Weights of `terminal` or `mean` for one view of the states.

    terminal: view . x^K = view . B0^K x0 + sum_j (view . B0^j) . u, where j bounds are left.
    mean: the average of these over the ends.

    Args:
        moves: With a leading axis (draw,).
        view: Shape (state,).
        objective: `"terminal"` or `"mean"`.
        longest: Most bounds a path may have.
    """
    n_draws, n_states = moves.start.shape
    powers = np.empty((n_draws, longest + 1, n_states))
    powers[:, 0] = view
    for j in range(longest):
        powers[:, j + 1] = (powers[:, j, None, :] @ moves.transition)[:, 0]
    constant = (powers @ moves.start[..., None])[..., 0]
    scale = np.ones(longest + 1)
    if objective == "mean":
        constant[:, 0] = 0.0
        constant = constant.cumsum(1)
        powers = powers.cumsum(1)
        scale = np.maximum(1.0, np.arange(longest + 1.0))
    return Weights(powers, constant, scale)


def best_additive(
    layers: Layers,
    drift: np.ndarray,
    weights: Weights,
    toll: np.ndarray,
    lengths: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The best path of every draw.

    Args:
        layers: The unrolled grid.
        drift: u, shape (draw, state, cell).
        weights: Of its states.
        toll: What each move costs, shape (move,).
        lengths: Which numbers of bounds are admissible.

    Returns:
        Scores, shape (draw,); -inf where there is no path; and paths, flat indices of cells, shape
        (draw, length), filled with -1.
    """
    n_draws = len(drift)
    scores = np.full(n_draws, -np.inf)
    paths = np.full((n_draws, len(layers.starts)), -1, np.int32)
    drift = np.ascontiguousarray(drift)

    def work(first: int, last: int) -> None:
        _best_paths(*layers, drift, *weights, toll, np.asarray(lengths), scores, paths, first, last)

    over_rows(work, n_draws) if n_draws > 1 else work(0, n_draws)
    return scores, paths


@_compiled
def _best_paths(
    cell, left, first, onward, move, starts, n_moves, u_turns,
    drift, per_bound, constant, scale, toll, lengths, scores, paths, begin, end,
):  # fmt: skip
    n_nodes, n_states = len(cell), drift.shape[1]
    gain, best, other = np.empty(n_nodes), np.empty(n_nodes), np.empty(n_nodes)
    way, by, tolled = np.empty(n_nodes, np.int64), np.empty(n_nodes, np.int8), toll.max() > 0.0
    for d in range(begin, end):
        for n in range(n_nodes):
            total = 0.0
            for s in range(n_states):
                total += per_bound[d, left[n], s] * drift[d, s, cell[n]]
            gain[n] = total
        _pass_back(
            left, first, onward, move, n_moves, u_turns, tolled, toll, gain, best, other, way, by
        )
        chosen = -1
        for length in lengths:
            node = starts[length]
            if node >= 0 and best[node] > -np.inf:
                score = (constant[d, length] + best[node]) / scale[length]
                if score > scores[d]:
                    scores[d], chosen = score, length
        if chosen >= 0:
            _trace(cell, first, onward, move, n_moves, u_turns, toll, gain, best, other, way, by,
                   starts[chosen], paths[d])  # fmt: skip


@_compiled
def _pass_back(
    left, first, onward, move, n_moves, u_turns, tolled, toll, gain, best, other, way, by
):
    """The best sum from each node on, its way and move; and the best by any other move."""
    for n in range(len(left)):
        if left[n] == 0:
            best[n], other[n], way[n], by[n] = 0.0, 0.0, -1, -1
            continue
        high, second, at, m_high = -np.inf, -np.inf, -1, -1
        for e in range(first[n], first[n + 1]):
            b, m = onward[e], move[e]
            on = best[b] if u_turns or by[b] != n_moves - 1 - m else other[b]
            value = gain[b] + on
            if tolled:
                value -= toll[m]
            if value > high:
                second = high
                high, at, m_high = value, e, m
            elif value > second:
                second = value
        best[n], other[n], way[n], by[n] = high, second, at, m_high


@_compiled
def _trace(
    cell, first, onward, move, n_moves, u_turns, toll, gain, best, other, way, by, node, path
):
    """Write down the path from a start node; ways that are second best are found again."""
    k, came = 0, -1
    path[0] = cell[node]
    while way[node] >= 0:
        e = way[node]
        if not u_turns and came >= 0 and by[node] == n_moves - 1 - came:
            high = -np.inf
            for x in range(first[node], first[node + 1]):
                b, m = onward[x], move[x]
                if m == by[node]:
                    continue
                on = best[b] if by[b] != n_moves - 1 - m else other[b]
                if gain[b] + on - toll[m] > high:
                    high, e = gain[b] + on - toll[m], x
        node, came = onward[e], move[e]
        k += 1
        path[k] = cell[node]
