"""Failures of past missions in the cells of a plan.

They explain why a plan enters a cell from another side than a mission that failed, or leaves it in
another direction.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from trustbo.campaign.learning import missions_of_hazard
from trustbo.campaign.state import State
from trustbo.data import POST_SETS, Cell, Mission, Station, require_path
from trustbo.hazard.trials import CAUSES, UNKNOWN, Trials
from trustbo.planning import Plan, Planner
from trustbo.planning.plan import PastFailure
from trustbo.workspace.moves import MOVES

_UNREPORTED = "failed"
"""Status of a mission of an earlier campaign of which only the failed bound is known."""


def with_past_failures(
    plan: Plan, state: State, planner: Planner, so_far: Mission | None = None
) -> Plan:
    """Add to a plan the failures of past missions at known bounds into the cells of its path.

    Args:
        plan: Plan of the next mission, or of the rest of a mission.
        state: Missions and failures of the campaign.
        planner: Planner with the failure probabilities.
        so_far: Bounds of the mission in progress.
    """
    risk = planner.problem.risk
    if risk is None:
        return plan
    ahead = range(1 + plan.n_driven, len(plan.path))
    n_ways = len(MOVES) * planner.workspace.n_posts

    found = []
    for mission, status, (before, row, col, after) in _failures(state, planner, so_far):
        for k in ahead:
            if plan.path[k] != (row, col):
                continue

            stations = [_left(before, (row, col))]
            if after == UNKNOWN:
                stations += [plan.stations[k], *plan.path[k + 1 : k + 2]]
            elif after == n_ways:
                stations += [(row, col)]
            else:
                stations += [(row, col, POST_SETS[after // len(MOVES)]), _moved((row, col), after)]
            way = require_path("way", stations)
            p_fail = float(risk.along(way).p_fail[0])
            if np.isfinite(p_fail):  # otherwise, the bound is not on the map
                found.append(PastFailure(k, mission, status, way, p_fail))
    return replace(plan, past_failures=tuple(sorted(found, key=lambda failure: failure.bound)))


def _failures(
    state: State, planner: Planner, so_far: Mission | None
) -> Iterator[tuple[int | None, str, tuple[int, int, int, int]]]:
    """Yield the mission, the status and the bound of each failure at a known bound.

    The bound is its way, the row and column that it enters, and the next way; see `Trials.bounds`.
    """
    n_posts = planner.workspace.n_posts
    for number, mission, goal in missions_of_hazard(state, so_far):
        bounds = zip(pairwise(mission.path), mission.statuses, strict=False)
        failed = {ends: status for ends, status in bounds if status in CAUSES}
        if failed:
            for bound in _failed(Trials.from_missions([mission], (), [goal], n_posts)):
                way, row, col, _ = bound
                left = _left(way, (row, col))[:2]
                yield number, failed[left, (row, col)], bound

    lost = [(_UNREPORTED, mission) for mission in state.earlier.lost]
    lost += [(one.reason, one.lost) for one in state.failures if one.lost is not None]
    for status, mission in lost:
        for bound in _failed(Trials.from_missions([], [mission], n_posts=n_posts)):
            yield None, status, bound


def _failed(trials: Trials) -> list[tuple[int, int, int, int]]:
    """Return the bounds that failed."""
    return [
        (way, row, col, after)
        for way, row, col, after in trials.bounds[trials.failed > 0.0].tolist()
    ]


def _left(way: int, entered: Cell) -> Station:
    """Return the cell that a way leaves, with its set of posts."""
    number, move = divmod(way, len(MOVES))
    return *_moved(entered, move, -1), POST_SETS[number]


def _moved(cell: Cell, way: int, steps: int = 1) -> Cell:
    """Return the cell after a number of steps of the move of a way."""
    down, right = MOVES[way % len(MOVES)]
    return cell[0] + steps * down, cell[1] + steps * right
