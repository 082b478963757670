"""What follows from posterior draws, exactly: latent trust and predicted contact rates."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax, random

from trustbo.models import statespace
from trustbo.models.pooled import ContactRate, TrustParams


class TrustMoments(NamedTuple):
    """Posterior mean and standard deviation of latent trust, (mission, bound, robot)."""

    mean: Array
    sd: Array


@jax.jit
def trust_draws(params: TrustParams, awareness: Array, contact_rate: Array, key: Array) -> Array:
    """One exact joint draw of latent trust per parameter draw, (draw, mission, bound, robot)."""

    def one(p: TrustParams, key: Array) -> Array:
        ssm = ContactRate(p, awareness).ssm()
        filtered = statespace.kalman_filter(ssm, jnp.swapaxes(contact_rate, 0, 1))
        return jnp.swapaxes(statespace.sample_backward(ssm, filtered, key), 0, 1)

    return jax.vmap(one)(params, random.split(key, len(params.beta0)))


@jax.jit
def trust_moments(params: TrustParams, awareness: Array, contact_rate: Array) -> TrustMoments:
    """Moments of latent trust over all draws, by the smoother and the law of total variance."""

    def add(carry, p: TrustParams):
        ssm = ContactRate(p, awareness).ssm()
        filtered = statespace.kalman_filter(ssm, jnp.swapaxes(contact_rate, 0, 1))
        mean, var = statespace.smooth(ssm, filtered)
        return (carry[0] + mean, carry[1] + var + mean**2), None

    zero = jnp.zeros_like(jnp.swapaxes(contact_rate, 0, 1))
    (total, total_squares), _ = lax.scan(add, (zero, zero), params)
    mean, mean_square = total / len(params.beta0), total_squares / len(params.beta0)
    sd = jnp.sqrt(jnp.maximum(mean_square - mean**2, 0.0))
    return TrustMoments(jnp.swapaxes(mean, 0, 1), jnp.swapaxes(sd, 0, 1))


@jax.jit
def predictive(params: TrustParams, awareness: Array, key: Array) -> Array:
    """Contact rates of replicated missions, one set per draw: (draw, mission, bound, robot)."""
    keys = random.split(key, len(params.beta0))
    return jax.vmap(lambda p, key: ContactRate(p, awareness).sample(key))(params, keys)
