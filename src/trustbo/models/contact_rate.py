"""The state space as a NumPyro distribution, for models of your own."""

import jax.numpy as jnp
import numpyro.distributions as dist
from jax import Array, random, vmap
from jax.typing import ArrayLike
from numpyro.distributions import constraints

from trustbo.models.state_space.scalar import ScalarSSM


class ContactRate(dist.Distribution):
    """Contact rates of missions given the drift of trust, equations (3)-(4), trust integrated out.

    x_k = beta0 x_{k-1} + drift_k + delta_w w_k, y_k = x_k + delta_v v_k, x_0 ~ N(x0_mean, x0_sd^2)

    The batch shape is (mission,), the event shape (bound, robot). A rate that is NaN was not
    measured. `drift` may be any function of awareness and of parameters with `numpyro.sample`
    statements of their own:

    >>> drift = level + most * (1.0 - jnp.exp(-rise * awareness[..., 1]))
    >>> with numpyro.plate("mission", len(drift)):
    ...     rates = ContactRate(drift, beta0, delta_w, delta_v)
    ...     numpyro.sample("contact_rate", rates, obs=contact_rate)
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("ssm",)

    def __init__(
        self,
        drift: Array,
        beta0: ArrayLike,
        delta_w: ArrayLike,
        delta_v: ArrayLike,
        x0_mean: ArrayLike = 0.5,
        x0_sd: ArrayLike = 0.5,
    ) -> None:
        """Take the drift and the parameters.

        Args:
            drift: What each bound adds to trust, shape (mission, bound, robot).
            beta0: Autoregression, shape () or (robot,).
            delta_w: Standard deviation of the process noise, shape () or (robot,).
            delta_v: Standard deviation of the observation noise, shape () or (robot,).
            x0_mean: Mean of trust before the first bound, shape ().
            x0_sd: Its standard deviation, shape ().
        """
        parameters = (jnp.asarray(p) for p in (beta0, delta_w, delta_v, x0_mean, x0_sd))
        beta0, delta_w, delta_v, x0_mean, x0_sd = parameters
        bounds = jnp.swapaxes(drift, 0, 1)
        self.ssm = ScalarSSM(beta0, bounds, delta_w, delta_v, x0_mean, x0_sd)
        super().__init__(drift.shape[:1], drift.shape[1:])

    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Log density of each mission in nats, shape (mission,)."""
        return self.ssm.log_likelihood(jnp.swapaxes(value, 0, 1)).sum(1)

    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Contact rates, shape `(*sample_shape, mission, bound, robot)`."""

        def one(key: Array) -> Array:
            return jnp.swapaxes(self.ssm.simulate(key)[1], 0, 1)

        for _ in sample_shape:
            one = vmap(one)
        return one(random.split(key, sample_shape))
