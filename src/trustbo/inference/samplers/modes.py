"""Distinct modes of a posterior: starts of NUTS chains, and checks that these visited them.

Chains that start at different modes and do not meet have a large R-hat. It does not detect a mode
that all chains left in their warm-up: so the mass that a Gaussian fit at each mode holds (Laplace)
is kept, to be compared with the share of the draws around it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from scipy import linalg

from trustbo.inference.samplers.laplace import inverse_hessian, newton

_SAME_MODE, _LEAST_LOG_MASS = 0.5, 5.0  # sd of the fit at a mode, and nats below the largest
LEAST_SHARE = 0.03
"""Lower limit of the mass of a mode that counts."""


class Modes(NamedTuple):
    """Gaussian fits at modes, with a leading axis (mode,), the one of most mass first."""

    mode: Array  # (mode, unknown)
    scale: Array  # (mode, unknown, unknown), Cholesky factors of the covariances
    share: Array  # (mode,), sum 1; 0 for duplicates and modes below the mass limit

    def spread(self, n_chains: int) -> tuple[Array, Array]:
        """Mode and scale for the start of each chain, cycling over modes with positive mass."""
        kept = self.share > 0.0
        places = jnp.argsort(~kept, stable=True)[jnp.arange(n_chains) % kept.sum()]
        return self.mode[places], self.scale[places]


def find_modes(
    profile: Callable[[Array], Array],
    log_density: Callable[[Array], Array],
    starts: Array,
    longest: Array,
) -> Modes:
    """Modes found from many starts.

    Args:
        profile: Cost whose local minima are found.
        log_density: Log density, whose value at a mode goes into its mass.
        starts: Shape (start, unknown).
        longest: Longest step in each unknown, (unknown,). Those where it is finite stay at first,
            until the others are at their best: else the search may leave for another mode.
    """

    def search(start: Array) -> tuple[Array, Array, Array]:
        def phase(z: Array, held: Array) -> tuple[Array, Array]:
            return newton(lambda x: profile(jnp.where(held, z, x)), z, longest)

        held = jnp.isfinite(longest)
        mode, hessians = lax.scan(phase, start, jnp.stack([held, jnp.zeros_like(held)]))
        scale = jnp.linalg.cholesky(inverse_hessian(jnp, hessians[1], 0.1))
        return mode, scale, log_density(mode) + jnp.log(jnp.diagonal(scale)).sum()

    mode, scale, log_mass = lax.map(search, starts)
    log_mass = jnp.where(jnp.isnan(log_mass), -jnp.inf, log_mass)
    order = jnp.argsort(-log_mass)
    mode, scale, log_mass = mode[order], scale[order], log_mass[order]
    gaps = mode[:, None] - mode[None]  # (other, start, unknown)
    white = jax.vmap(lambda L, gap: solve_triangular(L, gap.T, lower=True))(scale, gaps)
    near = jnp.abs(white).max(1) < _SAME_MODE
    again = jnp.triu(near, 1).any(0)  # as a heavier one
    light = log_mass < log_mass[0] - _LEAST_LOG_MASS
    mass = jnp.where(again | light, 0.0, jnp.exp(log_mass - log_mass[0])).at[0].set(1.0)
    return Modes(mode, scale, mass / mass.sum())


def visits(modes: Modes, draws: np.ndarray) -> dict[int, np.ndarray]:
    """Mask of the draws around each mode above the mass limit, by the mode's index.

    A draw belongs to the mode with the largest mass times Gaussian density there.

    Args:
        modes: Modes.
        draws: Shape (chain, draw, unknown).
    """
    kept = np.flatnonzero(np.asarray(modes.share) > LEAST_SHARE)
    fits = []
    for i in kept:
        scale, off = np.asarray(modes.scale[i]), draws - np.asarray(modes.mode[i])
        white = linalg.solve_triangular(scale, off.reshape(-1, len(scale)).T, lower=True)
        log_mass = np.log(modes.share[i]) - np.log(np.diag(scale)).sum()
        fits.append(log_mass - 0.5 * (white**2).sum(0))
    nearest = np.argmax(fits, axis=0).reshape(draws.shape[:-1])
    return {int(i): nearest == row for row, i in enumerate(kept)}
