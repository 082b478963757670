"""Gaussian rates, the paper's equation (4): y = x + v."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.random import Generator

from trustbo.models.families.family import Array, Drawn, Family, Moments, Near
from trustbo.models.families.moments import log_normal
from trustbo.statespace.kalman import gaussian_match


@dataclass(frozen=True)
class Gaussian(Family):
    """Rates that are trust plus normal noise."""

    name: ClassVar[str] = "gaussian"
    gaussian: ClassVar[bool] = True

    def sample(self, trust: Array, sd: Array, N: Array, rng: Generator) -> Array:
        """See `Family.sample`; rates may lie outside [0, 1]."""
        return trust + sd * rng.standard_normal(np.broadcast(trust, sd, N).shape)

    def log_prob(self, y: Array, N: Array, trust: Array, sd: Array) -> Array:
        """See `Family.log_prob`."""
        return log_normal(y - trust, sd**2)

    def _match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        return gaussian_match(y, m, v, sd)

    def _draw(
        self, y: Array, N: Array, m: Array, v: Array, sd: Array, rng: Generator, near: Near
    ) -> Drawn:
        log_p, mean, var = self._match(y, N, m, v, sd)
        return mean + np.sqrt(var) * rng.standard_normal(mean.shape), log_p

    def is_density(self, y: Array) -> Array:
        """See `Family.is_density`; true for every rate."""
        return np.ones(y.shape, dtype=bool)
