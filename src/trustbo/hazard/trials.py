"""Trials of bounds: how often each bound was begun and how often it ended a mission."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError
from trustbo.workspace.moves import bounds_along

CAUSES = ("stuck", "tipped", "timeout", "collision", "lost_contact")
"""Statuses of missions whose last bound failed; aborted missions do not count as failed."""


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
        bounds: Distinct bounds in lexicographic order, shape (bound, 3). The columns are the index
            of the move in `MOVES` and the row and column of the cell entered.
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

        The last bound of a failed mission counts as a failure. An aborted bound is not counted.

        Raises:
            TrustboError: If a path skips cells or does not enter `where`.
        """
        known = [_reported(mission) for mission in missions]
        known += [_located(mission) for mission in lost if mission.where is not None]
        unknown = [mission.path for mission in lost if mission.where is None]

        every = [path for path, _ in known] + unknown
        met = [bounds_along(path) for path in every]
        rows = np.concatenate([np.empty((0, 3), int), *met])
        bounds, index = np.unique(rows, axis=0, return_inverse=True)
        paths = np.split(index, np.cumsum([len(part) for part in met])[:-1]) if met else []

        n, failed = np.zeros((2, len(bounds)))
        for path, (_, fails) in zip(paths, known, strict=False):
            np.add.at(n, path, 1.0)
            failed[path[-1:]] += fails
        return cls(bounds, n, failed, tuple(paths[len(known) :]))


def _reported(mission: Mission) -> tuple[Sequence[Cell], bool]:
    """Return the path up to the last bound with a known outcome, and whether that bound failed."""
    n_run = len(mission.bounds)
    fails = mission.status in CAUSES
    is_known = fails or mission.status == "ok"  # an aborted bound neither failed nor was passed
    n_cells = n_run + 1 if is_known else n_run
    return mission.path[:n_cells], fails


def _located(mission: LostMission) -> tuple[Sequence[Cell], bool]:
    """Return the path of a lost mission up to `where`, and True because the last bound failed."""
    if mission.where not in mission.path[1:]:
        raise TrustboError(f"where must be a cell that the path enters; got {mission}.")

    n = mission.path.index(mission.where, 1)
    return mission.path[: n + 1], True
