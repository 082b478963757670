"""Risk of bounds: the posterior of their chances to fail, for planning."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import xarray as xr

from trustbo.errors import require_whole
from trustbo.hazard.difficulty import difficulty_of
from trustbo.hazard.sampler import LIMIT_NAMES, TILT, add_lost, prior_betas, steepness_of
from trustbo.workspace import Workspace

_ENTRIES = 1 << 20  # of (draw, bound) at a time
_SOME = 256  # number of bounds whose mean chance orders the draws


@dataclass(frozen=True, eq=False)
class BoundRisk:
    """Posterior of the chance that each bound ends the mission.

    Maps have shape (move, row, col): the bound that enters a cell by one of the eight `MOVES`. They
    are NaN where there is no bound.

    Attributes:
        coefficients: Weights in the logit of the prior mean, intercept first, (draw, 1 + measure).
        limit: Margin and width of the slope limit, degrees, (draw, 2); (draw, 0) without a limit.
        strength: Strength of the Betas, (draw,).
        difficulty: Difficulty less its reference, (move, row, col, measure).
        steepness: Degrees by which bounds are beyond the assumed slope limit, (move, row, col), or
            None without a limit.
        exists: Whether the bound exists, (move, row, col).
        exposures: Known exposures, (move, row, col).
        failures: Known failures, (move, row, col).
        lost: Bounds of each mission lost somewhere unknown, each (bound, 3).
        lost_weights: Their weights, (lost,).
        place: Bound at which each failed, from 1, (draw, lost).
        causes: Posterior mean share of each cause among failures.
    """

    coefficients: np.ndarray
    limit: np.ndarray
    strength: np.ndarray
    difficulty: np.ndarray
    steepness: np.ndarray | None
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
        limit = [hazard[name].values for name in LIMIT_NAMES if name in hazard]  # 0.2 has none
        difficulty, steepness = difficulty_of(workspace), None
        if limit:
            tilt = difficulty.sel(measure=TILT).values
            steepness = steepness_of(tilt, workspace.team.max_slope)
        measures = hazard["measure"].values.tolist()
        risk = cls(
            np.concatenate(terms, axis=1),
            np.reshape(limit, (len(limit), hazard.sizes["draw"])).T,
            hazard["strength"].values,
            difficulty.sel(measure=measures).values - hazard.attrs["reference"],
            steepness,
            workspace.passable_bounds.values,
            hazard["exposures"].values,
            hazard["failures"].values,
            tuple(path[path[:, 0] >= 0] for path in hazard["lost_bound"].values),
            hazard["lost_weight"].values,
            hazard["place"].values,
            dict(zip(names, (count / count.sum()).tolist(), strict=True)),
        )
        if "p_fail" in hazard:  # located failures
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
        """Posterior expected number of past failures, shape (move, row, col)."""
        counts = self.failures.copy()
        for j, (path, weight) in enumerate(zip(self.lost, self.lost_weights, strict=True)):
            for k, bound in enumerate(path, start=1):
                counts[*bound] += weight * (self.place[:, j] == k).mean()
        return counts

    def draw(self, n: int, seed: int = 0) -> np.ndarray:
        """Draws of the chances to fail, shape (draw, move, row, col).

        Args:
            n: Number of draws. Those of the hyperparameters are taken at even steps from the
                mildest to the worst, so that few draws have the posterior's mean chance to arrive.
            seed: Seed of the draws from the Betas.
        """
        rng = np.random.default_rng(seed)
        out = np.full((require_whole("n", n, 1), *self.exists.shape), np.nan)
        every, order = np.flatnonzero(self.exists), self._mildest_first
        chosen = rng.permutation(order[((np.arange(n) + 0.5) / n * len(order)).astype(int)])
        for part in _parts(n, len(every)):
            out[part, self.exists] = rng.beta(*self._betas(chosen[part], every))
        return out

    @cached_property
    def _mildest_first(self) -> np.ndarray:
        """Indices of the draws of the hyperparameters, by the mean chance of some of the bounds."""
        some = np.flatnonzero(self.exists)
        a, b = self._betas(np.arange(len(self.strength)), some[:: 1 + len(some) // _SOME])
        return np.argsort((a / (a + b)).mean(1))

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
        where = np.unravel_index(bounds, self.exists.shape)
        steepness = None if self.steepness is None else self.steepness[where]
        drawn = self.coefficients[draws], self.limit[draws], self.strength[draws]
        a, b = prior_betas(*drawn, self.difficulty[where], steepness)
        n, failed = self.exposures.ravel()[bounds], self.failures.ravel()[bounds]
        a, b = a + failed, b + n - failed
        for j, (path, weight) in enumerate(zip(self.lost, self.lost_weights, strict=True)):
            met = np.asarray(np.ravel_multi_index(tuple(path.T), self.exists.shape))
            add_lost(_places_in(bounds, met), weight, self.place[draws, j] - 1, a, b)
        return a, b


def _places_in(bounds: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Indices of wanted bounds in ascending `bounds`; -1 for one that is absent."""
    nearest = np.minimum(np.searchsorted(bounds, wanted), len(bounds) - 1)
    return np.where(bounds[nearest] == wanted, nearest, -1)


def _parts(n: int, other: int) -> list[slice]:
    """Slices of n rows of `other` entries each, of limited size."""
    step = max(1, _ENTRIES // max(1, other))
    return [slice(i, min(i + step, n)) for i in range(0, n, step)]
