"""Risk of bounds: the posterior of their chances to fail, for planning."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import xarray as xr
from scipy import special

from trustbo.errors import require_whole
from trustbo.models.hazard_sampler import FLOOR, add_lost
from trustbo.workspace import Workspace

_ENTRIES = 1 << 20  # of (draw, bound) at a time


@dataclass(frozen=True, eq=False)
class BoundRisk:
    """Posterior of the chance that each bound ends the mission.

    Maps have shape (move, row, col): the bound that enters a cell by one of the eight `MOVES`. They
    are NaN where there is no bound.

    Attributes:
        coefficients: Weights in the logit of the prior mean, intercept first, (draw, 1 + measure).
        strength: Strength of the Betas, (draw,).
        difficulty: Difficulty less its reference, (move, row, col, measure).
        exists: Whether there is a bound, (move, row, col).
        exposures: Known exposures, (move, row, col).
        failures: Known failures, (move, row, col).
        lost: Bounds of each mission lost somewhere unknown, each (bound, 3).
        lost_weights: Their weights, (lost,).
        place: Bound at which each failed, from 1, (draw, lost).
        causes: Posterior mean share of each cause among failures.
    """

    coefficients: np.ndarray
    strength: np.ndarray
    difficulty: np.ndarray
    exists: np.ndarray
    exposures: np.ndarray
    failures: np.ndarray
    lost: tuple[np.ndarray, ...]
    lost_weights: np.ndarray
    place: np.ndarray
    causes: dict[str, float]

    @classmethod
    def of(cls, hazard: xr.Dataset, workspace: Workspace) -> Self:
        """Risk of a workspace's bounds from the group `hazard` of a posterior; see `fit_hazard`."""
        count = hazard["failures_by_cause"].values + hazard.attrs["cause_concentration"]
        names = [str(name) for name in hazard["cause"].values]
        terms = [hazard["intercept"].values[:, None], hazard["coefficient"].values]
        risk = cls(
            np.concatenate(terms, axis=1),
            hazard["strength"].values,
            workspace.difficulty.values - hazard.attrs["reference"],
            workspace.passable_bounds.values,
            hazard["exposures"].values,
            hazard["failures"].values,
            tuple(path[path[:, 0] >= 0] for path in hazard["lost_bound"].values),
            hazard["lost_weight"].values,
            hazard["place"].values,
            dict(zip(names, (count / count.sum()).tolist(), strict=True)),
        )
        if "p_fail" in hazard:  # known already
            risk.__dict__["_moments"] = hazard["p_fail"].values, hazard["p_fail_sd"].values
        return risk

    @property
    def mean(self) -> np.ndarray:
        """Posterior mean of the chance to fail, shape (move, row, col)."""
        return self._moments[0]

    @property
    def sd(self) -> np.ndarray:
        """Posterior sd of the chance to fail, shape (move, row, col)."""
        return self._moments[1]

    @cached_property
    def stopped(self) -> np.ndarray:
        """Expected number of failures so far, shape (move, row, col)."""
        counts = self.failures.copy()
        for j, (path, weight) in enumerate(zip(self.lost, self.lost_weights, strict=True)):
            for k, bound in enumerate(path, start=1):
                counts[*bound] += weight * (self.place[:, j] == k).mean()
        return counts

    def draw(self, n: int, seed: int = 0) -> np.ndarray:
        """Draws of the chances to fail, shape (draw, move, row, col).

        Args:
            n: Number of draws; those of the hyperparameters are taken in turn.
            seed: Seed of the draws from the Betas.
        """
        rng = np.random.default_rng(seed)
        out = np.full((require_whole("n", n, 1), *self.exists.shape), np.nan)
        every = np.flatnonzero(self.exists)
        for part in _parts(n, len(every)):
            which = np.arange(part.start, part.stop) % len(self.strength)
            out[part, self.exists] = rng.beta(*self._betas(which, every))
        return out

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd over all draws, the Betas in closed form."""
        mean, sd = np.full((2, *self.exists.shape), np.nan)
        draws = np.arange(len(self.strength))
        every = np.flatnonzero(self.exists)
        for part in _parts(len(every), len(draws)):
            a, b = self._betas(draws, every[part])
            total = a + b
            chance = a / total
            first = chance.mean(0)
            second = (chance * (a + 1.0) / (total + 1.0)).mean(0)
            mean.flat[every[part]] = first
            sd.flat[every[part]] = np.sqrt(np.maximum(0.0, second - first**2))
        return mean, sd

    def _betas(self, draws: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Alpha and beta of the posterior Betas of bounds, flat indices; each (draw, bound)."""
        x = self.difficulty[np.unravel_index(bounds, self.exists.shape)]
        coefficients, strength = self.coefficients[draws], self.strength[draws, None]
        logit = coefficients[:, :1] + coefficients[:, 1:] @ x.T
        n, failed = self.exposures.ravel()[bounds], self.failures.ravel()[bounds]
        a = strength * special.expit(logit) + FLOOR + failed
        b = strength * special.expit(-logit) + FLOOR + n - failed
        for j, (path, weight) in enumerate(zip(self.lost, self.lost_weights, strict=True)):
            met = np.asarray(np.ravel_multi_index(tuple(path.T), self.exists.shape))
            add_lost(_places_in(bounds, met), weight, self.place[draws, j] - 1, a, b)
        return a, b


def _places_in(bounds: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Indices of wanted bounds in ascending `bounds`; -1 for one that is not there."""
    at = np.minimum(np.searchsorted(bounds, wanted), len(bounds) - 1)
    return np.where(bounds[at] == wanted, at, -1)


def _parts(n: int, other: int) -> list[slice]:
    """Slices of n rows of `other` entries each, of bounded size."""
    step = max(1, _ENTRIES // max(1, other))
    return [slice(i, min(i + step, n)) for i in range(0, n, step)]
