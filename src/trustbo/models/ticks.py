"""Ticks of bounds, for families of observations that count them."""

import numpy as np
from numpy.typing import ArrayLike

from trustbo.errors import TrustboError
from trustbo.models.likelihood.families import Family
from trustbo.stacking import MissionBatch

NO_TICKS = (
    "The beta-binomial family counts ticks: give n_ticks, the number of ticks of each bound "
    '(Mission.from_arrays(..., n_ticks=...)), or use observation "censored".'
)


def broadcast_ticks(
    family: Family, n_ticks: ArrayLike | None, shape: tuple[int, ...]
) -> np.ndarray:
    """Ticks of that shape, 1 if not given.

    Raises:
        TrustboError: They are not given, and the family needs them.
    """
    if n_ticks is None and family.needs_ticks:
        raise TrustboError(NO_TICKS)
    return np.broadcast_to(np.asarray(1.0 if n_ticks is None else n_ticks), shape)


def require_ticks(family: Family, batch: MissionBatch) -> None:
    """Refuse missions without ticks if the family needs them.

    Raises:
        TrustboError: A measured rate has no n_ticks.
    """
    if not family.needs_ticks:
        return
    without = ~np.isnan(batch.contact_rate) & ~(batch.n_ticks >= 1.0)
    if without.any():
        j, k, i = np.argwhere(without)[0]
        raise TrustboError(
            f"mission {j}, bound {k + 1}, robot {i} has a contact rate but no n_ticks. {NO_TICKS}"
        )
