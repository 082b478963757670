"""Dense Cholesky factors of covariances and precisions."""

from functools import cache
from typing import Any

import numpy as np

from trustbo.models.backend import inverse_and_log_det
from trustbo.statespace.matrices import namespace


@cache
def upper(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns of the upper triangle of n x n matrices; cached."""
    return np.triu_indices(n)


def log_diagonal(L: Any) -> Any:
    """Compute the log determinants of triangular matrices, in NumPy or JAX."""
    xp = namespace(L)
    return xp.log(xp.diagonal(L, axis1=-2, axis2=-1)).sum(-1)


def log_det(A: Any) -> Any:
    """Compute the log determinants of positive definite matrices, in NumPy or JAX."""
    if not isinstance(A, np.ndarray):
        return inverse_and_log_det(A)[1]
    return 2.0 * log_diagonal(cholesky(A))


def cholesky(A: np.ndarray) -> np.ndarray:
    """Compute lower Cholesky factors, with NaN where a matrix is not positive definite."""
    try:
        return np.linalg.cholesky(A)
    except np.linalg.LinAlgError:  # one bad point must not invalidate the others
        if A.ndim == 2:
            return np.full(A.shape, np.nan)
        return np.stack([cholesky(one) for one in A])
