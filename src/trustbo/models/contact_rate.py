"""The state-space model as a NumPyro distribution, for built-in and custom models."""

from typing import Any

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax import Array, lax, random
from jax.typing import ArrayLike
from numpyro.distributions import constraints

from trustbo.errors import TrustboError


class ContactRate(dist.Distribution):
    """Distribution of contact rates given the drift, equations (3)-(4), with trust integrated out.

    x_k = beta0 x_{k-1} + drift_k + delta_w w_k, y_k = x_k + delta_v v_k, x_0 ~ N(x0_mean, x0_sd^2)

    The batch shape is (mission,) and the event shape is (bound, robot). NaN marks unmeasured rates.
    `drift` may be any function of awareness and other sampled parameters:

    >>> drift = level + most * (1.0 - jnp.exp(-rise * awareness[..., 1]))
    >>> with numpyro.plate("mission", len(drift)):
    ...     rates = ContactRate(drift, beta0, delta_w, delta_v)
    ...     numpyro.sample("contact_rate", rates, obs=contact_rate)
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("drift", "parameters")

    def __init__(
        self,
        drift: Array,
        beta0: ArrayLike,
        delta_w: ArrayLike,
        delta_v: ArrayLike,
        x0_mean: ArrayLike = 0.5,
        x0_sd: ArrayLike = 0.5,
    ) -> None:
        """Set the drift and the parameters.

        Args:
            drift: Drift of trust in each bound, shape (mission, bound, robot).
            beta0: Autoregression coefficient, shape () or (robot,).
            delta_w: Standard deviation of the process noise, shape () or (robot,).
            delta_v: Standard deviation of the observation noise, shape () or (robot,).
            x0_mean: Mean of trust before the first bound, shape ().
            x0_sd: Standard deviation of trust before the first bound, shape ().

        Raises:
            TrustboError: The drift or a parameter has another shape.
        """
        self.drift = jnp.asarray(drift)
        self.parameters = tuple(jnp.asarray(p) for p in (beta0, delta_w, delta_v, x0_mean, x0_sd))
        if self.drift.ndim != 3:
            raise TrustboError(
                f"drift must have the shape (mission, bound, robot); got {self.drift.shape}. For "
                "one mission, give drift[None]."
            )
        n_robots = self.drift.shape[2]
        for name, value in zip(("beta0", "delta_w", "delta_v"), self.parameters, strict=False):
            if value.ndim and value.shape[-1] not in (1, n_robots):
                raise TrustboError(
                    f"{name} must have the shape () or ({n_robots},), as drift is of the shape "
                    f"(mission, bound, robot) = {self.drift.shape}; got {value.shape}."
                )
        super().__init__(self.drift.shape[:1], self.drift.shape[1:])

    @jax.numpy_rank_promotion("allow")
    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Compute the log density (mission,) of each mission with the Kalman filter.

        Raises TrustboError unless `value` has the shape (mission, bound, robot) of the drift.
        """
        if jnp.shape(value) != self.drift.shape:
            raise TrustboError(
                "contact rates must have the shape (mission, bound, robot) of the drift, "
                f"{self.drift.shape}; got {jnp.shape(value)}."
            )
        seen = ~jnp.isnan(value)
        bounds = (jnp.where(seen, value, 0.0), seen, self.drift)
        by_bound = tuple(jnp.swapaxes(a, 0, 1) for a in bounds)
        *_, x0_mean, x0_sd = self.parameters
        shape = self.drift[:, 0].shape
        start = jnp.full(shape, x0_mean), jnp.full(shape, x0_sd**2)
        return lax.scan(self._filter, start, by_bound)[1].sum(0)

    def _filter(self, state: Any, inputs: Any) -> Any:
        """Filter one bound; return trust afterwards and the log density (mission,) of the rates."""
        (m, P), (y, seen, u), (beta0, delta_w, delta_v, *_) = state, inputs, self.parameters
        m, P = beta0 * m + u, beta0**2 * P + delta_w**2  # predict
        F = P + delta_v**2
        gain, e = jnp.where(seen, P / F, 0.0), y - m
        log_p = jnp.where(seen, -0.5 * (e**2 / F + jnp.log(2.0 * jnp.pi * F)), 0.0)
        return (m + gain * e, P * (1.0 - gain)), log_p.sum(1)  # update

    @jax.numpy_rank_promotion("allow")
    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Draw contact rates with shape `(*sample_shape, mission, bound, robot)`."""
        beta0, delta_w, delta_v, x0_mean, x0_sd = self.parameters
        shape = *sample_shape, *self.drift.shape
        w, v, e = (random.normal(k, shape) for k in random.split(key, 3))
        x, rates = x0_mean + x0_sd * e[..., 0, :], []
        for k in range(self.drift.shape[1]):
            x = beta0 * x + self.drift[:, k] + delta_w * w[..., k, :]
            rates.append(x + delta_v * v[..., k, :])
        return jnp.stack(rates, axis=-2)
