"""Filter for the trust of robots during a mission, updated after every bound."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import Names, evenly_spaced, read_labelled
from trustbo.data import Station, require_path, require_shares, require_unit_interval
from trustbo.errors import TrustboError, one_line, require_whole
from trustbo.inference.learner import params_of
from trustbo.inference.order import as_fitted
from trustbo.inference.weights import systematic
from trustbo.models.draws import Draws
from trustbo.models.observations import NO_TICKS
from trustbo.parallel import computing
from trustbo.statespace import Inputs, kalman
from trustbo.workspace import Workspace
from trustbo.workspace.moves import bounds_along, require_on_grid

_TICKS = 200.0
"""Number of ticks assumed for a future bound."""
_BAND = (0.05, 0.95)
"""Quantiles of predicted contact rates."""


class TrustState(NamedTuple):
    """Mean and standard deviation (robot,) of trust, averaged over parameter draws."""

    mean: np.ndarray
    sd: np.ndarray


class TrustForecast(NamedTuple):
    """Trust and contact rates along future bounds, averaged over parameter draws.

    Attributes:
        mean: Mean of trust, shape (bound, robot).
        sd: Standard deviation of trust.
        rate: Mean contact rate.
        rate_low: 5 % quantile of the contact rate.
        rate_high: 95 % quantile of the contact rate.
        draws: Equally weighted joint draws (draw, bound, robot) of the contact rates of all bounds.
    """

    mean: np.ndarray
    sd: np.ndarray
    rate: np.ndarray
    rate_low: np.ndarray
    rate_high: np.ndarray
    draws: np.ndarray

    def __repr__(self) -> str:
        n_bounds, n_robots = self.rate.shape
        lines = [
            f"TrustForecast of {n_bounds} bounds, {n_robots} robots, {len(self.draws)} draws",
            "  contact rate of each robot, mean [5 %, 95 %], by bound ahead",
        ]
        ranges = np.stack([self.rate, self.rate_low, self.rate_high], axis=-1)
        for k, of_robots in enumerate(ranges, start=1):
            texts = ["{:.2f} [{:.2f}, {:.2f}]".format(*of_robot) for of_robot in of_robots]
            lines.append(f"  {k:>3}  {'  '.join(texts)}")
        return "\n".join(lines)


class TrustFilter:
    """Rao-Blackwellised filter for the trust of each robot during a mission.

    If rates are Gaussian, trust is Gaussian given a parameter draw, and the Kalman filter is exact.
    For other families, moments are matched after each observed rate (assumed-density filtering).
    The draws are reweighted by the predictive density of the rates. After bound k, the filter
    approximates p(trust, parameters | earlier missions, bounds 1..k).

    To follow a bound tick by tick, update a copy of the filter with the rate so far, as
    `tb.Follower` does.

    Attributes:
        params: Parameter draws with the leading axis (draw,).
        weights: Current weights (draw,) of the draws, which sum to 1.
        n_bounds: Number of bounds since the last `reset`.
        likelihood: Observation family.
        space: State-space form of each draw.

    Example:
        >>> trust = tb.inference.TrustFilter(posterior, workspace=workspace)
        >>> awareness = workspace.along(path)  # (bound, robot, feature)
        >>> trust.update(awareness[0], [0.9, 1.0, 0.4], bound=(path[0], path[1])).mean
        >>> trust.predict(awareness[1:], path[1:]).rate  # contact rates of the bounds to come
    """

    @computing()
    def __init__(
        self,
        posterior: xr.DataTree | Draws,
        n_robots: int | None = None,
        *,
        max_draws: int = 1000,
        workspace: Workspace | None = None,
    ) -> None:
        """Start the filter before the first bound of a mission.

        Args:
            posterior: DataTree from `fit`, or draws of parameters.
            n_robots: Number of robots; needed only with `TrustParams`.
            max_draws: Maximum number of draws; if there are more, evenly spaced draws are selected.
            workspace: Workspace that determines the order of robots and features in all arrays. By
                default, arrays without labels are in the order of the missions of the fit, or in
                that of the parameters.

        Raises:
            TrustboError: If the robots or features of the posterior differ from those of the
                workspace; the number of robots does not match the draws; the posterior is not from
                `fit`; or `TrustParams` are given without `n_robots`.
        """
        self._bounded = True
        if isinstance(posterior, xr.DataTree):
            tree = as_fitted("TrustFilter", posterior)
            if "constant_data" in tree.children:  # without a map, any awareness is valid
                self._bounded = bool((tree["constant_data"]["row"] >= 0).any())
            n_robots = tree.attrs["n_robots"] if workspace is None else None
            posterior = params_of(tree, workspace, next_mission=True)
        elif not isinstance(posterior, Draws):
            raise TrustboError(
                "TrustFilter needs a posterior from fit or parameter draws; got "
                f"{one_line(posterior)}. A campaign has no posterior before the first mission; "
                "use the `belief` of the campaign instead."
            )

        if workspace is not None:
            posterior = posterior.in_order(workspace.team.names, workspace.features)
            n_robots = workspace.team.n_robots if n_robots is None else n_robots
        self._names: dict[str, Names | None] = {
            "robot": posterior.robots or None,
            "feature": posterior.features or None,
        }
        if n_robots is None:
            n_robots = posterior.n_robots
        if n_robots is None:
            raise TrustboError("TrustParams do not contain the number of robots; give n_robots.")
        self._n_robots = require_whole("n_robots", n_robots, 1)
        self._n_features = posterior.n_features
        posterior.require_valid(self._n_robots, self._n_features)

        max_draws = require_whole("max_draws", max_draws, 1)
        kept = evenly_spaced(posterior.n_draws, max_draws)
        self.params: Draws = posterior.draw(kept)
        self.likelihood = self.params.likelihood
        self.space = self.params.state_space(self._n_robots, adds_noise=self.likelihood.adds_noise)
        self.reset()

    def reset(self) -> None:
        """Start a new mission with equally weighted draws."""
        n = self.params.n_draws
        offset = self.params.initial_offset[:, None, None]
        self._belief = kalman.initial(self.space, self._n_robots // self.space.n_members, offset)
        self._log_weight = np.zeros(n)
        self.weights = np.full(n, 1.0 / n)
        self.n_bounds = 0

    @property
    def kish(self) -> float:
        """Effective number of draws, 1 / sum(weights^2).

        It falls if rates surprise the posterior. If only a few draws are left, trust has a large
        Monte Carlo error.
        """
        return float(1.0 / (self.weights**2).sum())

    @property
    def state(self) -> TrustState:
        """Trust of each robot after the bounds so far."""
        return _average(self._belief, self.weights)

    @computing()
    def update(
        self,
        awareness: ArrayLike,
        contact_rate: ArrayLike,
        bound: tuple[Station, Station] | None = None,
        *,
        n_ticks: ArrayLike | None = None,
    ) -> TrustState:
        """Update trust with the contact rates of one bound.

        Args:
            awareness: Awareness in the bound, shape (robot, feature).
            contact_rate: Contact rates, shape (robot,); NaN where not measured.
            bound: Cell left and cell entered; needed if the model has place effects.
            n_ticks: Tick counts, shape () or (robot,); needed for the beta-binomial family.

        Returns:
            Mean and standard deviation of trust after the bound.

        Raises:
            TrustboError: If the number of robots or features is wrong; awareness is NaN or outside
                [0, 1]; tick counts are missing or inconsistent with the rates; or the bound is
                missing, off the grid or between cells that are not neighbours.
        """
        z = self._checked(awareness, 2)
        [inputs] = self.inputs(z[None], bound)

        y = self._of_robots("contact_rate", contact_rate)
        if y.shape != (self._n_robots,):
            raise TrustboError(f"contact_rate must have shape ({self._n_robots},); got {y.shape}.")
        y = require_unit_interval("contact_rate", y)

        ticks = self._of_robots("n_ticks", np.nan if n_ticks is None else n_ticks)
        if ticks.ndim == 0:
            ticks = np.full(y.shape, ticks)
        ticks = require_shares(y, ticks)
        if self.likelihood.needs_ticks and (np.isnan(ticks) & ~np.isnan(y)).any():
            raise TrustboError(NO_TICKS)

        predicted = kalman.predict(self.space, self._belief, inputs)
        rates = self.space.grouped(y)
        counts = self.space.grouped(ticks)
        self._belief, gained = kalman.update(self.space, predicted, rates, counts, self.likelihood)

        # Draws that predicted the rates better get larger weights.
        self._log_weight = self._log_weight + gained  # a new array, as copies share the old one
        weights = np.exp(self._log_weight - self._log_weight.max())
        self.weights = weights / weights.sum()

        self.n_bounds += 1
        return self.state

    def resample(self, *, seed: int = 0) -> Draws:
        """Return equally weighted draws of the parameters, given the bounds so far.

        Args:
            seed: Seed of the systematic resampling.
        """
        rng = np.random.default_rng(require_whole("seed", seed, 0))
        return self.params.draw(systematic(self.weights, len(self.weights), rng))

    @computing()
    def predict(self, awareness: ArrayLike, path: Sequence[Station] | None = None) -> TrustForecast:
        """Predict trust and contact rates along future bounds.

        One rate per bound and robot is drawn for each parameter draw. Future bounds are assumed to
        have 200 ticks.

        Args:
            awareness: Awareness along the path, shape (bound, robot, feature).
            path: Current cell of the team and the cells to be entered; needed with place effects.

        Raises:
            TrustboError: If the number of robots or features is wrong; awareness is NaN or outside
                [0, 1]; or the path is missing, has the wrong length, jumps or leaves the grid.
        """
        given = self._checked(awareness, 3)
        rng = np.random.default_rng(self.n_bounds)  # makes repeated predictions identical

        inputs = self.inputs(given, path)
        ticks = self.space.grouped(np.full(given.shape[:2], _TICKS))
        trust = []
        rates = []
        for belief, drawn in self.ahead(inputs, ticks, rng):
            trust.append(_average(belief, self.weights))
            rates.append(drawn)

        draws = np.stack(rates, axis=1)[systematic(self.weights, len(self.weights), rng)]
        mean, sd = (np.stack(column) for column in zip(*trust, strict=True))
        low, high = np.quantile(draws, _BAND, axis=0)
        return TrustForecast(mean, sd, draws.mean(0), low, high, draws)

    def ahead(
        self, inputs: Sequence[Inputs], n_ticks: np.ndarray, rng: np.random.Generator
    ) -> Iterator[tuple[kalman.Belief, np.ndarray]]:
        """Yield trust and drawn rates (draw, robot) of future bounds under each draw.

        `inputs` are those of the method `inputs`, and `n_ticks` has shape (bound, group, member).
        """
        return kalman.forecast(self.space, self._belief, inputs, n_ticks, self.likelihood, rng)

    def inputs(self, awareness: np.ndarray, path: Sequence[Station] | None) -> list[Inputs]:
        """Return the inputs (draw, group, member) of each bound of a path.

        `awareness` has shape (bound, robot, feature).
        """
        bounds = self._bounds(path, len(awareness))
        return self.params.along(np.swapaxes(awareness, 0, 1), bounds, self.space)

    def _bounds(self, path: Sequence[Station] | None, n_bounds: int) -> np.ndarray:
        """Return the ways, rows and columns (bound, 3) of a path; ways are -1 if not needed.

        Raises:
            TrustboError: If the path is missing, has the wrong length, jumps, leaves the grid, or
                has sets of posts that the posterior does not know.
        """
        grid = self.params.grid_shape
        if path is None and grid is None:
            return np.full((n_bounds, 3), -1)

        cells = require_path("path", path if isinstance(path, Iterable) else [])
        if len(cells) != n_bounds + 1:
            raise TrustboError(
                f"bound or path must have {n_bounds + 1} cells, beginning with the current cell of "
                f"the team; got {path!r}."
            )
        if grid is not None:
            require_on_grid(cells, grid)

        bounds = bounds_along(cells)  # refuses a path that jumps
        n_ways = self.params.n_ways
        if n_ways is not None and (bounds[:, 0] >= n_ways).any():
            k = int(np.argmax(bounds[:, 0] >= n_ways))
            raise TrustboError(
                f"path[{k}] has the posts {cells[k][-1]!r}, which no mission of the fit has used; "
                "give the workspace to fit, so that the posterior includes all its sets of posts."
            )
        return bounds

    def _of_robots(self, what: str, values: ArrayLike) -> np.ndarray:
        """Read values (robot,) by the names of the robots, if they are labelled."""
        return read_labelled(what, values, ("robot",), {"robot": self._names["robot"]}).values

    def _checked(self, awareness: ArrayLike, n_axes: int) -> np.ndarray:
        """Return awareness as an array; raises TrustboError if its shape or values are wrong."""
        dims = ("bound", "robot", "feature")[-n_axes:]
        z = read_labelled("awareness", awareness, dims, self._names).values
        n_features = z.shape[-1] if self._n_features is None else self._n_features
        expected = (self._n_robots, n_features)
        if z.ndim != n_axes or z.shape[-2:] != expected or not len(z):
            first = "bound, " if n_axes == 3 else ""
            raise TrustboError(
                f"the shape of awareness must be ({first}{self._n_robots} robots, "
                f"{n_features} features); got shape {z.shape}."
            )

        if np.isnan(z).any():
            raise TrustboError(
                "awareness must not be NaN; replace unmeasured values with those of the map, "
                "workspace.along(path), with shape (bound, robot, feature)."
            )
        if self._bounded:
            return require_unit_interval("awareness", z)
        return z


@np.errstate(under="ignore")  # small weights and tails round to 0
def _average(belief: kalman.Belief, weights: np.ndarray) -> TrustState:
    """Compute the mean and standard deviation of trust over weighted draws."""
    mean = belief.mean.reshape(len(weights), -1)
    var = np.diagonal(belief.cov, axis1=2, axis2=3).reshape(mean.shape)

    center = weights @ mean
    total = weights @ (var + (mean - center) ** 2)  # within and between draws
    return TrustState(center, np.sqrt(total))
