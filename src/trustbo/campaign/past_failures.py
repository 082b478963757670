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
from trustbo.data import Cell, Mission, cells_of
from trustbo.hazard.trials import CAUSES, UNKNOWN, Trials
from trustbo.planning import Plan, Planner
from trustbo.planning.plan import PastFailure
from trustbo.workspace.moves import END, MOVES

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
    cells = cells_of(plan.path)
    ends = zip(cells[1:], [*cells[2:], None], strict=True)
    ahead = [(k, *end) for k, end in enumerate(ends, start=1) if k > plan.n_driven]

    found = []
    for mission, status, (move, row, col, next_move) in _failures(state, so_far):
        for k, cell, onward in ahead:
            if cell != (row, col):
                continue

            left = _moved(cell, move, -1)
            if next_move != UNKNOWN:
                onward = None if next_move == END else _moved(cell, next_move)
            way = (left, cell) if onward is None else (left, cell, onward)
            p_fail = float(risk.along(way).p_fail[0])
            if np.isfinite(p_fail):  # otherwise, the bound is not on the map
                found.append(PastFailure(k, mission, status, way, p_fail))
    return replace(plan, past_failures=tuple(sorted(found, key=lambda failure: failure.bound)))


def _failures(
    state: State, so_far: Mission | None
) -> Iterator[tuple[int | None, str, tuple[int, int, int, int]]]:
    """Yield the mission, the status and the bound of each failure at a known bound.

    The bound is the index of its move, the row and column that it enters, and the index of the next
    move; see `Trials.bounds`.
    """
    goal = tuple(state.settings["goal"])
    for number, mission in missions_of_hazard(state, so_far):
        cells = cells_of(mission.path)
        bounds = zip(pairwise(cells), mission.statuses, strict=False)
        failed = {ends: status for ends, status in bounds if status in CAUSES}
        if failed:
            for bound in _failed(Trials.from_missions([mission], goal=goal)):
                move, row, col, _ = bound
                left = _moved((row, col), move, -1)
                yield number, failed[left, (row, col)], bound

    lost = [(_UNREPORTED, mission) for mission in state.earlier.lost]
    lost += [(one.reason, one.lost) for one in state.failures if one.lost is not None]
    for status, mission in lost:
        for bound in _failed(Trials.from_missions([], [mission])):
            yield None, status, bound


def _failed(trials: Trials) -> list[tuple[int, int, int, int]]:
    """Return the bounds that failed."""
    return [
        (move, row, col, next_move)
        for move, row, col, next_move in trials.bounds[trials.failed > 0.0].tolist()
    ]


def _moved(cell: Cell, move: int, steps: int = 1) -> Cell:
    """Return the cell after a number of steps of a move."""
    down, right = MOVES[move]
    return cell[0] + steps * down, cell[1] + steps * right
