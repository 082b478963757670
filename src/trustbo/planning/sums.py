"""Dynamic programming on the unrolled graph, for objectives that are sums over the bounds.

A bound with drift u and j bounds left after it adds w_j . u to the value, for any path length. The
weight w_j is the sum of credit(i) view . B0^(j - i) over i <= j (see `objectives.weights_of`).
States are processed in order of bounds left, so their successors are final (Bellman 1958).
"""

import numpy as np

from trustbo.parallel import over_rows
from trustbo.planning.objectives import Weights
from trustbo.planning.unrolled import Unrolled, edges_from, fill_to_go, kernel, new_to_go


def best_sums(
    graph: Unrolled, drift: np.ndarray, weights: Weights, toll: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find the path with the largest (constant + sum of w_j . u - tolls) / scale for each draw.

    Args:
        graph: Unrolled graph.
        drift: Drift of each state of trust, shape (draw, state, bound).
        weights: Weights of the drift.
        toll: Additional cost of each bound, shape (bound,).

    Returns:
        Scores (draw,) and paths (draw, cell), given as flat cell indices and padded with -1.
    """
    n = len(drift)
    scores, paths = np.full(n, -np.inf), np.full((n, graph.longest + 1), -1, np.int32)

    def work(begin: int, end: int) -> None:
        _best_sums(graph, drift, *weights, toll, scores, paths, begin, end)

    over_rows(work, n) if n > 1 else work(0, n)
    return scores, paths


@kernel
def _best_sums(graph, drift, per_bound, constant, scale, toll, scores, paths, begin, end):
    cost, to_go = np.empty(len(graph.head)), new_to_go(len(graph.cell))
    edges = np.empty(paths.shape[1], np.int64)
    for d in range(begin, end):
        costs_of_sums(graph, drift[d], per_bound[d], toll, cost)
        fill_to_go(graph, cost, to_go)
        chosen = -1
        for s in graph.starts:
            score = (constant[d, graph.left[s]] - to_go.least[s]) / scale[graph.left[s]]
            if score > scores[d]:
                scores[d], chosen = score, s
        if chosen >= 0:
            n = edges_from(graph, to_go, chosen, edges)
            paths[d, 0] = graph.cell[chosen]
            for k in range(n):
                paths[d, k + 1] = graph.cell[graph.head[edges[k]]]


@kernel
def costs_of_sums(graph, drift, per_bound, toll, cost) -> None:
    """Write the cost of each edge for one draw, the toll minus w_j . u, to `cost`."""
    for e in range(len(graph.head)):
        left, b = graph.left[graph.head[e]], graph.bound[e]
        cost[e] = toll[b]
        for i in range(len(drift)):
            cost[e] -= per_bound[left, i] * drift[i, b]
