"""Lower limits of the dual against its definition, and against the least cost of all paths."""

from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from trustbo.planning.search import labels
from trustbo.planning.search.costs_to_go import safest_to_go
from trustbo.planning.search.graph import Graph, Resources, SearchProblem
from trustbo.planning.search.labels import solve
from trustbo.planning.search.losses import NONE

N_LAYERS, WIDTH = 12, 9


def tight_problem(seed, failure_cost=0.0):
    """Layers of nodes where what is cheap uses much: far too many labels for none to be dropped."""
    rng = np.random.default_rng(seed)
    n_nodes = N_LAYERS * WIDTH + 2
    rank = np.concatenate([[0], np.repeat(np.arange(1, N_LAYERS + 1), WIDTH), [N_LAYERS + 1]])
    tail, head = np.nonzero(rank[:, None] == rank + 1)
    n = np.int64(len(tail))
    graph = Graph(
        np.searchsorted(tail, np.arange(n_nodes + 1)), head.astype(np.int32),
        rank.astype(np.int32), np.arange(n_nodes, dtype=np.int32), np.zeros(n, np.int8),
        np.arange(n, dtype=np.int32), np.array([n_nodes - 1]), 1, True, True,
    )  # fmt: skip
    toll = rng.uniform(0.1, 1.0, n)
    used = (1.1 - toll + rng.uniform(0.0, 0.3, n))[:, None]
    limit = 0.55 * N_LAYERS
    resources = Resources(
        used, np.array([limit]), 1, np.full(int(failure_cost > 0.0), failure_cost), used[:, 0],
        limit, safest_to_go(graph, used),
    )  # fmt: skip
    trust = np.array([[0.0, 0.0, 1.0]])
    return SearchProblem(
        graph, toll[None], np.zeros((1, 1)), np.zeros((1, 1)), trust, NONE, resources
    )


def dual_function(problem, price):
    """Least cost of all paths with a price on the resource, by networkx, less price x limit."""
    graph, used = problem.graph, problem.resources.of_bounds[:, 0]
    tail = np.repeat(np.arange(len(graph.rank)), np.diff(graph.first))
    priced = nx.DiGraph()
    priced.add_weighted_edges_from(
        zip(tail.tolist(), graph.head.tolist(), problem.toll[0] + price * used, strict=True)
    )
    least = nx.dijkstra_path_length(priced, len(graph.rank) - 1, 0)
    return least - price * problem.resources.limits[0]


def cut_short(problem, monkeypatch):
    """Result of the dual alone: the search is cut off at its first labels."""
    with monkeypatch.context() as patch:
        patch.setattr(labels, "MAX_LABELS", 1)
        return solve(problem)


@pytest.mark.parametrize("seed", range(4))
def test_the_lower_limit_is_the_largest_value_of_the_dual_function(seed, monkeypatch):
    problem = tight_problem(seed)
    best, short = solve(problem), cut_short(problem, monkeypatch)
    found = minimize_scalar(
        lambda price: -dual_function(problem, price), bounds=(0.0, 10.0), method="bounded",
        options={"xatol": 1e-9},
    )  # fmt: skip
    assert short.lower[0] < short.cost[0]  # it was cut short
    np.testing.assert_allclose(short.lower[0], -found.fun, rtol=1e-6)
    assert short.lower[0] <= best.cost[0] <= short.cost[0]
    np.testing.assert_allclose(best.lower, best.cost, rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_dual_s_path_keeps_the_limit_and_costs_what_is_claimed(seed, monkeypatch):
    for failure_cost in (0.0, 3.0):
        problem = tight_problem(seed, failure_cost)
        short = cut_short(problem, monkeypatch)
        nodes = short.paths[0][short.paths[0] >= 0]  # places are nodes here
        first, head = problem.graph.first, problem.graph.head
        edges = [
            first[a] + head[first[a] : first[a + 1]].tolist().index(b) for a, b in pairwise(nodes)
        ]
        used = problem.resources.of_bounds[edges, 0].sum()
        assert used <= problem.resources.limits[0] + 1e-12
        cost = problem.toll[0, edges].sum() - failure_cost * np.expm1(-used)
        np.testing.assert_allclose(short.cost[0], cost, rtol=1e-12)
        assert short.lower[0] <= solve(problem).cost[0] <= short.cost[0] + 1e-12
