"""Covariance of a mission's quasi-differences, written once for NumPy and JAX arrays.

Symbols of `gram`: Sigma = T + kappa e_1 e_1' with T tridiagonal Toeplitz of size n.
"""

from typing import Any

import numpy as np

Numbers = Any


def sine_basis(n: int) -> np.ndarray:
    """Orthonormal, symmetric matrix of the type-I discrete sine transform, (n, n)."""
    k = np.arange(1, n + 1)
    return np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * np.outer(k, k) / (n + 1))


def cosines(n: int) -> np.ndarray:
    """cos(pi k / (n + 1)), k = 1..n: the frequencies of the sine transform."""
    return np.cos(np.pi * np.arange(1, n + 1) / (n + 1))


def tridiagonal(beta0: Numbers, Q: Numbers, R: Numbers, lag: float) -> tuple[Numbers, Numbers]:
    """Diagonal of T, and minus its off-diagonal entry."""
    return Q * (1.0 + lag) + R * (1.0 + beta0**2), lag * Q + beta0 * R


def eigenvalues(diagonal: Numbers, beside: Numbers, cosine: Numbers) -> Numbers:
    """Eigenvalues of T, one for each of the `cosines`."""
    return diagonal - 2.0 * beside * cosine


def corner(
    beta0: Numbers, h: Numbers, Q: Numbers, R: Numbers, lag: float, x0_sd: Numbers
) -> Numbers:
    """The corner entry kappa, with h = beta0 - lag."""
    return h**2 * x0_sd**2 - lag * Q - beta0**2 * R
