"""Ticks of bounds: families that count them, and the resolution that they give a rate."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from trustbo.errors import TrustboError
from trustbo.models.families import Family
from trustbo.stacking import MissionBatch

NO_TICKS = (
    "The beta-binomial family counts ticks: give n_ticks, the number of ticks of each bound "
    '(Mission.from_arrays(..., n_ticks=...)), or use observation "censored".'
)
UNKNOWN_RESOLUTION, COARSEST_RESOLUTION = 0.005, 0.1
"""Resolution of a rate with an unknown number of ticks, and the coarsest resolution."""

TickWeights = dict[float, float]
"""Weight of the measured rates by their number of ticks, NaN ticks being 0; adds up."""


def broadcast_ticks(
    family: Family, n_ticks: ArrayLike | None, shape: tuple[int, ...]
) -> np.ndarray:
    """Ticks of that shape, NaN if not given.

    Raises:
        TrustboError: They are not given, and the family needs them.
    """
    if n_ticks is None and family.needs_ticks:
        raise TrustboError(NO_TICKS)
    return np.broadcast_to(np.asarray(np.nan if n_ticks is None else n_ticks, dtype=float), shape)


def require_ticks(family: Family, batch: MissionBatch) -> None:
    """Refuse measured rates without n_ticks if the family needs them: TrustboError."""
    if not family.needs_ticks:
        return
    without = ~np.isnan(batch.contact_rate) & ~(batch.n_ticks >= 1.0)
    if without.any():
        j, k, i = np.argwhere(without)[0]
        raise TrustboError(
            f"mission {j}, bound {k + 1}, robot {i} has a contact rate but no n_ticks. {NO_TICKS}"
        )


def weigh_ticks(batch: MissionBatch, weight: np.ndarray | None = None) -> TickWeights:
    """Weight of a batch's measured rates by their number of ticks.

    Args:
        batch: Missions, padded with NaN.
        weight: Weight of each mission, shape (mission,); 1 by default.
    """
    seen = ~np.isnan(batch.contact_rate)
    weights = np.ones(len(seen)) if weight is None else weight
    ticks = np.nan_to_num(np.broadcast_to(batch.n_ticks, seen.shape)[seen])
    values, index = np.unique(ticks, return_inverse=True)
    total = np.bincount(index, (seen * weights[:, None, None])[seen], len(values))
    return dict(zip(values.tolist(), total.tolist(), strict=True))


def add_ticks(terms: Sequence[Mapping[float, float]], factor: float = 1.0) -> TickWeights:
    """Sum of tick weights, times a factor."""
    total: TickWeights = {}
    for one in terms:
        for ticks, weight in one.items():
            total[ticks] = total.get(ticks, 0.0) + factor * weight
    return total


def resolution(ticks: Mapping[float, float]) -> float:
    """Weighted median of 1/n_ticks over the measured rates, at most `COARSEST_RESOLUTION`."""
    resolutions = sorted(
        (1.0 / n if n else UNKNOWN_RESOLUTION, w) for n, w in ticks.items() if w > 0.0
    )
    if not resolutions:
        return UNKNOWN_RESOLUTION
    values, weights = np.array(resolutions).T
    below = np.cumsum(weights) / weights.sum()
    # Where exactly half lie below, the mean of both neighbours, as a plain median does.
    middle = values[np.minimum(np.searchsorted(below, [0.5 - 1e-9, 0.5 + 1e-9]), len(values) - 1)]
    return float(min(middle.mean(), COARSEST_RESOLUTION))
