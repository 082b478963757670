"""Filter for the trust of robots during a mission, updated after every bound."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import Names, read_labelled
from trustbo.data import Cell, require_shares, require_unit_interval
from trustbo.errors import TrustboError, one_line, require_pair, require_whole
from trustbo.inference.draws import names_in, params_of, require_posterior, sites_of
from trustbo.inference.importance import systematic
from trustbo.models.families import FAMILIES, Family
from trustbo.models.params import CoupledParams, Params, check_params
from trustbo.models.slots import NO_TICKS
from trustbo.parallel import computing
from trustbo.workspace import Workspace
from trustbo.workspace.moves import bounds_along, require_on_grid

_TICKS = 200.0  # number of ticks assumed for a future bound
Effect = np.ndarray | float
"""Place effect of a bound, an array (draw, robot or 1) or a number."""


class Beliefs(NamedTuple):
    """Normal distribution of trust under each draw of the parameters.

    A group is a set of robots with dependent trust or noise: either all robots or a single one.
    """

    mean: np.ndarray  # (draw, group, member)
    cov: np.ndarray  # (draw, group, member, member)
    drift: np.ndarray  # (draw, group, member), drift of the last bound


class Dynamics:
    """Kalman filter step for one bound and many parameter draws, for any model.

    Predicted trust x ~ N(m, V) gives the signal f = x + n, n ~ N(0, noise). Rates are processed one
    robot at a time. The family matches the moments of f, exactly for Gaussian rates, and the gain
    of x on f transfers the update from f to x.
    """

    def __init__(
        self, params: Params, family: Family, n_robots: int, delta_s: np.ndarray | None = None
    ) -> None:
        """Set parameter draws (draw, ...) and the sd (draw,) of the noise that robots share."""
        p: Any = params
        self.family, self._coupled = family, isinstance(p, CoupledParams)
        self._x0 = p.x0_mean, p.x0_sd
        n, members = len(p.b), n_robots if self._coupled or delta_s is not None else 1
        self.shape = (n, n_robots // members, members)
        self._deviates = p.memory == "deviation"
        self._b, self._noise, one = p.b.reshape(n, -1), None, np.eye(members)
        if self._coupled:
            own = 0.5 * np.linalg.eigvalsh(p.Delta_v)[:, :1]
            if not family.adds_noise:
                own = np.diagonal(p.Delta_v, axis1=1, axis2=2)
            self._B0, self._Q = p.B0[:, None], p.Delta_w[:, None]
            self._noise = (p.Delta_v - own[:, None] * one)[:, None]
            self.sd = self._grouped(np.sqrt(own))
            self._beta = np.moveaxis(p.B, 1, -1).reshape(n, n_robots, -1)
            return
        beta0, delta_w = (self._grouped(v)[..., None] for v in (p.beta0, p.delta_w))
        self._B0, self._Q = beta0 * one, delta_w**2 * one
        if delta_s is not None:
            self._noise = delta_s[:, None, None, None] ** 2 * np.ones((members, members))
        self.sd = self._grouped(p.delta_v)
        self._beta = p.beta if p.beta.ndim == 3 else p.beta[:, None]

    def _grouped(self, values: np.ndarray) -> np.ndarray:
        """Rearrange values (draw,) or (draw, robot) as (draw, group, member)."""
        n, groups, members = self.shape
        return np.broadcast_to(values.reshape(n, -1), (n, groups * members)).reshape(self.shape)

    def start(self) -> Beliefs:
        """Return trust before the first bound."""
        mean, sd = (self._grouped(x0) for x0 in self._x0)
        return Beliefs(mean, sd[..., None] ** 2 * np.eye(self.shape[2]), mean)

    def predict(self, beliefs: Beliefs, z: np.ndarray, effect: Effect = 0.0) -> Beliefs:
        """Predict trust after a bound with awareness z (robot, feature)."""
        z = z.reshape(1, -1) if self._coupled else z
        drift = self._grouped(np.einsum("nim,im->ni", self._beta, z) + self._b + effect)
        before = beliefs.mean - beliefs.drift if self._deviates else beliefs.mean
        mean = _product(self._B0, before[..., None])[..., 0] + drift
        cov = _product(_product(self._B0, beliefs.cov), np.swapaxes(self._B0, 2, 3)) + self._Q
        return Beliefs(mean, cov, drift)

    def log_densities(self, predicted: Beliefs, y: np.ndarray, n_ticks: np.ndarray) -> np.ndarray:
        """Compute the marginal log density (draw, robot) of each rate, 0 for NaN rates."""
        y, n_ticks = (a.reshape(self.shape[1:]) for a in (y, n_ticks))
        cov = predicted.cov if self._noise is None else predicted.cov + self._noise
        var = np.diagonal(cov, axis1=2, axis2=3)
        log_mass = self.family.match(y, n_ticks, predicted.mean, var, self.sd)[0]
        return np.where(np.isnan(y), 0.0, log_mass).reshape(len(var), -1)

    def update(
        self, predicted: Beliefs, y: np.ndarray, n_ticks: np.ndarray
    ) -> tuple[Beliefs, np.ndarray]:
        """Update trust with rates (robot,), NaN where unmeasured; also return their log density."""
        y, n_ticks = (a.reshape(self.shape[1:]) for a in (y, n_ticks))
        members, (mean, J, drift), first = self.shape[2], predicted, 0
        if self._noise is not None:  # the joint normal has trust first, then signals
            mean, first = np.concatenate([mean, mean], axis=2), members
            J = np.block([[J, J], [J, J + self._noise]])
        log_density = np.zeros(self.shape[0])
        for i in np.flatnonzero(~np.isnan(y).all(0)):
            k = first + i
            m, v = mean[..., k], J[..., k, k]
            log_mass, after, left = self.family.match(y[:, i], n_ticks[:, i], m, v, self.sd[..., i])
            gain = J[..., k] / v[..., None]
            mean = mean + gain * (after - m)[..., None]
            J = J - gain[..., :, None] * gain[..., None, :] * (v - left)[..., None, None]
            log_density += np.broadcast_to(log_mass, m.shape).sum(1)
        return Beliefs(mean[..., :members], J[..., :members, :members], drift), log_density

    def draw(self, beliefs: Beliefs, rng: np.random.Generator) -> Beliefs:
        """Draw trust, and return the draws as beliefs with zero variance."""
        mean = beliefs.mean + _noise(beliefs.cov, rng)
        return beliefs._replace(mean=mean, cov=np.zeros_like(beliefs.cov))

    def roll(
        self,
        drawn: Beliefs,
        z: np.ndarray,
        n_ticks: np.ndarray,
        rng: np.random.Generator,
        effect: Effect = 0.0,
    ) -> tuple[Beliefs, np.ndarray]:
        """Draw trust after a bound given drawn trust before the bound; also return drawn rates."""
        now = self.draw(self.predict(drawn, z, effect), rng)
        signal = now.mean
        if self._noise is not None:
            signal = signal + _noise(np.broadcast_to(self._noise, now.cov.shape), rng)
        rates = self.family.sample(signal, self.sd, n_ticks.reshape(self.shape[1:]), rng)
        return now, rates.reshape(len(rates), -1)

    def ahead(
        self,
        beliefs: Beliefs,
        z: np.ndarray,
        n_ticks: np.ndarray,
        effects: Sequence[Effect],
        rng: np.random.Generator,
    ) -> Iterator[tuple[Beliefs, np.ndarray]]:
        """Yield predicted trust and jointly drawn rates (draw, robot), one bound at a time."""
        x = self.draw(beliefs, rng)
        for of_bound, ticks, effect in zip(z, n_ticks, effects, strict=True):
            beliefs = self.predict(beliefs, of_bound, effect)
            x, rates = self.roll(x, of_bound, ticks, rng, effect)
            yield beliefs, rates


def _product(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Multiply matrices; the elementwise product is much faster for 1 x 1 matrices."""
    return A * B if A.shape[-1] == 1 else A @ B


def _noise(cov: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw normal noise with covariances (..., member, member), which may be singular."""
    root = np.linalg.cholesky(cov + 1e-12 * np.eye(cov.shape[-1]))
    return _product(root, rng.standard_normal(cov.shape[:-1])[..., None])[..., 0]


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


class TrustFilter:
    """Rao-Blackwellised filter for the trust of each robot during a mission.

    Given a parameter draw and Gaussian rates, trust is Gaussian and the Kalman filter is exact. For
    other families, moments are matched after each observed rate (assumed-density filtering). The
    draws are reweighted by the predictive density of the rates. After bound k, the filter
    approximates p(trust, parameters | earlier missions, bounds 1..k).

    To follow a bound tick by tick, update a copy of the filter with the rate so far, as in
    `tb.Follower`.

    Attributes:
        params: Parameter draws with the leading axis (draw,).
        weights: Current weights (draw,) of the draws, which sum to 1.
        n_bounds: Number of bounds since the last `reset`.
        family: Observation family.
        dynamics: Kalman filter step for one bound and all draws.
    """

    @computing()
    def __init__(
        self,
        posterior: xr.DataTree | Params,
        n_robots: int | None = None,
        *,
        observation: str = "gaussian",
        max_draws: int = 1000,
        workspace: Workspace | None = None,
    ) -> None:
        """Start the filter before the first bound of a mission.

        Args:
            posterior: DataTree from `fit`, or parameter draws with the leading axis (draw,).
            n_robots: Number of robots; needed only with `TrustParams`.
            observation: Observation family of parameter draws; ignored for a DataTree.
            max_draws: Maximum number of draws; if there are more, evenly spaced draws are selected.
            workspace: Workspace whose robots and features the filter follows, in this order. By
                default, arrays without labels are in the order of the draws.

        Raises:
            TrustboError: If the posterior has other robots or features than the workspace, the
                number of robots does not match the draws, the posterior is not
                from `fit`, or `TrustParams` are given without `n_robots`.
        """
        delta_s, self._bounded = None, True
        self._names: dict[str, Names | None] = {"robot": None, "feature": None}
        if workspace is not None:
            self._names = {"robot": workspace.team.names, "feature": workspace.features}
        if isinstance(posterior, xr.DataTree):
            require_posterior("TrustFilter", posterior)
            if "constant_data" in posterior.children:  # without a map, any awareness is valid
                self._bounded = bool((posterior["constant_data"]["row"] >= 0).any())
            n_robots, observation = posterior.attrs["n_robots"], posterior.attrs["observation"]
            delta_s = sites_of(posterior).get("delta_s")
            if workspace is None:
                self._names = {axis: names_in(posterior, axis) or None for axis in self._names}
            posterior = params_of(posterior, workspace, day=True)
        elif not isinstance(posterior, Params):
            raise TrustboError(
                "TrustFilter needs a posterior from fit or parameter draws; got "
                f"{one_line(posterior)}. A campaign has no posterior before the first mission; "
                "use the `belief` of the campaign instead."
            )
        n_robots = posterior.n_robots if n_robots is None else n_robots
        if n_robots is None:
            raise TrustboError("TrustParams do not contain the number of robots; give n_robots.")
        self._n_robots = require_whole("n_robots", n_robots, 1)
        self._n_features = posterior.n_features
        check_params(posterior, self._n_robots, self._n_features)
        flat = posterior.flat()
        n, most = len(flat.b), require_whole("max_draws", max_draws, 1)
        kept = np.linspace(0, n - 1, min(n, most)).astype(int)
        self.params: Params = flat.draw(kept)
        self.family = FAMILIES[observation]
        delta_s = None if delta_s is None else delta_s[kept]
        self.dynamics = Dynamics(self.params, self.family, self._n_robots, delta_s)
        self.reset()

    def reset(self) -> None:
        """Start a new mission with equally weighted draws."""
        n = len(self.params.b)
        self._beliefs = self.dynamics.start()
        self._log_weight, self.weights = np.zeros(n), np.full(n, 1.0 / n)
        self.n_bounds = 0

    @property
    def state(self) -> TrustState:
        """Trust of each robot after the bounds so far."""
        return _average(self._beliefs, self.weights)

    @computing()
    def update(
        self,
        awareness: ArrayLike,
        contact_rate: ArrayLike,
        bound: tuple[Cell, Cell] | None = None,
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
        z, effect = self._checked(awareness, 2), self.effects(bound, 1)[0]
        y = self._of_robots("contact_rate", contact_rate)
        if y.shape != (self._n_robots,):
            raise TrustboError(f"contact_rate must have shape ({self._n_robots},); got {y.shape}.")
        require_unit_interval("contact_rate", y)
        ticks = self._of_robots("n_ticks", np.nan if n_ticks is None else n_ticks)
        ticks = ticks if ticks.ndim else np.full(y.shape, ticks)
        require_shares(y, ticks)
        if self.family.needs_ticks and (np.isnan(ticks) & ~np.isnan(y)).any():
            raise TrustboError(NO_TICKS)
        predicted = self.dynamics.predict(self._beliefs, z, effect)
        self._beliefs, gained = self.dynamics.update(predicted, y, ticks)
        self._log_weight = self._log_weight + gained  # a new array, as copies share the old one
        weights = np.exp(self._log_weight - self._log_weight.max())
        self.weights = weights / weights.sum()
        self.n_bounds += 1
        return self.state

    @computing()
    def predict(self, awareness: ArrayLike, path: Sequence[Cell] | None = None) -> TrustForecast:
        """Predict trust and contact rates along future bounds.

        One rate per bound and robot is drawn for each parameter draw. Tick counts are out of 200.

        Args:
            awareness: Awareness along the path, shape (bound, robot, feature).
            path: Current cell of the team and the cells to be entered; needed with place effects.

        Raises:
            TrustboError: If the number of robots or features is wrong; awareness is NaN or outside
                [0, 1]; or the path is missing, has the wrong length, jumps or leaves the grid.
        """
        given, rng = self._checked(awareness, 3), np.random.default_rng(self.n_bounds)
        ticks, effects = np.full(given.shape[:2], _TICKS), self.effects(path, len(given))
        trust, rates = [], []
        for beliefs, drawn in self.dynamics.ahead(self._beliefs, given, ticks, effects, rng):
            trust.append(_average(beliefs, self.weights))
            rates.append(drawn)
        draws = np.stack(rates, axis=1)[systematic(self.weights, len(self.weights), rng)]
        mean, sd = (np.stack(column) for column in zip(*trust, strict=True))
        low, high = np.quantile(draws, (0.05, 0.95), axis=0)
        return TrustForecast(mean, sd, draws.mean(0), low, high, draws)

    def effects(self, path: Sequence[Cell] | None, n_bounds: int) -> Sequence[Effect]:
        """Check the cells of a path, and return the place effect of each bound, by default 0."""
        places = self.params.places
        if path is None and not places:
            return [0.0] * n_bounds
        given = path if isinstance(path, Iterable) else []
        cells = [require_pair("a cell", cell) for cell in given]
        if len(cells) != n_bounds + 1:
            raise TrustboError(
                f"bound or path must have {n_bounds + 1} cells, beginning with the current cell of "
                f"the team; got {path!r}."
            )
        for grid in {np.shape(value)[-2:] for value in places.values()}:
            require_on_grid(cells, grid)
        bounds = bounds_along(cells)
        if not places:
            return [0.0] * n_bounds
        return list(np.moveaxis(self.params.of_places(bounds), -2, 0))

    def _of_robots(self, what: str, values: ArrayLike) -> np.ndarray:
        """Read values (robot,) by the names of the robots, if they are labelled."""
        return read_labelled(what, values, ("robot",), {"robot": self._names["robot"]}).values

    def _checked(self, awareness: ArrayLike, n_axes: int) -> np.ndarray:
        """Return awareness as an array; raises TrustboError if its shape or values are wrong."""
        dims = ("bound", "robot", "feature")[-n_axes:]
        z = read_labelled("awareness", awareness, dims, self._names).values
        expected = (self._n_robots, self._n_features)
        if z.ndim != n_axes or z.shape[-2:] != expected or not len(z):
            raise TrustboError(
                f"the shape of awareness must be {'(bound, ' if n_axes == 3 else '('}"
                f"{expected[0]} robots, {expected[1]} features); got shape {z.shape}."
            )
        if np.isnan(z).any():
            raise TrustboError(
                "awareness must not be NaN; replace unmeasured values with those of the map, "
                "workspace.along(path), with shape (bound, robot, feature)."
            )
        if self._bounded:
            require_unit_interval("awareness", z)
        return z


@np.errstate(under="ignore")  # small weights and tails round to 0
def _average(beliefs: Beliefs, weights: np.ndarray) -> TrustState:
    """Compute the mean and standard deviation of trust over weighted draws."""
    mean = beliefs.mean.reshape(len(weights), -1)
    var = np.diagonal(beliefs.cov, axis1=2, axis2=3).reshape(mean.shape)
    center = weights @ mean
    return TrustState(center, np.sqrt(weights @ (var + (mean - center) ** 2)))
