"""The joint distribution of contact rates, as numpyro has it, and what is compiled of it."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import Array, lax
from numpyro.distributions import constraints

from trustbo.models import observation as families
from trustbo.models.observation import SSM, Observed
from trustbo.models.params import Params

N_IMPORTANCE = 32
"""Trajectories over which the likelihood of other families than the Gaussian is averaged."""


class ContactRate(dist.Distribution):
    """Joint distribution of a batch of missions' contact rates.

    Batch shape (mission,), event shape (bound, robot). A rate that is NaN counts as not measured.
    Latent trust is integrated out; of families other than the Gaussian, `log_prob` is a weight that
    depends on `noise` and averages to the density (see `observation`).
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("params", "awareness", "exposure", "noise", "weight", "pilot")
    pytree_aux_fields = ("observation", "lag", "shared")

    def __init__(
        self,
        params: Params,
        awareness: Array,
        *,
        exposure: Array | None = None,
        noise: Array | None = None,
        weight: Array | None = None,
        pilot: Array | None = None,
        observation: str = "gaussian",
        lag: float = 0.0,
        shared: bool = False,
    ) -> None:
        """The distribution for given parameters and awareness.

        Args:
            params: Parameters without leading axes.
            awareness: Shape (mission, bound, robot, feature).
            exposure: Ticks, shape (mission, bound, robot); the beta-binomial family needs them.
            noise: What latent trust is made of where it cannot be integrated out, standard normal,
                shape (bound, mission, robot).
            weight: Of each mission's log density, shape (mission,).
            pilot: See `observation.Observed`; of the shape of `noise`.
            observation: `"gaussian"`, `"censored"` or `"beta_binomial"`.
            lag: 0 where rates measure trust, 1 where they measure its change.
            shared: No rate is missing before the last of a mission.
        """
        self.params, self.awareness, self.exposure = params, awareness, exposure
        self.noise, self.weight, self.pilot = noise, weight, pilot
        self.observation, self.lag, self.shared = observation, lag, shared
        super().__init__(awareness.shape[:1], awareness.shape[1:3])

    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Log density in nats, times the mission's weight; shape (mission,)."""
        observed = self.observed(value)
        noise = jnp.zeros_like(observed.y) if self.noise is None else self.noise
        each = families.log_weight(
            self.observation, self.ssm(), observed, noise, shared=self.shared
        )
        return each.sum(1) * (1.0 if self.weight is None else self.weight)

    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Contact rates, shape `(*sample_shape, mission, bound, robot)`."""
        keys = jax.random.split(key, sample_shape)

        def one(key: Array) -> Array:
            return jnp.swapaxes(self.simulate(key)[1], 0, 1)

        for _ in sample_shape:
            one = jax.vmap(one)
        return one(keys)

    def simulate(self, key: Array) -> tuple[Array, Array]:
        """Latent trust and contact rates, each (bound, mission, robot)."""
        like = self.awareness[..., 0] if self.exposure is None else self.exposure
        return families.simulate(self.observation, self.ssm(), jnp.swapaxes(like, 0, 1), key)

    def ssm(self) -> SSM:
        """The state space of all missions."""
        return self.params.ssm(self.awareness, self.lag)

    def observed(self, value: Array) -> Observed:
        """Rates and exposure, bound first."""
        exposure = jnp.full_like(value, jnp.nan) if self.exposure is None else self.exposure
        return Observed(jnp.swapaxes(value, 0, 1), jnp.swapaxes(exposure, 0, 1), self.pilot)


class TrustSample(NamedTuple):
    """Draws of latent trust and contact rate, each of shape (mission, bound, robot)."""

    trust: np.ndarray
    contact_rate: np.ndarray


@partial(jax.jit, static_argnames=("observation", "lag"))
def mission_log_likelihood(
    observation: str,
    lag: float,
    params: Params,
    awareness: Array,
    contact_rate: Array,
    exposure: Array,
    key: Array,
) -> Array:
    """Log p(contact rates of each mission | draw), latent trust integrated out; (draw, mission)."""

    def one(p: Params) -> Array:
        rates = ContactRate(p, awareness, exposure=exposure, observation=observation, lag=lag)
        observed = rates.observed(contact_rate)
        # The same noise for every draw: what is compared does not differ by luck.
        return families.marginal_log_likelihood(
            observation, rates.ssm(), observed, key, N_IMPORTANCE
        )

    return lax.map(one, params, batch_size=256)


@partial(jax.jit, static_argnames=("observation", "lag"))
def simulate_missions(
    observation: str, lag: float, params: Params, awareness: Array, exposure: Array, key: Array
) -> tuple[Array, Array]:
    """Latent trust and contact rates drawn from the model, each (bound, mission, robot)."""
    rates = ContactRate(params, awareness, exposure=exposure, observation=observation, lag=lag)
    return rates.simulate(key)
