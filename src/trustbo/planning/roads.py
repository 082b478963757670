"""Plans on a given graph, such as roads: its nodes are stops, its directed edges are bounds.

A path is searched by the label search of the planner of cells, on the graph unrolled over the
bounds left (`search/roads.py`).
"""

import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import as_names
from trustbo.data import Mission
from trustbo.display.card import Card, Displayed
from trustbo.errors import TrustboError, require_choice, require_kind
from trustbo.models.families import FAMILIES
from trustbo.models.model import RESPONSES
from trustbo.models.params import Params
from trustbo.planning.dynamics import Dynamics, trust_dynamics
from trustbo.planning.graph import NoPathError
from trustbo.planning.objectives import DEFAULT_MAX_BOUNDS, Objective, softplus
from trustbo.planning.paths import PathClass
from trustbo.planning.problem import draws_of, mean_of, require_objective
from trustbo.planning.search import solve
from trustbo.planning.search.compiled import best_history, best_sums
from trustbo.planning.search.graph import Best, Graph, no_resources
from trustbo.planning.search.layers import additive_weights
from trustbo.planning.search.roads import unroll
from trustbo.planning.values import bands_of, value_along

Node = Hashable
AWARENESS = "awareness"
"""Attribute of edges with their awareness, by feature: a number, or one for each robot."""
_ROBOTS = ("r1", "r2", "r3")


@dataclass(frozen=True, eq=False, repr=False)
class RoadPlan(Displayed):
    """A path along edges of a graph with its expected trust, value and exactness.

    Attributes:
        path: Nodes, start first.
        length: Sum of the edges' lengths, m; NaN where they have none.
        awareness: Awareness of the edges, shape (bound, robot, feature).
        trust: Expected trust after each bound, shape (bound, robot).
        bands: Quantiles of expected trust over draws, see `Plan.bands`.
        value: Value of the objective, to be maximised (see `OBJECTIVES`).
        objective: Name of the objective.
        exact: True if no admissible path is better.
        bound: Upper limit on the value of any admissible path; NaN for a given path.
        features: Names of the features.
        robots: Names of the robots.
        seconds: Time of the search, s.
    """

    path: tuple[Node, ...]
    length: float
    awareness: np.ndarray
    trust: np.ndarray
    bands: np.ndarray
    value: float
    objective: str
    exact: bool
    bound: float
    features: tuple[str, ...]
    robots: tuple[str, ...]
    seconds: float = 0.0

    def _card(self) -> Card:
        rows = [
            ("path", f"{len(self.path) - 1} bounds, {self.length:.0f} m"),
            ("value", f"{self.value:.3g} ({self.objective})"),
            ("best", "no path is better" if self.exact else f"at most {self.bound:.3g}"),
            ("trust at the goal", f"{self.trust[-1].mean():.3f}, mean of the robots"),
        ]
        nodes = {"nodes": [("path", " ".join(map(str, self.path)))]}
        return Card(f"RoadPlan: {self.path[0]} to {self.path[-1]}", rows, sections=nodes)

    def mission(self, contact_rate: ArrayLike, **measured: Any) -> Mission:
        """Make the mission that drove this path, to learn from by `fit`; it has no map.

        Args:
            contact_rate: Shape (bound, robot), in [0, 1]; fewer bounds where the mission ended.
            **measured: Further arguments of `Mission.from_arrays`, such as `n_ticks`.
        """
        rates = np.asarray(contact_rate, dtype=float)
        names = {"features": self.features, "robots": self.robots}
        return Mission.from_arrays(None, self.awareness[: len(rates)], rates, **names, **measured)


class RoadPlanner(Displayed):
    """Search for the most trustworthy path of a graph whose edges are bounds.

    Effects of places in a posterior are left out: they are of the cells of a grid, and their
    expectation elsewhere is 0. Bands of trust hence lack what roads differ by from one another.

    Attributes:
        graph: Directed graph of networkx.
        start: First node.
        goal: Last node.
        shortest: Fewest bounds from start to goal.
        longest: Largest number of bounds of an admissible path.
        features: Names of the features.
        robots: Names of the robots.
    """

    def __init__(
        self,
        graph: nx.DiGraph,
        start: Node,
        goal: Node,
        objective: str = "lost_contact",
        *,
        max_bounds: int | str | None = None,
        team: str = "mean",
        length_weight: float = 0.0,
        observation: str = "gaussian",
        response: str = "level",
    ) -> None:
        """Prepare to plan.

        Args:
            graph: Directed graph, such as that of `export.from_route_graph`. Each edge has
                `awareness`, a mapping of features to a number or to one for each robot; and for a
                length weight `length`, m. `graph.graph["robots"]` has the robots' names, by default
                r1, r2, r3.
            start: First node.
            goal: Last node.
            objective: See `Planner`.
            max_bounds: See `Planner`.
            team: See `Planner`; `"min"` is for stationary.
            length_weight: See `Planner`.
            observation: See `Planner`.
            response: See `Planner`.

        Raises:
            TrustboError: A node that is not in the graph; an edge without awareness or a length
                that is needed; or an argument is refused by `Planner`.
            NoPathError: The goal cannot be reached.
        """
        require_kind("graph", graph, nx.DiGraph, "give one of networkx, without parallel edges")
        for name, node in (("start", start), ("goal", goal)):
            if node not in graph:
                some = ", ".join(map(repr, list(graph)[:3])) or "none"
                raise TrustboError(f"{name} {node!r} is no node of the graph; its first: {some}.")
        if start == goal:
            raise TrustboError(f"start and goal are the same node {start!r}; choose two.")
        family = FAMILIES[require_choice("observation", observation, FAMILIES)]
        lag = float(require_choice("response", response, RESPONSES) == "change")
        self._objective, self._team = Objective(objective, length_weight, family, lag), team
        require_objective(self._objective, team)
        self.graph, self.start, self.goal = graph, start, goal
        try:
            self.shortest = int(nx.shortest_path_length(graph, start, goal))
        except nx.NetworkXNoPath:
            raise NoPathError(f"no edges lead from {start!r} to {goal!r}.") from None
        limit = (
            DEFAULT_MAX_BOUNDS.get(objective, "shortest+2") if max_bounds is None else max_bounds
        )
        self.longest = PathClass(max_bounds=limit).longest(self.shortest)
        if self.longest < self.shortest:
            raise TrustboError(
                f"max_bounds = {self.longest} is below the fewest possible from {start!r} to "
                f"{goal!r}, which is {self.shortest}."
            )
        self._u_turns = not isinstance(limit, str)
        self._edges = {edge: i for i, edge in enumerate(graph.edges)}
        self.robots = as_names("robots", graph.graph.get("robots", ())) or _ROBOTS
        first = next(iter(graph.edges(data=AWARENESS)))[2]
        self.features = tuple(first or ())
        self._awareness = np.stack([self._awareness_of(a, c) for a, c in self._edges])
        self._lengths = np.array([graph.edges[e].get("length", np.nan) for e in self._edges])
        if length_weight and np.isnan(self._lengths).any():
            edge = list(self._edges)[int(np.argmax(np.isnan(self._lengths)))]
            raise TrustboError(f"a length weight needs the length of each edge; {edge} has none.")

    def _card(self) -> Card:
        rows = [
            ("graph", f"{len(self.graph)} nodes, {len(self._edges)} edges"),
            ("from", f"{self.start} to {self.goal}"),
            ("objective", f"{self._objective.name}, {self._team} of the robots"),
            ("paths", f"{self.shortest} to {self.longest} bounds"),
            ("features", ", ".join(self.features)),
        ]
        return Card(f"RoadPlanner: {self.start} to {self.goal}", rows)

    def _awareness_of(self, a: Node, c: Node) -> np.ndarray:
        """Awareness of an edge, (robot, feature)."""
        given = self.graph.edges[a, c].get(AWARENESS)
        if not isinstance(given, Mapping) or not given or set(given) != set(self.features):
            raise TrustboError(
                f"the edge {a!r} to {c!r} needs awareness of {', '.join(self.features) or 'some'} "
                f"features, such as {{'visibility': 0.5}}; got {given!r:.60}. On a terrain, "
                "export.from_route_graph(path, workspace) computes it."
            )
        try:
            values = [np.broadcast_to(given[f], len(self.robots)) for f in self.features]
            awareness = np.stack(values, axis=1).astype(float)
        except (TypeError, ValueError):
            awareness = np.full(1, np.nan)
        if not np.isfinite(awareness).all():
            raise TrustboError(
                f"awareness of the edge {a!r} to {c!r} must be finite numbers, one or {self.robots}"
                f" of each feature; got {given!r:.60}."
            )
        return awareness

    def plan(self, params: Params | xr.DataTree, *, x0: ArrayLike | None = None) -> RoadPlan:
        """Find the best admissible path for given parameters, or for the mean of a posterior.

        Args:
            params: Posterior of `fit`, or parameters; of several draws, the path is that of their
                mean, and the bands are over the draws.
            x0: Expected trust at the start; by default `params.x0_mean`.

        Raises:
            ShapeError: Parameters of other robots or features.
            TrustboError: A team whose robots differ, for an objective that depends on the whole
                history; or beta0 outside the range that the objective is exact for.
        """
        started = time.perf_counter()
        mean = _without_places(mean_of(params))
        dynamics = self._dynamics(mean, self._awareness, x0)
        solve.require_valid(dynamics, self._objective)
        best = self._search(self._objective.capped(dynamics).flat())
        if best.paths[0, 0] < 0:
            raise TrustboError(
                f"too many partial paths are worth keeping; lower max_bounds = {self.longest}."
            )
        nodes = list(self.graph)
        path = tuple(nodes[i] for i in best.paths[0] if i >= 0)
        plan, gap = self.evaluate(path, mean, x0=x0), float(best.gap[0])
        return replace(
            plan,
            bands=self.evaluate(path, params, x0=x0).bands,
            exact=gap <= solve.EXACT,
            bound=solve.value_limit(self._objective.name, plan.value, gap),
            seconds=time.perf_counter() - started,
        )

    def evaluate(
        self, path: Sequence[Node], params: Params | xr.DataTree, *, x0: ArrayLike | None = None
    ) -> RoadPlan:
        """Evaluate a given path; `exact` is False and `bound` NaN.

        Args:
            path: Nodes, each the end of an edge from the last.
            params: Posterior or parameters; of several draws, `trust` and `value` are the means.
            x0: Expected trust at the start; by default `params.x0_mean`.

        Raises:
            ShapeError: Parameters of other robots or features.
            TrustboError: No edge leads from a node to the next.
        """
        params = _without_places(draws_of(params, day=True))
        if len(path) < 2:
            raise TrustboError(f"a path has two nodes at least; got {path!r}.")
        for edge in pairwise(path):
            if edge not in self._edges:
                raise TrustboError(f"no edge leads from {edge[0]!r} to {edge[1]!r}.")
        which = [self._edges[edge] for edge in pairwise(path)]
        z, length = self._awareness[which], float(self._lengths[which].sum())
        toll = float(self._tolls[which].sum())
        found = value_along(params, z, self._objective, self._team, toll, x0)
        return RoadPlan(
            tuple(path), length, z, found.draws.mean(0), bands_of(found.draws), found.value,
            self._objective.name, False, np.nan, self.features, self.robots,
        )  # fmt: skip

    def graph_of(self, params: Params | xr.DataTree) -> nx.DiGraph:
        """Build the graph with the costs of its edges, for other programs: see `Planner.graph_of`.

        Args:
            params: Posterior or parameters, whose mean is taken.

        Returns:
            Copy of the graph whose edges have `cost`, that of stationary, and for lost_contact of
            rates that measure trust `lost`, the contact that the bound would lose if all were like
            it, in bounds; tolls of length are in both.

        Raises:
            TrustboError: abs(beta0) >= 1, for which trust settles nowhere.
        """
        graph = self.graph.copy()
        dynamics = self._dynamics(_without_places(mean_of(params)), self._awareness, None)
        solve.require_valid(dynamics, self._objective._replace(name="stationary"))
        values = {"cost": softplus(-dynamics.steady_state().ravel())}
        if self._objective.name == "lost_contact" and not self._objective.lag:
            values["lost"] = solve.settled_loss(self._objective, dynamics).ravel()
        for name, of_edges in values.items():
            for edge, value in zip(self._edges, (of_edges + self._tolls).tolist(), strict=True):
                graph.edges[edge][name] = value
        return graph

    @property
    def _tolls(self) -> np.ndarray:
        """Cost of each edge's metres, (edge,)."""
        weight = self._objective.length_weight
        return weight * self._lengths if weight else np.zeros(len(self._edges))

    def _dynamics(self, params: Params, z: np.ndarray, x0: ArrayLike | None) -> Dynamics:
        """Recursion of expected trust whose cells are the edges, in a row."""
        return trust_dynamics(params, z.swapaxes(0, 1)[:, None, None], self._team, x0)

    def _search(self, dynamics: Dynamics) -> Best:
        """Best path of one draw; cells are indices of nodes."""
        objective, tolls = self._objective, self._tolls
        if objective.name == "stationary":
            return self._shortest(softplus(-dynamics.steady_state().ravel()) + tolls)
        if not (dynamics.is_scalar if objective.has_labels else len(dynamics.views) == 1):
            raise TrustboError(
                f"on a graph, {objective.name!r} is planned for the mean of robots that share their"
                " parameters; give tb.fit(result.missions, tb.models.PooledTrust()) and "
                "team='mean', or plan 'stationary'."
            )
        graph, n = self._layers, len(self._edges)
        tolls, resources = tolls[graph.bound], no_resources(graph, n)
        if objective.has_labels:
            return best_history(graph, dynamics, objective, tolls, resources)
        weights = additive_weights(dynamics, dynamics.views[0], objective, self.longest)
        gains = weights.per_bound[0] @ dynamics.drift[0].reshape(-1, n)  # (left, edge)
        of_edges = gains[graph.rank[graph.head], graph.bound]
        return best_sums(graph, lambda _: of_edges, weights, tolls, resources)

    def _shortest(self, costs: np.ndarray) -> Best:
        weighted, index = nx.DiGraph(), {node: i for i, node in enumerate(self.graph)}
        for (a, c), cost in zip(self._edges, costs.tolist(), strict=True):
            weighted.add_edge(a, c, cost=cost)
        total, path = nx.single_source_dijkstra(weighted, self.start, self.goal, weight="cost")
        cost = np.array([total])
        return Best(np.array([[index[node] for node in path]]), cost, cost)

    @cached_property
    def _layers(self) -> Graph:
        """Roads unrolled over the bounds left."""
        index = {node: i for i, node in enumerate(self.graph)}
        tail, head = np.array([[index[a], index[c]] for a, c in self._edges]).T
        done = nx.single_source_shortest_path_length(self.graph, self.start)
        from_start = np.array([done.get(node, len(tail)) for node in self.graph])
        ends = index[self.start], index[self.goal]
        return unroll(tail, head, ends, from_start, self.longest, u_turns=self._u_turns)


def _without_places(params: Params) -> Params:
    """Parameters without effects of places, whose expectation is 0 on a road."""
    return params._replace(**dict.fromkeys(params.places))  # pyright: ignore[reportArgumentType]
