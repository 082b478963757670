"""The compiled engine: dispatch of each objective to its kernel."""

from typing import NamedTuple

import numpy as np

from trustbo.errors import TrustboError
from trustbo.parallel import over_rows, plain
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.risk import RiskTable
from trustbo.planning.search.buckets import best_stationary
from trustbo.planning.search.compiled_risk import (
    LayeredSearch,
    plan_layered,
    plan_stationary,
    require_complete,
)
from trustbo.planning.search.constrained_stationary import least_to_goal
from trustbo.planning.search.contact_loss import LAWS, TINY_SD, least_loss
from trustbo.planning.search.dominance import build_heuristic, dominance_tests
from trustbo.planning.search.dual import Best
from trustbo.planning.search.labels_vector import TERMINAL, LabelRisk, LabelSearch, mode_of, search
from trustbo.planning.search.layers import Weights, additive_weights, best_additive
from trustbo.planning.values import entry_cost

_TOLERANCES = (0.0, 1e-3, 1e-2, 3e-2, 0.1)
_MAX_LABELS = 300_000  # per search


class BestPaths(NamedTuple):
    """Best path of each draw.

    Fields: paths (draw, length), flat indices of cells, filled with -1; gap (draw,), optimality gap
    in sums of softplus for `success`, in trust elsewhere.
    """

    paths: np.ndarray
    gap: np.ndarray


def plan_compiled(
    admissible: AdmissiblePaths,
    dynamics: Dynamics,
    objective: Objective,
    risk: RiskTable | None = None,
) -> BestPaths | None:
    """Find the best path of every draw; `dynamics` with a leading axis (draw,).

    None if no path is feasible under a risk.
    """
    if risk is not None:
        return _within_risk(admissible, dynamics, objective, risk)
    length_cost = objective.length_weight * admissible.lengths
    if objective.name == "lost_contact" and objective.has_labels and dynamics.is_scalar:
        if admissible.revisit:
            return _least_loss(admissible, dynamics, objective, length_cost)
    if objective.has_labels or (objective.name != "stationary" and len(dynamics.views) > 1):
        return _labelled(admissible, dynamics, objective, length_cost)
    if objective.name == "stationary":
        _, paths = best_stationary(
            lambda part: admissible.masked(dynamics.take(part).steady_state()),
            len(dynamics.start),
            admissible.passable,
            length_cost,
            admissible.steps,
            admissible.flat(admissible.start),
            admissible.flat(admissible.goal),
        )
    else:
        weights = additive_weights(dynamics, dynamics.views[0], objective, admissible.longest)
        drift = dynamics.drift.reshape(*dynamics.drift.shape[:3], -1)
        paths = _best_of_lengths(admissible, drift, weights, length_cost)
    return BestPaths(paths, np.zeros(len(paths)))


def _within_risk(
    admissible: AdmissiblePaths, dynamics: Dynamics, objective: Objective, risk: RiskTable
) -> BestPaths | None:
    length_cost = objective.length_weight * admissible.lengths
    if objective.name == "stationary":
        cost = entry_cost(admissible.passable, dynamics)
        return _found(plan_stationary(admissible, cost, length_cost, risk), admissible)
    scalar = dynamics.is_scalar if objective.has_labels else len(dynamics.views) == 1
    if not scalar or (objective.has_labels and not admissible.revisit):
        return _labelled(admissible, dynamics, objective, length_cost, risk)
    return _found(plan_layered(admissible, dynamics, objective, risk), admissible)


def _found(found: list[Best], admissible: AdmissiblePaths) -> BestPaths | None:
    """Paths and gaps of all draws, None if no path is feasible, which no draw changes."""
    require_complete(found, admissible.longest)
    if not all(len(best.path) for best in found):
        return None
    paths = np.full((len(found), max(len(best.path) for best in found)), -1, np.int64)
    for row, best in zip(paths, found, strict=True):
        row[: len(best.path)] = best.path
    return BestPaths(paths, np.array([best.cost - best.bound for best in found]))


def expected_path(
    admissible: AdmissiblePaths,
    dynamics: Dynamics,
    objective: Objective,
    risk: RiskTable | None = None,
) -> np.ndarray | None:
    """Find the path with the best *expectation* of terminal or mean trust, or of lost contact.

    These are linear in u with weights that do not depend on the path, so the expectation of weight
    times u, per bound and bounds left, replaces them: exact, with no assumption on the posterior.

    Returns:
        Flat indices of cells, filled with -1; None if no path is feasible under a risk.
    """
    weights = additive_weights(dynamics, dynamics.views[0], objective, admissible.longest)
    u = dynamics.drift.reshape(*dynamics.drift.shape[:3], -1)
    # E[w_j . u] for every number of bounds left j, move and cell: one state for every j.
    gain = np.einsum("djs,dsmc->jmc", weights.per_bound, np.nan_to_num(u)) / len(u)
    pick = np.eye(admissible.longest + 1)[None]
    averaged = Weights(pick, weights.constant.mean(0, keepdims=True), weights.scale)
    length_cost = objective.length_weight * admissible.lengths
    if risk is not None:
        by_left = gain.reshape(len(gain), -1)
        search = LayeredSearch(admissible, risk, length_cost)
        best = _found([search.sums(by_left, averaged.constant[0], averaged.scale)], admissible)
        return None if best is None else best.paths[0]
    return _best_of_lengths(admissible, gain[None], averaged, length_cost)[0]


def _best_of_lengths(
    admissible: AdmissiblePaths, drift: np.ndarray, weights: Weights, length_cost: np.ndarray
) -> np.ndarray:
    lengths = np.arange(admissible.shortest, admissible.longest + 1)
    if not length_cost.any() or (weights.scale == 1.0).all():
        return best_additive(admissible.layers, drift, weights, length_cost, lengths)[1]
    # A mean divides by the number of bounds, so its length cost is scaled for each of them.
    tries = [
        best_additive(admissible.layers, drift, weights, n * length_cost, lengths[i : i + 1])
        for i, n in enumerate(lengths)
    ]
    best = np.argmax([scores for scores, _ in tries], axis=0)
    return np.stack([tries[i][1][d] for d, i in enumerate(best)])


def _least_loss(
    admissible: AdmissiblePaths, dynamics: Dynamics, objective: Objective, length_cost: np.ndarray
) -> BestPaths:
    losses, paths = least_loss(
        admissible.layers,
        dynamics.drift[:, 0].reshape(len(dynamics.start), dynamics.drift.shape[2], -1),
        dynamics.transition[:, 0, 0],
        dynamics.start[:, 0],
        dynamics.noise_sd,
        length_cost,
        LAWS[objective.family.expected_rate],
        _MAX_LABELS,
    )
    if np.isnan(losses).any():
        raise _too_many_labels(admissible.longest)
    return BestPaths(paths, np.zeros(len(paths)))


def _labelled(
    admissible: AdmissiblePaths,
    dynamics: Dynamics,
    objective: Objective,
    length_cost: np.ndarray,
    risk: RiskTable | None = None,
) -> BestPaths | None:
    n_draws = len(dynamics.start)
    found: list[tuple[np.ndarray, float]] = [(np.empty(0), np.nan)] * n_draws

    def work(first: int, last: int) -> None:
        for d in range(first, last):
            found[d] = _label_one(admissible, dynamics.take(d), objective, length_cost, label_risk)

    label_risk = _label_risk(admissible, risk)
    work(0, n_draws) if n_draws == 1 else over_rows(work, n_draws)
    if not all(len(path) for path, _ in found):
        return None
    paths = np.full((n_draws, max(len(path) for path, _ in found)), -1, np.int64)
    for d, (path, _) in enumerate(found):
        paths[d, : len(path)] = path
    return BestPaths(paths, np.array([gap for _, gap in found]))


def _label_risk(admissible: AdmissiblePaths, risk: RiskTable | None) -> LabelRisk:
    """Risks of bounds for the label search; none without a risk."""
    n_cells = admissible.passable.size
    if risk is None:
        return LabelRisk(np.empty((0, 0)), np.empty(0), 0, 0.0, np.empty((n_cells, 0)))
    of_bounds = np.ascontiguousarray(risk.of_bounds.reshape(len(risk.limits), -1).T)
    safest = least_to_goal(admissible.neighbours, of_bounds, admissible.flat(admissible.goal))
    return LabelRisk(of_bounds, risk.limits, risk.needed, risk.failure_cost, safest)


def _label_one(
    admissible: AdmissiblePaths,
    dynamics: Dynamics,
    objective: Objective,
    length_cost: np.ndarray,
    risk: LabelRisk,
) -> tuple[np.ndarray, float]:
    """Find the best path of one draw and its optimality gap."""
    lengths = [admissible.longest]
    if not objective.has_labels:
        lengths = list(range(admissible.shortest, admissible.longest + 1))
    best, best_score, best_bound = np.empty(0, np.int64), -np.inf, -np.inf
    for n_bounds in lengths:
        scale = n_bounds if objective.name == "mean" else 1
        problem = _label_search(
            admissible, dynamics, objective, n_bounds, scale * length_cost, risk
        )
        path, cost, bound = _search_within_limit(problem)
        each = n_bounds if objective.name == "lost_contact" and not objective.has_labels else 0
        if len(path) and -cost / scale - each > best_score:
            best, best_score = path, -cost / scale - each
        best_bound = max(best_bound, -bound / scale - each)
    if not len(best):
        if best_bound > -np.inf:
            raise _too_many_labels(admissible.longest)
        return best, 0.0
    return best, best_bound - best_score


def _label_search(
    admissible: AdmissiblePaths,
    dynamics: Dynamics,
    objective: Objective,
    n_bounds: int,
    length_cost: np.ndarray,
    risk: LabelRisk,
) -> LabelSearch:
    goal = admissible.flat(admissible.goal)
    at_goal = objective.name == "terminal"
    return LabelSearch(
        mode_of(objective),
        plain(dynamics.transition),
        plain(dynamics.drift.reshape(*dynamics.drift.shape[:2], -1)),
        plain(dynamics.start),
        dynamics.views,
        dominance_tests(dynamics, n_bounds),
        build_heuristic(dynamics, n_bounds, admissible.neighbours, goal, at_goal=at_goal),
        admissible.neighbours,
        length_cost,
        admissible.bounds_to_goal.ravel(),
        admissible.flat(admissible.start),
        goal,
        n_bounds,
        admissible.u_turns,
        admissible.revisit or not objective.has_labels,
        max(float(dynamics.noise_sd), TINY_SD),
        risk,
    )


def _search_within_limit(problem: LabelSearch) -> tuple[np.ndarray, float, float]:
    """Search exactly, or with the least tolerance that stays within the limit on labels."""
    if not len(problem.heuristic.powers) and problem.mode >= TERMINAL:
        raise TrustboError(
            f"a team's least trust over {problem.max_bounds} bounds on {len(problem.to_goal)} "
            "cells is too much for sums over paths; use larger cells, or team='mean'."
        )
    if not problem.revisit:
        # If the best walk of all enters no cell twice, it is the best simple path too.
        free = search(problem._replace(revisit=True), 0.0, _MAX_LABELS)
        if free.path is not None and len(set(free.path.tolist())) == len(free.path):
            return free.path, free.cost, free.bound
    for tolerance in _TOLERANCES:
        found = search(problem, tolerance, _MAX_LABELS)
        if found.path is not None:
            return found.path, found.cost, found.bound
    raise _too_many_labels(problem.max_bounds)


def _too_many_labels(longest: int) -> TrustboError:
    return TrustboError(
        f"more than {_MAX_LABELS} partial paths are worth keeping; lower max_bounds = "
        f"{longest}, use larger cells, or team='mean'."
    )
