"""Graph of all bounds with their costs, as the route server of Nav2 searches it.

Its edges are straight, so that a bent way is a chain of nodes. Its ids are 16 bits in messages,
those of nodes and edges differ, and its costs are positive.
"""

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import networkx as nx
import numpy as np
import shapely

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_choice
from trustbo.export.frame import PlacedFrame
from trustbo.models.params import Params
from trustbo.planning import Planner
from trustbo.workspace.moves import MOVES, move_indices

OBJECTIVES = ("lost_contact", "stationary")
"""Objectives whose values are sums over bounds, or nearly."""
MOST_IDS = 65_535
"""Largest id that messages of Nav2 hold: uint16 in EdgeCost and DynamicEdges of Jazzy."""
LEAST_COST = 1e-9
"""Least cost of an edge, as the route server refuses 0."""
_FIRST = 1 + len(MOVES[8])
"""Ids of stops and of first edges, by the number of cells; those within chains follow."""
Bound = tuple[Cell, Cell]


@dataclass(frozen=True, eq=False, repr=False)
class RouteGraph(Summary):
    """Directed graph of stops and bounds, with positions and costs.

    Edges of a bent way form a chain, among which the cost of the bound is divided by length.

    Attributes:
        nodes: Ids of the nodes, (node,). That of a cell's stop is row * columns + column.
        positions: Their positions, (node, 2), x and y in the frame, m.
        cells: Their cells, (node, 2), row and column; -1 within a way.
        edges: Ids of the edges, (edge,).
        ends: Ids of the nodes from and to which each leads, (edge, 2).
        costs: Cost of each, positive, (edge,): of stationary -log sigma of trust, of lost_contact
            the contact lost, in bounds.
        frame: Name of the frame.
        objective: Objective of the costs.
        route: Cells of the cheapest route from start to goal.
        gap: Loss of the route beyond that of the exact plan, as a share of the contact expected on
            the plan; negative where it loses less, as routes are not limited to `max_bounds`. 0 for
            stationary.
    """

    nodes: np.ndarray
    positions: np.ndarray
    cells: np.ndarray
    edges: np.ndarray
    ends: np.ndarray
    costs: np.ndarray
    frame: str
    objective: str
    route: tuple[Cell, ...]
    gap: float

    def _rows(self) -> Rows:
        low, high = self.costs.min(), self.costs.max()
        rows = [
            ("nodes", f"{len(self.nodes)}, positions in {self.frame!r}"),
            ("edges", f"{len(self.edges)}, costs {low:.3g} to {high:.3g}"),
            ("objective", self.objective),
            ("cheapest route", f"{len(self.route) - 1} bounds; {self.compared()}"),
        ]
        return rows

    def node_of(self, cell: Cell) -> int:
        """Id of the node of a cell; TrustboError: the cell has none."""
        (found,) = np.nonzero((self.cells == np.asarray(cell)).all(1))
        if not len(found):
            raise TrustboError(f"the graph has no node of cell {cell!r}; it is impassable.")
        return int(self.nodes[found[0]])

    def compared(self) -> str:
        """Comparison of the cheapest route with the exact plan, as text."""
        if self.objective == "stationary":
            return "it is the exact plan"
        than = "more" if self.gap >= 0 else "less"
        return f"it loses {abs(self.gap):.2%} of contact {than} than the exact plan"


def graph_of(
    planner: Planner, params: Params, place: PlacedFrame, tolerance: float | None = None
) -> RouteGraph:
    """Make the graph of a planner whose objective is one of `OBJECTIVES`.

    Args:
        planner: Planner of stationary or lost_contact.
        params: Parameters without leading axes.
        place: Frame of the positions.
        tolerance: Largest distance of a chain of edges from the lead's way, m, by default half a
            pixel; `inf` for straight edges.

    Raises:
        TrustboError: abs(beta0) >= 1, or more ids than messages of Nav2 hold.
    """
    chains = _chains(planner, tolerance)
    costs, route, gap = _costs(planner, params)
    edges, positions = [], {}
    for bound, cost in costs.items():
        edges += chains[bound].edges(cost)
        positions.update(chains[bound].nodes())
    edges.sort()
    nodes = np.array(sorted(positions))
    shape = planner.paths.passable.shape
    cells = np.stack(np.divmod(nodes, shape[1]), axis=1)
    cells[nodes >= math.prod(shape)] = -1
    return RouteGraph(
        nodes,
        place.of_crs(np.array([positions[node] for node in nodes.tolist()])),
        cells,
        np.array([edge for edge, *_ in edges]),
        np.array([(start, end) for _, start, end, _ in edges]),
        np.array([cost for *_, cost in edges]),
        place.name,
        planner.objective,
        route,
        gap,
    )


def summed(planner: Planner, objective: str | None) -> Planner:
    """Return the planner of an objective of `OBJECTIVES`, by default that of the planner.

    TrustboError: another objective, or rates that measure changes for lost_contact.
    """
    name = planner.objective if objective is None else objective
    if objective is None and name not in OBJECTIVES:
        raise TrustboError(
            f"the value of {name!r} is no sum of costs of bounds, which a route graph has; give "
            "objective='lost_contact' or 'stationary'."
        )
    require_choice("objective", name, OBJECTIVES)
    return planner if name == planner.objective else planner.with_objective(name)


class _Chain(NamedTuple):
    """Way of a bound as straight edges, from stop to stop."""

    node_ids: tuple[int, ...]
    edge_ids: tuple[int, ...]
    points: np.ndarray  # (node, 2), CRS metres

    def nodes(self) -> Iterator[tuple[int, np.ndarray]]:
        return zip(self.node_ids, self.points, strict=True)

    def edges(self, cost: float) -> Iterator[tuple[int, int, int, float]]:
        """Id, ends and cost of each edge, of the cost of them all."""
        lengths = np.hypot(*np.diff(self.points, axis=0).T)
        shares = (lengths / lengths.sum()).tolist()
        for edge, ends, share in zip(self.edge_ids, pairwise(self.node_ids), shares, strict=True):
            yield edge, *ends, max(cost * share, LEAST_COST)


def _chains(planner: Planner, tolerance: float | None) -> dict[Bound, _Chain]:
    """Chains of all bounds of a workspace; TrustboError: their ids exceed those of messages.

    Ids depend on the workspace, the connectivity and the tolerance alone, so that graphs of all
    missions agree in them: cells', row * columns + column, for stops; (1 + move) * cells + the cell
    entered for the first edge of a bound; then those of further nodes and edges, bound by bound.
    """
    workspace, shape, chains = planner.workspace, planner.paths.passable.shape, {}
    n_cells = math.prod(shape)
    following = _FIRST * n_cells
    for m in move_indices(planner.connectivity).tolist():
        down, right = MOVES[8][m]
        for row, col in np.argwhere(workspace.passable_bounds.values[m]).tolist():
            bound = (row - down, col - right), (row, col)
            first, last = (planner.paths.flat(cell) for cell in bound)
            points = _way(planner, bound, tolerance)
            n = len(points) - 2
            inner, later = range(following, following + n), range(following + n, following + 2 * n)
            following = later.stop
            edge = (1 + m) * n_cells + last
            chains[bound] = _Chain((first, *inner, last), (edge, *later), points)
    if following - 1 > MOST_IDS:
        raise TrustboError(
            f"the graph of {shape[0]} x {shape[1]} cells has ids up to {following - 1}, and "
            f"messages of Nav2 up to {MOST_IDS}; give a larger tolerance, m (inf: each bound is "
            "one straight edge), or take larger cells."
        )
    return chains


def _way(planner: Planner, bound: Bound, tolerance: float | None) -> np.ndarray:
    """Points of the lead's way, CRS metres (point, 2), thinned; without a terrain, the centres."""
    workspace = planner.workspace
    if workspace.ground is None or workspace.surface is None:
        return np.array([workspace.grid.center(cell) for cell in bound])
    line = workspace.ground.posts.lead_line(*bound)
    if tolerance == math.inf:
        return line[[0, -1]]
    near = 0.5 * min(workspace.surface.pixel) if tolerance is None else tolerance
    return shapely.get_coordinates(shapely.LineString(line).simplify(near))


def _costs(planner: Planner, params: Params) -> tuple[dict[Bound, float], tuple[Cell, ...], float]:
    """Cost of each bound, the cheapest route, and its gap to the exact plan."""
    graph, problem, plan = planner.graph_of(params), planner.problem, planner.plan(params)
    contact = 1.0
    if planner.objective == "lost_contact":
        # A failure costs c (1 - exp(-risk)) in each stratum, which is concave: its tangents at the
        # plan's risks lie above it elsewhere, so that no route is cheaper by them and worse in
        # truth.
        table, shape, slopes = problem.risk_table, problem.paths.passable.shape, np.empty(0)
        if table is not None:
            slopes = table.slopes(table.along(plan.path, shape))
        for a, c, edge in graph.edges(data=True):
            edge["cost"] = edge["lost"]
            if table is not None:
                edge["cost"] += float(slopes @ table.along((a, c), shape)[: len(slopes)])
        lost = -plan.value - problem.cost_of_failure(plan.path)
        contact = len(plan.path) - 1 - (lost - problem.objective.length_weight * plan.length)
    for *_, edge in graph.edges(data=True):
        edge["cost"] = max(edge["cost"], LEAST_COST)
    route = nx.dijkstra_path(graph, planner.start, planner.goal, weight="cost")
    if problem.risk is not None and not problem.is_within_risk(route):
        warnings.warn(
            f"the cheapest route fails with a chance of {1.0 - problem.risk.survival(route):.3g}, "
            f"beyond max_failure = {problem.rule.max_failure:g}: a route graph knows no limit.",
            stacklevel=4,
        )
    gap = 0.0
    if planner.objective == "lost_contact":
        gap = (plan.value - planner.evaluate(route, params).value) / contact
    costs = {(a, c): float(cost) for a, c, cost in graph.edges(data="cost")}
    return costs, tuple(route), gap
