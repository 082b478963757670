"""The mode of a smooth density of few dimensions, and the Gaussian that fits there."""

from collections.abc import Callable

import numpy as np

Density = Callable[[np.ndarray], np.ndarray]


def laplace(
    log_density: Density, start: np.ndarray, n_steps: int = 60
) -> tuple[np.ndarray, np.ndarray]:
    """Mode, and Cholesky factor of the inverse negative Hessian there, by damped Newton steps."""
    z, value = start, float(log_density(start[None])[0])
    for _ in range(n_steps):
        gradient, hessian = _derivatives(log_density, z)
        eigenvalues, vectors = np.linalg.eigh(-hessian)
        step = vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(eigenvalues), 1e-3))
        candidates = z + np.outer(0.5 ** np.arange(12), step)
        values = log_density(candidates)
        best = int(np.nanargmax(values))
        if not values[best] > value + 1e-10:
            break
        z, value = candidates[best], float(values[best])
    eigenvalues, vectors = np.linalg.eigh(-_derivatives(log_density, z)[1])
    # Floor: a direction the data leave open gets the width of the priors, not an infinite one.
    covariance = (vectors / np.maximum(eigenvalues, 0.05)) @ vectors.T
    return z, np.linalg.cholesky(covariance)


def _derivatives(log_density: Density, z: np.ndarray, h: float = 1e-3):
    """Gradient and Hessian by central differences, all points in one batch."""
    d = len(z)
    steps = h * np.eye(d)
    offsets = [np.zeros(d)]
    offsets += [sign * steps[i] for i in range(d) for sign in (1, -1)]
    pairs = [(i, j) for i in range(d) for j in range(i)]
    for i, j in pairs:
        offsets += [a * steps[i] + b * steps[j] for a in (1, -1) for b in (1, -1)]
    f = log_density(z + np.array(offsets))
    plus, minus = f[1 : 1 + 2 * d : 2], f[2 : 2 + 2 * d : 2]
    gradient = (plus - minus) / (2.0 * h)
    hessian = np.diag((plus - 2.0 * f[0] + minus) / h**2)
    for (i, j), four in zip(pairs, f[1 + 2 * d :].reshape(-1, 4), strict=True):
        hessian[i, j] = hessian[j, i] = (four[0] - four[1] - four[2] + four[3]) / (4.0 * h**2)
    return gradient, hessian
