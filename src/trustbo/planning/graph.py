"""The graph of passable cells, and which cells can be reached in how many bounds."""

from collections.abc import Mapping

import networkx as nx
import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.terrain import Workspace

Steps = tuple[tuple[int, int], ...]
MOVES: Mapping[int, Steps] = {
    4: ((-1, 0), (0, -1), (0, 1), (1, 0)),
    8: ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)),
}
"""Moves to the neighbouring cells, by connectivity."""


class NoPathError(TrustboError, nx.NetworkXNoPath):
    """The goal cannot be reached from the start."""


def cell_graph(workspace: Workspace, connectivity: int = 8) -> nx.DiGraph:
    """Passable cells as nodes `(row, col)`, possible bounds as edges.

    Args:
        workspace: Where.
        connectivity: 4, or 8 to allow diagonal bounds too.

    Returns:
        A DiGraph with node attributes `x`, `y` (CRS metres) and edge attribute `length` (m).

    Raises:
        TrustboError: Another connectivity.
    """
    if connectivity not in MOVES:
        raise TrustboError(f"connectivity must be 4 or 8; got {connectivity!r}.")
    grid, passable = workspace.grid, workspace.passable.values
    graph = nx.DiGraph()
    for row, col in np.argwhere(passable).tolist():
        x, y = grid.center((row, col))
        graph.add_node((row, col), x=x, y=y)
    for row, col in list(graph):
        for down, right in MOVES[connectivity]:
            other = (row + down, col + right)
            if other in graph:
                length = float(np.hypot(down * grid.cell_height, right * grid.cell_width))
                graph.add_edge((row, col), other, length=length)
    return graph


def fewest_bounds(graph: nx.DiGraph, start: Cell, goal: Cell) -> dict[Cell, int]:
    """Fewest bounds from every cell to the goal.

    Raises:
        NoPathError: None leads there from the start.
    """
    to_goal = dict(nx.single_target_shortest_path_length(graph, goal))
    if start not in to_goal:
        n_reached = len(nx.descendants(graph, start)) + 1
        raise NoPathError(
            f"no path from {start} to {goal}: {n_reached} of {len(graph)} passable cells can be "
            "reached from the start. Choose a goal among them, or a team with a larger max_slope."
        )
    return to_goal
