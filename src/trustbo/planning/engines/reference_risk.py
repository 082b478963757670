"""The reference engine where plans have a risk: labels with Pareto dominance, for every objective.

A label is a walk, its trust, score and risk. Of two that are in one cell after as many bounds, the
one that has at least as good a score, as much trust at every bound to come, and no more of any
risk has the better of every completion; so labels that no other dominates suffice.
"""

from typing import NamedTuple

import numpy as np

from trustbo.data import Cell
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.engines.dominance import dominance_tests
from trustbo.planning.objectives import Objective, softplus
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.risk import RiskTable

Path = tuple[Cell, ...]


class _Label(NamedTuple):
    criteria: np.ndarray
    """Numbers of which more is better: score, minus length, minus risks, tests of trust."""
    x: np.ndarray
    path: Path


def feasible_paths(
    admissible: AdmissiblePaths, dynamics: Dynamics, objective: Objective, risk: RiskTable
) -> list[Path]:
    """Find feasible paths that include the best one; none if no path is feasible."""
    longest, drift, tests = admissible.longest, dynamics.drift, np.zeros((0, 1))
    if objective.name == "stationary":  # no history: the score of a bound is that of its own trust
        longest, drift = int(admissible.passable.sum()) - 1, dynamics.steady_state()[None]
        dynamics = dynamics._replace(transition=np.zeros((1, 1)), start=np.zeros(1), views=_ONE)
    else:
        tests = dominance_tests(dynamics, longest)
    # As in every engine, `revisit` concerns the objectives that depend on the whole history.
    simple = objective.has_labels and not admissible.revisit
    first = np.inf if objective.name == "bottleneck" else 0.0
    start = np.concatenate([[first, 0.0], np.zeros(len(risk.limits)), tests @ dynamics.start])
    labels = {(None, admissible.start): [_Label(start, dynamics.start, (admissible.start,))]}
    found, n_risks = [], len(risk.limits)
    for k in range(1, longest + 1):
        layer: dict[tuple[Cell | None, Cell], list[_Label]] = {}
        for (_, cell), here in labels.items():
            for m, other in _successors(admissible, cell):
                if admissible.to_goal.get(other, np.inf) > longest - k:
                    continue
                flat, by_move = admissible.flat(other), min(m, drift.shape[1] - 1)
                step, risks = drift[:, by_move, *other], risk.of_bounds[:, m, flat]
                metres = objective.length_weight * admissible.lengths[m]
                for label in here:
                    if _excluded(admissible, label.path, other, simple=simple):
                        continue
                    x = dynamics.transition @ label.x + step
                    trust = float((dynamics.views @ x).min())
                    score = _score(objective, label.criteria[0], trust, dynamics.noise_sd)
                    total = label.criteria[2 : 2 + n_risks] - risks
                    if not risk.is_feasible(-total):
                        continue
                    length = label.criteria[1] - metres
                    criteria = np.concatenate([[score, length], total, tests @ x])
                    new = _Label(criteria, x, (*label.path, other))
                    if other == admissible.goal:
                        found.append(new.path)
                    else:
                        at = layer.setdefault((None if admissible.u_turns else cell, other), [])
                        _keep(at, new, simple=simple)
        labels = layer
    return found


_ONE = np.ones((1, 1))


def _successors(admissible: AdmissiblePaths, cell: Cell) -> list[tuple[int, Cell]]:
    """Moves that lead from a cell, by index, and the cells entered."""
    steps = [(cell[0] + down, cell[1] + right) for down, right in admissible.steps.tolist()]
    return [(m, other) for m, other in enumerate(steps) if admissible.graph.has_edge(cell, other)]


def _excluded(admissible: AdmissiblePaths, path: Path, other: Cell, *, simple: bool) -> bool:
    """Whether a path may not go on to a cell, because of a U-turn or a revisit."""
    u_turn = not admissible.u_turns and len(path) > 1 and path[-2] == other
    return u_turn or (simple and other in path)


def _score(objective: Objective, score: float, trust: float, noise_sd: np.ndarray) -> float:
    """Score of a label after one more bound, larger is better."""
    if objective.name == "bottleneck":
        return min(score, trust)
    if objective.name in ("success", "stationary"):
        return score - float(softplus(-trust))
    if objective.name == "lost_contact" and objective.has_labels:
        return score - float(objective.contact_lost(np.array([trust]), trust, noise_sd)[0])
    at_end = objective.name == "terminal" or (objective.name == "lost_contact" and objective.lag)
    return score if at_end else score + trust


def _keep(at: list[_Label], new: _Label, *, simple: bool) -> None:
    """Add a label unless another dominates it; drop those that it dominates."""
    if any(_dominates(old, new, simple) for old in at):
        return
    at[:] = [old for old in at if not _dominates(new, old, simple)]
    at.append(new)


def _dominates(a: _Label, b: _Label, simple: bool) -> bool:
    return bool((a.criteria >= b.criteria).all()) and not (simple and set(a.path) - set(b.path))
