"""Likelihood of all missions together, effects of places integrated out, as compiled code for NUTS.

Dense where `place_rows` filters, so that each is a check of the other: with x = (x_0, ..., x_K) of
one robot in one mission, rates are y = H x + v, H = (0 I) - lag (I 0), and the effects g of its
bounds enter x by T, T_kj = beta0^(k - j). Whitened by the covariance of its rates, the T of all
missions and robots add up to the precision W that the data lend to g, and then, with L_g L_g' the
prior covariance of g, det(V + T K T') = det(V) det(I + L_g' W L_g).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular

from trustbo.models.place import Visited
from trustbo.models.state_space.scalar import ScalarSSM

_BUCKET = 32
_JITTER = 1e-10  # of tau_s^2, where bounds have no effect of their own


class PlaceIndex(NamedTuple):
    """Visited places as data of compiled code, padded so that the next mission meets the same."""

    cells: Array | np.ndarray  # (cell, 3): effect, row, col
    cell_of: Array | np.ndarray  # (unit,)
    unit: Array | np.ndarray  # (mission, bound, effect)

    @classmethod
    def of(cls, places: Visited) -> "PlaceIndex":
        """Pad cells, each an effect of its own, and units, which nobody measured."""
        more = -len(places.cells) % _BUCKET
        apart = np.column_stack([-1 - np.arange(more), np.zeros((more, 2), dtype=int)])
        cells = np.concatenate([places.cells, apart])
        cell_of = np.concatenate([places.cell_of, np.zeros(-len(places.units) % _BUCKET, int)])
        return cls(cells, cell_of, np.maximum(places.unit, 0))


class PlaceHyper(NamedTuple):
    """Hyperparameters of places; 0, and a length scale of 1, for an effect there is not."""

    tau_s: Array
    length_scale: Array
    tau_e: Array


def prior_factor(hyper: PlaceHyper, places: PlaceIndex) -> Array:
    """Cholesky's factor of the prior covariance of the units' effects g, (unit, unit)."""
    gap = places.cells[:, None] - places.cells[None]
    h = jnp.sqrt(3.0) * jnp.hypot(*jnp.moveaxis(gap[..., 1:] * 1.0, -1, 0)) / hyper.length_scale
    K = hyper.tau_s**2 * (1.0 + h) * jnp.exp(-h) * (gap[..., 0] == 0)
    own = hyper.tau_e**2 + _JITTER * hyper.tau_s**2 + 1e-14
    return jnp.linalg.cholesky(
        K[places.cell_of][:, places.cell_of] + own * jnp.eye(len(places.cell_of))
    )


def log_likelihood(
    ssm: ScalarSSM, y: Array, weight: Array, hyper: PlaceHyper, places: PlaceIndex
) -> Array:
    """Log density of all rates y (mission, bound, robot), each mission weighted."""
    W, h, rest = _statistics(ssm, y, weight, places)
    L = prior_factor(hyper, places)
    root, half = _posterior(L, W, h)
    return rest + 0.5 * (half**2).sum() - jnp.log(jnp.diagonal(root)).sum()


def draw_effects(
    ssm: ScalarSSM,
    y: Array,
    weight: Array,
    hyper: PlaceHyper,
    places: PlaceIndex,
    key: Array,
) -> Array:
    """Effects g of the units given all rates, one exact draw, (unit,)."""
    W, h, _ = _statistics(ssm, y, weight, places)
    L = prior_factor(hyper, places)
    root, half = _posterior(L, W, h)
    z = half + jax.random.normal(key, half.shape, half.dtype)
    return L @ solve_triangular(root, z, lower=True, trans=1)


def _posterior(L: Array, W: Array, h: Array) -> tuple[Array, Array]:
    """Factor of I + L' W L, and its inverse times L' h."""
    root = jnp.linalg.cholesky(jnp.eye(len(L)) + L.T @ W @ L)
    return root, solve_triangular(root, L.T @ h, lower=True)


def _statistics(
    ssm: ScalarSSM, y: Array, weight: Array, places: PlaceIndex
) -> tuple[Array, Array, Array]:
    """Precision W and right side h of g, and the log density of the rates at g = 0."""
    n_missions, n_bounds, n_robots = y.shape
    drift = jnp.swapaxes(ssm.drift, 0, 1)  # (mission, bound, robot)

    def each(value: Array) -> Array:
        return jnp.broadcast_to(value, (n_robots,))

    def robot(y: Array, u: Array, beta0: Array, w: Array, v: Array) -> tuple[Array, ...]:
        return _whiten(ssm, y, u, beta0, w, v)

    over_robots = jax.vmap(robot, in_axes=(1, 1, 0, 0, 0))
    over_missions = jax.vmap(over_robots, in_axes=(0, 0, None, None, None))
    noises = (each(ssm.beta0), each(ssm.delta_w), each(ssm.delta_v))
    T, r, log_det, n = over_missions(y, drift, *noises)  # (mission, robot, bound, bound), ...
    w = weight[:, None]
    S = jnp.einsum("jikm,jikn->jimn", T, T) * w[..., None, None]
    h = jnp.einsum("jikm,jik->jim", T, r) * w[..., None]
    unit = jnp.broadcast_to(places.unit, (n_missions, n_bounds, n_robots)).swapaxes(1, 2)
    size = len(places.cell_of)
    W = jnp.zeros((size, size)).at[unit[..., :, None], unit[..., None, :]].add(S)
    right = jnp.zeros(size).at[unit].add(h)
    rest = -0.5 * ((r**2).sum(-1) + log_det + n * jnp.log(2.0 * jnp.pi))
    return W, right, (rest * w).sum()


def _whiten(
    ssm: ScalarSSM, y: Array, u: Array, beta0: Array, delta_w: Array, delta_v: Array
) -> tuple[Array, Array, Array, Array]:
    """T and residuals of one robot in one mission, whitened, the log determinant, the number."""
    n = len(y)
    step = jnp.arange(n + 1)
    ahead = step[:, None] - step[None, 1:]  # of x_k after the bound j
    carried = jnp.where(ahead >= 0, beta0 ** jnp.maximum(ahead, 0), 0.0)  # (n + 1, n)
    start = beta0**step
    mean = start * ssm.x0_mean + carried @ u
    covariance = ssm.x0_sd**2 * jnp.outer(start, start) + delta_w**2 * carried @ carried.T
    H = jnp.eye(n, n + 1, 1) - ssm.lag * jnp.eye(n, n + 1)
    seen = ~jnp.isnan(y)
    both = seen[:, None] & seen[None]
    V = jnp.where(both, H @ covariance @ H.T, 0.0)
    L = jnp.linalg.cholesky(V + jnp.diag(jnp.where(seen, delta_v**2, 1.0)))
    r = jnp.where(seen, y - H @ mean, 0.0)
    T = jnp.where(seen[:, None], H @ carried, 0.0)
    white = solve_triangular(L, jnp.column_stack([T, r]), lower=True)
    return white[:, :-1], white[:, -1], 2.0 * jnp.log(jnp.diagonal(L)).sum(), seen.sum()
