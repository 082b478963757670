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


class Paired(NamedTuple):
    """Unrolled graph for costs that depend on a bound and on the next move.

    A state of `graph` is a state of the plain graph together with the bound that led to it, so each
    edge knows the bound before it. U-turns are excluded by leaving out their edges.

    Attributes:
        graph: Unrolled graph; its attribute `turns` is True, as no search has to exclude U-turns.
        completed: Flat index into (move, row, col, next_move) of the bound before each edge, with
            the move of the edge as the next move, shape (edge,); -1 if the edge leaves the start.
        last: The same index for the edge's own bound if it enters the goal, otherwise -1, shape
            (edge,).
    """

    graph: Unrolled
    completed: np.ndarray
    last: np.ndarray

    def of_edges(self, values: np.ndarray) -> np.ndarray:
        """Add up values of bounds with their next moves over the bounds that each edge completes.

        Args:
            values: Values (bound, ...), where the index of a bound is a flat index into (move, row,
                col, next_move).

        Returns:
            Sums (edge, ...). The total along a path counts each bound of the path once.
        """
        nothing = np.zeros((1, *values.shape[1:]))
        padded = np.concatenate([values, nothing])  # the index -1
        return padded[self.completed] + padded[self.last]


def paired(graph: Unrolled, n_cells: int) -> Paired:
    """Add the bound that led to each state to the states of a graph.

    Args:
        graph: Plain graph.
        n_cells: Number of cells of the grid.
    """
    n_moves = END
    way, entered = np.divmod(graph.bound.astype(np.int64), n_cells)
    move = way % n_moves  # move of each edge; risks do not depend on the posts

    # The key of a state is `number of the plain state` x 9 + `move that led there`, where 8 stands
    # for the start. These keys keep the order of the states. All ways to enter the goal form one
    # state.
    width = n_moves + 1
    onward = np.where(graph.head > 0, graph.head.astype(np.int64) * width + move, 0)
    begun = graph.starts.astype(np.int64) * width + n_moves
    keys = np.unique(np.concatenate([[0], begun, onward]))
    plain_state, came_by = np.divmod(keys, width)

    # Repeat the edges of each plain state for each move that led there.
    n_edges = np.diff(graph.first)[plain_state]
    tail = np.repeat(np.arange(len(keys)), n_edges)
    before = np.cumsum(n_edges) - n_edges
    edge = np.arange(len(tail)) - before[tail] + graph.first[plain_state[tail]]
    if not graph.turns:
        is_kept = move[edge] != n_moves - 1 - came_by[tail]  # the reverse of move m is move 7 - m
        tail, edge = tail[is_kept], edge[is_kept]

    first = np.searchsorted(tail, np.arange(len(keys) + 1))
    head = np.searchsorted(keys, onward[edge]).astype(np.int32)

    left = graph.cell[plain_state[tail]]  # the cell in which the bound before the edge ended
    by = came_by[tail]
    completed = np.where(by < n_moves, (by * n_cells + left) * width + move[edge], -1)
    own = (move[edge] * n_cells + entered[edge]) * width + END
    last = np.where(head == 0, own, -1)

    whole = Unrolled(
        cell=graph.cell[plain_state],
        n_bounds_left=graph.n_bounds_left[plain_state],
        first=first,
        head=head,
        bound=graph.bound[edge],
        station=graph.station[edge],
        starts=np.searchsorted(keys, begun).astype(graph.starts.dtype),
        turns=True,
    )
    return Paired(whole, completed, last)


class ToGo(NamedTuple):
    """Costs (state,) and first edges (state,) of the best and second-best paths to the goal.

    The best path has the cost `least` and the first edge `edge`. The second-best path, which first
    enters another cell, has `second` and `other`. A forbidden U-turn excludes one cell.
    """

    least: np.ndarray
    edge: np.ndarray
    second: np.ndarray
    other: np.ndarray


@kernel
def new_to_go(n_states: int) -> ToGo:
    """Allocate arrays for the costs from `n_states` states to the goal."""
    edge = np.full(n_states, -1)
    other = np.full(n_states, -1)
    return ToGo(np.zeros(n_states), edge, np.full(n_states, np.inf), other)


@kernel
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


@kernel
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
