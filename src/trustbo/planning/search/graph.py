"""The problem of the searches: a directed graph with costs, drifts and resources of its edges.

`SearchProblem` is the one record of a path problem on any graph: that of cells unrolled over the
bounds left (`layers`), cells alone (`grid_graph`), or other nodes and edges given in CSR form.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import PART

_part = njit(nogil=True, error_model="numpy", **PART)
_inlined = njit(nogil=True, error_model="numpy", inline="always")  # no counts of references


class Graph(NamedTuple):
    """Directed graph in CSR form: the edges of node n are first[n] to first[n + 1] - 1.

    Nodes are in the order of their rank, the (fewest) edges from them to the goal, which is node 0.
    Where the graph is `layered`, every edge leads to a node of lower rank: one pass over the nodes
    then suffices for what otherwise takes several.
    """

    first: np.ndarray  # (node + 1,)
    head: np.ndarray  # (edge,), node that it leads to
    rank: np.ndarray  # (node,)
    cell: np.ndarray  # (node,), the place that a path through the node enters
    move: np.ndarray  # (edge,); n_moves - 1 - move leads back
    bound: np.ndarray  # (edge,), index of its bound: move * cells + cell entered
    starts: np.ndarray  # (length,), node of the start by the number of bounds of a path, or -1
    n_moves: int
    u_turns: bool
    layered: bool


class Resources(NamedTuple):
    """Sums over the edges of a path that have limits, and a cost of the first few of them.

    A path is feasible if `needed` of its sums are within their limits. With r_m the first of them,
    the strata of a risk, it costs the sum of failure_costs[m] (1 - exp(-r_m)).
    """

    of_bounds: np.ndarray  # (bound, resource), not negative
    limits: np.ndarray  # (resource,), inf where there is none
    needed: int
    failure_costs: np.ndarray  # (stratum,), positive
    priced: np.ndarray  # (bound,), one resource whose limit every feasible path keeps
    priced_limit: float
    safest: np.ndarray  # (node, resource), least sums from a node to the goal


class SearchProblem(NamedTuple):
    """Path problems under several draws on one graph.

    Trust follows x -> beta0 x + drift along a path. An edge costs its toll and a loss of the trust
    after it, see `losses`; a path has a cost at its start, by its length.
    """

    graph: Graph
    toll: np.ndarray  # (draw, edge), or (1, edge) where it is the same under all draws
    drift: np.ndarray  # (draw, bound), or (draw, cell) where all bounds into a cell are alike
    start_cost: np.ndarray  # (draw, length); inf: not admissible
    trust: np.ndarray  # (draw, 3): beta0, x0 and the sd of a rate given trust
    loss: int  # of `losses`
    resources: Resources


class Best(NamedTuple):
    """Best paths: flat indices of cells filled with -1, (draw, length); no cells where none is.

    Costs (draw,), and lower limits on the cost of every path, equal to the costs where exact.
    """

    paths: np.ndarray
    cost: np.ndarray
    lower: np.ndarray

    @property
    def gap(self) -> np.ndarray:
        """Optimality gap of each path, (draw,)."""
        return self.cost - self.lower


class Costs(NamedTuple):
    """Costs of the edges under one draw: a row of each array of `SearchProblem`."""

    toll: np.ndarray  # (edge,)
    drift: np.ndarray  # (bound,) or (cell,)
    by_bound: bool
    start_cost: np.ndarray  # (length,)
    beta0: float
    x0: float
    noise_sd: float
    loss: int


def no_resources(graph: Graph, n_bounds: int) -> Resources:
    """Resources of a problem that has none."""
    none = np.empty((n_bounds, 0)), np.empty(0), 0, np.empty(0)
    return Resources(*none, np.empty(0), np.inf, np.empty((len(graph.rank), 0)))


@_part
def costs_of(problem: SearchProblem, draw: int) -> Costs:
    """Select one draw."""
    beta0, x0, noise_sd = problem.trust[draw]
    return Costs(
        problem.toll[min(draw, len(problem.toll) - 1)],
        problem.drift[min(draw, len(problem.drift) - 1)],
        problem.drift.shape[1] == len(problem.resources.of_bounds),
        problem.start_cost[min(draw, len(problem.start_cost) - 1)],
        beta0,
        x0,
        noise_sd,
        problem.loss,
    )


@_inlined
def drift_of(graph, costs, edge):  # noqa: ANN201
    """Drift of an edge."""
    column = graph.bound[edge] if costs.by_bound else graph.cell[graph.head[edge]]
    return costs.drift[column]


@_part
def filled(n: int, value: float) -> np.ndarray:
    """Array of `n` numbers; np.full takes longer to compile than this."""
    values = np.empty(n)
    for i in range(n):
        values[i] = value
    return values


def grid_graph(neighbours: np.ndarray, to_goal: np.ndarray, start: int) -> Graph:
    """Build the graph of the cells from which the goal can be reached.

    Args:
        neighbours: Cells that can be entered from each, flat indices (cell, move); -1 where none.
        to_goal: Fewest bounds to the goal of each cell, (cell,); -1 where there is no way.
        start: Flat index of the first cell.
    """
    cell = np.argsort(to_goal, kind="stable")
    cell = cell[np.searchsorted(to_goal[cell], 0) :]
    node_of = np.full(len(to_goal), -1)
    node_of[cell] = np.arange(len(cell))
    entered = neighbours[cell]
    heads = np.where(entered >= 0, node_of[entered], -1)
    heads[0] = -1  # a path ends at the goal
    tail, move = np.nonzero(heads >= 0)
    head = heads[tail, move]
    return Graph(
        first=np.searchsorted(tail, np.arange(len(cell) + 1)),
        head=head.astype(np.int32),
        rank=to_goal[cell].astype(np.int32),
        cell=cell.astype(np.int32),
        move=move.astype(np.int8),
        bound=(move * len(to_goal) + cell[head]).astype(np.int32),
        starts=node_of[[start]],
        n_moves=neighbours.shape[1],
        u_turns=True,
        layered=False,
    )
