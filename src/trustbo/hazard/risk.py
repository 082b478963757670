"""Risk: the posterior of the chances that bounds fail, and of those of a path, for planning."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_whole
from trustbo.hazard.prior import LIMIT_NAMES, TILT, prior_betas, steepness_of
from trustbo.hazard.strata import MOST, Strata, partition
from trustbo.workspace import Workspace
from trustbo.workspace.difficulty import difficulty_of
from trustbo.workspace.moves import moves_along

ROUNDING = 1e-12
"""Rounding of the risk of a path that is just within a limit."""
_BAND = (0.05, 0.95)
_ENTRIES = 1 << 20  # of (draw, bound) at a time
_SOME = 256  # number of bounds whose mean chance orders the draws


@dataclass(frozen=True, eq=False)
class BoundRisk:
    """Posterior of the chance that each bound ends the mission.

    Maps have shape (move, row, col): the bound that enters a cell by one of the eight `MOVES`; NaN
    where there is none.

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
    place: np.ndarray
    causes: dict[str, float]

    @classmethod
    def of(cls, hazard: xr.Dataset, workspace: Workspace) -> Self:
        """Risk of a workspace's bounds from the group `hazard` of a posterior; see `fit_hazard`."""
        count = hazard["failures_by_cause"].values + hazard.attrs["cause_concentration"]
        names = [str(name) for name in hazard["cause"].values]
        terms = [hazard["intercept"].values[:, None], hazard["coefficient"].values]
        limit = [hazard[name].values for name in LIMIT_NAMES if name in hazard]
        difficulty, steepness = difficulty_of(workspace), None
        if limit:
            tilt = difficulty.sel(measure=TILT).values
            steepness = steepness_of(tilt, workspace.team.max_slope)
        measures = hazard["measure"].values.tolist()
        return cls(
            np.concatenate(terms, axis=1),
            np.reshape(limit, (len(limit), hazard.sizes["draw"])).T,
            hazard["strength"].values,
            difficulty.sel(measure=measures).values - hazard.attrs["reference"],
            steepness,
            workspace.passable_bounds.values,
            hazard["exposures"].values,
            hazard["failures"].values,
            tuple(path[path[:, 0] >= 0] for path in hazard["lost_bound"].values),
            hazard["place"].values,
            dict(zip(names, (count / count.sum()).tolist(), strict=True)),
        )

    @property
    def mean(self) -> np.ndarray:
        """Posterior mean of the chance to fail, shape (move, row, col)."""
        return self._moments[0]

    @property
    def sd(self) -> np.ndarray:
        """Posterior sd of the chance to fail, shape (move, row, col)."""
        return self._moments[1]

    @property
    def has_failures(self) -> bool:
        """Whether a failure was recorded, at a known bound or a mission lost somewhere."""
        return bool(self.failures.any()) or len(self.lost) > 0

    @cached_property
    def stopped(self) -> np.ndarray:
        """Posterior expected number of past failures, shape (move, row, col)."""
        counts = self.failures.copy()
        for j, path in enumerate(self.lost):
            for k, bound in enumerate(path, start=1):
                counts[*bound] += (self.place[:, j] == k).mean()
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
        for block in _blocks(n, len(every)):
            out[block, self.exists] = rng.beta(*self._betas(chosen[block], every))
        return out

    def strata(self, n: int = MOST) -> Strata:
        """Chances under at most `n` groups of draws, from mild to severe; see `Strata`.

        Their mean, by the shares, is that over all draws.
        """
        order = self._mildest_first
        ends = partition(self._severity[order], require_whole("n", n, 1))
        sizes = np.diff(ends, prepend=0)
        member = np.empty(len(order), int)
        member[order] = np.repeat(np.arange(len(ends)), sizes)
        weights = (member == np.arange(len(ends))[:, None]) / sizes[:, None]
        p_fail = np.full((len(ends), *self.exists.shape), np.nan)
        draws, every = np.arange(len(order)), np.flatnonzero(self.exists)
        for block in _blocks(len(every), len(draws)):
            a, b = self._betas(draws, every[block])
            p_fail.reshape(len(ends), -1)[:, every[block]] = weights @ (a / (a + b))
        return Strata(p_fail, sizes / sizes.sum())

    @cached_property
    def _mildest_first(self) -> np.ndarray:
        """Indices of the draws of the hyperparameters, from mild to severe."""
        return np.argsort(self._severity)

    @cached_property
    def _severity(self) -> np.ndarray:
        """Mean chance of some of the bounds under each draw of the hyperparameters, (draw,)."""
        some = np.flatnonzero(self.exists)
        a, b = self._betas(np.arange(len(self.strength)), some[:: 1 + len(some) // _SOME])
        return (a / (a + b)).mean(1)

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd over all draws, the Betas in closed form."""
        mean, sd = np.full((2, *self.exists.shape), np.nan)
        draws = np.arange(len(self.strength))
        every = np.flatnonzero(self.exists)
        for block in _blocks(len(every), len(draws)):
            a, b = self._betas(draws, every[block])
            total = a + b
            chance = a / total
            first = chance.mean(0)
            second = (chance * (a + 1.0) / (total + 1.0)).mean(0)
            mean.flat[every[block]] = first
            sd.flat[every[block]] = np.sqrt(np.maximum(0.0, second - first**2))
        return mean, sd

    def _betas(self, draws: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Alpha and beta of the posterior Betas of bounds, flat indices; each (draw, bound)."""
        where = np.unravel_index(bounds, self.exists.shape)
        steepness = None if self.steepness is None else self.steepness[where]
        drawn = self.coefficients[draws], self.limit[draws], self.strength[draws]
        a, b = prior_betas(*drawn, self.difficulty[where], steepness)
        n, failed = self.exposures.ravel()[bounds], self.failures.ravel()[bounds]
        a, b = a + failed, b + n - failed
        for j, path in enumerate(self.lost):
            met = np.asarray(np.ravel_multi_index(tuple(path.T), self.exists.shape))
            add_lost(_places_in(bounds, met), self.place[draws, j] - 1, a, b)
        return a, b


def add_lost(path: np.ndarray, place: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
    """Add a mission that failed at `place` (point,) of its path to Betas a, b (point, bound).

    A negative index in the path is a bound that is not among these.
    """
    for k, e in enumerate(path):
        if e >= 0:
            a[:, e] += place == k
            b[:, e] += place > k


def _places_in(bounds: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Indices of wanted bounds in ascending `bounds`; -1 for one that is absent."""
    nearest = np.minimum(np.searchsorted(bounds, wanted), len(bounds) - 1)
    return np.where(bounds[nearest] == wanted, nearest, -1)


def _blocks(n: int, other: int) -> list[slice]:
    """Slices of n rows of `other` entries each, of limited size."""
    step = max(1, _ENTRIES // max(1, other))
    return [slice(i, min(i + step, n)) for i in range(0, n, step)]


@dataclass(frozen=True, eq=False)
class Risk:
    """Chance that a bound ends the mission, of all bounds of a workspace.

    Attributes:
        p_fail: Posterior mean, shape (move, row, col) with the moves of `MOVES[8]`; NaN where there
            is no bound.
        draws: Draws from its posterior, shape (draw, move, row, col), or None.
        causes: Shares of the causes of a failure, each a number or an array (move, row, col); they
            add up to 1.
        strata: Chances under groups of draws, by which a failure is priced; None: by `p_fail`, as
            if bounds were independent.

    Raises:
        TrustboError: Another shape; a chance outside [0, 1], or shares that do not add up to 1.
    """

    p_fail: np.ndarray
    draws: np.ndarray | None = None
    causes: Mapping[str, ArrayLike] = field(default_factory=dict)
    strata: Strata | None = None

    def __post_init__(self) -> None:
        of_strata = None if self.strata is None else self.strata.p_fail
        for name, p, axis in (
            ("p_fail", self.p_fail, ""),
            ("draws of p_fail", self.draws, "draw, "),
            ("strata of p_fail", of_strata, "stratum, "),
        ):
            if p is None:
                continue
            if p.shape[-3:] != self.p_fail.shape or p.ndim != 3 + bool(axis):
                expected = axis + "move, row, col"
                raise TrustboError(f"{name} must have axes ({expected}); got shape {p.shape}.")
            if ((p < 0.0) | (p > 1.0)).any():
                worst = float(p[(p < 0.0) | (p > 1.0)][0])
                raise TrustboError(f"{name} must be in [0, 1]; got {worst:g}.")
        if self.strata is not None:
            shares = np.asarray(self.strata.shares)
            if shares.shape != self.strata.p_fail.shape[:1]:
                raise TrustboError(f"strata need a share each; got shape {shares.shape}.")
            if (shares < 0.0).any() or abs(shares.sum() - 1.0) > 1e-9:
                raise TrustboError(f"shares of strata must add up to 1; got {shares}.")

    def survival(self, path: Sequence[Cell] | np.ndarray) -> float:
        """Product of 1 - p_fail along a path, by which limits of plans go.

        The chance to arrive is larger where bounds fail together under the draws: see `along`.
        """
        return float(np.prod(1.0 - self.p_fail[_index_of(path)]))

    def priced(self, path: Sequence[Cell] | np.ndarray) -> float:
        """Chance that a path fails by which costs of plans go: the mean over the strata."""
        if self.strata is None:
            return 1.0 - self.survival(path)
        p_fail, shares = self.strata
        return float(shares @ (1.0 - np.prod(1.0 - p_fail[_index_of(path)], axis=1)))

    def along(self, path: Sequence[Cell] | np.ndarray) -> "PathRisk":
        """Select the bounds of a path."""
        index = _index_of(path)
        p = self.p_fail[index]
        shares = {
            cause: np.broadcast_to(s, self.p_fail.shape)[index] for cause, s in self.causes.items()
        }
        band, arrive = np.full((2, len(p)), np.nan), (np.nan, np.nan)
        reach = np.cumprod(1.0 - p)
        if self.draws is not None:
            drawn = self.draws[index]
            band = np.quantile(drawn, _BAND, axis=0)
            low, high = np.quantile(np.prod(1.0 - drawn, axis=1), _BAND).tolist()
            arrive = low, high
            reach = np.minimum.accumulate(np.minimum(reach * _dependence(drawn), 1.0 - p))
        by_cause = {cause: share * p for cause, share in shares.items()}
        return PathRisk(p, band, float(reach[-1]), arrive, by_cause, reach)


def _index_of(path: Sequence[Cell] | np.ndarray) -> tuple[Any, ...]:
    """Index of the bounds of a path in arrays (..., move, row, col)."""
    rows, cols = np.asarray(path)[1:].T
    return ..., moves_along(path), rows, cols


def _dependence(draws: np.ndarray) -> np.ndarray:
    """Mean over draws (draw, bound) of the product of 1 - p, over the product of the means.

    Shape (bound,): of the first bound, the first two, and so on. It is the factor by which bounds
    are likelier to be passed together than if they were independent; multiplied by the product of
    1 - p_fail it has none of the error that few draws make in each p_fail.
    """
    together = np.cumprod(1.0 - draws, axis=1).mean(0)
    apart = np.cumprod((1.0 - draws).mean(0))
    return np.divide(together, apart, out=np.ones_like(apart), where=apart > 0.0)


class PathRisk(NamedTuple):
    """Chance that a path's bounds end the mission, each given that it is begun."""

    p_fail: np.ndarray
    """Posterior mean, shape (bound,)."""
    p_fail_band: np.ndarray
    """Ends of its 90 % band over draws, shape (end, bound); NaN without draws."""
    p_arrive: float
    """Chance to reach the goal: the mean over draws of the product of 1 - p_fail, as the chances of
    bounds are correlated; without draws, the product of the means."""
    p_arrive_band: tuple[float, float]
    """Ends of its 90 % band over draws; NaN without draws."""
    by_cause: Mapping[str, np.ndarray]
    """`p_fail` by cause of the failure, each of shape (bound,)."""
    p_reach: np.ndarray
    """Chance to complete each bound and all before it, shape (bound,); the last is `p_arrive`."""

    def to_record(self) -> dict[str, Any]:
        """Convert to plain lists and numbers."""
        by_cause = {cause: p.tolist() for cause, p in self.by_cause.items()}
        return {
            **self._asdict(),
            "p_fail": self.p_fail.tolist(),
            "p_fail_band": self.p_fail_band.tolist(),
            "by_cause": by_cause,
            "p_reach": self.p_reach.tolist(),
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Convert the record of `to_record` back."""
        low, high = record["p_arrive_band"]
        return cls(
            np.array(record["p_fail"]),
            np.array(record["p_fail_band"]),
            record["p_arrive"],
            (low, high),
            {cause: np.array(p) for cause, p in record["by_cause"].items()},
            np.array(record["p_reach"]),
        )
