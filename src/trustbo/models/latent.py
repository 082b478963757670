"""What follows from posterior draws: latent trust and predicted contact rates."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax, random

from trustbo.models import observation as families
from trustbo.models.contact_rate import ContactRate
from trustbo.models.geometry import NutsData
from trustbo.models.params import Params


class TrustMoments(NamedTuple):
    """Posterior mean and standard deviation of latent trust, (mission, bound, robot)."""

    mean: Array
    sd: Array


@partial(jax.jit, static_argnames=("observation", "lag"))
def trust_draws(
    observation: str,
    lag: float,
    params: Params,
    noise: Array | None,
    pilot: Array | None,
    data: NutsData,
    key: Array,
) -> Array:
    """One exact joint draw of latent trust per parameter draw, (draw, mission, bound, robot)."""

    def one(inputs):
        p, e, key = inputs
        trust = families.draw_trust(observation, *_given(p, e, pilot, data, lag), key)
        return jnp.swapaxes(trust, 0, 1)

    return lax.map(one, (params, noise, random.split(key, len(params.b))), batch_size=64)


@partial(jax.jit, static_argnames=("observation", "lag"))
def trust_moments(
    observation: str,
    lag: float,
    params: Params,
    noise: Array | None,
    pilot: Array | None,
    data: NutsData,
) -> TrustMoments:
    """Moments of latent trust over all draws, by the law of total variance."""

    def add(carry, inputs):
        p, e = inputs
        mean, var = families.trust_moments(observation, *_given(p, e, pilot, data, lag))
        return (carry[0] + mean, carry[1] + var + mean**2), None

    zero = jnp.zeros_like(jnp.swapaxes(data.contact_rate, 0, 1))
    (total, total_squares), _ = lax.scan(add, (zero, zero), (params, noise))
    mean, mean_square = total / len(params.b), total_squares / len(params.b)
    sd = jnp.sqrt(jnp.maximum(mean_square - mean**2, 0.0))
    return TrustMoments(jnp.swapaxes(mean, 0, 1), jnp.swapaxes(sd, 0, 1))


@partial(jax.jit, static_argnames=("observation", "lag"))
def predictive(observation: str, lag: float, params: Params, data: NutsData, key: Array) -> Array:
    """Contact rates of replicated missions, one set per draw: (draw, mission, bound, robot)."""

    def one(inputs):
        p, key = inputs
        rates = ContactRate(
            p, data.awareness, exposure=data.exposure, observation=observation, lag=lag
        )
        return rates.sample(key)

    return lax.map(one, (params, random.split(key, len(params.b))), batch_size=64)


def _given(p: Params, e: Array | None, pilot: Array | None, data: NutsData, lag: float):
    """State space, data and noise of one draw; the Gaussian family, without noise, reads zeros."""
    rates = ContactRate(p, data.awareness, exposure=data.exposure, pilot=pilot, lag=lag)
    observed = rates.observed(data.contact_rate)
    return rates.ssm(), observed, jnp.zeros_like(observed.y) if e is None else e
