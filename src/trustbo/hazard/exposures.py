"""Exposures of bounds to failure: how often each was begun, and how often it ended a mission."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Cell, Mission
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.workspace.moves import bounds_along

CAUSES = ("stuck", "tipped", "timeout", "collision", "lost_contact")
"""Statuses that a bound fails with; an aborted mission has no outcome of its last bound."""

Bounds = np.ndarray
"""Bounds, shape (bound, 3): move of the eight of `MOVES`, row and column of the cell entered."""


class LostMission(NamedTuple):
    """A mission that failed and did not report."""

    path: tuple[Cell, ...]
    """Planned cells, start first."""
    cause: str
    """Cause of the failure, one of `CAUSES`."""
    where: Cell | None = None
    """Cell that it failed to enter, the first time that the path does; None where not known."""


class Exposures(NamedTuple):
    """Exposures of the bounds that missions met, the sufficient statistics of a hazard.

    Counts are whole unless missions have weights.
    """

    bounds: Bounds
    """Distinct bounds with an exposure, in lexicographic order."""
    n: np.ndarray
    """Exposures whose outcome is known, shape (bound,): bounds completed, and those that failed."""
    failed: np.ndarray
    """Exposures that failed, shape (bound,)."""
    lost: tuple[np.ndarray, ...]
    """Planned bounds of each mission lost somewhere unknown, indices in `bounds`."""
    lost_weights: np.ndarray
    """Weight of each mission lost somewhere unknown."""
    causes: np.ndarray
    """Failures by cause, shape (cause,)."""

    @classmethod
    def of(
        cls,
        missions: Sequence[Mission],
        lost: Sequence[LostMission] = (),
        weights: ArrayLike | None = None,
        lost_weights: ArrayLike | None = None,
    ) -> Self:
        """Count the exposures of missions that reported, and of those that were lost.

        Args:
            missions: Missions as measured; the last bound of one that failed is a failure.
            lost: Missions that failed and did not report.
            weights: Weight of each mission, shape (mission,); 1 by default.
            lost_weights: Weight of each lost mission; 1 by default.

        Raises:
            TrustboError: A path that jumps, a `where` that it does not enter, an unknown cause.
            ShapeError: Not one weight for each mission.
        """
        weight = _weights("weights", weights, len(missions))
        lost_weight = _weights("lost_weights", lost_weights, len(lost))
        runs = [_reported(m, w) for m, w in zip(missions, weight, strict=True)]
        located = [_located(m, w) for m, w in zip(lost, lost_weight, strict=True) if m.where]
        unknown = [m for m in lost if m.where is None]
        met = [run.bounds for run in (*runs, *located)]
        planned = [_bounds_of(m.path) for m in unknown]
        rows = np.concatenate([np.empty((0, 3), int), *met, *planned])
        bounds, index = np.unique(rows, axis=0, return_inverse=True)
        n, failed, causes = np.zeros(len(bounds)), np.zeros(len(bounds)), np.zeros(len(CAUSES))
        start = 0
        for run in (*runs, *located):
            indices = index[start : start + len(run.bounds)]
            start += len(run.bounds)
            np.add.at(n, indices, run.weight)
            if run.cause is not None:
                failed[indices[-1]] += run.weight
                causes[CAUSES.index(run.cause)] += run.weight
        places = (
            np.split(index[start:], np.cumsum([len(p) for p in planned])[:-1]) if planned else []
        )
        kept = np.array([w for m, w in zip(lost, lost_weight, strict=True) if m.where is None])
        for mission, w in zip(unknown, kept, strict=True):
            causes[CAUSES.index(require_choice("cause", mission.cause, CAUSES))] += w
        return cls(bounds, n, failed, tuple(places), kept, causes)


class _Run(NamedTuple):
    bounds: Bounds
    cause: str | None
    weight: float


def _reported(mission: Mission, weight: float) -> _Run:
    n = len(mission.bounds)
    if mission.status in CAUSES:
        return _Run(_bounds_of(mission.path[: n + 1]), mission.status, weight)
    survived = n - (mission.status != "ok")  # an aborted bound is no exposure
    return _Run(_bounds_of(mission.path[: survived + 1]), None, weight)


def _located(mission: LostMission, weight: float) -> _Run:
    cause = require_choice("cause", mission.cause, CAUSES)
    for k, (_, cell) in enumerate(pairwise(mission.path), start=1):
        if cell == mission.where:
            return _Run(_bounds_of(mission.path[: k + 1]), cause, weight)
    raise TrustboError(f"the path {mission.path} never enters where = {mission.where}.")


def _bounds_of(path: Iterable[Cell]) -> Bounds:
    cells = np.asarray(tuple(path))
    if len(cells) < 2:
        return np.empty((0, 3), int)
    return bounds_along(cells)


def _weights(what: str, given: ArrayLike | None, n: int) -> np.ndarray:
    weights = np.ones(n) if given is None else np.asarray(given, dtype=float)
    if weights.shape != (n,):
        raise ShapeError(f"{what} must be ({n},), one per mission; got {weights.shape}.")
    return weights
