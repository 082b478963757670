"""Loader of route graphs by the rules of Nav2's own, and its search, without code of trustbo.

The rules are those of nav2_route (2025): `geojson_graph_file_loader.cpp`, `graph_loader.cpp`,
`route_planner.cpp`, `penalty_scorer.cpp`, `dynamic_edges_scorer.cpp`; ids are uint16 in the
messages of Jazzy. Numbers have the types that nlohmann::json gives them by their spelling.
"""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import networkx as nx

MOST_ID = 65_535


class GraphError(Exception):
    """Graph that the server cannot load, or cannot plan on."""


class _Unsigned(int):
    """Number that is spelt with digits alone."""


class _Float(float):
    """Number that is spelt with a decimal point or an exponent."""


@dataclass
class Server:
    """Route server with a graph, PenaltyScorer and DynamicEdgesScorer."""

    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    edges: dict[int, dict[str, Any]] = field(default_factory=dict)
    closed: set[int] = field(default_factory=set)
    dynamic: dict[int, float] = field(default_factory=dict)

    def adjust(self, request: dict[str, Any]) -> None:
        """Take a request of DynamicEdges."""
        for name in ("closed_edges", "opened_edges"):
            for edge in request[name]:
                _require_id(edge, "edge")
        self.closed |= set(request["closed_edges"])
        self.closed -= set(request["opened_edges"])
        for one in request["adjust_edges"]:
            _require_id(one["edgeid"], "edge")
            self.dynamic[one["edgeid"]] = one["cost"]

    def costs(self) -> dict[int, float]:
        """Cost of each edge that is open."""
        return {
            edge: self._cost(edge, about)
            for edge, about in self.edges.items()
            if not (about["overridable"] and edge in self.closed)
        }

    def _cost(self, edge: int, about: dict[str, Any]) -> float:
        if not about["overridable"]:
            if not about["cost"] > 0.0:
                raise GraphError(f"edge {edge} has no valid cost")
            return about["cost"]
        penalty = about["metadata"].get("penalty", _Float(0.0))
        if not isinstance(penalty, _Float):
            raise GraphError(f"any_cast<float> fails for the penalty {penalty!r} of edge {edge}")
        return penalty + self.dynamic.get(edge, 0.0)

    def graph(self) -> nx.MultiDiGraph:
        """Graph of open edges with their `cost`."""
        graph = nx.MultiDiGraph()
        graph.add_nodes_from(self.positions)
        for edge, cost in self.costs().items():
            about = self.edges[edge]
            graph.add_edge(about["startid"], about["endid"], key=edge, cost=cost)
        return graph

    def route(self, start: int, goal: int) -> list[int]:
        """Ids of the nodes of the cheapest route, by networkx."""
        return nx.dijkstra_path(self.graph(), start, goal, weight="cost")


def load(path: str | Path, route_frame: str = "map", frames: tuple[str, ...] = ()) -> Server:
    """Load a file; `frames` are those with a known transform to `route_frame`."""
    try:
        content = json.loads(
            Path(path).read_text(),
            parse_int=lambda text: int(text) if text.startswith("-") else _Unsigned(text),
            parse_float=_Float,
            parse_constant=_no_constant,
        )
    except ValueError as error:
        raise GraphError(f"failed to parse: {error}") from None
    kinds = {"Point": [], "LineString": [], "MultiLineString": []}
    for feature in content.get("features") or ():
        kinds.get(feature["geometry"]["type"], []).append(feature)
    nodes, edges = kinds["Point"], kinds["LineString"] + kinds["MultiLineString"]
    if not nodes or not edges:
        raise GraphError("the graph is malformed: it has no nodes or no edges")
    server = Server()
    for node in nodes:
        _add_node(server, node, route_frame, frames)
    for edge in edges:
        _add_edge(server, edge["properties"])
    server.costs()  # as planning would find the first bad one
    return server


def _add_node(server: Server, node: dict, route_frame: str, frames: tuple[str, ...]) -> None:
    properties = node["properties"]
    number = _require_id(properties.get("id"), "node")
    if number in server.positions:
        raise GraphError(f"node {number} is there twice")
    frame = properties.get("frame", route_frame)
    if not isinstance(frame, str):
        raise GraphError(f"the frame of node {number} is {frame!r}")
    if frame not in (route_frame, "", *frames):
        raise GraphError(f"there is no transform from {frame!r} to {route_frame!r}")
    x, y = node["geometry"]["coordinates"][:2]
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in (x, y)):
        raise GraphError(f"node {number} is at {x!r}, {y!r}")
    server.positions[number] = float(x), float(y)
    _require_metadata(properties.get("metadata", {}))


def _add_edge(server: Server, properties: dict) -> None:
    number = _require_id(properties.get("id"), "edge")
    if number in server.edges or number in server.positions:
        raise GraphError(f"id {number} of an edge is not its alone")
    ends = [_require_id(properties.get(end), end) for end in ("startid", "endid")]
    for end in ends:
        if end not in server.positions:
            raise GraphError(f"node {end} of edge {number} does not exist")
    cost, overridable = properties.get("cost", 0.0), properties.get("overridable", True)
    if not isinstance(cost, int | float) or not isinstance(overridable, bool):
        raise GraphError(f"edge {number} has cost {cost!r}, overridable {overridable!r}")
    _require_metadata(properties.get("metadata", {}))
    server.edges[number] = {
        "startid": ends[0], "endid": ends[1], "cost": float(cost), "overridable": overridable,
        "metadata": properties.get("metadata", {}),
    }  # fmt: skip


def _no_constant(text: str) -> None:
    raise ValueError(f"{text} is no JSON")


def _require_id(value: object, what: str) -> int:
    if not isinstance(value, _Unsigned | int) or isinstance(value, bool) or value < 0:
        raise GraphError(f"the id of {what} is {value!r}")
    if value > MOST_ID:
        raise GraphError(f"id {value} of {what} is more than {MOST_ID}")
    return int(value)


def _require_metadata(metadata: object) -> None:
    """Primitive values, arrays of them, and objects of these."""
    if not isinstance(metadata, dict):
        raise GraphError(f"metadata is {metadata!r}")
    for key, value in metadata.items():
        if isinstance(value, dict):
            _require_metadata(value)
            continue
        for one in value if isinstance(value, list) else [value]:
            if not isinstance(one, bool | int | float | str):
                raise GraphError(f"failed to convert {key}: {one!r}")
