"""Latent trust under posterior draws, compiled for all models."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random

from trustbo.models.backend import in_batches
from trustbo.models.families import Family, Observed
from trustbo.models.params import Params
from trustbo.stacking import MissionBatch

_BATCH = 64  # draws computed at once


class Latents(NamedTuple):
    """Innovations of latent trust sampled with the parameters, where it does not integrate out."""

    innovations: Array | np.ndarray | None = None
    """Standard normal numbers, (draw, bound, mission, robot)."""
    linearisation: Array | None = None
    """Linearisation point of the weights, see `families.family.Observed`."""


def trust_draws(
    family: Family, lag: float, params: Params, latents: Latents, batch: MissionBatch, key: Array
) -> np.ndarray:
    """One exact joint draw of latent trust per parameter draw, (draw, mission, bound, robot)."""
    keys = random.split(key, len(params.b))
    draw = partial(_trust_draws, family, lag, batch, latents.linearisation)
    return in_batches(draw, (params, latents.innovations, keys), _BATCH)


@partial(jax.jit, static_argnames=("family", "lag"))
def trust_moments(
    family: Family, lag: float, params: Params, latents: Latents, batch: MissionBatch
) -> tuple[Array, Array]:
    """Mean and sd of latent trust (mission, bound, robot) over draws, by the total variance."""
    observed = Observed.of(batch.contact_rate, batch.n_ticks, latents.linearisation)  # pyright: ignore

    def add(carry, inputs):
        p, e = inputs
        e = jnp.zeros_like(observed.y) if e is None else e
        mean, var = family.trust_moments(p.ssm(batch.awareness, lag), observed, e)
        return (carry[0] + mean, carry[1] + var + mean**2), None

    zero = jnp.zeros_like(observed.y)
    (total, total_squares), _ = lax.scan(add, (zero, zero), (params, latents.innovations))
    mean, mean_square = total / len(params.b), total_squares / len(params.b)
    sd = jnp.sqrt(jnp.maximum(mean_square - mean**2, 0.0))
    return jnp.swapaxes(mean, 0, 1), jnp.swapaxes(sd, 0, 1)


@partial(jax.jit, static_argnames=("family", "lag"))
def _trust_draws(
    family: Family, lag: float, batch: MissionBatch, linearisation: Array | None, inputs: Any
) -> Array:
    observed = Observed.of(batch.contact_rate, batch.n_ticks, linearisation)  # pyright: ignore

    def one(inputs: Any) -> Array:
        p, e, key = inputs
        e = jnp.zeros_like(observed.y) if e is None else e
        ssm = p.ssm(batch.awareness, lag)
        return jnp.swapaxes(family.draw_trust(ssm, observed, e, key), 0, 1)

    return jax.vmap(one)(inputs)
