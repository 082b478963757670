"""Rates and features of missions by slot; a slot is one bound of one robot in one mission."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from trustbo.data import is_line_of_sight
from trustbo.errors import TrustboError
from trustbo.models.families import Family
from trustbo.models.visited import Visited

NO_TICKS = (
    "The beta-binomial family counts ticks. Give the tick count of each bound as n_ticks, for "
    'example in Mission.from_arrays, or use observation="censored".'
)
UNKNOWN_RESOLUTION, COARSEST_RESOLUTION = 0.005, 0.1
"""Resolution assumed for rates with an unknown tick count, and limit on `Slots.resolution`."""


class Slots(NamedTuple):
    """Rates and features of missions, padded to the number of bounds of the longest mission."""

    y: np.ndarray  # (mission, bound, robot), NaN where not measured
    z: np.ndarray  # (mission, bound, robot, feature), 0 in the padding
    n_ticks: np.ndarray  # (mission, bound, robot), NaN where unknown
    features: tuple[str, ...] = ()
    visited: Visited | None = None

    @property
    def n_missions(self) -> int:
        """Number of missions."""
        return self.y.shape[0]

    @property
    def n_bounds(self) -> int:
        """Number of bounds in the longest mission."""
        return self.y.shape[1]

    @property
    def n_robots(self) -> int:
        """Number of robots."""
        return self.y.shape[2]

    @property
    def line_of_sight(self) -> np.ndarray:
        """Mean (mission, bound, robot) of the line-of-sight features, or 1 if there are none."""
        sight = [m for m, name in enumerate(self.features) if is_line_of_sight(name)]
        return self.z[..., sight].mean(-1) if sight else np.ones(self.y.shape)

    @property
    def resolution(self) -> float:
        """Median resolution 1 / n_ticks of the measured rates, at most `COARSEST_RESOLUTION`."""
        ticks = np.nan_to_num(self.n_ticks[~np.isnan(self.y)])
        if not len(ticks):
            return UNKNOWN_RESOLUTION
        some = ticks > 0.0
        steps = np.where(some, 1.0 / np.where(some, ticks, 1.0), UNKNOWN_RESOLUTION)
        return float(min(np.median(steps), COARSEST_RESOLUTION))

    def first(self, n: int) -> Self:
        """Return the first n missions."""
        visited = None if self.visited is None else self.visited.first(n)
        y, z, n_ticks = self.y[:n], self.z[:n], self.n_ticks[:n]
        return self._replace(y=y, z=z, n_ticks=n_ticks, visited=visited)

    def without(self, missions: Sequence[int] | slice) -> Self:
        """Return a copy in which all rates of the given missions are NaN."""
        y = self.y.copy()
        y[missions] = np.nan
        return self._replace(y=y)


def require_ticks(family: Family, y: np.ndarray, n_ticks: np.ndarray) -> None:
    """Raise TrustboError if the family needs n_ticks and a measured rate in y lacks it."""
    without = ~np.isnan(y) & ~(n_ticks >= 1.0)
    if family.needs_ticks and without.any():
        j, k, i = np.argwhere(without)[0]
        raise TrustboError(
            f"robot {i} has a rate but no n_ticks at bound {k + 1} of mission {j}. {NO_TICKS}"
        )
