"""Posterior failure probabilities of bounds and paths, for planning.

The group `hazard` of a posterior contains draws of hyperparameters, and what happened in bounds.
For each draw, the failure probability of a bound has a Beta distribution, which follows in three
steps:

1. The prior Beta(a, b) depends on the difficulty of the bound, through the weights of the measures
   of difficulty and the slope limit.
2. A failure at this bound adds 1 to a, and each time that it was passed adds 1 to b.
3. A mission that was lost in an unknown bound of its path is counted as in step 2, for the bound
   that the draw assumes.

All means are averages over the draws. Options of a bound that pass or fail together are one unit,
and have the same probability, so the steps are taken once for each unit (see `hazard.units`).
Results are maps by way and next way, as planners read them (see `workspace.moves`).
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from trustbo.arrays import in_order
from trustbo.data import Station
from trustbo.display import Rows
from trustbo.errors import TrustboError, require_whole
from trustbo.hazard.components import Components, partition
from trustbo.hazard.path_risk import BAND, PathRisk, Risk
from trustbo.hazard.prior import LIMIT_NAMES, REFERENCE, prior_betas, steepness_of
from trustbo.hazard.units import Units
from trustbo.workspace import Workspace
from trustbo.workspace.difficulty import TILT, Difficulty
from trustbo.workspace.moves import by_option, next_names, way_names

_DIMS = ("draw", "lost", "measure", "bound", "axis", "move", "row", "col", "next_move")
"""Axes of the group `hazard`, in order."""
_ENTRIES = 1 << 17
"""Maximum size of an array (draw, unit), which fits into the cache of a core."""
_SOME = 256
"""Approximate number of units whose mean failure probability determines the order of the draws."""


class BoundRisk(Risk):
    """Posterior of the probability that each bound of a workspace ends the mission.

    Maps have shape (way, row, col, next_way), where (row, col) is the cell that a bound enters. A
    way is a move of `MOVES` or, with several sets of posts, move + 8 set; see `workspace.moves`.
    The last next way is the end of the path. Failure probabilities are NaN where there is no bound.

    Attributes:
        exists: Whether each bound exists and can be followed by the next way, shape (way, row, col,
            next_way).
        trials: Number of times that each bound is known to have been completed or to have failed,
            shape (way, row, col, next_way).
        failures: Number of failures at a known bound, shape (way, row, col, next_way).

    The risk of a path needs the difficulty of its bounds only. Maps need that of all bounds, which
    is measured when a map is first computed.

    Example:
        >>> risk = tb.hazard.BoundRisk(tb.hazard.fit_hazard(missions, workspace), workspace)
        >>> draws = risk.draw(100)  # failure probabilities, leading axis (draw,)
    """

    def __init__(self, hazard: xr.Dataset, workspace: Workspace) -> None:
        """Read the group `hazard` of a posterior (see `fit_hazard`) for a workspace.

        Raises:
            TrustboError: If the group was made by version 0.4 or earlier, or if its bounds or its
                measures of difficulty are not those of the workspace.
        """
        difficulty = workspace.difficulty
        hazard = _in_order(hazard, workspace.n_posts)
        _require_same_bounds(hazard, difficulty.exists)
        _require_measures(hazard, difficulty)

        # What happened.
        self.exists = difficulty.exists
        self.trials = hazard["trials"].values
        self.failures = hazard["failures"].values
        self._trials_of_options = by_option(self.trials)
        self._failures_of_options = by_option(self.failures)
        self._lost = [path[path[:, 0] >= 0] for path in hazard["lost_bound"].values]  # (bound, 4)
        self._place = hazard["place"].values  # of the failure in a lost path, (draw, lost), from 1

        # Difficulty.
        self._difficulty = difficulty
        self._n_posts = workspace.n_posts
        self._measures = [difficulty.measures.index(name) for name in hazard["measure"].values]
        self._max_slope = workspace.team.max_slope

        # Hyperparameters.
        intercept = hazard["intercept"].values[:, None]
        self._weights = np.concatenate([intercept, hazard["coefficient"].values], axis=1)
        self._strength = hazard["strength"].values  # (draw,)
        limit = [hazard[name].values for name in LIMIT_NAMES if name in hazard]
        self._has_limit = bool(limit)
        self._limit = np.reshape(limit, (len(limit), len(self._strength))).T  # (draw, parameter)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the maps."""
        return self.exists.shape

    def _rows(self) -> Rows:
        is_bound = self.exists.any(-1)
        n_driven = int((self.trials.sum(-1)[is_bound] > 0).sum())
        n_unknown = len(self._lost)
        failures = f"{self.failures.sum():.0f} at a known bound"
        if n_unknown:
            failures += f", {n_unknown} in an unknown bound of a path"

        return [
            ("bounds", f"{int(is_bound.sum())}, of which {n_driven} were driven"),
            ("trials", f"{self.trials.sum():.0f}"),
            ("failures", failures),
            *self._rows_of_failures(),
        ]

    @cached_property
    def steepness(self) -> np.ndarray | None:
        """Degrees by which each bound exceeds the stated slope limit; None without a limit.

        The shape is (way, row, col, next_way).
        """
        if not self._has_limit:
            return None
        return self._steepness_of(self._difficulty.whole().values)

    def _steepness_of(self, measures: np.ndarray) -> np.ndarray:
        """Return the steepness (...) of bounds with the measures (..., measure)."""
        tilt = measures[..., self._difficulty.measures.index(TILT)]
        return steepness_of(tilt, self._max_slope)

    @cached_property
    def _units(self) -> Units:
        """Units of all bounds, which are measured now if they were not before."""
        return Units(self._difficulty.whole().unit, self._n_posts)

    @cached_property
    def mean(self) -> np.ndarray:
        """Posterior mean of the failure probability, shape (way, row, col, next_way)."""
        mean = np.empty(len(self._units.named))
        for units, a, b in self._betas():
            mean[units] = (a / (a + b)).mean(0)
        return self._units.on_maps(mean)

    @cached_property
    def past_failures(self) -> np.ndarray:
        """Posterior mean of the number of past failures of each bound, shape (move, row, col).

        Failures with all next moves and all sets of posts are counted.
        """
        counts = self.failures.copy()
        for j, path in enumerate(self._lost):
            for k, bound in enumerate(path, start=1):
                counts[*bound] += (self._place[:, j] == k).mean()
        return by_option(counts).sum(-1)

    def draw(self, n: int, seed: int = 0) -> np.ndarray:
        """Draw the failure probabilities, shape (draw, way, row, col, next_way).

        Args:
            n: Number of draws. The hyperparameter draws are evenly spaced in order of severity, so
                a few draws suffice to estimate the mean arrival probability.
            seed: Random seed.
        """
        rng = np.random.default_rng(seed)
        order = np.argsort(self._severity)
        steps = (np.arange(require_whole("n", n, 1)) + 0.5) / n
        chosen = rng.permutation(order[(steps * len(order)).astype(int)])

        out = np.empty((n, len(self._units.named)))
        for units, a, b in self._betas(chosen):
            out[:, units] = rng.beta(a, b)
        return self._units.on_maps(out)

    def components(self, n: int = 5) -> Components:
        """Average the failure probabilities in at most `n` groups of draws (see `Components`).

        The mean of the groups, weighted by their sizes, equals the mean over all draws.
        """
        order = np.argsort(self._severity)
        ends = partition(self._severity[order], require_whole("n", n, 1))
        sizes = np.diff(ends, prepend=0)

        member = np.empty(len(order), int)
        member[order] = np.repeat(np.arange(len(ends)), sizes)
        # One product averages over the members of each group.
        weights = (member == np.arange(len(ends))[:, None]) / sizes[:, None]

        p_fail = np.empty((len(ends), len(self._units.named)))
        for units, a, b in self._betas():
            p_fail[:, units] = weights @ (a / (a + b))
        return Components(self._units.on_maps(p_fail), sizes / sizes.sum())

    @cached_property
    def searched(self) -> Components:
        """Components with which paths are searched."""
        return self.components()

    def along(self, path: Sequence[Station] | np.ndarray) -> PathRisk:
        """Compute the risk along a path, without the risk of other bounds.

        Given the hyperparameters, units fail independently, with probabilities that have Beta
        distributions. The arrival probability is averaged over the draws of the hyperparameters.
        Probabilities of bounds that do not exist are NaN, and so is the arrival probability.
        """
        pairs = self.pairs_along(path)
        units, index = np.unique(self._difficulty.units_of(pairs), axis=0, return_inverse=True)
        a, b = self._betas_of(units)
        exists = self.exists[*pairs.T]
        p_fail = np.where(exists, (a / (a + b)).mean(0)[index], np.nan)
        if not exists.all():
            return PathRisk(p_fail, np.nan, (np.nan, np.nan))

        # If a unit is passed several times, each pass is evidence for the next one.
        arrives = np.ones(len(a))
        n_passed = np.zeros(len(units))
        for unit in index:
            passed = b[:, unit] + n_passed[unit]
            arrives *= passed / (a[:, unit] + passed)
            n_passed[unit] += 1.0

        drawn = np.random.default_rng(0).beta(a, b)[:, index]
        low, high = np.quantile(np.prod(1.0 - drawn, axis=1), BAND).tolist()
        return PathRisk(p_fail, float(arrives.mean()), (low, high))

    @cached_property
    def _severity(self) -> np.ndarray:
        """Mean failure probability (draw,) over a subset of units for each hyperparameter draw."""
        named = self._units.named
        a, b = self._betas_of(named[:: 1 + len(named) // _SOME])
        return (a / (a + b)).mean(1)

    def _betas(self, draws: Any = slice(None)) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield chunks of all units: their slice, and alpha and beta (draw, unit)."""
        named = self._units.named
        n_draws = len(self._strength[draws])
        step = max(1, _ENTRIES // n_draws)
        for start in range(0, len(named), step):
            some = slice(start, start + step)
            yield some, *self._betas_of(named[some], draws)

    def _betas_of(
        self, units: np.ndarray, draws: Any = slice(None)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return alpha and beta (draw, unit) of the posterior Beta distributions of units.

        The units (unit, 4) are named as in `Units`, and distinct.
        """
        difficulty = self._difficulty.of(units[:, :3])
        measures = difficulty.values[np.arange(len(units)), units[:, 3]]
        a, b = self._prior_of(measures, draws)

        is_member = difficulty.unit == units[:, 3:]  # (unit, option)
        failures = _total(self._failures_of_options, units, is_member)
        trials = _total(self._trials_of_options, units, is_member)
        a += failures
        b += trials - failures

        number = {unit: k for k, unit in enumerate(map(tuple, units.tolist()))}
        for j, path in enumerate(self._lost):
            passed = self._difficulty.units_of(path).tolist()
            numbers = np.array([number.get(tuple(unit), -1) for unit in passed])
            add_lost(numbers, self._place[draws, j] - 1, a, b)
        return a, b

    def _prior_of(self, measures: np.ndarray, draws: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return alpha and beta (draw, unit) of the prior, given measures (unit, measure)."""
        steepness = self._steepness_of(measures) if self._has_limit else None
        return prior_betas(
            self._weights[draws],
            self._limit[draws],
            self._strength[draws],
            measures[:, self._measures] - REFERENCE,
            steepness,
        )


def _in_order(hazard: xr.Dataset, n_posts: int) -> xr.Dataset:
    """Return the group `hazard` with its axes and labels in order."""
    labels = {
        "draw": None,  # numbers
        "axis": _DIMS[-4:],
        "move": way_names(n_posts),
        "next_move": next_names(n_posts),
    }
    hazard = in_order("the hazard posterior", hazard, labels)
    return hazard.transpose(*_DIMS, missing_dims="ignore")


def _require_same_bounds(hazard: xr.Dataset, exists: np.ndarray) -> None:
    """Raise TrustboError unless the bounds of the hazard posterior are those of the workspace."""
    if hazard["trials"].shape != exists.shape:
        raise TrustboError(
            f"the hazard posterior has trials of the shape {hazard['trials'].shape}; for this "
            f"workspace, it must be (move, row, col, next_move) = {exists.shape}. Call fit_hazard "
            "again with the missions; posteriors of trustbo 0.4 have no next moves."
        )
    if "is_bound" in hazard and (hazard["is_bound"].values != exists.any(-1)).any():
        raise TrustboError(
            "the hazard posterior has other bounds than this workspace; call fit_hazard "
            "again with this workspace."
        )


def _require_measures(hazard: xr.Dataset, difficulty: Difficulty) -> None:
    """Raise TrustboError if the hazard posterior needs measures that the workspace lacks."""
    names = hazard["measure"].values.tolist()
    if set(names) - set(difficulty.measures):
        raise TrustboError(
            f"the hazard posterior needs the measures of difficulty {', '.join(names)}, which "
            "a workspace without a terrain does not have; call fit_hazard again with this "
            "workspace."
        )


def _total(counts: np.ndarray, units: np.ndarray, is_member: np.ndarray) -> np.ndarray:
    """Add up counts (move, row, col, option) over the options of each unit, shape (unit,)."""
    of_bounds = counts[*units[:, :3].T]  # (unit, option)
    return np.where(is_member, of_bounds, 0.0).sum(-1)


def add_lost(path: np.ndarray, place: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
    """Update a and b (point, bound) with a mission that failed at index `place` (point,) of `path`.

    `path` contains indices of bounds in `a` and `b`; they are negative for bounds that `a` and `b`
    do not contain.
    """
    for k, e in enumerate(path):
        if e >= 0:
            a[:, e] += place == k
            b[:, e] += place > k
