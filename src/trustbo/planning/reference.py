"""Reference planner, based on networkx and enumeration, for testing the compiled searches.

If the value of a path is a sum over its bounds, the Bellman-Ford algorithm finds the best path in
the unrolled graph. If the value depends on history or risk, all admissible paths are enumerated.
Neither method uses the compiled kernels.
"""

from collections.abc import Iterator

import networkx as nx
import numpy as np
import xarray as xr

from trustbo.data import Cell
from trustbo.models.params import Params
from trustbo.planning.objectives import capped, has_history
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.problem import mean_of
from trustbo.planning.recursion import Recursion
from trustbo.workspace.moves import MOVES


def plan(planner: Planner, params: Params | xr.DataTree) -> Plan:
    """Find the best admissible path for given parameters, or for the mean of a posterior.

    The value equals that of `planner.plan(params)`. The paths may differ if several are optimal.

    Args:
        planner: Planner for a small grid.
        params: Posterior from `fit`, or parameters. Several draws are replaced by their mean.

    Raises:
        InfeasibleError: If no path respects `max_failure`.
    """
    problem = planner.problem
    mean = mean_of(params, planner.workspace)

    if problem.risks is not None or has_history(problem.objective, problem.likelihood):
        plans = [planner.evaluate(path, mean) for path in every_path(problem.paths)]
        feasible = [one for one in plans if not one.infeasible]
        if not feasible:
            return planner.plan(mean)  # raises InfeasibleError
        return max(feasible, key=lambda one: one.value)

    recursion = capped(problem.objective, problem.likelihood, problem.recursion(mean))
    plans = [planner.evaluate(path, mean) for path in shortest_paths(planner, recursion)]
    return max(plans, key=lambda one: one.value)


def shortest_paths(planner: Planner, recursion: Recursion) -> Iterator[tuple[Cell, ...]]:
    """Find the best path for each number of bounds with `networkx.bellman_ford_path`.

    A bound with drift u and j bounds left after it adds w_j . u minus its cost to the value. Here,
    w_j = sum_{i <= j} credit(i) s . B0^(j - i), where s . x is the team's mean trust.
    """
    problem = planner.problem
    graph = problem.paths.graph
    n_states = len(recursion.start)
    state_weights = np.full(n_states, 1.0 / n_states)
    credit = problem.objective.credit(np.arange(graph.longest + 1))

    weights = []
    carried = np.zeros(n_states)
    for j in range(graph.longest):
        carried = carried @ recursion.transition + credit[j] * state_weights
        weights.append(carried)

    drift = recursion.drift.reshape(n_states, -1)
    bound_cost = problem.bound_cost.ravel()
    n_bounds_left = graph.n_bounds_left[graph.head]  # bounds left after each edge
    cost = [
        bound_cost[b] - weights[j] @ drift[:, b]
        for b, j in zip(graph.bound, n_bounds_left, strict=True)
    ]
    network = graph.to_networkx(cost)

    for s in graph.starts:
        start = None, int(graph.cell[s]), int(graph.n_bounds_left[s])
        try:
            nodes = nx.bellman_ford_path(network, start, "goal", weight="cost")
        except (nx.NetworkXNoPath, nx.NodeNotFound):  # every path of this length has a U-turn
            continue

        cells = np.array([node[1] for node in nodes[:-1]])
        yield (*problem.paths.cells(cells), planner.goal)


def every_path(paths: AdmissiblePaths) -> Iterator[tuple[Cell, ...]]:
    """Enumerate all admissible paths, which is feasible only for small grids."""
    onward: dict[Cell, list[Cell]] = {}
    for move, row, col in np.argwhere(paths.bounds).tolist():
        down, right = MOVES[move]
        onward.setdefault((row - down, col - right), []).append((row, col))

    stack: list[tuple[Cell, ...]] = [(paths.start,)]
    while stack:
        path = stack.pop()
        for cell in onward.get(path[-1], []):
            if not 0 <= paths.bounds_to_goal[cell] <= paths.longest - len(path):
                continue
            if not paths.turns and path[-2:-1] == (cell,):
                continue
            if cell == paths.goal:
                yield (*path, cell)
            else:
                stack.append((*path, cell))
