"""Graph of passable cells, and the fewest bounds between cells."""

import networkx as nx
import numpy as np
from numba import njit

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES


class NoPathError(TrustboError, nx.NetworkXNoPath):
    """The goal cannot be reached from the start."""


def cell_graph(workspace: Workspace, connectivity: int, bounds: np.ndarray) -> nx.DiGraph:
    """Build the graph with passable cells `(row, col)` as nodes and possible bounds as edges.

    Bounds (move, row, col) are of a connectivity's moves. A DiGraph with node attributes `x`, `y`
    (CRS metres) and edge attribute `length` (m).
    """
    moves, grid, passable = MOVES[connectivity], workspace.grid, workspace.passable.values
    graph = nx.DiGraph()
    for row, col in np.argwhere(passable).tolist():
        x, y = grid.center((row, col))
        graph.add_node((row, col), x=x, y=y)
    lengths = move_lengths(workspace, connectivity).tolist()
    for row, col in list(graph):
        for m, ((down, right), length) in enumerate(zip(moves, lengths, strict=True)):
            other = (row + down, col + right)
            if other in graph and bounds[m, *other]:
                graph.add_edge((row, col), other, length=length)
    return graph


def move_lengths(workspace: Workspace, connectivity: int) -> np.ndarray:
    """Length of each move in metres, in the order of `MOVES`."""
    size = workspace.grid.cell_height, workspace.grid.cell_width
    return np.hypot(*(np.array(MOVES[connectivity]) * size).T)


def fewest_bounds(
    bounds: np.ndarray, cell: Cell, connectivity: int, *, back: bool = False
) -> np.ndarray:
    """Fewest bounds from a cell to every other, shape (row, col); -1 where there is no way.

    Of bounds (move, row, col) of a connectivity's moves. With `back`, from every other to the cell.
    """
    # A closed margin saves the test whether a move leaves the grid.
    closed = np.pad(bounds, ((0, 0), (1, 1), (1, 1)))
    rows, cols = closed.shape[1:]
    fewest = np.full(rows * cols, -1, np.int32)
    steps = np.array(MOVES[connectivity]) @ (cols, 1)
    start = (cell[0] + 1) * cols + cell[1] + 1
    _breadth_first(fewest, closed.reshape(len(bounds), -1), start, steps, back)
    return fewest.reshape(rows, cols)[1:-1, 1:-1]


@njit(cache=True, nogil=True)
def _breadth_first(fewest, bounds, start, steps, back):
    queue = np.empty(len(fewest), np.int32)
    queue[0], fewest[start] = start, 0
    first, last = 0, 1
    while first < last:
        c = queue[first]
        first += 1
        for m in range(len(steps)):
            other = c - steps[m] if back else c + steps[m]
            if bounds[m, c if back else other] and fewest[other] == -1:
                fewest[other] = fewest[c] + 1
                queue[last] = other
                last += 1
