"""Cholesky factors of many small matrices at once, the point last."""

import numpy as np


def small_cholesky(A: np.ndarray) -> np.ndarray:
    """Lower factors of many small matrices, (row, column, point); NaN where one is not positive.

    NumPy's takes the point first, one matrix at a time, and raises for all if one is not positive.
    """
    L = np.zeros_like(A)
    for j in range(len(A)):
        L[j, j] = np.sqrt(A[j, j] - (L[j, :j] ** 2).sum(0))
        for i in range(j + 1, len(A)):
            L[i, j] = (A[i, j] - (L[i, :j] * L[j, :j]).sum(0)) / L[j, j]
    return L


def forward(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """L^-1 b for factors (row, column, point) and vectors (row, point)."""
    x = np.empty_like(b)
    for i in range(len(b)):
        x[i] = (b[i] - (L[i, :i] * x[:i]).sum(0)) / L[i, i]
    return x


def backward(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """L'^-1 b for factors (row, column, point) and vectors (row, point)."""
    x = np.empty_like(b)
    for i in reversed(range(len(b))):
        x[i] = (b[i] - (L[i + 1 :, i] * x[i + 1 :]).sum(0)) / L[i, i]
    return x
