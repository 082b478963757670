"""One bound of the Kalman filter under many parameter draws, in NumPy, for `TrustFilter`."""

from typing import Any, NamedTuple

import numpy as np

from trustbo.models.families import Family
from trustbo.models.params import (
    CoupledParams,
    DeviationParams,
    DeviationRobotParams,
    Params,
    RobotParams,
    TrustParams,
)
from trustbo.models.state_space import kalman

Moments = tuple[np.ndarray, np.ndarray]
Effect = np.ndarray | float
"""Effect of a place, shape (draw, robot or 1)."""


class Rates(NamedTuple):
    """Rates of one bound and their family."""

    family: Family
    y: np.ndarray  # (robot,), NaN where not measured
    n_ticks: np.ndarray  # (robot,), NaN where not known


class ApartFilter:
    """Robots that do not influence each other; arrays are (draw, robot)."""

    def __init__(self, params: TrustParams | RobotParams, n_robots: int) -> None:
        self._p: Any = params
        self._n_robots = n_robots
        columns = (params.beta0, params.b, params.delta_w**2, params.delta_v**2)
        self._beta0, self._b, self._Q, self._R = (p.reshape(len(p), -1) for p in columns)
        self._x0 = params.x0_mean, params.x0_sd

    def start(self) -> Moments:
        """Mean and variance of trust before the first bound."""
        shape = (len(self._b), self._n_robots)
        mean, sd = (np.broadcast_to(p[:, None], shape) for p in self._x0)
        return mean.copy(), sd**2

    def predict(
        self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, effect: Effect = 0.0
    ) -> Moments:
        """Mean and variance after a bound, nothing measured.

        Awareness z (robot, feature), or of each draw (draw, robot, feature); `effect` is that of
        the bound's place.
        """
        ahead = kalman.update(self._beta0, self._Q, var, 0.0, 0.0)
        return self._state(self._beta0 * mean + self._drift(z) + effect, z, effect), ahead

    def update(
        self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, rates: Rates, effect: Effect = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Moments given rates, and the log density of these up to a constant, (draw,)."""
        family, y, n_ticks = rates
        seen, drift = ~np.isnan(y), self._drift(z) + effect
        if family.observes_trust:
            S = C = kalman.update(self._beta0, self._Q, var, 0.0, 0.0)
        else:
            S, C = kalman.innovation(self._beta0, self._Q, self._R, var)
        expected = self._beta0 * mean + drift
        left = log_density = np.zeros(mean.shape)
        if family.integrates_out:  # all robots at once
            e = np.where(seen, y - self._beta0 * mean - drift, 0.0)
            log_density = np.where(seen, -0.5 * (e**2 / S + np.log(S)), 0.0)
        else:
            e, left, log_density = (np.zeros(mean.shape) for _ in range(3))
            sd = np.broadcast_to(np.sqrt(self._R), mean.shape)
            moments, left[:, seen], log_density[:, seen] = family.observe(
                expected[:, seen], S[:, seen], y[seen], n_ticks[seen], sd[:, seen]
            )
            e[:, seen] = moments - expected[:, seen]
        gain = np.where(seen, C / S, 0.0)
        mean = expected + gain * e
        ahead = kalman.update(self._beta0, self._Q, var, gain, S - left)
        return self._state(mean, z, effect), ahead, log_density.sum(1)

    def trust(
        self, mean: np.ndarray, z: np.ndarray | None = None, effect: Effect = 0.0
    ) -> np.ndarray:
        """Mean of trust of the mean of the state after a bound of drift z; None, before any."""
        return mean

    def draw(self, rng: np.random.Generator, mean: np.ndarray, var: np.ndarray) -> np.ndarray:
        """State drawn from its moments, (draw, robot)."""
        return mean + np.sqrt(var) * rng.standard_normal(mean.shape)

    def roll(
        self,
        rng: np.random.Generator,
        family: Family,
        x: np.ndarray,
        z: np.ndarray,
        effect: Effect,
        n_ticks: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """State (draw, robot) after a bound, drawn given that before it, and rates of it."""
        drift = self._drift(z) + effect
        w, v = rng.standard_normal((2, *x.shape))
        now, sd = self._beta0 * x + drift + np.sqrt(self._Q) * w, np.sqrt(self._R)
        rates = family.draw_rates(rng, now, now + sd * v, sd, n_ticks)
        return self._state(now, z, effect), rates

    def _state(self, trust: np.ndarray, z: np.ndarray, effect: Effect) -> np.ndarray:
        """State of trust after a bound of drift z: trust itself, where that lasts."""
        return trust

    def _drift(self, z: np.ndarray) -> np.ndarray:
        beta = self._p.beta
        if beta.ndim == z.ndim == 2:
            return beta @ z.T + self._b
        of_robots = beta if beta.ndim == 3 else beta[:, None]
        return (of_robots * z).sum(-1) + self._b


class DeviationFilter(ApartFilter):
    """Robots of which the deviation of trust from its expectation lasts, and is the state.

    Rates are of trust, that of a bound being the state and the bound's drift.
    """

    def start(self) -> Moments:
        """See `ApartFilter.start`."""
        mean, var = super().start()
        return np.zeros_like(mean), var

    def trust(
        self, mean: np.ndarray, z: np.ndarray | None = None, effect: Effect = 0.0
    ) -> np.ndarray:
        """See `ApartFilter.trust`."""
        return mean + (self._x0[0][:, None] if z is None else self._drift(z) + effect)

    def _state(self, trust: np.ndarray, z: np.ndarray, effect: Effect) -> np.ndarray:
        return trust - self._drift(z) - effect


class CoupledFilter:
    """Coupled robots; means (draw, robot), covariances (draw, robot, robot).

    Rates enter one robot at a time, see `vector`.
    """

    def __init__(self, params: CoupledParams, n_robots: int) -> None:
        self._p, self._n_robots = params, n_robots
        # Of trust and rate together, (draw, 2 robot, ...).
        self._F = np.concatenate([params.B0, params.B0], axis=1)
        self._F_T = np.ascontiguousarray(np.swapaxes(self._F, 1, 2))
        self._noise = np.tile(params.Delta_w, (1, 2, 2))
        self._noise[:, n_robots:, n_robots:] += params.Delta_v
        # (draw, robot, robot' and feature): the drift is one product.
        self._B = np.moveaxis(params.B, 1, -1).reshape(len(params.b), n_robots, -1)

    def start(self) -> Moments:
        """See `ApartFilter.start`."""
        mean = np.repeat(self._p.x0_mean[:, None], self._n_robots, axis=1)
        return mean, self._p.x0_sd[:, None, None] ** 2 * np.eye(self._n_robots)

    def predict(
        self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, effect: Effect = 0.0
    ) -> Moments:
        """See `ApartFilter.predict`."""
        n = self._n_robots
        F, F_T = self._F[:, :n], self._F_T[:, :, :n]
        moved = (F @ mean[..., None])[..., 0] + self._drift(z) + effect
        return moved, F @ var @ F_T + self._p.Delta_w

    def update(
        self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, rates: Rates, effect: Effect = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `ApartFilter.update`."""
        n, (family, y, n_ticks) = self._n_robots, rates
        drift = self._drift(z) + effect
        joint = (self._F @ mean[..., None])[..., 0]
        joint[:, :n] += drift
        joint[:, n:] += drift
        J = self._F @ var @ self._F_T + self._noise
        log_density = np.zeros(len(mean))
        for i in np.flatnonzero(~np.isnan(y)):
            k = i if family.observes_trust else n + i
            S, row = J[:, k, k].copy(), J[:, k].copy()
            moments, left, increment = family.observe(
                joint[:, k], S, y[i], n_ticks[i], np.sqrt(self._p.Delta_v[:, i, i])
            )
            gain, e = row / S[:, None], moments - joint[:, k]
            log_density += increment
            joint += gain * e[:, None]
            J -= gain[:, :, None] * (row * (1.0 - left / S)[:, None])[:, None, :]
        return joint[:, :n], J[:, :n, :n], log_density

    def trust(
        self, mean: np.ndarray, z: np.ndarray | None = None, effect: Effect = 0.0
    ) -> np.ndarray:
        """See `ApartFilter.trust`."""
        return mean

    def draw(self, rng: np.random.Generator, mean: np.ndarray, var: np.ndarray) -> np.ndarray:
        """See `ApartFilter.draw`."""
        factor = np.linalg.cholesky(var + 1e-12 * np.eye(self._n_robots))
        return mean + (factor @ rng.standard_normal((*mean.shape, 1)))[..., 0]

    def roll(
        self,
        rng: np.random.Generator,
        family: Family,
        x: np.ndarray,
        z: np.ndarray,
        effect: Effect,
        n_ticks: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `ApartFilter.roll`."""
        n, Delta_v = self._n_robots, np.asarray(self._p.Delta_v)
        factors = np.linalg.cholesky(self._p.Delta_w), np.linalg.cholesky(Delta_v)
        w, v = ((L @ rng.standard_normal((*x.shape, 1)))[..., 0] for L in factors)
        joint = (self._F @ x[..., None])[..., 0]
        drift = self._drift(z) + effect
        now, y = joint[:, :n] + drift + w, joint[:, n:] + drift + w + v
        sd = np.sqrt(np.diagonal(Delta_v, axis1=1, axis2=2))
        return now, family.draw_rates(rng, now, y, sd, n_ticks)

    def _drift(self, z: np.ndarray) -> np.ndarray:
        flat = z.reshape(*z.shape[:-2], -1)
        return (self._B @ flat[..., None])[..., 0] + self._p.b


def live_filter(params: Params, n_robots: int) -> ApartFilter | CoupledFilter:
    """Build the filter of one bound under parameters with the leading axis (draw,)."""
    if isinstance(params, CoupledParams):
        return CoupledFilter(params, n_robots)
    if isinstance(params, DeviationParams | DeviationRobotParams):
        return DeviationFilter(params, n_robots)
    return ApartFilter(params, n_robots)
