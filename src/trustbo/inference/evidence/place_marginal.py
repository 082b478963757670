"""Likelihood of all missions together, effects of places integrated out, as compiled code for NUTS.

Dense where `gaussian` filters, so that each is a check of the other: with x = (x_0, ..., x_K) of
one robot in one mission, rates are y = H x + v, H = (0 I) - lag (I 0), and the effects g of its
bounds enter x by T, T_kj = beta0^(k - j). Whitened by the covariance of its rates, the T of all
missions and robots add up to the precision W that the data lend to g, and then, with L_g L_g' the
prior covariance of g, det(V + T K T') = det(V) det(I + L_g' W L_g). Weights and intercept of the
pooled model are more unknowns of that kind, with columns X of features in the place of T: sampled,
they would make a funnel with the scales of the effects, which widen them tenfold.

NUTS takes tens of thousands of gradients, so that common factors are shared. V and T do not depend
on awareness, and those of a short mission are leading blocks of those of a long one: there is one
whitening for each pattern of gaps, not for each mission and robot. The term of all units has its
gradient in closed form, without the derivative of a Cholesky factor.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import block_diag, solve_triangular

from trustbo.models.place import Visited
from trustbo.models.state_space.scalar import ScalarSSM

_BUCKET = 32
_JITTER = 1e-10  # of tau_s^2, where bounds have no effect


class PlaceIndex(NamedTuple):
    """Visited places as data of compiled code, padded so that the next mission reuses it."""

    cells: Array | np.ndarray  # (cell, 3): effect, row, col
    cell_of: Array | np.ndarray  # (unit,)
    unit: Array | np.ndarray  # (mission, bound, effect)
    patterns: Array | np.ndarray  # (pattern, bound), whether a rate was measured
    pattern_of: Array | np.ndarray  # (mission, robot)

    @classmethod
    def of(cls, places: Visited, contact_rate: np.ndarray) -> "PlaceIndex":
        """Pad with cells of separate effects and with unmeasured units.

        A pattern is that of the gaps in rates (mission, bound, robot); the end of a mission is no
        gap. Patterns without gaps pad to a power of four.
        """
        more = -len(places.cells) % _BUCKET
        apart = np.column_stack([-1 - np.arange(more), np.zeros((more, 2), dtype=int)])
        cells = np.concatenate([places.cells, apart])
        cell_of = np.concatenate([places.cell_of, np.zeros(-len(places.units) % _BUCKET, int)])
        seen = np.swapaxes(~np.isnan(contact_rate), 1, 2)  # (mission, robot, bound)
        over = ~np.logical_or.accumulate(seen[..., ::-1], axis=2)[..., ::-1]
        masks = (seen | over).reshape(-1, seen.shape[2])
        patterns, pattern_of = np.unique(masks, axis=0, return_inverse=True)
        n = 4 ** int(np.ceil(np.log2(len(patterns)) / 2.0))
        padding = np.ones((n - len(patterns), seen.shape[2]), dtype=bool)
        return cls(
            cells, cell_of, np.maximum(places.unit, 0),
            np.concatenate([patterns, padding]), pattern_of.reshape(seen.shape[:2]),
        )  # fmt: skip


class PlaceHyper(NamedTuple):
    """Hyperparameters of places; 0, and a length scale of 1, for an absent effect."""

    tau_s: Array
    length_scale: Array
    tau_e: Array

    @classmethod
    def of(cls, values: Mapping[str, Array]) -> "PlaceHyper":
        """Take the effects that are there from parameters by name."""
        absent = {"tau_s": jnp.zeros(()), "length_scale": jnp.ones(()), "tau_e": jnp.zeros(())}
        return cls(*(values.get(name, absent[name]) for name in cls._fields))


def prior_factor(hyper: PlaceHyper, places: PlaceIndex) -> Array:
    """Cholesky's factor of the prior covariance of the units' effects g, (unit, unit)."""
    return jnp.linalg.cholesky(_prior_covariance(hyper, places))


def _prior_covariance(hyper: PlaceHyper, places: PlaceIndex) -> Array:
    gap = places.cells[:, None] - places.cells[None]
    h = jnp.sqrt(3.0) * jnp.hypot(*jnp.moveaxis(gap[..., 1:] * 1.0, -1, 0)) / hyper.length_scale
    K = hyper.tau_s**2 * (1.0 + h) * jnp.exp(-h) * (gap[..., 0] == 0)
    nugget = hyper.tau_e**2 + _JITTER * hyper.tau_s**2 + 1e-14
    same = places.cell_of
    return K[same][:, same] + nugget * jnp.eye(len(same))


class Linear(NamedTuple):
    """Part of the drift that is linear in coefficients with independent normal priors."""

    columns: Array  # (mission, bound, robot, coefficient)
    mean: Array  # (coefficient,)
    sd: Array  # (coefficient,)


def log_likelihood(
    ssm: ScalarSSM,
    y: Array,
    weight: Array,
    hyper: PlaceHyper,
    places: PlaceIndex,
    linear: Linear | None = None,
) -> Array:
    """Log density of all rates y (mission, bound, robot), each mission weighted.

    With `linear`, its coefficients integrate out next to the effects, and the drift of `ssm` is the
    rest.
    """
    K, W, h, rest = _unknowns(ssm, y, weight, hyper, places, linear)
    return rest + _log_marginal(K, W, h)


def draw_effects(
    ssm: ScalarSSM,
    y: Array,
    weight: Array,
    hyper: PlaceHyper,
    places: PlaceIndex,
    key: Array,
    linear: Linear | None = None,
) -> tuple[Array, Array]:
    """Effects (unit,) and coefficients (coefficient,) given all rates, one exact draw."""
    K, W, h, _ = _unknowns(ssm, y, weight, hyper, places, linear)
    L = jnp.linalg.cholesky(K)
    root = _root(L, W)
    half = solve_triangular(root, L.T @ h, lower=True)
    z = half + jax.random.normal(key, half.shape, half.dtype)
    g, c = jnp.split(L @ solve_triangular(root, z, lower=True, trans=1), [len(places.cell_of)])
    return g, c if linear is None else linear.mean + c


@jax.custom_vjp
def _log_marginal(K: Array, W: Array, h: Array) -> Array:
    """Log of the mean of exp(h'g - g'Wg / 2) over g ~ N(0, K)."""
    return _with_posterior(K, W, h)[0]


def _with_posterior(K: Array, W: Array, h: Array) -> tuple[Array, tuple[Array, ...]]:
    """Log marginal; and W, the mean m and covariance C of g under that weight, and h - W m."""
    L = jnp.linalg.cholesky(K)
    root = _root(L, W)
    X = solve_triangular(root, L.T, lower=True)
    half = X @ h
    m, C = X.T @ half, X.T @ X
    value = 0.5 * (half**2).sum() - jnp.log(jnp.diagonal(root)).sum()
    return value, (W, m, C, h - W @ m)


def _gradient(saved: tuple[Array, ...], ahead: Array) -> tuple[Array, Array, Array]:
    """Gradients in K, W and h: (K + W^-1)^-1 = W - W C W."""
    W, m, C, left = saved
    of_K = jnp.outer(left, left) - W + W @ C @ W
    return 0.5 * ahead * of_K, -0.5 * ahead * (C + jnp.outer(m, m)), ahead * m


_log_marginal.defvjp(_with_posterior, _gradient)


def _root(L: Array, W: Array) -> Array:
    """Factor of I + L' W L."""
    return jnp.linalg.cholesky(jnp.eye(len(L)) + L.T @ W @ L)


def _unknowns(
    ssm: ScalarSSM,
    y: Array,
    weight: Array,
    hyper: PlaceHyper,
    places: PlaceIndex,
    linear: Linear | None,
) -> tuple[Array, Array, Array, Array]:
    """Prior covariance K of g, and of coefficients less their means; what the rates add.

    Returns:
        K, the precision W and the right side h that the rates lend, and the log density of the
        rates where all unknowns are 0.
    """
    r, T, log_scale = _whitened(ssm, y, weight, places)
    columns, K = r[..., None], _prior_covariance(hyper, places)
    if linear is not None:
        X = jnp.einsum("mikj,mjip->mikp", T, linear.columns)
        columns = jnp.concatenate([columns - (X @ linear.mean)[..., None], X], 3)
        K = block_diag(K, jnp.diag(linear.sd**2))
    unit = jnp.swapaxes(jnp.asarray(places.unit), 1, 2)
    S = jnp.einsum("mikj,mikl->mijl", T, T)
    B = jnp.einsum("mikj,mikc->mijc", T, columns)
    if unit.shape[1] == 1:
        S, B = S.sum(1, keepdims=True), B.sum(1, keepdims=True)
    size = len(places.cell_of)
    W = jnp.zeros((size, size)).at[unit[..., :, None], unit[..., None, :]].add(S)
    B = jnp.zeros((size, columns.shape[3])).at[unit].add(B)
    flat = columns.reshape(-1, columns.shape[3])
    A = flat.T @ flat
    W = jnp.block([[W, B[:, 1:]], [B[:, 1:].T, A[1:, 1:]]])
    return K, W, jnp.append(B[:, 0], A[1:, 0]), -0.5 * A[0, 0] - log_scale


def _whitened(
    ssm: ScalarSSM, y: Array, weight: Array, places: PlaceIndex
) -> tuple[Array, Array, Array]:
    """Rates with independent errors of variance 1; a mission's weight multiplies their squares.

    Returns:
        Residuals (mission, robot, bound) at g = 0, and 0 where no rate was measured; their response
        to the drift of each bound, (mission, robot, bound, bound); and the log of the errors' scale
        before, and of sqrt(2 pi), summed.
    """
    n_bounds, n_robots = y.shape[1:]
    seen = jnp.swapaxes(~jnp.isnan(y), 1, 2)  # (mission, robot, bound)
    # Robots that share their parameters share the whitening too.
    alike = max(jnp.ndim(parameter) for parameter in (ssm.beta0, ssm.delta_w, ssm.delta_v)) == 0
    sets = [jnp.broadcast_to(v, 1 if alike else n_robots) for v in ssm[:1] + ssm[2:4]]
    whiten = jax.vmap(lambda *arguments: _whitening(ssm, jnp.asarray(places.patterns), *arguments))
    carried, start, inverse, log_scale, T = whiten(*sets)
    robot = jnp.arange(n_robots)[None] * (not alike)
    H = jnp.eye(n_bounds, n_bounds + 1, 1) - ssm.lag * jnp.eye(n_bounds, n_bounds + 1)
    mean = start[robot] * ssm.x0_mean + jnp.einsum("ikj,jmi->mik", carried[robot[0]], ssm.drift)
    r = jnp.where(seen, jnp.nan_to_num(jnp.swapaxes(y, 1, 2)) - mean @ H.T, 0.0)
    pattern, w = places.pattern_of, weight[:, None, None]
    # Bounds after the end of a mission do not affect those before, and are left out here.
    r = seen * jnp.einsum("mikj,mij->mik", inverse[robot, pattern], r)
    T = seen[..., None] * T[robot, pattern]
    log_scale = seen * (log_scale[robot, pattern] + 0.5 * jnp.log(2.0 * jnp.pi))
    return jnp.sqrt(w) * r, jnp.sqrt(w)[..., None] * T, (w * log_scale).sum()


def _whitening(
    ssm: ScalarSSM, patterns: Array, beta0: Array, delta_w: Array, delta_v: Array
) -> tuple[Array, ...]:
    """Whitening of the rates of one robot, for each pattern.

    Returns:
        Response of each x_k to a bound (bound + 1, bound) and to x_0; and for each
        pattern the inverse of the factor of V, the log of its diagonal, and its product with T.
    """
    n = patterns.shape[1]
    step = jnp.arange(n + 1)
    ahead = step[:, None] - step[None, 1:]  # of x_k after the bound j
    carried = jnp.where(ahead >= 0, beta0 ** jnp.maximum(ahead, 0), 0.0)
    start = beta0**step
    H = jnp.eye(n, n + 1, 1) - ssm.lag * jnp.eye(n, n + 1)
    T, first = H @ carried, H @ start
    V = ssm.x0_sd**2 * jnp.outer(first, first) + delta_w**2 * T @ T.T

    def one(seen: Array) -> tuple[Array, Array, Array]:
        noise = jnp.diag(jnp.where(seen, delta_v**2, 1.0))
        L = jnp.linalg.cholesky(jnp.where(seen[:, None] & seen[None], V, 0.0) + noise)
        inverse = solve_triangular(L, jnp.eye(n), lower=True)
        return inverse, jnp.log(jnp.diagonal(L)), inverse @ jnp.where(seen[:, None], T, 0.0)

    return carried, start, *jax.vmap(one)(patterns)
