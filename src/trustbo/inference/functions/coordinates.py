"""Coordinates in which the variables of a NumPyro function are sampled.

They are the unconstrained values of NumPyro, except for the two noises if these are variables of
the function. Their total and their share replace them, as in `models.scores`: the data determine
the total well, but often not the share, so that the logarithms of both noises lie on a bent ridge.
"""

from collections.abc import Collection, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.special import ndtr, ndtri
from jax.scipy.stats import norm

_RIGHT_ANGLE = 0.5 * np.pi


class Coordinates:
    """Conversion between coordinates (coordinate,) and unconstrained values by name, in JAX.

    Attributes:
        names: Name of the variable of each coordinate.
        deviations: Names of the normal variables whose coordinates are deviations from their means,
            in units of their standard deviations.
        key: What a program that was compiled for these coordinates depends on.
    """

    def __init__(
        self, free: Mapping[str, Any], noises: tuple[str, str] | None, deviations: Collection[str]
    ) -> None:
        """Set the shapes.

        Args:
            free: Arrays of the shape of each variable in unconstrained space.
            noises: Names of the variables whose logarithms are those of delta_w and delta_v, of
                equal shape; None if there are none.
            deviations: See the attribute.
        """
        self.deviations = frozenset(deviations)
        flat, self._unravel = ravel_pytree(dict(free))
        sizes = {name: int(np.prod(np.shape(values))) for name, values in sorted(free.items())}
        self.names = [name for name, n in sizes.items() for _ in range(n)]
        self.key = (tuple((name, np.shape(free[name])) for name in sizes), noises, self.deviations)

        # Places of the logarithms of both noises, of which those of total and share take the place.
        numbers = np.arange(len(flat))
        self._w, self._v = (
            numbers[[name == noise for name in self.names]] for noise in noises or ("", "")
        )

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.names)

    def unconstrained(self, x: Any) -> dict[str, Any]:
        """Convert coordinates (coordinate,) to unconstrained values by name."""
        log_total = x[self._w]
        angle = x[self._v]
        log_w = log_total + jnp.log(jnp.sin(_RIGHT_ANGLE * ndtr(angle)))
        log_v = log_total + jnp.log(jnp.sin(_RIGHT_ANGLE * ndtr(-angle)))
        return self._unravel(x.at[self._w].set(log_w).at[self._v].set(log_v))

    def log_jacobian(self, x: Any) -> Any:
        """Compute the log volume of unconstrained values per volume of coordinates (coordinate,).

        It is that of log(w / v) = log tan(pi / 2 Phi(angle)) per angle.
        """
        angle = x[self._v]
        sine = jnp.sin(_RIGHT_ANGLE * ndtr(angle))
        cosine = jnp.sin(_RIGHT_ANGLE * ndtr(-angle))
        return (np.log(_RIGHT_ANGLE) + norm.logpdf(angle) - jnp.log(sine) - jnp.log(cosine)).sum()

    def of(self, free: Mapping[str, Any]) -> Any:
        """Convert unconstrained values by name to coordinates (coordinate,)."""
        x = ravel_pytree(dict(free))[0]
        log_w = x[self._w]
        log_v = x[self._v]
        log_total = 0.5 * jnp.logaddexp(2.0 * log_w, 2.0 * log_v)
        angle = ndtri(jnp.arctan(jnp.exp(log_w - log_v)) / _RIGHT_ANGLE)
        return x.at[self._w].set(log_total).at[self._v].set(angle)
