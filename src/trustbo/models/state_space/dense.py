"""The likelihood of coupled robots' complete missions, by one Cholesky factor for all of them.

r_k = y_k - B0 y_{k-1} - c_k = w_k + v_k - B0 v_{k-1} is a block MA(1): its covariance is block
tridiagonal and does not depend on the data. A mission that ends early needs the leading part of the
factor only. Without a loop over bounds this is faster than the filter, as long as the matrix is
small.
"""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular

if TYPE_CHECKING:
    from trustbo.models.state_space.vector import VectorSSM

MAX_SIZE = 128
"""Rows of the matrix beyond which the filter is as fast."""


def is_small(ssm: "VectorSSM") -> bool:
    """Whether the matrix is small enough to be faster than the filter."""
    n_bounds, _, n_robots = ssm.drift.shape
    return n_bounds * n_robots <= MAX_SIZE


def log_likelihood(ssm: "VectorSSM", y: Array) -> Array:
    """Log density of complete missions' rates, latent trust integrated out.

    Args:
        ssm: State space.
        y: Contact rates, shape (bound, mission, robot); NaN only after a mission's last bound.

    Returns:
        Nats, shape (mission, 1).
    """
    seen = jnp.where(jnp.isnan(y), 0.0, 1.0)
    white, log_scale = _whiten(ssm, jnp.where(seen > 0.0, y, 0.0))
    terms = white**2 + (2.0 * log_scale)[:, None, :] + jnp.log(2.0 * jnp.pi)
    return -0.5 * (terms * seen).sum((0, 2))[:, None]


def _whiten(ssm: "VectorSSM", y: Array) -> tuple[Array, Array]:
    """Independent standard normal residuals, and the log of their scales (bound, robot)."""
    n_bounds, n_sequences, p = y.shape
    B0, Q, R = ssm.B0, ssm.Q, ssm.R
    BR = B0 @ R
    usual = Q + R + BR @ B0.T
    first = ssm.x0_sd**2 * B0 @ B0.T + Q + R
    beside = jnp.kron(jnp.eye(n_bounds, k=-1), -BR)
    covariance = jnp.kron(jnp.eye(n_bounds), usual) + beside + beside.T
    covariance = covariance.at[:p, :p].set(first)
    L = jnp.linalg.cholesky(covariance)
    start = jnp.broadcast_to(B0.sum(1) * ssm.x0_mean, (1, n_sequences, p))
    lagged = jnp.concatenate([start, y[:-1] @ B0.T + ssm.drift[1:]])
    r = y - lagged - jnp.concatenate([ssm.drift[:1], jnp.zeros_like(ssm.drift[1:])])
    flat = jnp.swapaxes(r, 1, 2).reshape(n_bounds * p, n_sequences)
    white = solve_triangular(L, flat, lower=True).reshape(n_bounds, p, n_sequences)
    return jnp.swapaxes(white, 1, 2), jnp.log(jnp.diagonal(L)).reshape(n_bounds, p)
