"""The identity of `gram` in JAX, for NUTS: the pooled Gaussian likelihood from sums over missions.

The cost of a density does not depend on the number of rates. Lengths and frequencies are padded, so
that compiled code is reused.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import cho_solve

from trustbo.inference.evidence.gram import LengthGram, SufficientStatistics
from trustbo.inference.evidence.toeplitz import (
    corner,
    cosines,
    eigenvalues,
    sine_basis,
    tridiagonal,
)
from trustbo.models.params import TrustParams


class Spectrum(NamedTuple):
    """Sums over the complete sequences of each length; padding is 0, its mask too."""

    spectral: Array | np.ndarray  # (length, frequency, column, column)
    corner: Array | np.ndarray  # (length, frequency, frequency, column, column)
    cosine: Array | np.ndarray  # (length, frequency)
    first: Array | np.ndarray  # (length, frequency), squares of the first row of the sine basis
    mask: Array | np.ndarray  # (length, frequency)
    weight: Array | np.ndarray  # (length,), number of sequences
    n_measured: Array | np.ndarray  # ()


def spectrum(statistics: SufficientStatistics) -> Spectrum:
    """Pad the statistics of missions without gaps: lengths to a power of two, bounds by fours."""
    grams = statistics.grams
    n_bounds = -(-max(grams) // 4) * 4
    n_lengths = max(2, 1 << (len(grams) - 1).bit_length())
    p = statistics.n_features + 4
    padded = Spectrum(
        np.zeros((n_lengths, n_bounds, p, p)),
        np.zeros((n_lengths, n_bounds, n_bounds, p, p)),
        np.zeros((n_lengths, n_bounds)),
        np.zeros((n_lengths, n_bounds)),
        np.zeros((n_lengths, n_bounds)),
        np.zeros(n_lengths),
        np.asarray(statistics.n_measured),
    )
    for i, (n, gram) in enumerate(sorted(grams.items())):
        sines = sine_basis(n)
        padded.spectral[i, :n] = gram.spectral
        padded.corner[i, :n, :n] = _rotated(gram, sines)
        padded.cosine[i, :n] = cosines(n)
        padded.first[i, :n] = sines[0] ** 2
        padded.mask[i, :n] = 1.0
        padded.weight[i] = gram.weight
    return padded


class Conditional(NamedTuple):
    """Conditional distribution of weights and intercept under normal priors."""

    mean: Array  # (coefficient,)
    cholesky: Array  # (coefficient, coefficient), lower factor of their precision


def coefficients(
    params: TrustParams, s: Spectrum, lag: float, mean: Array, precision: Array
) -> Conditional:
    """Posterior of (beta, b) given beta0 and the noises, by generalised least squares.

    Args:
        params: Other parameters; its `beta` and `b` are not read.
        s: Sums over missions.
        lag: 0 where rates measure trust, 1 where they measure its change.
        mean: Prior mean of (beta, b).
        precision: Prior precisions.
    """
    inverse, shrink, _ = _scales(params, s, lag)
    M = jnp.einsum("gk,gkpq->pq", inverse, s.spectral)
    outer = shrink[:, None, None] * inverse[:, :, None] * inverse[:, None, :]
    M = M - jnp.einsum("gkl,gklpq->pq", outer, s.corner)
    loadings = jnp.stack([jnp.ones_like(params.beta0), -params.beta0, lag - params.beta0])
    L = jnp.linalg.cholesky(M[3:, 3:] + jnp.diag(precision))
    rhs = 0.5 * (M[3:, :3] + M[:3, 3:].T) @ loadings + precision * mean
    return Conditional(cho_solve((L, True), rhs), L)


def _scales(p: TrustParams, s: Spectrum, lag: float) -> tuple[Array, Array, Array]:
    """Inverse eigenvalues, the corner's factor, and the log determinant."""
    Q, R, h = p.delta_w**2, p.delta_v**2, p.beta0 - lag
    entries = tridiagonal(p.beta0, Q, R, lag)
    values = jnp.where(s.mask > 0.0, eigenvalues(*entries, s.cosine), 1.0)
    inverse = jnp.asarray(s.mask) / values
    kappa = corner(p.beta0, h, Q, R, lag, p.x0_sd)
    tau = (s.first * inverse).sum(1)
    shrink = kappa / (1.0 + kappa * tau)
    log_det = (jnp.log(values).sum(1) + jnp.log1p(kappa * tau)) @ s.weight
    return inverse, shrink, log_det


def log_likelihood(params: TrustParams, s: Spectrum, lag: float) -> Array:
    """Log density of all rates, latent trust integrated out."""
    p, h = params, params.beta0 - lag
    inverse, shrink, log_det = _scales(params, s, lag)
    loadings = jnp.stack([jnp.ones_like(p.beta0), -p.beta0, -h])
    v = jnp.concatenate([loadings, -p.beta, -jnp.reshape(p.b, (1,))])
    pairs = jnp.reshape(v[:, None] * v[None, :], -1)
    # The two products with the data; all else is a handful of numbers.
    on_diagonal = jnp.reshape(s.spectral, (-1, pairs.size)) @ pairs
    outer = shrink[:, None, None] * inverse[:, :, None] * inverse[:, None, :]
    corner = jnp.reshape(outer, -1) @ jnp.reshape(s.corner, (-1, pairs.size))
    misfit = jnp.reshape(inverse, -1) @ on_diagonal - corner @ pairs
    return -0.5 * (misfit + log_det + s.n_measured * jnp.log(2.0 * jnp.pi))


def _rotated(gram: LengthGram, sines: np.ndarray) -> np.ndarray:
    """Products that e_1' T^-1 multiplies, (frequency, frequency, column, column)."""
    rotated = np.einsum("ka,lb,abpq->klpq", sines, sines, gram.corner, optimize=True)
    return rotated * (sines[0][:, None] * sines[0][None])[..., None, None]
