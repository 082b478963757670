"""Exact search for the best path, one algorithm per family of objectives.

The team's expected trust follows the scalar recursion x_k = beta0 x_{k-1} + u(path[k]) from x_0. A
path ends when it first enters the goal. Dijkstra with "trust on arrival" as the label is wrong for
every history-dependent objective: the cell's best label need not extend to the goal's best.
"""

import heapq
import itertools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import networkx as nx
import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.planning.objectives import softplus

Path = tuple[Cell, ...]
_dijkstra: Any = nx.dijkstra_path  # networkx's own annotations do not know `backend=None`


class Recursion(NamedTuple):
    """The team's expected trust: x_k = beta0 x_{k-1} + u(cell)."""

    beta0: float
    u: Mapping[Cell, float]
    x0: float


def additive_weights(objective: str, beta0: float, n_bounds: int) -> np.ndarray:
    """Weight of u(path[k]) in a path's value, up to a constant and a positive factor; (bound,).

    terminal: x^K = beta0^K x0 + sum_k beta0^(K-k) u_k. mean: the average of these over the ends.
    """
    powers = beta0 ** np.arange(n_bounds - 1.0, -1.0, -1.0)
    return powers if objective == "terminal" else np.cumsum(powers[::-1])[::-1] / n_bounds


def best_additive(
    graph: nx.DiGraph,
    start: Cell,
    goal: Cell,
    to_goal: Mapping[Cell, int],
    u: Mapping[Cell, float],
    weights: np.ndarray,
    *,
    u_turns: bool = True,
    backend: str | None = None,
) -> Path | None:
    """Path of exactly len(weights) bounds that maximises sum_k weights[k] u(path[k]).

    The cells are unrolled over the bounds into a layered DAG. All paths through it are equally
    long, so each layer's weights may be shifted to be non-negative: Dijkstra then applies, whatever
    the signs of u and beta0.

    Args:
        graph: Passable cells.
        start: First cell.
        goal: Last cell, entered by the last bound only.
        to_goal: Fewest bounds from each cell to the goal.
        u: Drift of each cell.
        weights: Weight of each bound.
        u_turns: Whether a bound may lead back to the cell that the last one left.
        backend: networkx backend to dispatch to.

    Returns:
        The path, or None if none has that many bounds.
    """
    n_bounds = len(weights)
    dag = nx.DiGraph()
    source, sink = (0, None, start), "goal"
    dag.add_node(source)
    layer = [source]
    for k, weight in enumerate(weights, start=1):
        entered = {}
        for node in layer:
            _, before, cell = node
            for other in graph.successors(cell):
                on_time = to_goal.get(other, np.inf) <= n_bounds - k
                if not on_time or (other == goal) != (k == n_bounds):
                    continue
                if not u_turns and other == before:
                    continue
                target = (k, None if u_turns else cell, other)
                entered.setdefault(target, []).append(node)
        if not entered:
            return None
        most = max(weight * u[target[2]] for target in entered)
        for target, sources in entered.items():
            for node in sources:
                dag.add_edge(node, target, weight=most - weight * u[target[2]])
        layer = list(entered)
    for node in layer:
        dag.add_edge(node, sink, weight=0.0)
    nodes: list[Any] = _dijkstra(dag, source, sink, weight="weight", backend=backend)
    return tuple(node[2] for node in nodes[:-1])


def best_labelled(
    graph: nx.DiGraph,
    start: Cell,
    goal: Cell,
    to_goal: Mapping[Cell, int],
    recursion: Recursion,
    max_bounds: int,
    objective: str,
    *,
    revisit: bool = True,
) -> Path:
    """Walk of at most `max_bounds` bounds with the best `success` or `bottleneck`, beta0 >= 0.

    Label-setting: labels leave the queue in the order of their cost, which never falls along a
    walk. A later label at a cell is worth settling only if it brings strictly more trust, or fewer
    bounds (or, without revisits, has not been where the earlier one has), for beta0 >= 0 makes
    more trust now more trust ever after.

    Raises:
        TrustboError: beta0 < 0, or no walk is short enough.
    """
    beta0, u, x0 = recursion
    if beta0 < 0:
        raise TrustboError(
            f"objective {objective!r} needs beta0 >= 0; got {beta0:g}. Use 'terminal' or 'mean'."
        )
    combine: Callable[[float, float], float] = (
        (lambda cost, x: cost + float(softplus(-x)))
        if objective == "success"
        else (lambda cost, x: max(cost, -x))
    )
    bit = {cell: 1 << i for i, cell in enumerate(graph)} if not revisit else {}
    settled: dict[Cell, list[tuple[float, int, int]]] = {cell: [] for cell in graph}
    order = itertools.count()  # among equal costs, first come first served: deterministic
    queue: list[Any] = [
        (-np.inf if objective == "bottleneck" else 0.0, 0, next(order), x0, (start,), 0)
    ]
    while queue:
        cost, n_bounds, _, x, path, seen = heapq.heappop(queue)
        cell = path[-1]
        if cell == goal:
            return path
        seen |= bit.get(cell, 0)
        if any(x <= x2 and n_bounds >= n2 and s2 & ~seen == 0 for x2, n2, s2 in settled[cell]):
            continue
        settled[cell].append((x, n_bounds, seen))
        for other in graph.successors(cell):
            if n_bounds + 1 + to_goal.get(other, np.inf) > max_bounds or seen & bit.get(other, 0):
                continue
            reached = beta0 * x + u[other]
            label = (combine(cost, reached), n_bounds + 1, next(order), reached)
            heapq.heappush(queue, (*label, (*path, other), seen))
    raise TrustboError(f"no path has at most {max_bounds} bounds.")


def best_stationary(
    graph: nx.DiGraph, start: Cell, goal: Cell, recursion: Recursion, backend: str | None = None
) -> Path:
    """Simple path with the least sum of softplus(-u / (1 - beta0)), by plain Dijkstra.

    Raises:
        TrustboError: abs(beta0) >= 1, where trust settles nowhere.
    """
    if abs(recursion.beta0) >= 1.0:
        raise TrustboError(
            f"objective 'stationary' needs abs(beta0) < 1; got {recursion.beta0:g}. "
            "Use 'terminal' or 'mean'."
        )
    cost = {c: float(softplus(-u / (1.0 - recursion.beta0))) for c, u in recursion.u.items()}
    weighted = nx.DiGraph()
    weighted.add_weighted_edges_from((a, b, cost[b]) for a, b in graph.edges)
    return tuple(_dijkstra(weighted, start, goal, weight="weight", backend=backend))
