"""Mode of a smooth log density, and the Gaussian fit there, for the proposals of both samplers.

Newton's direction and the inverse Hessian are written once, on an array namespace. The searches
around them differ: NumPy's takes derivatives from central differences and 12 step lengths in one
batch, because the exact sampler compiles nothing; JAX's takes them from automatic differentiation
and controls the step by a ridge, in a loop that compiles into the program of NUTS.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

Density = Callable[[np.ndarray], np.ndarray]


def newton_direction(
    xp: ModuleType, gradient: Any, hessian: Any, floor: float, ridge: Any = 0.0
) -> Any:
    """Hessian's absolute value plus a ridge, inverted, times the gradient of a cost.

    Away from the mode the Hessian may be indefinite: its absolute value still gives descent.
    """
    eigenvalues, vectors = xp.linalg.eigh(hessian)
    rotated = vectors.T @ gradient / (xp.maximum(xp.abs(eigenvalues), floor) + ridge)
    return vectors @ rotated


def inverse_hessian(xp: ModuleType, hessian: Any, floor: float) -> Any:
    """Covariance of the Gaussian fit at a mode.

    The floor gives a direction that the data leave open the width of the priors, not an infinite
    one.
    """
    eigenvalues, vectors = xp.linalg.eigh(hessian)
    return (vectors / xp.maximum(eigenvalues, floor)[None]) @ vectors.T


def laplace(
    log_density: Density, start: np.ndarray, n_steps: int = 60
) -> tuple[np.ndarray, np.ndarray]:
    """Mode, and Cholesky factor of the inverse negative Hessian there, in NumPy."""
    z, value = start, float(log_density(start[None])[0])
    for _ in range(n_steps):
        gradient, hessian = _derivatives(log_density, z)
        if not np.isfinite(hessian).all():  # beside a point without density
            break
        step = newton_direction(np, gradient, -hessian, 1e-3)
        candidates = z + np.outer(0.5 ** np.arange(12), step)
        values = log_density(candidates)
        best = int(np.argmax(values))
        if not values[best] > value + 1e-10:
            break
        z, value = candidates[best], float(values[best])
    hessian = _derivatives(log_density, z)[1]
    if not np.isfinite(hessian).all():
        return z, np.eye(len(z))
    return z, np.linalg.cholesky(inverse_hessian(np, -hessian, 0.05))


def newton(
    potential: Callable[[Array], Array], start: Array, n_steps: int = 40
) -> tuple[Array, Array]:
    """Mode and Hessian of a potential there, in JAX; the ridge shrinks as steps succeed."""

    def everything(z: Array):
        def with_value(z: Array):
            value, gradient = jax.value_and_grad(potential)(z)
            return gradient, (value, gradient)

        hessian, (value, gradient) = jax.jacfwd(with_value, has_aux=True)(z)
        return value, gradient, hessian

    def step(_, carry):
        z, at, proposal, ridge = carry
        new = everything(proposal)
        # The Hessian may overflow where the value does not: such a point is not stepped on.
        finite = jnp.isfinite(new[1]).all() & jnp.isfinite(new[2]).all()
        better = finite & (new[0] < at[0])
        z = jnp.where(better, proposal, z)
        at = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, at)
        ridge = jnp.where(better, ridge / 4.0, ridge * 8.0 + 1e-6)
        return z, at, z - newton_direction(jnp, at[1], at[2], 1e-6, ridge), ridge

    d = len(start)
    nothing = (jnp.asarray(jnp.inf), jnp.zeros(d), jnp.eye(d))
    carry = (start, nothing, start, jnp.asarray(4.0))
    z, (_, _, hessian), _, _ = lax.fori_loop(0, n_steps, step, carry)
    return z, hessian


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
