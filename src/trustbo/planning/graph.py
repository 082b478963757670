"""Graph of passable cells, and the fewest bounds between cells."""

import networkx as nx
import numpy as np
from numba import njit

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, require_connectivity


class NoPathError(TrustboError, nx.NetworkXNoPath):
    """The goal cannot be reached from the start."""


def cell_graph(workspace: Workspace, connectivity: int = 8) -> nx.DiGraph:
    """Build the graph with passable cells `(row, col)` as nodes and possible bounds as edges.

    A DiGraph with node attributes `x`, `y` (CRS metres) and edge attribute `length` (m).
    TrustboError: a connectivity other than 4, or 8 to allow diagonal bounds too.
    """
    moves = MOVES[require_connectivity(connectivity)]
    grid, passable = workspace.grid, workspace.passable.values
    graph = nx.DiGraph()
    for row, col in np.argwhere(passable).tolist():
        x, y = grid.center((row, col))
        graph.add_node((row, col), x=x, y=y)
    lengths = move_lengths(workspace, connectivity).tolist()
    for row, col in list(graph):
        for (down, right), length in zip(moves, lengths, strict=True):
            other = (row + down, col + right)
            if other in graph:
                graph.add_edge((row, col), other, length=length)
    return graph


def move_lengths(workspace: Workspace, connectivity: int) -> np.ndarray:
    """Length of each move in metres, in the order of `MOVES`."""
    size = workspace.grid.cell_height, workspace.grid.cell_width
    return np.hypot(*(np.array(MOVES[connectivity]) * size).T)


def fewest_bounds(passable: np.ndarray, cell: Cell, connectivity: int) -> np.ndarray:
    """Fewest bounds between a cell and every other, shape (row, col); -1 where there is no way."""
    rows, cols = passable.shape
    # A closed margin saves the test whether a move leaves the grid.
    known = np.full((rows + 2, cols + 2), -1, np.int32)
    known[1:-1, 1:-1][~passable] = _CLOSED
    known[[0, -1]] = known[:, [0, -1]] = _CLOSED
    steps = np.array(MOVES[connectivity]) @ (cols + 2, 1)
    _breadth_first(known.ravel(), (cell[0] + 1) * (cols + 2) + cell[1] + 1, steps)
    return np.maximum(known[1:-1, 1:-1], -1)


_CLOSED = -2


@njit(cache=True, nogil=True)
def _breadth_first(known, start, steps):
    queue = np.empty(len(known), np.int32)
    queue[0], known[start] = start, 0
    first, last = 0, 1
    while first < last:
        c = queue[first]
        first += 1
        for step in steps:
            if known[c + step] == -1:
                known[c + step] = known[c] + 1
                queue[last] = c + step
                last += 1


def require_way(
    passable: np.ndarray, to_goal: np.ndarray, start: Cell, goal: Cell, connectivity: int
) -> None:
    """Refuse ends that are not connected: NoPathError, which counts the cells in reach."""
    if to_goal[start] < 0:
        n_reached = int((fewest_bounds(passable, start, connectivity) >= 0).sum())
        n_goal = int((to_goal >= 0).sum())
        raise NoPathError(
            f"no path from {start} to {goal}: {n_reached} of {int(passable.sum())} passable cells "
            f"can be reached from the start, and the goal from {n_goal}. Choose ends in one part, "
            "or a team with a larger max_slope."
        )
