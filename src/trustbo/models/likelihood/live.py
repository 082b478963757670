"""One bound of the Kalman filter under many parameter draws, in NumPy, for `TrustFilter`."""

from typing import TYPE_CHECKING

import numpy as np

from trustbo.models.likelihood import kalman

if TYPE_CHECKING:
    from trustbo.models.params import CoupledParams, RobotParams, TrustParams

Moments = tuple[np.ndarray, np.ndarray]
Effect = np.ndarray | float
"""Effect of a place, shape (draw, robot or 1)."""


class ApartFilter:
    """Robots that do not influence each other; arrays are (draw, robot)."""

    def __init__(self, params: "TrustParams | RobotParams", lag: float, n_robots: int) -> None:
        self._n_robots = n_robots
        columns = (params.beta0, params.b, params.delta_w**2, params.delta_v**2)
        self._beta0, self._b, self._Q, self._R = (p.reshape(len(p), -1) for p in columns)
        self._h = self._beta0 - lag
        # (draw, robot or 1, feature)
        self._beta = params.beta.reshape(len(params.b), -1, params.beta.shape[-1])
        self._x0 = params.x0_mean, params.x0_sd

    def start(self) -> Moments:
        """Mean and variance of trust before the first bound."""
        shape = (len(self._b), self._n_robots)
        mean, sd = (np.broadcast_to(p[:, None], shape) for p in self._x0)
        return mean.copy(), sd**2

    def predict(
        self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, effect: Effect = 0.0
    ) -> Moments:
        """Mean and variance after a bound with awareness z (robot, feature), nothing measured.

        `effect` is that of its place.
        """
        ahead = kalman.update(self._beta0, self._Q, var, 0.0, 0.0)
        return self._beta0 * mean + self._drift(z) + effect, ahead

    def update(
        self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, y: np.ndarray, effect: Effect = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same given rates y (robot,), and their log density but for a constant, (draw,)."""
        seen = ~np.isnan(y)
        drift = self._drift(z) + effect
        S, C = kalman.innovation(self._beta0, self._h, self._Q, self._R, var)
        e = np.where(seen, y - self._h * mean - drift, 0.0)
        gain = np.where(seen, C / S, 0.0)
        log_density = np.where(seen, -0.5 * (e**2 / S + np.log(S)), 0.0).sum(1)
        mean = self._beta0 * mean + drift + gain * e
        return mean, kalman.update(self._beta0, self._Q, var, gain, S), log_density

    def _drift(self, z: np.ndarray) -> np.ndarray:
        if self._beta.shape[1] == 1:
            return self._beta[:, 0] @ z.T + self._b
        return np.einsum("nim,im->ni", self._beta, z) + self._b


class CoupledFilter:
    """Coupled robots; means (draw, robot), covariances (draw, robot, robot).

    Rates enter one robot at a time, see `vector`.
    """

    def __init__(self, params: "CoupledParams", lag: float, n_robots: int) -> None:
        self._p, self._n_robots = params, n_robots
        # Of trust and rate together, (draw, 2 robot, ...).
        self._F = np.concatenate([params.B0, params.B0 - lag * np.eye(n_robots)], axis=1)
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
        self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, y: np.ndarray, effect: Effect = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `ApartFilter.update`."""
        n = self._n_robots
        drift = self._drift(z) + effect
        joint = (self._F @ mean[..., None])[..., 0]
        joint[:, :n] += drift
        joint[:, n:] += drift
        J = self._F @ var @ self._F_T + self._noise
        log_density = np.zeros(len(mean))
        for i in np.flatnonzero(~np.isnan(y)):
            S, row = J[:, n + i, n + i].copy(), J[:, n + i].copy()
            gain, e = row / S[:, None], y[i] - joint[:, n + i]
            log_density -= 0.5 * (e**2 / S + np.log(S))
            joint += gain * e[:, None]
            J -= gain[:, :, None] * row[:, None, :]
        return joint[:, :n], J[:, :n, :n], log_density

    def _drift(self, z: np.ndarray) -> np.ndarray:
        return self._B @ z.ravel() + self._p.b
