"""Ticks of bounds, which some families count."""

import numpy as np
from numpy.typing import ArrayLike

from trustbo.errors import TrustboError
from trustbo.models.families import Family

NO_TICKS = (
    "The beta-binomial family counts ticks: give n_ticks, the number of ticks of each bound "
    '(Mission.from_arrays(..., n_ticks=...)), or use observation "censored".'
)


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


def require_ticks(family: Family, y: np.ndarray, n_ticks: np.ndarray) -> None:
    """Refuse measured rates (mission, bound, robot) without n_ticks if the family needs them.

    Raises:
        TrustboError: A measured rate has no number of ticks.
    """
    without = ~np.isnan(y) & ~(n_ticks >= 1.0)
    if family.needs_ticks and without.any():
        j, k, i = np.argwhere(without)[0]
        raise TrustboError(
            f"mission {j}, bound {k + 1}, robot {i} has a contact rate but no n_ticks. {NO_TICKS}"
        )
