"""Risk of a path, and what all risks of the bounds of a workspace have in common."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from trustbo.data import Station
from trustbo.display import Rows, Summary
from trustbo.hazard.components import Components
from trustbo.workspace.moves import MOVES, pairs_along

ROUNDING = 1e-12
"""Tolerance for rounding errors when the risk of a path is compared with its limit."""
BAND = (0.05, 0.95)
"""Quantile levels of the ends of `p_arrive_band`."""


class PathRisk(NamedTuple):
    """Failure probabilities of the bounds of a path, and the arrival probability."""

    p_fail: np.ndarray
    """Posterior mean probability that each bound, once begun, ends the mission, shape (bound,)."""
    p_arrive: float
    """Probability of reaching the goal."""
    p_arrive_band: tuple[float, float]
    """Ends of the 90 % band of `p_arrive` over the draws; NaN without draws."""

    def to_record(self) -> dict[str, Any]:
        """Convert the risk to plain lists and numbers."""
        return {**self._asdict(), "p_fail": self.p_fail.tolist()}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Restore the risk from a record made by `to_record`."""
        low, high = record["p_arrive_band"]
        return cls(np.array(record["p_fail"]), record["p_arrive"], (low, high))


class Risk(Summary, ABC):
    """Probability that each bound of a workspace ends the mission.

    Maps have shape (way, row, col, next_way), where (row, col) is the cell that a bound enters. A
    way is a move of `MOVES` or, with several sets of posts, move + 8 set; see `workspace.moves`.
    The last next way is the end of the path. Failure probabilities are NaN where there is no bound.
    """

    @cached_property
    @abstractmethod
    def mean(self) -> np.ndarray:
        """Mean of the failure probability, shape (way, row, col, next_way)."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of the maps."""

    @cached_property
    @abstractmethod
    def searched(self) -> Components:
        """Components with which paths are searched."""

    @abstractmethod
    def along(self, path: Sequence[Station] | np.ndarray) -> PathRisk:
        """Compute the risk along a path."""

    @property
    def of_bounds(self) -> np.ndarray:
        """Failure probability of each bound, shape (way, row, col), averaged over next ways."""
        known = np.isfinite(self.mean)
        total = np.where(known, self.mean, 0.0).sum(-1)
        return np.where(known.any(-1), total / np.maximum(known.sum(-1), 1), np.nan)

    def pairs_along(self, path: Sequence[Station] | np.ndarray) -> np.ndarray:
        """Return the indices in the maps of the bounds of a path, shape (bound, 4)."""
        return pairs_along(path, self.shape[0] // len(MOVES))

    def failure(self, path: Sequence[Station] | np.ndarray) -> float:
        """Compute the failure probability of a path, for `failure_cost` and `max_failure`.

        It is averaged over the components, as in a search, because failures of bounds are
        correlated; see `along` for the exact mean.
        """
        p_fail, weights = self.searched
        index = self.pairs_along(path).T
        return float(weights @ (1.0 - np.prod(1.0 - p_fail[:, *index], axis=1)))

    def _rows_of_failures(self) -> Rows:
        """Summarise the failure probabilities."""
        p = self.mean[np.isfinite(self.mean)]
        if not p.size:
            return [("failure probability", "no bound can be driven")]
        middle, high = np.quantile(p, (0.5, 0.95))
        spread = f"median {middle:.3g}, 95 % quantile {high:.3g} over bounds"
        return [("failure probability", spread)]
