"""Latent trust under posterior draws of Gaussian models, compiled; for coupled robots."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random

from trustbo.models.backend import in_batches
from trustbo.models.params import Params
from trustbo.stacking import MissionBatch

_BATCH = 64  # draws computed at once


def trust_draws(params: Params, batch: MissionBatch, key: Array) -> np.ndarray:
    """One exact joint draw of latent trust per parameter draw, (draw, mission, bound, robot)."""
    keys = random.split(key, len(params.b))
    return in_batches(partial(_trust_draws, batch), (params, keys), _BATCH)


@jax.jit
def trust_moments(params: Params, batch: MissionBatch) -> tuple[Array, Array]:
    """Mean and sd of latent trust (mission, bound, robot) over draws, by the total variance."""
    y = jnp.swapaxes(batch.contact_rate, 0, 1)

    def add(carry, p):
        ssm: Any = p.ssm(batch.awareness)
        mean, var = ssm.smooth(ssm.filter(y))
        return (carry[0] + mean, carry[1] + var + mean**2), None

    zero = jnp.zeros_like(y)
    (total, total_squares), _ = lax.scan(add, (zero, zero), params)
    mean, mean_square = total / len(params.b), total_squares / len(params.b)
    sd = jnp.sqrt(jnp.maximum(mean_square - mean**2, 0.0))
    return jnp.swapaxes(mean, 0, 1), jnp.swapaxes(sd, 0, 1)


@jax.jit
def _trust_draws(batch: MissionBatch, inputs: Any) -> Array:
    y = jnp.swapaxes(batch.contact_rate, 0, 1)

    def one(inputs: Any) -> Array:
        p, key = inputs
        ssm = p.ssm(batch.awareness)
        trust = ssm.sample_backward(ssm.filter(y), random.normal(key, y.shape, y.dtype))
        return jnp.swapaxes(trust, 0, 1)

    return jax.vmap(one)(inputs)
