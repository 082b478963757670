"""Exposures of bounds to failure: how often each was begun, and how often it ended a mission."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_choice
from trustbo.workspace.moves import bounds_along

CAUSES = ("stuck", "tipped", "timeout", "collision", "lost_contact")
"""Statuses that a bound fails with; an aborted mission has no outcome of its last bound."""


class LostMission(NamedTuple):
    """A mission that failed and did not report.

    Attributes:
        path: Planned cells, start first.
        cause: Cause of the failure, one of `CAUSES`.
        where: Cell that it failed to enter, the first time that the path does; None: not known.
    """

    path: tuple[Cell, ...]
    cause: str
    where: Cell | None = None


class Exposures(NamedTuple):
    """Exposures of the bounds that missions met, the sufficient statistics of a hazard.

    Attributes:
        bounds: Distinct bounds in lexicographic order, shape (bound, 3): move of the eight of
            `MOVES`, row and column of the cell entered.
        n: Number of exposures with a known outcome, shape (bound,).
        failed: Number of those that failed, shape (bound,).
        lost: Planned bounds of each mission lost somewhere unknown, indices in `bounds`.
        causes: Number of failures by cause, shape (cause,).
    """

    bounds: np.ndarray
    n: np.ndarray
    failed: np.ndarray
    lost: tuple[np.ndarray, ...]
    causes: np.ndarray

    @classmethod
    def of(cls, missions: Sequence[Mission], lost: Sequence[LostMission] = ()) -> Self:
        """Count the exposures of missions that reported, and of those that were lost.

        The last bound of a mission that failed is a failure; an aborted bound counts for nothing.

        Raises:
            TrustboError: A path that jumps, a `where` that it does not enter, an unknown cause.
        """
        known = [_reported(mission) for mission in missions]
        known += [_located(mission) for mission in lost if mission.where is not None]
        unknown = [(mission.path, mission.cause) for mission in lost if mission.where is None]

        met = [bounds_along(path) for path, _ in (*known, *unknown)]
        rows = np.concatenate([np.empty((0, 3), int), *met])
        bounds, index = np.unique(rows, axis=0, return_inverse=True)
        paths = np.split(index, np.cumsum([len(part) for part in met])[:-1]) if met else []

        n, failed, causes = np.zeros(len(bounds)), np.zeros(len(bounds)), np.zeros(len(CAUSES))
        for path, (_, cause) in zip(paths, known, strict=False):
            np.add.at(n, path, 1.0)
            if cause is not None:
                failed[path[-1]] += 1.0
                causes[CAUSES.index(cause)] += 1.0
        for _, cause in unknown:
            causes[CAUSES.index(require_choice("cause", cause, CAUSES))] += 1.0
        return cls(bounds, n, failed, tuple(paths[len(known) :]), causes)


def _reported(mission: Mission) -> tuple[Sequence[Cell], str | None]:
    """Path of the bounds with an outcome, and the cause of a failure of the last one."""
    n, cause = len(mission.bounds), mission.status if mission.status in CAUSES else None
    return mission.path[: n + (cause is not None or mission.status == "ok")], cause


def _located(mission: LostMission) -> tuple[Sequence[Cell], str | None]:
    if mission.where not in mission.path[1:]:
        raise TrustboError(f"the path {mission.path} never enters where = {mission.where}.")
    n = mission.path.index(mission.where, 1)
    return mission.path[: n + 1], require_choice("cause", mission.cause, CAUSES)
