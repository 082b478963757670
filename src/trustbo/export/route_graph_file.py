"""Files of route graphs for Nav2, and updates of the one that its route server has loaded.

They are GeoJSON of its loader (nav2_route): coordinates are metres in a frame, and a number in
`metadata` is a float only with a decimal point.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import yaml

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_kind, require_not_negative
from trustbo.export.frame import (
    AT_START,
    Frame,
    PlacedFrame,
    frame_file,
    placed,
    require_fine,
    save_beside,
)
from trustbo.export.route_graph import RouteGraph, graph_of, summed
from trustbo.files import FilePath, require_file, write_text
from trustbo.models.params import Params
from trustbo.planning import Planner
from trustbo.planning.problem import mean_of

_NEAR = 1e-6
"""Distance within which positions are the same, m."""
_SERVER = {
    "edge_cost_functions": ["PenaltyScorer", "DynamicEdgesScorer"],
    "PenaltyScorer": {"plugin": "nav2_route::PenaltyScorer"},
    "DynamicEdgesScorer": {"plugin": "nav2_route::DynamicEdgesScorer"},
}


def write_route_graph(
    path: FilePath,
    planner: Planner | Result,
    params: Params | xr.DataTree | None = None,
    *,
    objective: str | None = None,
    tolerance: float | None = None,
    overridable: bool = True,
    frame: Frame | PlacedFrame = AT_START,
) -> RouteGraph:
    """Write the graph of all possible bounds, with their costs, for the route server of Nav2.

    Costs of stationary are exact: the cheapest route is the plan. What a bound loses of
    lost_contact depends on the bounds before it; its cost is that once trust has settled, and of a
    failure in proportion to its risk. `gap` of the graph is the loss beyond the exact plan.

    A file with the suffix _params.yaml in the same folder has the parameters of the server, which
    by default plans by distance; another of the frame is as that of `write_ros_map`.

    Args:
        path: .geojson or .json file to write, or to replace.
        planner: Result, whose planner and posterior mean are taken; or a planner.
        params: Posterior or parameters, whose mean is taken, for a planner.
        objective: `"lost_contact"` or `"stationary"`; by default the planner's.
        tolerance: Largest distance of edges from the lead's way, m, which is a chain of straight
            ones; by default half a pixel. `inf`: each bound is one edge.
        overridable: Whether scorers of the server may change costs, which `edge_updates` need:
            the cost is in `metadata` then, for PenaltyScorer. False: costs are final.
        frame: Frame, by default at the start of the path, as the server holds positions in float32.

    Returns:
        Graph that was written.

    Raises:
        TrustboError: An objective that is no sum over bounds; abs(beta0) >= 1; more ids than
            messages of Nav2 hold; coordinates too large for float32; a frame that `write_ros_map`
            refuses; or a file that cannot be written.
    """
    target = require_file(path, ".geojson", ".json")
    params_file(target)
    frame_file(target)
    require_kind("planner", planner, Planner | Result, "give a Result, or a Planner and parameters")
    if isinstance(planner, Result):
        planner, params = planner.planner, planner.posterior
    if params is None:
        raise TrustboError("a planner needs parameters, such as a posterior.")
    if tolerance is not None and tolerance != math.inf:
        tolerance = require_not_negative("tolerance", tolerance)
    planner = summed(planner, objective)
    place = placed(frame, planner.workspace, planner.start)
    require_fine(place, planner.workspace, "a route graph")
    graph = graph_of(planner, mean_of(params), place, tolerance)
    save_route_graph(target, graph, overridable=overridable)
    save_beside(target, frame, place, planner.workspace)
    return graph


def params_file(path: Path) -> Path:
    """Return the file with the parameters of the route server, in the folder of a graph."""
    return require_file(path.with_name(f"{path.stem}_params.yaml"))


def save_route_graph(target: Path, graph: RouteGraph, *, overridable: bool = True) -> None:
    """Write a graph and the parameters of the server, without the file of the frame."""
    lines = []
    rows = zip(graph.nodes.tolist(), graph.positions.tolist(), graph.cells.tolist(), strict=True)
    for node, place, (row, col) in rows:
        about: dict[str, Any] = {"id": node, "frame": graph.frame}
        if row >= 0:
            about["metadata"] = {"row": row, "col": col}
        lines.append(_feature("Point", place, about))
    where = dict(zip(graph.nodes.tolist(), graph.positions.tolist(), strict=True))
    rows = zip(graph.edges.tolist(), graph.ends.tolist(), graph.costs.tolist(), strict=True)
    for edge, (start, end), cost in rows:
        about = {"id": edge, "startid": start, "endid": end, "cost": cost}
        about |= {"overridable": overridable, "metadata": {"penalty": cost}}
        lines.append(_feature("MultiLineString", [[where[start], where[end]]], about))
    text = '{"type": "FeatureCollection", "features": [\n' + ",\n".join(lines) + "\n]}\n"
    server = {"graph_filepath": target.name, "route_frame": graph.frame, **_SERVER}
    settings = params_file(target)
    head = (
        "# Parameters of the route server of Nav2; give graph_filepath as a path on the robot:\n"
        f"#   ros2 run nav2_route route_server --ros-args --params-file {settings.name}\n"
    )
    first, last = (graph.node_of(graph.route[end]) for end in (0, -1))
    head += f"# Costs are of {graph.objective}. The cheapest route from node {first} to {last}:\n"
    head += f"# {graph.compared()}.\n"
    record = {"route_server": {"ros__parameters": server}}
    write_text(settings, head + yaml.safe_dump(record, sort_keys=False))
    write_text(target, text)


def edge_updates(before: RouteGraph, after: RouteGraph) -> dict[str, list[Any]]:
    """Make the request by which a route server has the costs of another graph.

    It is that of the service `/route_server/DynamicEdgesScorer/adjust_edges`
    (nav2_msgs/srv/DynamicEdges), and has all edges, so that earlier requests do not matter.
    The server adds a cost to the penalty of its file; hence costs are differences to `before`, the
    graph that the server has loaded, not the last update.

    Args:
        before: Graph that the server has loaded, as `write_route_graph` returned it.
        after: Graph after further missions.

    Returns:
        `closed_edges` (ids that `after` lacks), `opened_edges` (those that it has), and
        `adjust_edges`, mappings of `edgeid` and `cost`: lists of plain numbers, for YAML or JSON.

    Raises:
        TrustboError: The graphs are of different workspaces or ways, or objectives; or `after` has
            an edge that `before` lacks, which needs SetRouteGraph.
    """
    if before.objective != after.objective:
        raise TrustboError(
            f"costs are of {before.objective!r} before, and of {after.objective!r} after; give "
            "graphs of one objective."
        )
    rows = zip(before.edges.tolist(), before.ends.tolist(), before.costs.tolist(), strict=True)
    known = {edge: (ends, cost) for edge, ends, cost in rows}
    places = dict(zip(before.nodes.tolist(), before.positions, strict=True))
    nowhere = np.full(2, np.nan)
    moved = [
        node
        for node, place in zip(after.nodes.tolist(), after.positions, strict=True)
        if not np.abs(places.get(node, nowhere) - place).max() < _NEAR
    ]
    edges = list(zip(after.edges.tolist(), after.ends.tolist(), after.costs.tolist(), strict=True))
    changed = [edge for edge, ends, _ in edges if known.get(edge, (None,))[0] != ends]
    if moved or changed:
        raise TrustboError(
            f"{len(moved)} nodes and {len(changed)} edges of the graph after are not in that "
            "before; an update changes costs alone. Give graphs of one workspace, frame and "
            "tolerance, or have the server load the new file by its service SetRouteGraph."
        )
    adjusted = [{"edgeid": edge, "cost": cost - known[edge][1]} for edge, _, cost in edges]
    opened = [edge for edge, *_ in edges]
    closed = sorted(known.keys() - set(opened))
    return {"closed_edges": closed, "opened_edges": opened, "adjust_edges": adjusted}


def _feature(kind: str, coordinates: list[Any], properties: Mapping[str, Any]) -> str:
    geometry = {"type": kind, "coordinates": coordinates}
    return _json({"type": "Feature", "properties": properties, "geometry": geometry})


def _json(value: Any) -> str:
    """JSON of plain values, every float with a decimal point, and without an exponent."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(k)}: {_json(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_json, value)) + "]"
    if isinstance(value, float):
        return np.format_float_positional(value, trim="0")
    return json.dumps(value)
