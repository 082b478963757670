"""Trials of bounds: how often each bound was begun and how often it ended a mission.

Whether a bound is completed depends on the next move (see `workspace.difficulty`), so bounds are
counted with their next moves.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError
from trustbo.workspace.moves import bounds_and_next

CAUSES = ("stuck", "tipped", "timeout", "collision", "lost_contact")
"""Statuses of bounds that failed; aborted bounds and missions do not count as failures."""


class LostMission(NamedTuple):
    """A failed mission without any measurements.

    Attributes:
        path: Planned cells, beginning with the start.
        where: Cell that the team failed to enter, or None if unknown. If the path enters this
            cell more than once, the first of these bounds failed.
    """

    path: tuple[Cell, ...]
    where: Cell | None = None


class Trials(NamedTuple):
    """Trials of attempted bounds, which are sufficient statistics of the hazard model.

    Attributes:
        bounds: Distinct bounds in lexicographic order, shape (bound, 4). The columns are the index
            of the move in `MOVES`, the row and column of the cell entered, and the index of the
            next move, which is `END` at the end of a path.
        n: Number of trials with a known outcome, shape (bound,).
        failed: Number of failures among the trials in `n`, shape (bound,).
        lost: Planned bounds of each mission lost at an unknown place, as indices into `bounds`.
    """

    bounds: np.ndarray
    n: np.ndarray
    failed: np.ndarray
    lost: tuple[np.ndarray, ...]

    @classmethod
    def from_missions(cls, missions: Sequence[Mission], lost: Sequence[LostMission] = ()) -> Self:
        """Count the trials in measured missions and in lost missions.

        The last bound of a failed mission counts as a failure, and so does each earlier bound that
        failed. An aborted bound is not counted. If the robots turn back during a bound, they drive
        only a part of the bound that leads back, so this bound is counted only if it fails.

        Raises:
            TrustboError: If a path skips cells or does not enter `where`.
        """
        known = [_reported(mission) for mission in missions]
        known += [_located(mission) for mission in lost if mission.where is not None]
        unknown = [bounds_and_next(mission.path) for mission in lost if mission.where is None]

        met = [tried for tried, _ in known] + unknown
        rows = np.concatenate([np.empty((0, 4), int), *met])
        bounds, index = np.unique(rows, axis=0, return_inverse=True)
        paths = np.split(index, np.cumsum([len(part) for part in met])[:-1]) if met else []

        n, failed = np.zeros((2, len(bounds)))
        for path, (_, fails) in zip(paths, known, strict=False):
            np.add.at(n, path, 1.0)
            np.add.at(failed, path, fails)
        return cls(bounds, n, failed, tuple(paths[len(known) :]))

    def of_units(self, unit: np.ndarray) -> Self:
        """Add up the trials of each unit, whose next moves pass or fail together.

        Args:
            unit: Next move that represents the unit of each bound, (move, row, col, next_move); see
                `workspace.difficulty.Difficulty`. It is negative for a bound that is not on the
                map, which forms its own unit.
        """
        rows = self.bounds.copy()
        of_rows = unit[*rows.T]
        rows[:, 3] = np.where(of_rows >= 0, of_rows, rows[:, 3])

        bounds, index = np.unique(rows, axis=0, return_inverse=True)
        n = np.bincount(index, self.n, len(bounds))
        failed = np.bincount(index, self.failed, len(bounds))
        return type(self)(bounds, n, failed, tuple(index[path] for path in self.lost))


def _reported(mission: Mission) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds with a known outcome, (bound, 4), and whether each one failed."""
    path = mission.path
    statuses = mission.statuses

    fails = np.array([status in CAUSES for status in statuses])
    is_known = fails.copy()
    for k, status in enumerate(statuses):
        goes_back = k > 0 and statuses[k - 1] != "ok" and path[k + 1] == path[k - 1]
        if status == "ok" and not goes_back:
            is_known[k] = True

    # The path is the planned one, so the next move is also known for the last bound.
    tried = bounds_and_next(path[: len(statuses) + 2])[: len(statuses)]
    return tried[is_known], fails[is_known]


def _located(mission: LostMission) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of a lost mission up to `where`, and whether each one failed."""
    if mission.where not in mission.path[1:]:
        raise TrustboError(f"where must be a cell that the path enters; got {mission}.")

    n = mission.path.index(mission.where, 1)
    return bounds_and_next(mission.path[: n + 2])[:n], np.arange(1, n + 1) == n
