"""The compiled engine: which kernel finds the best path of which objective."""

from typing import NamedTuple

import numpy as np

from trustbo.errors import TrustboError, require_choice
from trustbo.planning.buckets import best_stationary
from trustbo.planning.course import Course
from trustbo.planning.dominance import outlook, tests
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.labels import MODES, Problem, search
from trustbo.planning.layers import Weights, additive_weights, best_additive
from trustbo.planning.objectives import LABELLED, Aim
from trustbo.terrain.parallel import over_rows

ENGINES = ("auto", "networkx", "numba")
LARGEST_FOR_NETWORKX = 2500
"""Cells up to which `auto` plans single paths with networkx."""
_TOLERANCES = (0.0, 1e-3, 1e-2, 3e-2, 0.1)
_ROOM = 300_000  # labels per search


class Answer(NamedTuple):
    """The best path of each draw.

    Fields: paths (draw, length), flat indices of cells, filled with -1; slack (draw,), by how much
    a path could be better at most: in sums of softplus for `success`, in trust elsewhere.
    """

    paths: np.ndarray
    slack: np.ndarray


def choose_engine(engine: str, n_cells: int, n_draws: int) -> str:
    """The engine of that name; for `auto`, by size."""
    if require_choice("engine", engine, ENGINES) != "auto":
        return engine
    return "networkx" if n_draws == 1 and n_cells <= LARGEST_FOR_NETWORKX else "numba"


def require_valid(moves: Dynamics, objective: str) -> None:
    """Refuse dynamics that an objective is not defined, or not exact, for.

    Args:
        moves: Of one or many draws.
        objective: Its name.

    Raises:
        TrustboError: success or bottleneck with beta0 < 0; stationary with abs(beta0) >= 1.
    """
    own = np.diagonal(moves.transition, axis1=-2, axis2=-1)
    if objective in LABELLED and (own < 0.0).any():
        raise TrustboError(
            f"objective {objective!r} needs beta0 >= 0; got {own.min():g}. Use 'terminal' or "
            "'mean'."
        )
    if objective == "stationary":
        radius = np.abs(np.linalg.eigvals(moves.transition))
        if (radius >= 1.0).any():
            raise TrustboError(
                f"objective 'stationary' needs abs(beta0) < 1; got {radius.max():g}. Use "
                "'terminal' or 'mean'."
            )


def plan_compiled(course: Course, moves: Dynamics, aim: Aim) -> Answer:
    """The best path of every draw, by compiled code; `moves` with a leading axis (draw,)."""
    toll = aim.length_weight * course.lengths
    if aim.objective == "stationary":
        ends = course.flat(course.start), course.flat(course.goal)
        _, paths = best_stationary(
            lambda part: moves.take(part).settled(),
            len(moves.start),
            course.passable,
            toll,
            course.steps,
            *ends,
        )
        return Answer(paths, np.zeros(len(paths)))
    if aim.objective not in LABELLED and len(moves.views) == 1:
        return _additive(course, moves, aim, toll)
    return _labelled(course, moves, aim, toll)


def _additive(course: Course, moves: Dynamics, aim: Aim, toll: np.ndarray) -> Answer:
    weights = additive_weights(moves, moves.views[0], aim.objective, course.longest)
    drift = moves.drift.reshape(*moves.drift.shape[:2], -1)
    return Answer(_best_of_lengths(course, drift, weights, toll), np.zeros(len(drift)))


def _best_of_lengths(
    course: Course, drift: np.ndarray, weights: Weights, toll: np.ndarray
) -> np.ndarray:
    lengths = np.arange(course.shortest, course.longest + 1)
    if not toll.any() or (weights.scale == 1.0).all():
        return best_additive(course.layers, drift, weights, toll, lengths)[1]
    # A mean divides by the number of bounds, so the toll has to be scaled for each length.
    tries = [
        best_additive(course.layers, drift, weights, n * toll, lengths[i : i + 1])
        for i, n in enumerate(lengths)
    ]
    best = np.argmax([scores for scores, _ in tries], axis=0)
    return np.stack([tries[i][1][d] for d, i in enumerate(best)])


def expected_paths(course: Course, moves: Dynamics, aim: Aim) -> Answer:
    """The one path with the best *expectation* over draws of terminal trust, or of mean trust.

    Both are linear in u with weights that do not depend on the path, so the expectation of weight
    times u, per cell and bounds left, replaces them: exact, with no assumption on the posterior.
    """
    weights = additive_weights(moves, moves.views[0], aim.objective, course.longest)
    u = moves.drift.reshape(*moves.drift.shape[:2], -1)
    # E[w_j . u(c)] for every number of bounds left j and cell c: as a state for every j.
    gain = np.einsum("djs,dsc->jc", weights.per_bound, np.nan_to_num(u)) / len(u)
    pick = np.eye(course.longest + 1)[None]
    averaged = Weights(pick, weights.constant.mean(0, keepdims=True), weights.scale)
    toll = aim.length_weight * course.lengths
    return Answer(_best_of_lengths(course, gain[None], averaged, toll), np.zeros(1))


def _labelled(course: Course, moves: Dynamics, aim: Aim, toll: np.ndarray) -> Answer:
    n_draws = len(moves.start)
    found: list[tuple[np.ndarray, float]] = [(np.empty(0), np.nan)] * n_draws

    def work(first: int, last: int) -> None:
        for d in range(first, last):
            found[d] = _label_one(course, moves.draw(d), aim, toll)

    work(0, n_draws) if n_draws == 1 else over_rows(work, n_draws)
    paths = np.full((n_draws, max(len(path) for path, _ in found)), -1, np.int64)
    for d, (path, _) in enumerate(found):
        paths[d, : len(path)] = path
    return Answer(paths, np.array([slack for _, slack in found]))


def _label_one(
    course: Course, moves: Dynamics, aim: Aim, toll: np.ndarray
) -> tuple[np.ndarray, float]:
    """The best path of one draw, and by how much it could be better at most."""
    lengths = [course.longest]
    if aim.objective not in LABELLED:
        lengths = list(range(course.shortest, course.longest + 1))
    best, best_score, best_bound = np.empty(0, np.int64), -np.inf, -np.inf
    for n_bounds in lengths:
        scale = n_bounds if aim.objective == "mean" else 1
        problem = _problem(course, moves, aim, n_bounds, scale * toll)
        path, cost, bound = _search_within_room(problem)
        if len(path) and -cost / scale > best_score:
            best, best_score = path, -cost / scale
        best_bound = max(best_bound, -bound / scale)
    return best, best_bound - best_score


def _problem(course: Course, moves: Dynamics, aim: Aim, n_bounds: int, toll: np.ndarray) -> Problem:
    goal = course.flat(course.goal)
    at_goal = aim.objective == "terminal"
    return Problem(
        MODES[aim.objective],
        np.ascontiguousarray(moves.transition),
        moves.drift.reshape(len(moves.start), -1),
        np.ascontiguousarray(moves.start),
        moves.views,
        tests(moves, n_bounds),
        outlook(moves, n_bounds, course.neighbours, goal, at_goal=at_goal),
        course.neighbours,
        toll,
        course.bounds_to_goal.ravel(),
        course.flat(course.start),
        goal,
        n_bounds,
        course.u_turns,
        course.revisit or aim.objective not in LABELLED,
    )


def _search_within_room(problem: Problem) -> tuple[np.ndarray, float, float]:
    """Search exactly; if there are too many labels, with as little tolerance as will do."""
    if not len(problem.outlook.powers) and problem.mode not in (MODES[name] for name in LABELLED):
        raise TrustboError(
            f"a team's least trust over {problem.most_bounds} bounds on {len(problem.to_goal)} "
            "cells is too much for 'terminal' and 'mean'; use larger cells, or team='mean'."
        )
    if not problem.revisit:
        # The best walk of all, if it happens to enter no cell twice, is the best such walk.
        free = search(problem._replace(revisit=True), 0.0, _ROOM)
        if free.path is not None and len(set(free.path.tolist())) == len(free.path):
            return free.path, free.cost, free.bound
    for tolerance in _TOLERANCES:
        found = search(problem, tolerance, _ROOM)
        if found.path is not None:
            return found.path, found.cost, found.bound
    raise TrustboError(
        f"more than {_ROOM} partial paths are worth keeping; lower max_bounds = "
        f"{problem.most_bounds}, use larger cells, or team='mean'."
    )
