"""Dynamic programming on the unrolled graph, for objectives that are sums over the bounds.

A bound with drift u that is followed by j more bounds adds w_j . u to the value, regardless of the
length of the path. `objectives.weights_of` computes the weights w_j. States are processed in order
of the number of bounds left, so the successors of a state are final (Bellman 1958).
"""

import numpy as np

from trustbo.parallel import over_rows
from trustbo.planning.objectives import Weights
from trustbo.planning.unrolled import Unrolled, edges_from, fill_to_go, kernel, new_to_go, part


def best_sums(
    graph: Unrolled, drift: np.ndarray, weights: Weights, bound_cost: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find the path with the largest (constant + sum of w_j . u - costs) / scale for each draw.

    Args:
        graph: Unrolled graph.
        drift: Drift of each state of trust, shape (draw, state, bound).
        weights: Weights of the drift.
        bound_cost: Additional cost of each bound, shape (bound,).

    Returns:
        Scores (draw,) and paths (draw, cell) as indices of stations, padded with -1; the last one
        is the goal.
    """
    n = len(drift)
    scores = np.full(n, -np.inf)
    paths = np.full((n, graph.longest + 1), -1, np.int32)

    def work(begin: int, end: int) -> None:
        _best_sums(graph, drift, *weights, bound_cost, scores, paths, begin, end)

    over_rows(work, n)
    return scores, paths


@kernel
def _best_sums(graph, drift, per_bound, constant, scale, bound_cost, scores, paths, begin, end):
    """Write the best score and path of the draws from `begin` to `end`."""
    cost = np.empty(len(graph.head))
    to_go = new_to_go(len(graph.cell))
    edges = np.empty(paths.shape[1], np.int64)

    for d in range(begin, end):
        costs_of_sums(graph, drift[d], per_bound[d], bound_cost, cost)
        fill_to_go(graph, cost, to_go)

        chosen = -1
        for s in graph.starts:
            n_bounds_left = graph.n_bounds_left[s]
            score = (constant[d, n_bounds_left] - to_go.least[s]) / scale[n_bounds_left]
            if score > scores[d]:
                scores[d] = score
                chosen = s

        if chosen >= 0:
            n = edges_from(graph, to_go, chosen, edges)
            for k in range(n):
                paths[d, k] = graph.station[edges[k]]
            paths[d, n] = graph.cell[0]


@part
def costs_of_sums(graph, drift, per_bound, bound_cost, cost) -> None:
    """Write the cost of each edge for one draw to `cost`: that of its bound minus w_j . u."""
    for e in range(len(graph.head)):
        n_bounds_left = graph.n_bounds_left[graph.head[e]]
        b = graph.bound[e]
        cost[e] = bound_cost[b]
        for i in range(len(drift)):
            cost[e] -= per_bound[n_bounds_left, i] * drift[i, b]
