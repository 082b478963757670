"""Cells and bounds as a networkx graph."""

import networkx as nx
import numpy as np

from trustbo.data import POST_SETS
from trustbo.errors import TrustboError
from trustbo.models.draws import Draws
from trustbo.planning.objectives import LOST_CONTACT, capped
from trustbo.planning.paths import STEPS
from trustbo.planning.problem import Problem, risk_of
from trustbo.workspace.moves import for_sets


def graph_of(problem: Problem, mean: Draws) -> nx.DiGraph | nx.MultiDiGraph:
    """Return the graph of `Planner.graph` for a single set of parameters."""
    recursion = problem.recursion(mean)
    radius = np.abs(np.linalg.eigvals(recursion.transition)).max()
    if radius >= 1.0:
        raise TrustboError(
            f"the graph needs abs(beta0) < 1, because trust must converge; got {radius:g}. "
            "Give other parameters, or use `plan` to find a path."
        )

    contact = capped(LOST_CONTACT, recursion)
    workspace = problem.paths.workspace
    grid = workspace.grid
    n_posts = workspace.n_posts
    bounds = for_sets(problem.paths.bounds, n_posts)
    steps = for_sets(STEPS, n_posts, axis=0)
    length = np.hypot(*(steps * (grid.cell_height, grid.cell_width)).T)  # (way,)

    def of_bounds(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, bounds.shape)[bounds]

    trust = of_bounds(recursion.steady_state()[0])
    of_contact = of_bounds(contact.steady_state()[0])
    rate = recursion.likelihood.mean_rate(of_contact, recursion.noise_sd)
    bound_cost = for_sets(problem.bound_cost, n_posts)
    lost = of_bounds(bound_cost) + np.maximum(1.0 - rate, 0.0)  # without rounding
    cost, constant = problem.costs_of_bounds(trust, lost)
    values = {
        "length": of_bounds(length[:, None, None]),
        "drift": of_bounds(recursion.drift[0].mean(0)),
        "trust": trust,
        "lost": lost,
        "cost": cost,
    }
    if problem.risk is not None:
        values["risk"] = of_bounds(risk_of(problem.risk.of_bounds))

    graph = nx.DiGraph(constant=constant) if n_posts == 1 else nx.MultiDiGraph(constant=constant)
    for row, col in np.argwhere(workspace.passable.values).tolist():
        graph.add_node((row, col), x=float(grid.x[col]), y=float(grid.y[row]))
    for k, (way, row, col) in enumerate(np.argwhere(bounds).tolist()):
        origin = row - int(steps[way, 0]), col - int(steps[way, 1])
        key = {} if n_posts == 1 else {"key": POST_SETS[way // len(STEPS)]}
        attributes = {name: float(v[k]) for name, v in values.items()}
        graph.add_edge(origin, (row, col), **key, **attributes)

    return graph
