"""Trust in real time: what a running mission says, bound by bound."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.errors import ShapeError, TrustboError
from trustbo.models.params import TrustParams


class TrustState(NamedTuple):
    """Trust as far as it is known, parameters and their uncertainty averaged over."""

    mean: np.ndarray
    """Shape (robot,) now, or (bound, robot) ahead."""
    sd: np.ndarray
    """Standard deviation, of the same shape."""


class TrustFilter:
    """Follows the trust of each robot during a mission (a Rao-Blackwellised filter).

    Given a draw of the parameters, trust is Gaussian and the Kalman filter (3)-(4) exact; the draws
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
        posterior: xr.DataTree | TrustParams,
        n_robots: int | None = None,
        *,
        max_draws: int = 1000,
    ) -> None:
        """Start before the first bound of a mission.

        Args:
            posterior: What `fit` returned, or draws with leading axis (draw,).
            n_robots: How many robots; needed with draws, a posterior knows its own.
            max_draws: At most so many draws, evenly spaced, are followed.

        Raises:
            TrustboError: Draws without `n_robots`.
        """
        if isinstance(posterior, xr.DataTree):
            n_robots = posterior["constant_data"].sizes["robot"]
            posterior = TrustParams.from_posterior(posterior)
        if n_robots is None:
            raise TrustboError("with draws of the parameters, say how many robots: n_robots=.")
        n = len(np.atleast_1d(posterior.beta0))
        kept = np.linspace(0, n - 1, min(n, max_draws)).astype(int)
        self.params = TrustParams(*(each[kept] for each in posterior.flat()))
        self._n_robots = n_robots
        self._beta0, self._Q, self._R = (
            column[:, None]
            for column in (self.params.beta0, self.params.delta_w**2, self.params.delta_v**2)
        )
        self.reset()

    def reset(self) -> None:
        """Back to before the first bound of a new mission, all draws of equal weight."""
        shape = (len(self.params.beta0), self._n_robots)
        self._mean = np.broadcast_to(self.params.x0_mean[:, None], shape).copy()
        self._var = np.broadcast_to(self.params.x0_sd[:, None] ** 2, shape).copy()
        self._log_weight = np.zeros(shape[0])
        self.weights = np.full(shape[0], 1.0 / shape[0])
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
        mean, var = self._step(self._mean, self._var, z)
        seen = ~np.isnan(y)
        S = var + self._R
        residual = np.where(seen, y - mean, 0.0)
        gain = np.where(seen, var / S, 0.0)
        self._mean, self._var = mean + gain * residual, (1.0 - gain) * var
        self._log_weight += np.where(seen, -0.5 * (residual**2 / S + np.log(S)), 0.0).sum(1)
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
            mean, var = self._step(mean, var, z)
            ahead.append(self._average(mean, var))
        return TrustState(*(np.stack(column) for column in zip(*ahead, strict=True)))

    def _step(self, mean: np.ndarray, var: np.ndarray, z: np.ndarray):
        drift = self.params.beta @ z.T + self.params.b[:, None]
        return self._beta0 * mean + drift, self._beta0**2 * var + self._Q

    def _average(self, mean: np.ndarray, var: np.ndarray) -> TrustState:
        """Mean and sd of the mixture over draws."""
        center = self.weights @ mean
        spread = self.weights @ (var + (mean - center) ** 2)
        return TrustState(center, np.sqrt(spread))

    def _checked(self, awareness: ArrayLike, n_axes: int) -> np.ndarray:
        z = np.asarray(awareness, dtype=float)
        expected = (self._n_robots, self.params.beta.shape[-1])
        if z.ndim != n_axes or z.shape[-2:] != expected or not len(z):
            raise ShapeError(
                f"awareness must be {'(bound, ' if n_axes == 3 else '('}{expected[0]} robots, "
                f"{expected[1]} features); got shape {z.shape}."
            )
        if np.isnan(z).any():
            raise TrustboError("awareness must not be NaN; take unmeasured values from the map.")
        return z
