"""Dynamic programming on the unrolled graph, for objectives that are sums over the bounds.

With j bounds left after a bound, its drift u adds w_j . u to the value, whatever the length of the
path: w_j is the sum over i <= j of credit(i) view . B0^(j - i), see `objectives.weights_of`. States
are processed in order of the bounds left, so that successors are final (Bellman 1958).
"""

import numpy as np

from trustbo.parallel import over_rows
from trustbo.planning.objectives import Weights
from trustbo.planning.unrolled import Unrolled, edges_from, fill_to_go, kernel, new_to_go


def best_sums(
    graph: Unrolled, drift: np.ndarray, weights: Weights, toll: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find the best path of every draw: the largest (constant + sum of w_j . u - tolls) / scale.

    Args:
        graph: Unrolled graph.
        drift: Drift of trust, (draw, state of trust, bound).
        weights: Weights of the drift.
        toll: Further cost of each bound, (bound,).

    Returns:
        Scores (draw,), and paths as flat cells, (draw, cell), filled with -1.
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
    """Write the cost of each edge under one draw: its toll less w_j . u."""
    for e in range(len(graph.head)):
        left, b = graph.left[graph.head[e]], graph.bound[e]
        cost[e] = toll[b]
        for i in range(len(drift)):
            cost[e] -= per_bound[left, i] * drift[i, b]
