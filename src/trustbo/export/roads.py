"""Route graphs of Nav2 as graphs of bounds to plan on."""

import networkx as nx
import numpy as np

from trustbo.errors import TrustboError
from trustbo.export.frame import OF_CRS, Frame, placed
from trustbo.export.route_graph import RouteGraph
from trustbo.export.route_graph_file import read_route_graph
from trustbo.files import FilePath, interpreting
from trustbo.planning.roads import AWARENESS
from trustbo.workspace import Workspace
from trustbo.workspace.way_awareness import awareness_of_ways


def from_route_graph(
    path: FilePath, workspace: Workspace | None = None, *, frame: Frame = OF_CRS
) -> nx.DiGraph:
    """Read a route graph of Nav2 as a graph whose edges are bounds, for `planning.RoadPlanner`.

    Each node is a stop of the lead, each edge a bound. In files of `write_route_graph`, where a
    chain of edges is one bound, nodes within chains are left out, and the id of a cell is
    row * columns + column.

    Args:
        path: GeoJSON file, of `write_route_graph` or any other for the route server.
        workspace: Workspace on the terrain of the roads: edges get its features, with T2 at the
            node where the lead sets out. By default edges have the `awareness` in their metadata,
            features by name, a number or one for each robot, which `write_route_graph` writes.
        frame: Frame of the file's positions, for a workspace.

    Returns:
        Graph of the nodes' ids: nodes with `x` and `y` in the frame, m; edges with `ids` of the
        file's edges, `length`, m, `cost`, and `awareness` where it is known. `graph["robots"]` are
        the robots' names.

    Raises:
        DamagedFileError: There is no such file, or it is no route graph.
        TrustboError: Two edges from one node to another; roads off the terrain; or a workspace or a
            frame that cannot be.
    """
    read = read_route_graph(path)
    where = dict(zip(read.nodes.tolist(), read.positions, strict=True))
    graph = nx.DiGraph()
    if read.robots:
        graph.graph["robots"] = read.robots
    stops = read.cells[:, 0] >= 0
    stops = read.nodes[stops if stops.any() else ...].tolist()
    for node in stops:
        graph.add_node(node, x=float(where[node][0]), y=float(where[node][1]))
    ways = {}
    with interpreting(path):
        chains = _chains(read, set(stops))
    for chain, edges, costs in chains:
        if graph.has_edge(chain[0], chain[-1]):
            raise TrustboError(
                f"{str(path)!r} has two edges from {chain[0]} to {chain[-1]}, of which a path of "
                "nodes does not say which; remove one."
            )
        points = np.array([where[node] for node in chain])
        about = {"ids": tuple(edges), "length": float(np.hypot(*np.diff(points, axis=0).T).sum())}
        if edges[0] in read.awareness:
            about[AWARENESS] = read.awareness[edges[0]]
        graph.add_edge(chain[0], chain[-1], cost=sum(costs), **about)
        ways[chain[0], chain[-1]] = points
    if workspace is not None:
        to_crs = placed(frame, workspace).to_crs
        awareness = awareness_of_ways(workspace, [to_crs(points) for points in ways.values()])
        graph.graph["robots"] = workspace.team.names
        for ends, values in zip(ways, awareness, strict=True):
            of_features = dict(zip(workspace.features, values.T.tolist(), strict=True))
            graph.edges[ends][AWARENESS] = of_features
    return graph


def _chains(read: RouteGraph, stops: set[int]) -> list[tuple[list[int], list[int], list[float]]]:
    """Nodes, edges and costs of the chains from stop to stop."""
    rows = zip(read.edges.tolist(), read.ends.tolist(), read.costs.tolist(), strict=True)
    onward: dict[int, list[tuple[int, int, float]]] = {}
    for edge, (start, end), cost in rows:
        onward.setdefault(start, []).append((edge, end, cost))
    chains = []
    for start in [node for node in read.nodes.tolist() if node in stops]:
        for edge, end, cost in onward.get(start, ()):
            nodes, edges, costs = [start, end], [edge], [cost]
            while nodes[-1] not in stops:  # a node within a chain has one edge on
                if len(nodes) > len(read.nodes):
                    raise ValueError("a chain without an end")
                ((edge, end, cost),) = onward[nodes[-1]]
                nodes.append(end)
                edges.append(edge)
                costs.append(cost)
            chains.append((nodes, edges, costs))
    return chains
