"""The reference engine: exact search on the course's networkx graph, one algorithm per family.

A path ends when it first enters the goal. Dijkstra with "trust on arrival" as the label is wrong
for every history-dependent objective: the cell's best label need not extend to the goal's best.
"""

import heapq
import itertools
from collections.abc import Callable, Mapping
from typing import Any

import networkx as nx
import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.planning.course import Course
from trustbo.planning.dominance import tests
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.layers import additive_weights
from trustbo.planning.objectives import LABELLED, Aim, softplus
from trustbo.planning.values import entry_cost, path_value

Path = tuple[Cell, ...]
_dijkstra: Any = nx.dijkstra_path  # networkx's own annotations do not know `backend=None`


def plan_networkx(course: Course, moves: Dynamics, aim: Aim, backend: str | None = None) -> Path:
    """The best path of one draw.

    Args:
        course: Which paths are admissible.
        moves: Without leading axes.
        aim: What the path should be best at.
        backend: networkx backend for shortest paths.
    """
    ends = (course.graph, course.start, course.goal)
    if aim.objective == "stationary":
        cost = entry_cost(course.passable, moves)
        return best_stationary(*ends, cost, aim.length_weight, backend)
    if aim.objective in LABELLED:
        limits = {"u_turns": course.u_turns, "revisit": course.revisit}
        return best_labelled(*ends, course.to_goal, moves, course.longest, aim.objective, **limits)
    find = _additive if len(moves.views) == 1 else _layered
    paths = find(course, moves, aim, backend)
    return max((p for p in paths if p is not None), key=lambda p: path_value(moves, aim, course, p))


def _additive(course: Course, moves: Dynamics, aim: Aim, backend: str | None) -> list[Path | None]:
    """The best path of every length."""
    weights = additive_weights(moves.stacked(), moves.views[0], aim.objective, course.longest)
    gains = np.tensordot(weights.per_bound[0], moves.drift, (1, 0))  # (left, row, col)
    paths = []
    for n_bounds in range(course.shortest, course.longest + 1):

        def gain(k: int, cell: Cell, n: int = n_bounds) -> float:
            return float(gains[n - k, *cell] / weights.scale[n])

        paths.append(
            best_additive(
                course.graph,
                course.start,
                course.goal,
                course.to_goal,
                gain,
                n_bounds,
                length_weight=aim.length_weight,
                u_turns=course.u_turns,
                backend=backend,
            )
        )
    return paths


def _layered(course: Course, moves: Dynamics, aim: Aim, backend: str | None) -> list[Path | None]:
    """The best path of every length, for a team's least trust; there is no shortest path in it."""
    return [
        best_layered(
            course.graph,
            course.start,
            course.goal,
            course.to_goal,
            moves,
            n_bounds,
            aim.objective,
            length_weight=aim.length_weight,
            u_turns=course.u_turns,
        )
        for n_bounds in range(course.shortest, course.longest + 1)
    ]


def best_additive(
    graph: nx.DiGraph,
    start: Cell,
    goal: Cell,
    to_goal: Mapping[Cell, int],
    gain: Callable[[int, Cell], float],
    n_bounds: int,
    *,
    length_weight: float = 0.0,
    u_turns: bool = True,
    backend: str | None = None,
) -> Path | None:
    """Path of exactly `n_bounds` bounds that maximises the sum of gain(k, path[k]).

    The cells are unrolled over the bounds into a layered DAG. All paths through it are equally
    long, so each layer's weights may be shifted to be non-negative: Dijkstra then applies, whatever
    the signs of the gains.

    Args:
        graph: Passable cells.
        start: First cell.
        goal: Last cell, entered by the last bound only.
        to_goal: Fewest bounds from each cell to the goal.
        gain: Of entering a cell by bound k.
        n_bounds: Of the path.
        length_weight: What a metre costs.
        u_turns: Whether a bound may lead back to the cell that the last one left.
        backend: networkx backend to dispatch to.

    Returns:
        The path, or None if none has that many bounds.
    """
    dag = nx.DiGraph()
    source, sink = (0, None, start), "goal"
    dag.add_node(source)
    layer = [source]
    for k in range(1, n_bounds + 1):
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
        gains = {target: gain(k, target[2]) for target in entered}
        most = max(gains.values())
        for target, sources in entered.items():
            for node in sources:
                length = graph.edges[node[2], target[2]]["length"]
                dag.add_edge(node, target, weight=most - gains[target] + length_weight * length)
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
    moves: Dynamics,
    max_bounds: int,
    objective: str,
    *,
    u_turns: bool = True,
    revisit: bool = True,
) -> Path:
    """Walk of at most `max_bounds` bounds with the best `success` or `bottleneck`.

    Label-setting: labels leave the queue in the order of their cost, which never falls along a
    walk. A later label at a cell is worth settling only if it can still become better than each
    earlier one (see `dominance`), takes fewer bounds, or, without revisits, has not been where the
    earlier one has.

    Raises:
        TrustboError: No walk is short enough.
    """
    combine: Callable[[float, float], float] = (
        (lambda cost, x: cost + float(softplus(-x)))
        if objective == "success"
        else (lambda cost, x: max(cost, -x))
    )
    marks = tests(moves, max_bounds)
    bit = {cell: 1 << i for i, cell in enumerate(graph)} if not revisit else {}
    settled: dict[object, list[tuple[np.ndarray, int, int]]] = {}
    order = itertools.count()  # among equal costs, first come first served: deterministic
    queue: list[Any] = [
        (-np.inf if objective == "bottleneck" else 0.0, 0, next(order), moves.start, (start,), 0)
    ]
    while queue:
        cost, n_bounds, _, x, path, seen = heapq.heappop(queue)
        cell, before = path[-1], path[-2] if len(path) > 1 and not u_turns else None
        if cell == goal:
            return path
        seen |= bit.get(cell, 0)
        known, mark = settled.setdefault((before, cell), []), marks @ x
        if any((q >= mark).all() and n <= n_bounds and s & ~seen == 0 for q, n, s in known):
            continue
        known.append((mark, n_bounds, seen))
        for other in graph.successors(cell):
            if n_bounds + 1 + to_goal.get(other, np.inf) > max_bounds or seen & bit.get(other, 0):
                continue
            if other == before:
                continue
            reached = moves.transition @ x + moves.drift[:, *other]
            trust = float((moves.views @ reached).min())
            label = (combine(cost, trust), n_bounds + 1, next(order), reached)
            heapq.heappush(queue, (*label, (*path, other), seen))
    raise TrustboError(f"no path has at most {max_bounds} bounds.")


def best_layered(
    graph: nx.DiGraph,
    start: Cell,
    goal: Cell,
    to_goal: Mapping[Cell, int],
    moves: Dynamics,
    n_bounds: int,
    objective: str,
    *,
    length_weight: float = 0.0,
    u_turns: bool = True,
) -> Path | None:
    """Path of exactly `n_bounds` bounds with the best `terminal` or `mean` of a team's least trust.

    Bound by bound, keeping at each cell all labels that no other dominates.
    """
    marks = tests(moves, n_bounds)
    labels: dict[object, list[tuple[np.ndarray, float, np.ndarray, Path]]] = {
        (None, start): [(marks @ moves.start, 0.0, moves.start, (start,))]
    }
    for k in range(1, n_bounds + 1):
        new: dict[object, list[tuple[np.ndarray, float, np.ndarray, Path]]] = {}
        for (before, cell), here in labels.items():  # pyright: ignore[reportGeneralTypeIssues]
            for other in graph.successors(cell):
                on_time = to_goal.get(other, np.inf) <= n_bounds - k
                if not on_time or (other == goal) != (k == n_bounds) or other == before:
                    continue
                toll = length_weight * graph.edges[cell, other]["length"]
                at = new.setdefault((None if u_turns else cell, other), [])
                for _, score, x, path in here:
                    reached = moves.transition @ x + moves.drift[:, *other]
                    trust = float((moves.views @ reached).min())
                    gained = trust if objective == "mean" or k == n_bounds else 0.0
                    _keep(at, (marks @ reached, score + gained - toll, reached, (*path, other)))
        labels = new
    ends = [label for at in labels.values() for label in at]
    return max(ends, key=lambda label: label[1])[3] if ends else None


def _keep(at: list[Any], label: Any) -> None:
    """Add a label unless another dominates it; drop those it dominates."""
    mark, score = label[:2]
    if any(s >= score and (q >= mark).all() for q, s, *_ in at):
        return
    at[:] = [old for old in at if not (score >= old[1] and (mark >= old[0]).all())]
    at.append(label)


def best_stationary(
    graph: nx.DiGraph,
    start: Cell,
    goal: Cell,
    cost: np.ndarray,
    length_weight: float = 0.0,
    backend: str | None = None,
) -> Path:
    """Simple path with the least sum of what its cells, shape (row, col), and metres cost."""
    weighted = nx.DiGraph()
    weighted.add_weighted_edges_from(
        (a, b, float(cost[b]) + length_weight * length)
        for a, b, length in graph.edges(data="length")
    )
    return tuple(_dijkstra(weighted, start, goal, weight="weight", backend=backend))
