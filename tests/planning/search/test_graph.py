"""A `SearchProblem` on graphs that are no grids: the best path is that of enumeration."""

from functools import cache

import numpy as np
import pytest

from trustbo.planning.search.costs_to_go import safest_to_go
from trustbo.planning.search.graph import Graph, Resources, SearchProblem, no_resources
from trustbo.planning.search.labels import solve
from trustbo.planning.search.losses import CLIPPED, LEAST, LOGISTIC, NONE, SOFTPLUS

N_NODES, BETA0, X0, SD = 9, 0.7, 0.4, 0.2
NODES = np.linspace(-8.0, 8.0, 20_001)
WEIGHTS = np.exp(-0.5 * NODES**2) / np.exp(-0.5 * NODES**2).sum()


def csr(edges, starts, *, layered):
    """Graph of edges (tail, head), sorted by tail; each edge is a bound of its own."""
    tail, head = np.array(sorted(edges)).T
    n = np.int64(len(tail))
    return Graph(
        first=np.searchsorted(tail, np.arange(N_NODES + 1)),
        head=head.astype(np.int32),
        rank=np.arange(N_NODES, dtype=np.int32),
        cell=np.arange(N_NODES, dtype=np.int32),
        move=np.zeros(n, np.int8),
        bound=np.arange(n, dtype=np.int32),
        starts=np.array(starts),
        n_moves=1,
        u_turns=True,
        layered=layered,
    )


def paths_of(graph, node, path=()):
    """All paths of edges to the goal; simple ones where the graph has cycles."""
    if node == 0:
        yield ()
        return
    for e in range(graph.first[node], graph.first[node + 1]):
        if graph.head[e] not in (node, *path):
            for rest in paths_of(graph, graph.head[e], (*path, node)):
                yield (e, *rest)


@cache  # many paths have their first bounds in common
def loss(kind, x):
    """Loss of a bound by its definition; censored rates by quadrature."""
    if kind == CLIPPED:
        return 1.0 - float(WEIGHTS @ np.clip(x + SD * NODES, 0.0, 1.0))
    return {LOGISTIC: 1 / (1 + np.exp(x)), SOFTPLUS: np.log1p(np.exp(-x)), LEAST: -x, NONE: 0}[kind]


def cost_of(problem, path, draw):
    """Cost of a path of edges by the definition, inf where it is not feasible."""
    x, losses, resources = X0, [], problem.resources
    used = resources.of_bounds[list(path)].sum(0)
    if (used <= resources.limits).sum() < resources.needed:
        return np.inf
    for e in path:
        x = BETA0 * x + float(problem.drift[min(draw, len(problem.drift) - 1), e])
        losses.append(loss(problem.loss, x))
    lost = max(losses) if problem.loss == LEAST else sum(losses)
    strata = used[: len(resources.failure_costs)]
    failure = (resources.failure_costs * (1 - np.exp(-strata))).sum()
    tolls = problem.toll[min(draw, len(problem.toll) - 1), list(path)].sum()
    return tolls + lost + failure


def resources_of(graph, rng, n_resources, needed, failure_costs, limit):
    of_bounds = rng.uniform(0.0, 0.3, (len(graph.head), n_resources))
    limits = np.full(n_resources, limit)
    least = np.sort(of_bounds, axis=1)[:, :needed].mean(1)
    return Resources(
        of_bounds, limits, needed, np.array(failure_costs, float), least, limit,
        safest_to_go(graph, of_bounds),
    )  # fmt: skip


@pytest.mark.parametrize("kind", [LOGISTIC, CLIPPED, SOFTPLUS, LEAST, NONE])
@pytest.mark.parametrize("n_resources", [0, 1, 3])
def test_the_best_path_of_an_acyclic_graph_is_that_of_enumeration(kind, n_resources):
    feasible = 0
    for seed in range(8):
        rng = np.random.default_rng([seed, kind, n_resources])
        edges = [(a, b) for a in range(1, N_NODES) for b in range(a) if rng.uniform() < 0.6]
        edges += [(a, a - 1) for a in range(1, N_NODES)]
        graph = csr(set(edges), [N_NODES - 1], layered=True)
        n = len(graph.head)
        resources = no_resources(graph, n)
        if n_resources:
            needed = min(2, n_resources)
            failure_costs = np.array([1.5, 0.2, 4.0])[: (1, 3)[seed % 2]][:n_resources]
            failure_costs = failure_costs[: 0 if kind == LEAST else None]
            resources = resources_of(graph, rng, n_resources, needed, failure_costs, 0.4)
        problem = SearchProblem(
            graph,
            np.zeros((1, n)) if kind == LEAST else rng.uniform(0.0, 0.3, (1, n)),
            rng.normal(0.0, 0.5, (3, n)),
            np.zeros((1, 1)),
            np.tile([BETA0, X0, SD], (3, 1)),
            kind,
            resources,
        )
        best = solve(problem)
        for d in range(3):
            costs = [cost_of(problem, path, d) for path in paths_of(graph, N_NODES - 1)]
            # Quadrature is right to 1e-7.
            np.testing.assert_allclose(
                best.cost[d], min(costs), rtol=1e-6 if kind == CLIPPED else 1e-12
            )
            np.testing.assert_allclose(best.lower[d], best.cost[d], rtol=1e-12)
            cells = best.paths[d][best.paths[d] >= 0]
            assert (len(cells) > 0) == np.isfinite(min(costs))
            feasible += len(cells) > 0
    assert feasible >= 12


@pytest.mark.parametrize("n_resources", [0, 1, 3])
def test_the_best_path_of_a_graph_with_cycles_is_that_of_enumeration(n_resources):
    for seed in range(4):
        rng = np.random.default_rng([seed, n_resources])
        edges = {(a, b) for a in range(1, N_NODES) for b in range(N_NODES)
                 if a != b and rng.uniform() < 0.4}  # fmt: skip
        graph = csr(edges | {(a, a - 1) for a in range(1, N_NODES)}, [N_NODES - 1], layered=False)
        n = len(graph.head)
        resources = no_resources(graph, n)
        if n_resources:
            resources = resources_of(graph, rng, n_resources, min(2, n_resources), [], 0.35)
        toll, trust = rng.uniform(0.01, 1.0, (2, n)), np.tile([0.0, 0.0, 1.0], (2, 1))
        problem = SearchProblem(
            graph, toll, np.zeros((1, n)), np.zeros((1, 1)), trust, NONE, resources
        )
        best = solve(problem)
        for d in range(2):
            least = min(cost_of(problem, path, d) for path in paths_of(graph, N_NODES - 1))
            np.testing.assert_allclose(best.cost[d], least, rtol=1e-12)


def test_no_path_is_found_that_does_not_cost_less_than_asked_for():
    graph = csr({(a, a - 1) for a in range(1, N_NODES)}, [N_NODES - 1], layered=True)
    toll, none = np.full((1, N_NODES - 1), 0.5), no_resources(graph, N_NODES - 1)
    trust = np.array([[0.0, 0.0, 1.0]])
    problem = SearchProblem(graph, toll, np.zeros((1, 1)), np.zeros((1, 1)), trust, NONE, none)
    assert solve(problem).paths.tolist() == [list(range(N_NODES - 1, -1, -1))]
    below = solve(problem, np.array([4.0]))
    assert (below.paths < 0).all()
    assert below.cost.tolist() == [4.0]
