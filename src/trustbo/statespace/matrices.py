"""Formulas that work with both NumPy and JAX arrays."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_JITTER = 1e-12
"""Number added to covariances, which may be singular, before they are factored."""
_JITTER_32 = 1e-6
"""The same number for single precision, the default of JAX."""


def namespace(x: Any) -> ModuleType:
    """Return `jax.numpy` for a JAX array, otherwise NumPy, so that one formula works for both."""
    return jnp if isinstance(x, jax.Array) else np


def transpose(A: Any) -> Any:
    """Transpose matrices (..., n, m)."""
    return namespace(A).swapaxes(A, -1, -2)


def product(A: Any, B: Any) -> Any:
    """Multiply matrices; the elementwise product is much faster for 1 x 1 matrices."""
    if A.shape[-2:] == (1, 1) and B.shape[-2] == 1:
        return A * B

    return A @ B


def apply(A: Any, x: Any) -> Any:
    """Multiply matrices A (..., n, m) by vectors x (..., m)."""
    return product(A, x[..., None])[..., 0]


def repeat_diagonal(A: Any, n: int) -> Any:
    """Make block-diagonal matrices with n copies of matrices (..., m, m), like kron(I_n, A)."""
    m = A.shape[-1]
    blocks = np.eye(n)[:, None, :, None] * A[..., None, :, None, :]
    return blocks.reshape(*A.shape[:-2], n * m, n * m)


def root(cov: Any) -> Any:
    """Compute a Cholesky factor of covariances (..., n, n), which may be singular."""
    xp = namespace(cov)
    n = cov.shape[-1]
    if n == 1:
        return xp.sqrt(cov)

    jitter = _JITTER if cov.dtype == np.float64 else _JITTER_32
    return xp.linalg.cholesky(cov + jitter * np.eye(n, dtype=cov.dtype))
