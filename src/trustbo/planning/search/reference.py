"""The reference engine: exact search on a networkx graph, one algorithm per family of objectives.

A path ends when it first enters the goal. Dijkstra with "trust on arrival" as the label is wrong
for every history-dependent objective: the best label of a cell need not extend to the best path.

Where plans have a risk, and for sums of the least of several trusts: labels with Pareto dominance,
bound by bound. A label is a walk, its trust, score and risk. Of two that are in one cell after as
many bounds, the one that has at least as good a score, as much trust at every bound to come, and no
more of any risk has the better of every completion; so labels that no other dominates suffice.
"""

import heapq
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import networkx as nx
import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import SCORES, Objective, softplus
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.risk import RiskTable
from trustbo.planning.search.case import Case
from trustbo.planning.search.dominance import dominance_tests
from trustbo.planning.search.graph import Best
from trustbo.planning.search.layers import additive_weights
from trustbo.planning.tolls import toll_along
from trustbo.planning.values import entry_cost, path_trust
from trustbo.workspace.moves import MOVES

Path = tuple[Cell, ...]


def plan_networkx(case: Case) -> Best | None:
    """Find the best path of every draw; None if none is feasible."""
    best = []
    for d in range(len(case.dynamics.start)):
        if (path := _of_draw(case, case.dynamics.take(d))) is None:
            return None
        best.append([case.admissible.flat(cell) for cell in path])
    paths = np.full((len(best), max(map(len, best))), -1)
    for flat, cells in zip(paths, best, strict=True):
        flat[: len(cells)] = cells
    return Best(paths, np.zeros(len(best)), np.zeros(len(best)))


def _of_draw(case: Case, dynamics: Dynamics) -> Path | None:
    """Best path of one draw, `dynamics` without leading axes."""
    admissible, _, objective, risk = case

    def score(path: Path) -> float:
        toll = toll_along(admissible, objective, path)
        trust = path_trust(dynamics.along(path), objective, toll)
        return float(SCORES[objective.name](trust))

    if risk is None:
        if objective.name == "stationary":
            cost = entry_cost(admissible.passable, dynamics)
            return best_stationary(admissible, cost, case.tolls)
        if objective.has_labels:
            return best_labelled(case, dynamics)
        if len(dynamics.views) == 1:  # the least of several views is no sum of weights
            return max(_best_sums(case, dynamics), key=score)
        nothing = np.zeros((0, len(admissible.steps), admissible.passable.size))
        risk = RiskTable(nothing, np.zeros(0), 0, np.zeros(0), nothing[:0])
    feasible = feasible_paths(case, dynamics, risk)
    cost = [risk.cost(risk.along(path, admissible.passable.shape)) for path in feasible]
    scores = [score(path) for path in feasible]
    return feasible[int(np.argmax(np.subtract(scores, cost)))] if feasible else None


def _best_sums(case: Case, dynamics: Dynamics) -> list[Path]:
    """Best path of each number of bounds, where the score is a sum of weights."""
    admissible, _, objective, _ = case
    weights = additive_weights(dynamics.flat(), dynamics.views[0], objective, admissible.longest)
    gains = np.tensordot(weights.per_bound[0], dynamics.drift, (1, 0))  # (left, move, row, col)
    paths, tolls = [], on_map(admissible, case.tolls)
    for n_bounds in range(admissible.shortest, admissible.longest + 1):

        def gain(k: int, before: Cell, cell: Cell, n: int = n_bounds) -> float:
            trust = float(_of_bound(gains[n - k], before, cell) / weights.scale[n])
            return trust - float(_of_bound(tolls, before, cell))

        path = best_additive(admissible, gain, n_bounds)
        if path is not None:
            paths.append(path)
    return paths


def _of_bound(values: np.ndarray, before: Cell, cell: Cell) -> Any:
    """Value of the bound into a cell from the one before, out of (..., move, row, col)."""
    n_moves = values.shape[-3]
    step = cell[0] - before[0], cell[1] - before[1]
    return values[..., MOVES[n_moves].index(step) if n_moves > 1 else 0, *cell]


def best_additive(
    admissible: AdmissiblePaths, gain: Callable[[int, Cell, Cell], float], n_bounds: int
) -> Path | None:
    """Find the path, if any, of exactly `n_bounds` bounds with the largest sum of gains.

    That of bound k is gain(k, path[k-1], path[k]).

    The grid is unrolled over the bounds into a layered DAG. All paths through it are equally long,
    so each layer's weights may be shifted to be non-negative: Dijkstra then applies, to gains of
    either sign.
    """
    graph, dag = admissible.graph, nx.DiGraph()
    source, sink = (0, None, admissible.start), "goal"
    dag.add_node(source)
    layer = [source]
    for k in range(1, n_bounds + 1):
        entered = {}
        for node in layer:
            _, before, cell = node
            for other in graph.successors(cell):
                if not _on_time(admissible, other, n_bounds - k):
                    continue
                if not admissible.u_turns and other == before:
                    continue
                target = (k, None if admissible.u_turns else cell, other)
                entered.setdefault(target, []).append(node)
        if not entered:
            return None
        bounds = {(node[2], target[2]) for target in entered for node in entered[target]}
        gains = {(a, c): gain(k, a, c) for a, c in bounds}
        most = max(gains.values())
        for target, sources in entered.items():
            for node in sources:
                bound = node[2], target[2]
                dag.add_edge(node, target, weight=most - gains[bound])
        layer = list(entered)
    for node in layer:
        dag.add_edge(node, sink, weight=0.0)
    nodes: list[Any] = nx.dijkstra_path(dag, source, sink, weight="weight")
    return tuple(node[2] for node in nodes[:-1])


def best_labelled(case: Case, dynamics: Dynamics) -> Path:
    """Find the walk with the best objective that has labels; TrustboError if none is short enough.

    Label setting: labels leave the queue in the order of their cost, which never falls along a
    walk. A later label at a cell is settled only if no earlier one with as few bounds dominates it
    (see `dominance`).
    """

    def combine(cost: float, x: float) -> float:
        if objective.name == "bottleneck":
            return max(cost, -x)
        if objective.name == "success":
            return cost + float(softplus(-x))
        return cost + float(objective.contact_lost(np.array([x]), dynamics.noise_sd)[0])

    admissible, _, objective, _ = case
    tolls = on_map(admissible, case.tolls)
    graph, to_goal, max_bounds = admissible.graph, admissible.to_goal, admissible.longest
    tests, u_turns = dominance_tests(dynamics, max_bounds), admissible.u_turns
    settled: dict[object, list[tuple[np.ndarray, int]]] = {}
    order = itertools.count()  # equal costs leave in the order of entry: deterministic
    first = -np.inf if objective.name == "bottleneck" else 0.0
    queue: list[Any] = [(first, 0, next(order), dynamics.start, (admissible.start,))]
    while queue:
        cost, n_bounds, _, x, path = heapq.heappop(queue)
        cell, before = path[-1], path[-2] if len(path) > 1 and not u_turns else None
        if cell == admissible.goal:
            return path
        earlier, tested = settled.setdefault((before, cell), []), tests @ x
        if any((q >= tested).all() and n <= n_bounds for q, n in earlier):
            continue
        earlier.append((tested, n_bounds))
        for other in graph.successors(cell):
            if n_bounds + 1 + to_goal.get(other, np.inf) > max_bounds or other == before:
                continue
            reached = dynamics.transition @ x + _of_bound(dynamics.drift, cell, other)
            trust = float((dynamics.views @ reached).min())
            toll = float(_of_bound(tolls, cell, other))
            label = (combine(cost, trust) + toll, n_bounds + 1, next(order), reached)
            heapq.heappush(queue, (*label, (*path, other)))
    raise TrustboError(f"no path has at most {max_bounds} bounds.")


def _on_time(admissible: AdmissiblePaths, cell: Cell, left: int) -> bool:
    """True if a path may enter a cell with so many bounds left; the goal only by the last."""
    return admissible.to_goal.get(cell, np.inf) <= left and (cell == admissible.goal) == (left == 0)


def best_stationary(admissible: AdmissiblePaths, cost: np.ndarray, tolls: np.ndarray) -> Path:
    """Find the simple path with the least cost of bounds, (move, row, col), and their tolls."""
    graph, ends = with_costs(admissible, cost, tolls), (admissible.start, admissible.goal)
    return tuple(nx.dijkstra_path(graph, *ends, weight="cost"))


def with_costs(
    admissible: AdmissiblePaths, cost: np.ndarray, tolls: np.ndarray, **values: np.ndarray
) -> nx.DiGraph:
    """Build the graph of bounds with their `cost`, their toll (see `tolls_of`) included.

    Further edge attributes by name; like costs these are of bounds, (move, row, col), of one move
    where all into a cell are alike.
    """
    graph, tolls = admissible.graph.copy(), on_map(admissible, tolls)
    for a, b, edge in graph.edges(data=True):
        edge["cost"] = float(_of_bound(cost, a, b)) + float(_of_bound(tolls, a, b))
        edge.update({name: float(_of_bound(value, a, b)) for name, value in values.items()})
    return graph


def on_map(admissible: AdmissiblePaths, tolls: np.ndarray) -> np.ndarray:
    """Tolls of bounds, (move, row, col), from (move, cell) or (move, 1)."""
    shape = admissible.passable.shape
    return np.broadcast_to(tolls, (len(tolls), shape[0] * shape[1])).reshape(-1, *shape)


class _Label(NamedTuple):
    criteria: np.ndarray
    """Numbers of which more is better: score, minus toll, minus risks, tests of trust."""
    x: np.ndarray
    path: Path


def feasible_paths(case: Case, dynamics: Dynamics, risk: RiskTable) -> list[Path]:
    """Find feasible paths that include the best one; none if no path is feasible."""
    admissible, _, objective, _ = case
    tolls = on_map(admissible, case.tolls)
    longest, drift, tests = admissible.longest, dynamics.drift, np.zeros((0, 1))
    if objective.name == "stationary":  # no history: the score of a bound is that of its own trust
        longest, drift = int(admissible.passable.sum()) - 1, dynamics.steady_state()[None]
        dynamics = dynamics._replace(transition=np.zeros((1, 1)), start=np.zeros(1), views=_ONE)
    else:
        tests = dominance_tests(dynamics, longest)
    first = np.inf if objective.name == "bottleneck" else 0.0
    start = np.concatenate([[first, 0.0], np.zeros(len(risk.limits)), tests @ dynamics.start])
    labels = {(None, admissible.start): [_Label(start, dynamics.start, (admissible.start,))]}
    paths, n_risks = [], len(risk.limits)
    for k in range(1, longest + 1):
        layer: dict[tuple[Cell | None, Cell], list[_Label]] = {}
        for (_, cell), here in labels.items():
            for m, other in _successors(admissible, cell):
                if admissible.to_goal.get(other, np.inf) > longest - k:
                    continue
                flat, by_move = admissible.flat(other), min(m, drift.shape[1] - 1)
                step, risks = drift[:, by_move, *other], risk.of_bounds[:, m, flat]
                toll = tolls[m, *other]
                for label in here:
                    if not admissible.u_turns and label.path[-2:-1] == (other,):
                        continue
                    x = dynamics.transition @ label.x + step
                    trust = float((dynamics.views @ x).min())
                    score = _score(objective, label.criteria[0], trust, dynamics.noise_sd)
                    total = label.criteria[2 : 2 + n_risks] - risks
                    if not risk.is_feasible(-total):
                        continue
                    paid = label.criteria[1] - toll
                    criteria = np.concatenate([[score, paid], total, tests @ x])
                    new = _Label(criteria, x, (*label.path, other))
                    if other == admissible.goal:
                        paths.append(new.path)
                    else:
                        before = None if admissible.u_turns else cell
                        _keep_label(layer.setdefault((before, other), []), new)
        labels = layer
    return paths


_ONE = np.ones((1, 1))


def _successors(admissible: AdmissiblePaths, cell: Cell) -> list[tuple[int, Cell]]:
    """Moves that lead from a cell, by index, and the cells entered."""
    steps = [(cell[0] + down, cell[1] + right) for down, right in admissible.steps.tolist()]
    return [(m, other) for m, other in enumerate(steps) if admissible.graph.has_edge(cell, other)]


def _score(objective: Objective, score: float, trust: float, noise_sd: np.ndarray) -> float:
    """Score of a label after one more bound, larger is better."""
    if objective.name == "bottleneck":
        return min(score, trust)
    if objective.name in ("success", "stationary"):
        return score - float(softplus(-trust))
    if objective.name == "lost_contact" and objective.has_labels:
        return score - float(objective.contact_lost(np.array([trust]), noise_sd)[0])
    return score if objective.name == "terminal" else score + trust


def _keep_label(labels: list[_Label], new: _Label) -> None:
    """Add a label unless another dominates it; drop those that it dominates."""
    if any((old.criteria >= new.criteria).all() for old in labels):
        return
    labels[:] = [old for old in labels if not (new.criteria >= old.criteria).all()]
    labels.append(new)
