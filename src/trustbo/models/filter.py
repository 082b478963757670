"""Trust in real time: what a running mission says, bound by bound."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.models.model import RESPONSES
from trustbo.models.params import (
    CoupledParams,
    Params,
    RobotParams,
    TrustParams,
    check_params,
    params_of,
)


class TrustState(NamedTuple):
    """Trust as far as it is known, parameters and their uncertainty averaged over."""

    mean: np.ndarray
    """Shape (robot,) now, or (bound, robot) ahead."""
    sd: np.ndarray
    """Standard deviation, of the same shape."""


class TrustFilter:
    """Follows the trust of each robot during a mission (a Rao-Blackwellised filter).

    Given a draw of the parameters, trust is Gaussian and the Kalman filter exact; the draws
    themselves are reweighted by how well they predicted each contact rate. So after bound k the
    filter holds p(trust, parameters | earlier missions, bounds 1..k), exactly but for the number of
    draws.

    Attributes:
        params: The parameter draws, leading axis (draw,).
        weights: Their weights now, shape (draw,), sum 1.
        n_bounds: Bounds taken in since the last `reset`.
    """

    def __init__(
        self,
        posterior: xr.DataTree | Params,
        n_robots: int | None = None,
        *,
        response: str = "level",
        max_draws: int = 1000,
    ) -> None:
        """Start before the first bound of a mission.

        Args:
            posterior: What `fit` returned for any model with Gaussian observations, or draws with
                leading axis (draw,).
            n_robots: How many robots; needed with `TrustParams`, others know their own.
            response: What rates measure; needed with draws, a posterior knows its own.
            max_draws: At most so many draws, evenly spaced, are followed.

        Raises:
            ShapeError: Draws of another number of robots.
            TrustboError: `TrustParams` without `n_robots`, or other observations than Gaussian.
        """
        if isinstance(posterior, xr.DataTree):
            n_robots = posterior["constant_data"].sizes["robot"]
            response = posterior.attrs["response"]
            if (family := posterior.attrs["observation"]) != "gaussian":
                raise TrustboError(
                    f'TrustFilter needs Gaussian observations; this posterior has "{family}".'
                )
            posterior = params_of(posterior)
        elif isinstance(posterior, RobotParams | CoupledParams):
            n_robots = np.shape(posterior.b)[-1] if n_robots is None else n_robots
        if n_robots is None:
            raise TrustboError("with draws of the parameters, say how many robots: n_robots=.")
        axes = np.shape(posterior.B if isinstance(posterior, CoupledParams) else posterior.beta)
        self._n_features = axes[-3] if isinstance(posterior, CoupledParams) else axes[-1]
        check_params(posterior, n_robots, self._n_features)
        flat = posterior.flat()
        n = len(flat.b)
        kept = np.linspace(0, n - 1, min(n, max_draws)).astype(int)
        self.params = type(flat)(*(each[kept] for each in flat))
        self._n_robots = n_robots
        lag = float(require_choice("response", response, RESPONSES) == "change")
        params = self.params
        self._core = (
            _Coupled(params, lag, n_robots)
            if isinstance(params, CoupledParams)
            else _Apart(params, lag, n_robots)
        )
        self.reset()

    def reset(self) -> None:
        """Back to before the first bound of a new mission, all draws of equal weight."""
        n = len(self.params.b)
        self._mean, self._var = self._core.start()
        self._log_weight = np.zeros(n)
        self.weights = np.full(n, 1.0 / n)
        self.n_bounds = 0

    @property
    def state(self) -> TrustState:
        """Trust after the bounds so far, shapes (robot,)."""
        return self._average(self._mean, self._var)

    def update(self, awareness: ArrayLike, contact_rate: ArrayLike) -> TrustState:
        """Take in one bound.

        Args:
            awareness: Shape (robot, feature).
            contact_rate: Shape (robot,); NaN where not measured.

        Returns:
            Trust after it, shapes (robot,).

        Raises:
            ShapeError: Another number of robots or features.
            TrustboError: Awareness that is NaN, or a rate outside [0, 1].
        """
        z, y = self._checked(awareness, 2), np.asarray(contact_rate, dtype=float)
        if y.shape != (self._n_robots,):
            raise ShapeError(f"contact_rate must be ({self._n_robots},); got shape {y.shape}.")
        if ((y < 0.0) | (y > 1.0)).any():
            raise TrustboError(f"contact_rate must be in [0, 1]; got {y}.")
        self._mean, self._var, increment = self._core.update(self._mean, self._var, z, y)
        self._log_weight += increment
        weights = np.exp(self._log_weight - self._log_weight.max())
        self.weights = weights / weights.sum()
        self.n_bounds += 1
        return self.state

    def predict(self, awareness: ArrayLike) -> TrustState:
        """Trust along the bounds to come, none of them measured yet.

        Args:
            awareness: Shape (bound, robot, feature).

        Returns:
            Shapes (bound, robot).

        Raises:
            ShapeError: Another number of robots or features.
            TrustboError: Awareness that is NaN.
        """
        mean, var, ahead = self._mean, self._var, []
        for z in self._checked(awareness, 3):
            mean, var = self._core.predict(mean, var, z)
            ahead.append(self._average(mean, var))
        return TrustState(*(np.stack(column) for column in zip(*ahead, strict=True)))

    def _average(self, mean: np.ndarray, var: np.ndarray) -> TrustState:
        """Mean and sd of the mixture over draws."""
        var = var if var.ndim == 2 else np.diagonal(var, axis1=1, axis2=2)
        center = self.weights @ mean
        spread = self.weights @ (var + (mean - center) ** 2)
        return TrustState(center, np.sqrt(spread))

    def _checked(self, awareness: ArrayLike, n_axes: int) -> np.ndarray:
        z = np.asarray(awareness, dtype=float)
        expected = (self._n_robots, self._n_features)
        if z.ndim != n_axes or z.shape[-2:] != expected or not len(z):
            raise ShapeError(
                f"awareness must be {'(bound, ' if n_axes == 3 else '('}{expected[0]} robots, "
                f"{expected[1]} features); got shape {z.shape}."
            )
        if np.isnan(z).any():
            raise TrustboError("awareness must not be NaN; take unmeasured values from the map.")
        return z


class _Apart:
    """One step of robots that do not influence each other; arrays are (draw, robot)."""

    def __init__(self, params: TrustParams | RobotParams, lag: float, n_robots: int) -> None:
        self._n_robots = n_robots
        columns = (params.beta0, params.b, params.delta_w**2, params.delta_v**2)
        self._beta0, self._b, self._Q, self._R = (p.reshape(len(p), -1) for p in columns)
        self._h = self._beta0 - lag
        # (draw, robot or 1, feature)
        self._beta = params.beta.reshape(len(params.b), -1, params.beta.shape[-1])
        self._x0 = params.x0_mean, params.x0_sd

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        shape = (len(self._b), self._n_robots)
        mean, sd = (np.broadcast_to(p[:, None], shape) for p in self._x0)
        return mean.copy(), sd**2

    def predict(self, mean: np.ndarray, var: np.ndarray, z: np.ndarray):
        return self._beta0 * mean + self._drift(z), self._beta0**2 * var + self._Q

    def update(self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, y: np.ndarray):
        seen = ~np.isnan(y)
        drift = self._drift(z)
        S = self._h**2 * var + self._Q + self._R
        e = np.where(seen, y - self._h * mean - drift, 0.0)
        gain = np.where(seen, (self._beta0 * self._h * var + self._Q) / S, 0.0)
        log_density = np.where(seen, -0.5 * (e**2 / S + np.log(S)), 0.0).sum(1)
        mean = self._beta0 * mean + drift + gain * e
        return mean, self._beta0**2 * var + self._Q - gain**2 * S, log_density

    def _drift(self, z: np.ndarray) -> np.ndarray:
        if self._beta.shape[1] == 1:
            return self._beta[:, 0] @ z.T + self._b
        return np.einsum("nim,im->ni", self._beta, z) + self._b


class _Coupled:
    """One step of coupled robots; means (draw, robot), covariances (draw, robot, robot).

    Rates enter one robot at a time, as in `vectorspace`.
    """

    def __init__(self, params: CoupledParams, lag: float, n_robots: int) -> None:
        self._p, self._n_robots = params, n_robots
        # Of trust and rate together, (draw, 2 robot, ...).
        self._F = np.concatenate([params.B0, params.B0 - lag * np.eye(n_robots)], axis=1)
        self._F_T = np.ascontiguousarray(np.swapaxes(self._F, 1, 2))
        self._noise = np.tile(params.Delta_w, (1, 2, 2))
        self._noise[:, n_robots:, n_robots:] += params.Delta_v
        # (draw, robot, robot' and feature): the drift is one product.
        self._B = np.moveaxis(params.B, 1, -1).reshape(len(params.b), n_robots, -1)

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        mean = np.repeat(self._p.x0_mean[:, None], self._n_robots, axis=1)
        return mean, self._p.x0_sd[:, None, None] ** 2 * np.eye(self._n_robots)

    def predict(self, mean: np.ndarray, var: np.ndarray, z: np.ndarray):
        n = self._n_robots
        F, F_T = self._F[:, :n], self._F_T[:, :, :n]
        moved = (F @ mean[..., None])[..., 0] + self._drift(z)
        return moved, F @ var @ F_T + self._p.Delta_w

    def update(self, mean: np.ndarray, var: np.ndarray, z: np.ndarray, y: np.ndarray):
        n = self._n_robots
        drift = self._drift(z)
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
