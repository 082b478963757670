"""Contact rates and awareness of missions, padded to one array each."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from trustbo.data import Mission, sight_columns
from trustbo.errors import TrustboError
from trustbo.models.families import Family
from trustbo.models.visited import Visited
from trustbo.stacking import padded
from trustbo.statespace.matrices import namespace

NO_TICKS = (
    "The beta-binomial family counts ticks. Give the tick count of each bound as n_ticks, for "
    'example in Mission.from_arrays, or use family="censored".'
)
UNKNOWN_RESOLUTION = 0.005
"""Resolution assumed for rates with an unknown tick count."""
COARSEST_RESOLUTION = 0.1
"""Limit on `median_resolution`."""


class Observations(NamedTuple):
    """Contact rates and awareness of missions, padded to the bounds of the longest mission."""

    contact_rate: np.ndarray
    """Shape (mission, bound, robot); NaN in the padding and where not measured."""
    awareness: np.ndarray
    """Shape (mission, bound, robot, feature); 0 in the padding."""
    n_ticks: np.ndarray
    """Number of ticks, shape (mission, bound, robot); NaN in the padding and where unknown."""
    features: tuple[str, ...] = ()
    visited: Visited | None = None
    """Places of the bounds, or None if no effect needs them."""

    @classmethod
    def from_missions(cls, missions: Sequence[Mission]) -> Self:
        """Pad missions of any length with the same robots and features; see `require_same_team`.

        Raises:
            TrustboError: If an awareness value is NaN; only contact rates may be missing.
        """
        for j, mission in enumerate(missions):
            unknown = np.argwhere(np.isnan(mission.awareness))
            if len(unknown):
                k, i, m = unknown[0]
                raise TrustboError(
                    f"awareness of mission {j}, bound {k + 1}, robot {mission.robots[i]}, feature "
                    f"{mission.features[m]} is NaN; pass workspace= to fill it, or leave out the "
                    "mission if the map does not know the cell."
                )

        return cls(
            contact_rate=padded([mission.contact_rate for mission in missions], np.nan),
            awareness=padded([mission.awareness for mission in missions], 0.0),
            n_ticks=padded([mission.n_ticks for mission in missions], np.nan),
            features=missions[0].features,
        )

    @property
    def n_missions(self) -> int:
        """Number of missions."""
        return self.contact_rate.shape[0]

    @property
    def n_bounds(self) -> int:
        """Number of bounds in the longest mission."""
        return self.contact_rate.shape[1]

    @property
    def n_robots(self) -> int:
        """Number of robots."""
        return self.contact_rate.shape[2]

    @property
    def line_of_sight(self) -> np.ndarray:
        """Mean (mission, bound, robot) of the line-of-sight features, or 1 if there are none."""
        sight = sight_columns(self.features)
        if not sight:
            return np.ones(self.contact_rate.shape)
        return self.awareness[..., sight].mean(-1)

    @property
    def resolution(self) -> float:
        """Resolution of the measured rates; see `median_resolution`."""
        is_measured = ~np.isnan(self.contact_rate)
        return float(median_resolution(np.where(is_measured, self.n_ticks, 0.0)))

    def first(self, n: int) -> Self:
        """Return the first n missions."""
        return self._replace(
            contact_rate=self.contact_rate[:n],
            awareness=self.awareness[:n],
            n_ticks=self.n_ticks[:n],
            visited=None if self.visited is None else self.visited.first(n),
        )

    def without(self, missions: Sequence[int] | slice) -> Self:
        """Return a copy in which all rates of the given missions are NaN."""
        contact_rate = self.contact_rate.copy()
        contact_rate[missions] = np.nan
        return self._replace(contact_rate=contact_rate)


def median_resolution(n_ticks: Any) -> Any:
    """Return the median resolution 1 / n_ticks of rates, in NumPy or JAX.

    Entries that are 0 or NaN, as in the padding, do not count. If there are no others, the result
    is `UNKNOWN_RESOLUTION`. It is at most `COARSEST_RESOLUTION`.
    """
    xp = namespace(n_ticks)
    is_counted = n_ticks > 0.0
    steps = xp.where(is_counted, 1.0 / xp.where(is_counted, n_ticks, 1.0), UNKNOWN_RESOLUTION)

    # The median of the counted entries, which come first in this order.
    steps = xp.sort(xp.where(is_counted, steps, xp.inf), axis=None)
    n = is_counted.sum()
    middle = 0.5 * (steps[xp.maximum(n - 1, 0) // 2] + steps[n // 2])
    return xp.where(n > 0, xp.minimum(middle, COARSEST_RESOLUTION), UNKNOWN_RESOLUTION)


def require_ticks(likelihood: Family, contact_rate: np.ndarray, n_ticks: np.ndarray) -> None:
    """Raise TrustboError if the family needs n_ticks and a measured rate lacks it.

    Both arrays have the shape (mission, bound, robot).
    """
    without = ~np.isnan(contact_rate) & ~(n_ticks >= 1.0)
    if likelihood.needs_ticks and without.any():
        j, k, i = np.argwhere(without)[0]
        raise TrustboError(
            f"robot {i} has a rate but no n_ticks at bound {k + 1} of mission {j}. {NO_TICKS}"
        )
