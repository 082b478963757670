"""Reference planner, based on networkx and enumeration, with which plans are compared.

The reference planner covers everything that `Planner.plan` does: all objectives, families, models,
costs, risks and limits. If the score of a path is a sum over its bounds, the Bellman-Ford algorithm
of networkx finds the best path in the unrolled graph, whose nodes consist of a cell and the number
of bounds left. If the score is a nonlinear function of trust, or depends on a risk, all admissible
paths are enumerated, which is feasible for small grids. Neither method uses the compiled kernels.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import cast

import networkx as nx
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Station, require_path
from trustbo.hazard.path_risk import Risk
from trustbo.models.draws import Draws
from trustbo.planning.given import mean_and_draws_of
from trustbo.planning.objectives import capped, has_history
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.problem import InfeasibleError, Problem
from trustbo.planning.recursion import Recursion, states_along, trust_recursion
from trustbo.planning.unrolled import Unrolled
from trustbo.workspace.moves import cells_ahead


def plan(planner: Planner, params: Draws | xr.DataTree, *, x0: ArrayLike | None = None) -> Plan:
    """Find the best admissible path for given parameters, or for the mean of a posterior.

    The value equals that of `planner.plan(params, x0=x0)`. The paths may differ if several are
    optimal.

    Args:
        planner: Planner; its grid must be small if all paths have to be enumerated.
        params: Posterior from `fit`, or parameters; see `Planner.plan`.
        x0: Expected trust at the start; by default `params.x0_mean`.

    Raises:
        InfeasibleError: If no path respects `max_failure`.
    """
    started = time.perf_counter()
    problem = planner.problem
    mean, draws = mean_and_draws_of(params, planner.workspace)
    recursion = capped(problem.objective, problem.recursion(mean, x0))

    if problem.edge_risks is not None or has_history(problem.objective, mean.likelihood):
        paths = every_path(problem.paths)
    else:
        paths = shortest_paths(planner, recursion)

    best = None
    best_value = -np.inf
    for path in paths:
        if not problem.is_within_limit(path):
            continue
        value = _value_of(problem, mean, path, x0)
        if best is None or value > best_value:
            best = path
            best_value = value
    if best is None:
        raise _infeasible(problem, cast("Risk", problem.risk))  # without a risk, no path is refused

    found = planner.evaluate(best, mean, x0=x0)
    if draws is not None:
        found = found.with_draws(planner.evaluate(best, params, x0=x0))
    seconds = time.perf_counter() - started
    return replace(found, exact=True, limit=found.value, seconds=seconds)


def shortest_paths(planner: Planner, recursion: Recursion) -> Iterator[tuple[Station, ...]]:
    """Find the best path for each number of bounds with `networkx.bellman_ford_path`.

    A bound with drift u that is followed by j more bounds adds w_j . u minus its cost to the value.
    Here, w_j = sum_{i <= j} credit(i) s . B0^(j - i), where s . x is the team's mean trust.
    """
    problem = planner.problem
    graph = problem.paths.graph
    n_states = recursion.start.shape[1]
    state_weights = np.full(n_states, 1.0 / n_states)
    credit = problem.objective.credit(np.arange(graph.longest + 1))

    weights = []
    carried = np.zeros(n_states)
    for j in range(graph.longest):
        carried = carried @ recursion.transition[0] + credit[j] * state_weights
        weights.append(carried)

    drift = recursion.drift.reshape(n_states, -1)
    bound_cost = np.tile(problem.bound_cost.ravel(), planner.workspace.n_posts)
    n_bounds_left = graph.n_bounds_left[graph.head]  # bounds left after each edge
    cost = [
        bound_cost[b] - weights[j] @ drift[:, b]
        for b, j in zip(graph.bound, n_bounds_left, strict=True)
    ]
    return cheapest_paths(problem.paths, cost)


def cheapest_paths(
    paths: AdmissiblePaths, cost: Sequence[float] | np.ndarray
) -> Iterator[tuple[Station, ...]]:
    """Find the path of least cost for each number of bounds.

    Args:
        paths: Admissible paths.
        cost: Cost of each edge of the unrolled graph `paths.graph`, shape (edge,).
    """
    graph = paths.graph
    network = network_of(graph, cost)

    for s in graph.starts:
        start = None, int(graph.cell[s]), int(graph.n_bounds_left[s])
        try:
            nodes = nx.bellman_ford_path(network, start, "goal", weight="cost")
        except (nx.NetworkXNoPath, nx.NodeNotFound):  # every path of this length has a U-turn
            continue

        stations = np.array([network.edges[edge]["station"] for edge in pairwise(nodes)])
        yield (*paths.cells(stations), paths.goal)


def network_of(graph: Unrolled, cost: Sequence[float] | np.ndarray) -> nx.DiGraph:
    """Convert an unrolled graph to networkx, with the `cost` and the `station` of each edge.

    Of the edges that differ only in their posts, the cheapest is kept.

    Every path from a node `(None, start, n_bounds_left)` to the node `"goal"` is admissible. Each
    other node is a tuple (previous cell, cell, bounds left). If U-turns are allowed, the previous
    cell is not needed and is None.

    Args:
        graph: Unrolled graph, such as `paths.graph`.
        cost: Cost of each edge, shape (edge,).
    """
    network = nx.DiGraph()
    nodes: list[tuple[int | None, int]] = [(None, s) for s in graph.starts.tolist()]
    met = set(nodes)

    while nodes:
        before, s = nodes.pop()
        tail = (before, int(graph.cell[s]), int(graph.n_bounds_left[s]))
        for e in range(graph.first[s], graph.first[s + 1]):
            h = int(graph.head[e])
            if not graph.turns and graph.cell[h] == before:
                continue

            onward = (None if graph.turns else tail[1], h)
            head = "goal"
            if h != 0:
                head = onward[0], int(graph.cell[h]), int(graph.n_bounds_left[h])
            known = network.get_edge_data(tail, head)
            if known is None or cost[e] < known["cost"]:
                network.add_edge(tail, head, cost=float(cost[e]), station=int(graph.station[e]))
            if h > 0 and onward not in met:
                met.add(onward)
                nodes.append(onward)

    return network


def _value_of(
    problem: Problem, mean: Draws, path: Sequence[Station], x0: ArrayLike | None
) -> float:
    """Compute the value of a path, with the expected cost of failure."""
    z, bounds = problem.along(path)
    recursion = trust_recursion(mean, z, problem.initial_trust(x0), bounds=bounds)
    along = capped(problem.objective, recursion)
    trust = states_along(along).mean(-1)
    value = problem.value_along(problem.bound_cost_along(path), trust, along)
    return value.item() - problem.failure_along(path)


def _infeasible(problem: Problem, risk: Risk) -> InfeasibleError:
    """Return an error with the safest path, because no path respects `max_failure`."""
    safest = min(every_path(problem.paths), key=risk.failure)
    p_fail = risk.failure(safest)
    return InfeasibleError(
        f"no admissible path has a failure probability of at most max_failure = "
        f"{problem.max_failure:g}. The smallest is {p_fail:.4g}.",
        safest,
        p_fail,
    )


def every_path(paths: AdmissiblePaths) -> Iterator[tuple[Station, ...]]:
    """Enumerate all admissible paths, which is feasible only for small grids."""
    onward = cells_ahead(paths.bounds)

    # The last cell of a path on the stack has no posts yet.
    stack: list[tuple[Station, ...]] = [(paths.start,)]
    while stack:
        path = stack.pop()
        for cell in onward.get(path[-1], []):
            if not 0 <= paths.bounds_to_goal[cell] <= paths.longest - len(path):
                continue
            if not paths.turns and len(path) > 1 and path[-2][:2] == cell:
                continue
            for name in paths.workspace.post_sets:
                longer = require_path("path", [*path[:-1], (*path[-1], name), cell])
                if cell == paths.goal:
                    yield longer
                else:
                    stack.append(longer)
