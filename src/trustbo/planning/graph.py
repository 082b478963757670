"""Cells and bounds as a networkx graph."""

import networkx as nx
import numpy as np

from trustbo.errors import TrustboError
from trustbo.models.draws import Draws
from trustbo.planning.objectives import LOST_CONTACT, capped
from trustbo.planning.paths import STEPS
from trustbo.planning.problem import Problem, risk_of


def graph_of(problem: Problem, mean: Draws) -> nx.DiGraph:
    """Return the graph of `Planner.graph` for a single set of parameters."""
    recursion = problem.recursion(mean)
    radius = np.abs(np.linalg.eigvals(recursion.transition)).max()
    if radius >= 1.0:
        raise TrustboError(
            f"the graph needs abs(beta0) < 1, because trust must converge; got {radius:g}. "
            "Give other parameters, or use `plan` to find a path."
        )

    contact = capped(LOST_CONTACT, problem.likelihood, recursion)
    workspace = problem.paths.workspace
    grid = workspace.grid
    bounds = problem.paths.bounds
    length = np.hypot(*(STEPS * (grid.cell_height, grid.cell_width)).T)  # (move,)

    def of_bounds(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, bounds.shape)[bounds]

    trust = of_bounds(recursion.steady_state()[0])
    of_contact = of_bounds(contact.steady_state()[0])
    rate = problem.likelihood.mean_rate(of_contact, recursion.noise_sd)
    lost = of_bounds(problem.bound_cost) + np.maximum(1.0 - rate, 0.0)  # without rounding
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

    graph = nx.DiGraph(constant=constant)
    for row, col in np.argwhere(workspace.passable.values).tolist():
        graph.add_node((row, col), x=float(grid.x[col]), y=float(grid.y[row]))
    for k, (move, row, col) in enumerate(np.argwhere(bounds).tolist()):
        origin = row - int(STEPS[move, 0]), col - int(STEPS[move, 1])
        graph.add_edge(origin, (row, col), **{name: float(v[k]) for name, v in values.items()})

    return graph
