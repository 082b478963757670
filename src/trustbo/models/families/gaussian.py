"""Gaussian rates, the paper's equation (4): y = x + v."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy import ndarray
from numpy.random import Generator
from scipy.stats import norm

from trustbo.models.families.family import Family, Moments, log_normal


@dataclass(frozen=True)
class Gaussian(Family):
    """Rates that are trust plus normal noise."""

    name: ClassVar[str] = "gaussian"
    gaussian: ClassVar[bool] = True

    def sample(self, trust: ndarray, delta_v: ndarray, n_ticks: ndarray, rng: Generator) -> ndarray:
        """See `Family.sample`: rates may leave [0, 1]."""
        return trust + delta_v * rng.standard_normal(np.broadcast(trust, delta_v, n_ticks).shape)

    def log_prob(self, y: Any, n_ticks: Any, trust: Any, delta_v: Any) -> Any:
        """See `Family.log_prob`."""
        return log_normal(y - trust, delta_v**2)

    def match(
        self, y: ndarray, n_ticks: ndarray, m: ndarray, v: ndarray, delta_v: ndarray
    ) -> Moments:
        """See `Family.match`."""
        seen, total = ~np.isnan(y), v + delta_v**2
        off = np.where(seen, y - m, 0.0)
        var = np.where(seen, v - v**2 / total, v)
        return np.where(seen, log_normal(off, total), 0.0), m + v / total * off, var

    def draw(
        self,
        y: ndarray,
        n_ticks: ndarray,
        m: ndarray,
        v: ndarray,
        delta_v: ndarray,
        rng: Generator,
    ) -> tuple[ndarray, ndarray]:
        """See `Family.draw`: exact."""
        log_p, mean, var = self.match(y, n_ticks, m, v, delta_v)
        return mean + np.sqrt(var) * rng.standard_normal(mean.shape), log_p

    def probabilities(
        self, trust: ndarray, noise_sd: ndarray, y: ndarray, n_ticks: ndarray
    ) -> tuple[ndarray, ndarray]:
        """See `Family.probabilities`."""
        p = norm.cdf((y - trust) / noise_sd)
        return p, p

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`."""
        return trust, np.ones(trust.shape), np.broadcast_to(noise_sd**2, trust.shape)

    def is_density(self, y: ndarray) -> ndarray:
        """See `Family.is_density`: every rate has a density."""
        return np.ones(y.shape, dtype=bool)
