"""Unrolled graph, which contains a copy of each cell and bound for each number of bounds left.

A state (cell, n_bounds_left) is a cell from which exactly `n_bounds_left` bounds remain. Each edge
is a bound, and leads to a state with one bound fewer left. Paths through the graph are the
admissible paths, except that U-turns must be excluded if they are forbidden. Compiled kernels
process the states in order of `n_bounds_left`.
"""

from typing import NamedTuple

import numpy as np

from trustbo import kernels
from trustbo.workspace.moves import END

kernel = kernels.kernel()
"""Numba decorator of the kernels of the search."""
part = kernels.part()
"""Numba decorator of what only these kernels call."""


class Unrolled(NamedTuple):
    """Graph whose states are sorted by the number of bounds left, and edges by their tails.

    Attributes:
        cell: Flat index of the cell of each state, shape (state,).
        n_bounds_left: Number of bounds left in each state, shape (state,); state 0 is the goal.
        first: Index of the first edge that leaves each state, followed by the number of edges.
        head: State to which each edge leads, shape (edge,).
        bound: Flat index way * cells + cell of the bound of each edge, shape (edge,). With several
            sets of posts, successive edges lead to the same state by the same move.
        station: Flat index posts * cells + cell of the set of posts and the cell that each edge
            leaves, shape (edge,).
        starts: Index of the start state of each path length, ascending, shape (length,).
        turns: Whether U-turns are allowed.
    """

    cell: np.ndarray
    n_bounds_left: np.ndarray
    first: np.ndarray
    head: np.ndarray
    bound: np.ndarray
    station: np.ndarray
    starts: np.ndarray
    turns: bool

    @property
    def longest(self) -> int:
        """Largest number of bounds of a path."""
        return int(self.n_bounds_left[-1])


class Committed(NamedTuple):
    """Unrolled graph for costs that depend on a bound and on the way that follows it.

    A state of `graph` is a state of the plain graph together with the way out of it, so each edge
    knows the next way. U-turns are excluded by leaving out their edges.

    Attributes:
        graph: Unrolled graph; its attribute `turns` is True, as no search has to exclude U-turns.
        risk: Flat index into (way, row, col, next_way) of the bound of each edge, shape (edge,).
    """

    graph: Unrolled
    risk: np.ndarray


def committed(graph: Unrolled, n_cells: int, n_ways: int, number: np.ndarray | None) -> Committed:
    """Add the way out of each state to the states of a graph.

    Args:
        graph: Plain graph.
        n_cells: Number of cells of the grid.
        n_ways: Number of ways, which is the next way at the end of a path.
        number: Index of each bound and next way, shape (way, cell, next way). It becomes `bound` of
            the edges. None to keep `bound`.
    """
    way, entered = np.divmod(graph.bound, n_cells)
    move = way % END

    # A plain edge becomes a state, whose index is that of the edge + 1; state 0 is the goal. Each
    # plain edge is repeated for each one that can follow, or once if it enters the goal (-1).
    n_after = np.where(graph.head > 0, np.diff(graph.first)[graph.head], 1)
    edge = np.repeat(np.arange(len(way)), n_after)
    number_after = np.arange(len(edge)) - np.repeat(np.cumsum(n_after) - n_after, n_after)
    head = graph.head[edge]
    after = np.where(head > 0, graph.first[head] + number_after, -1)
    if not graph.turns:
        is_kept = (after < 0) | (move[after] != END - 1 - move[edge])  # the reverse of m is 7 - m
        edge, after = edge[is_kept], after[is_kept]

    next_way = np.where(after < 0, n_ways, way[after])
    bound = graph.bound[edge]
    if number is not None:
        bound = number[way[edge], entered[edge], next_way]

    tail = np.repeat(np.arange(len(graph.cell)), np.diff(graph.first))
    ends = [np.arange(*graph.first[s : s + 2]) + 1 for s in graph.starts]
    whole = Unrolled(
        cell=np.concatenate([graph.cell[:1], graph.cell[tail]]),
        n_bounds_left=np.concatenate([graph.n_bounds_left[:1], graph.n_bounds_left[tail]]),
        first=np.searchsorted(edge + 1, np.arange(len(way) + 2)),
        head=(after + 1).astype(np.int32),
        bound=bound,
        station=graph.station[edge],
        starts=np.concatenate(ends).astype(graph.starts.dtype),
        turns=True,
    )
    cell = (way[edge].astype(np.int64) * n_cells + entered[edge]) * (n_ways + 1)
    return Committed(whole, cell + next_way)


class ToGo(NamedTuple):
    """Costs (state,) and first edges (state,) of the best and second-best paths to the goal.

    The best path has the cost `least` and the first edge `edge`. The second-best path, which first
    enters another cell, has `second` and `other`. A forbidden U-turn excludes one cell.
    """

    least: np.ndarray
    edge: np.ndarray
    second: np.ndarray
    other: np.ndarray


@part
def new_to_go(n_states: int) -> ToGo:
    """Allocate arrays for the costs from `n_states` states to the goal."""
    edge = np.full(n_states, -1)
    other = np.full(n_states, -1)
    return ToGo(np.zeros(n_states), edge, np.full(n_states, np.inf), other)


@part
def fill_to_go(graph, cost, to_go) -> None:
    """Fill `to_go` for the edge costs (edge,) by dynamic programming, starting at the goal."""
    least, edge, second, other = to_go
    cell = graph.cell
    first = graph.first
    head = graph.head

    for s in range(1, len(cell)):
        low = np.inf
        next_low = np.inf
        at = -1
        at_next = -1
        for e in range(first[s], first[s + 1]):
            h = head[e]
            value = cost[e] + least[h]  # Bellman's equation
            if not graph.turns and edge[h] >= 0 and cell[head[edge[h]]] == cell[s]:
                value = cost[e] + second[h]  # the best path from h would be a U-turn

            # Edges that enter the same state are successive and differ in their posts.
            again = at >= 0 and head[at] == h
            if value < low:
                if not again:
                    next_low = low
                    at_next = at
                low = value
                at = e
            elif value < next_low and not again:
                next_low = value
                at_next = e

        least[s] = low
        edge[s] = at
        second[s] = next_low
        other[s] = at_next


@part
def edges_from(graph, to_go, start, edges) -> int:
    """Write the edges of the cheapest path from a state to `edges`, and return their number."""
    s = start
    before = -1
    n = 0

    while s > 0:
        e = to_go.edge[s]
        if not graph.turns and graph.cell[graph.head[e]] == before:
            e = to_go.other[s]
        edges[n] = e
        before = graph.cell[s]
        s = graph.head[e]
        n += 1

    return n
