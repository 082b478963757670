"""Families known by their log probability given trust, fitted by a Gaussian where it is likely.

Around a linearisation point the log probability is a parabola: Gaussian rates with a variance each.
Trust is drawn from the smoother of these rates as a function of the innovations, and weighted by
the ratio of the two likelihoods, so the result is exact for any point (importance sampling from the
Laplace approximation of a state space; Durbin and Koopman 1997).
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jax import Array, lax

from trustbo.models.families.family import SSM, Family, Observed
from trustbo.models.state_space.scalar import Filtered, log_normal

Data = tuple[Array, Array]
_N_STEPS = 6
"""Passes of the smoother after which the linearisation point moves no more."""


@dataclass(frozen=True)
class Linearised(Family):
    """A family given by `log_prob` and its two derivatives in trust."""

    linearises: ClassVar[bool] = True

    @abstractmethod
    def log_prob(self, ssm: SSM, data: Data, trust: Array) -> Array:
        """Log probability of each rate given trust; any finite number where not measured."""

    @abstractmethod
    def derivatives(self, ssm: SSM, data: Data, trust: Array) -> tuple[Array, Array]:
        """First and second derivative of `log_prob` in trust, exact or approximate."""

    @abstractmethod
    def start(self, observed: Observed) -> Array:
        """Trust equivalent of each rate alone, finite where not measured too."""

    def read(self, observed: Observed) -> Data:
        """Values of the observations, and their weight or ticks: both 0 where not measured."""
        seen = jnp.where(jnp.isnan(observed.y), 0.0, 1.0)
        return jnp.where(seen > 0.0, observed.y, 0.0), seen

    def log_density(self, ssm: SSM, observed: Observed, e: Array, complete: bool = False) -> Array:
        """See `Family.log_density`; each rate has a separate variance, complete or not."""
        approximate, filtered = self._approximate(ssm, observed)
        trust = approximate.sample_backward(filtered, e)
        data, R = self.read(observed), approximate.rate_variance
        gap = self.log_prob(ssm, data, trust) - log_normal(filtered.y - trust, R)
        return ssm.per_sequence(filtered.log_likelihood + jnp.where(filtered.seen > 0.0, gap, 0.0))

    def draw_trust(self, ssm: SSM, observed: Observed, e: Array, key: Array) -> Array:
        """See `Family.draw_trust`; the innovations determine it."""
        approximate, filtered = self._approximate(ssm, observed)
        return approximate.sample_backward(filtered, e)

    def trust_moments(self, ssm: SSM, observed: Observed, e: Array) -> tuple[Array, Array]:
        """See `Family.trust_moments`; the variance is 0."""
        approximate, filtered = self._approximate(ssm, observed)
        trust = approximate.sample_backward(filtered, e)
        return trust, jnp.zeros_like(trust)

    def refine(self, ssm: SSM, observed: Observed) -> Observed:
        """Move the linearisation point to the most likely trust (Laplace, by smoothing)."""

        def step(_, trust: Array) -> Array:
            approximate, filtered = self._approximate(ssm, observed._replace(linearisation=trust))
            return approximate.smooth(filtered).mean

        point = lax.fori_loop(0, _N_STEPS, step, self.start(observed))
        return observed._replace(linearisation=point)

    def _approximate(self, ssm: SSM, observed: Observed) -> tuple[SSM, Filtered]:
        """The state space with Gaussian rates in place of the family's, and their filter."""
        data = self.read(observed)
        point = self.start(observed) if observed.linearisation is None else observed.linearisation
        slope, curvature = self.derivatives(ssm, data, point)
        var = 1.0 / jnp.maximum(-curvature, 1e-3)
        y = point + jnp.clip(var * slope, -3.0, 3.0)
        approximate = ssm.with_rate_variance(var)
        return approximate, approximate.filter(jnp.where(data[1] > 0.0, y, jnp.nan))
