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

    The floor gives a direction without information the width of the priors, not an infinite one.
    """
    eigenvalues, vectors = xp.linalg.eigh(hessian)
    return (vectors / xp.maximum(eigenvalues, floor)[None]) @ vectors.T


def laplace(
    log_density: Density, starts: np.ndarray, n_steps: int = 60
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mode found from each start, all searches in one batch, in NumPy.

    Args:
        log_density: Log density of points (point, axis), shape (point,).
        starts: Shape (start, axis).
        n_steps: Largest number of Newton steps.

    Returns:
        Modes (start, axis), their log densities (start,), and Cholesky factors (start, axis, axis)
        of the inverse negative Hessians there.
    """
    z, value = starts.copy(), log_density(starts)
    active = np.flatnonzero(np.isfinite(value))
    for _ in range(n_steps):
        if not len(active):
            break
        steps = np.zeros_like(z[active])
        for i, (gradient, hessian) in enumerate(
            zip(*derivatives(log_density, z[active]), strict=True)
        ):
            if np.isfinite(hessian).all():  # else it is next to a point of zero density
                steps[i] = newton_direction(np, gradient, -hessian, 1e-3)
        candidates = z[active, None] + 0.5 ** np.arange(12)[:, None] * steps[:, None]
        values = log_density(candidates.reshape(-1, z.shape[1])).reshape(len(active), -1)
        best = values.argmax(1)
        row = np.arange(len(active))
        better = values[row, best] > value[active] + 1e-10
        active, moved = active[better], candidates[row, best][better]
        z[active], value[active] = moved, values[row, best][better]
    hessians = derivatives(log_density, z)[1]
    scales = np.tile(np.eye(z.shape[1]), (len(z), 1, 1))
    for i, hessian in enumerate(hessians):
        if np.isfinite(hessian).all():
            scales[i] = np.linalg.cholesky(inverse_hessian(np, -hessian, 0.05))
    return z, value, scales


def newton(
    potential: Callable[[Array], Array], start: Array, n_steps: int = 60
) -> tuple[Array, Array]:
    """Mode and Hessian of a potential there, in JAX; the ridge shrinks as steps succeed.

    Args:
        potential: Cost of a point.
        start: Shape (axis,).
        n_steps: Largest number of steps; fewer where they promise less than 1e-12 nats.
    """

    def everything(z: Array):
        def with_value(z: Array):
            value, gradient = jax.value_and_grad(potential)(z)
            return gradient, (value, gradient)

        hessian, (value, gradient) = jax.jacfwd(with_value, has_aux=True)(z)
        return value, gradient, hessian

    def step(carry):
        k, z, derivatives, proposal, ridge, _ = carry
        new = everything(proposal)
        # The Hessian may overflow where the value does not: such a step is rejected.
        finite = jnp.isfinite(new[1]).all() & jnp.isfinite(new[2]).all()
        better = finite & (new[0] < derivatives[0])
        z = jnp.where(better, proposal, z)
        derivatives = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, derivatives)
        ridge = jnp.where(better, ridge / 4.0, ridge * 8.0 + 1e-6)
        direction = newton_direction(jnp, derivatives[1], derivatives[2], 1e-6, ridge)
        return k + 1, z, derivatives, z - direction, ridge, derivatives[1] @ direction

    def unfinished(carry):
        return (carry[0] < n_steps) & ~(carry[-1] < 1e-12)

    d = len(start)
    nothing = (jnp.asarray(jnp.inf), jnp.zeros(d), jnp.eye(d))
    carry = (0, start, nothing, start, jnp.asarray(4.0), jnp.asarray(jnp.inf))
    _, z, (_, _, hessian), *_ = lax.while_loop(unfinished, step, carry)
    return z, hessian


def derivatives(
    log_density: Density, z: np.ndarray, h: float = 1e-3
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients and Hessians at points (point, axis) by central differences, in one batch."""
    n, d = z.shape
    steps = h * np.eye(d)
    offsets = [np.zeros(d)]
    offsets += [sign * steps[i] for i in range(d) for sign in (1, -1)]
    pairs = [(i, j) for i in range(d) for j in range(i)]
    offsets += [sign * (steps[i] + steps[j]) for i, j in pairs for sign in (1, -1)]
    f = log_density((z[:, None] + np.array(offsets)).reshape(-1, d)).reshape(n, -1)
    plus, minus = f[:, 1 : 1 + 2 * d : 2], f[:, 2 : 2 + 2 * d : 2]
    with np.errstate(invalid="ignore"):
        gradient = (plus - minus) / (2.0 * h)
        hessian = ((plus - 2.0 * f[:, :1] + minus) / h**2)[:, :, None] * np.eye(d)
        for k, (i, j) in enumerate(pairs):
            both = f[:, 1 + 2 * (d + k)] - 2.0 * f[:, 0] + f[:, 2 + 2 * (d + k)]
            mixed = 0.5 * (both / h**2 - hessian[:, i, i] - hessian[:, j, j])
            hessian[:, i, j] = hessian[:, j, i] = mixed
    return gradient, hessian
