"""Dense Cholesky factors of covariances and precisions."""

from functools import cache

import numpy as np


@cache
def upper(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns of the upper triangle of n x n matrices; cached."""
    return np.triu_indices(n)


def log_diagonal(L: np.ndarray) -> np.ndarray:
    """Compute the log determinants of triangular matrices."""
    return np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(-1)


def log_det(A: np.ndarray) -> np.ndarray:
    """Compute the log determinants of positive definite matrices."""
    return 2.0 * log_diagonal(cholesky(A))


def cholesky(A: np.ndarray) -> np.ndarray:
    """Compute lower Cholesky factors, with NaN where a matrix is not positive definite."""
    try:
        return np.linalg.cholesky(A)
    except np.linalg.LinAlgError:  # one bad point must not invalidate the others
        if A.ndim == 2:
            return np.full(A.shape, np.nan)
        return np.stack([cholesky(one) for one in A])
