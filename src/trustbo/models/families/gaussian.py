"""Gaussian rates, the paper's equation (4): y = x + v, latent trust integrated out exactly."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jax import Array
from numpy import ndarray
from numpy.random import Generator
from scipy.stats import norm

from trustbo.models.families.family import SSM, Family, Moments, Observed
from trustbo.models.families.terms import GAUSSIAN, NONE, Terms


@dataclass(frozen=True)
class Gaussian(Family):
    """Rates that are trust plus normal noise."""

    name: ClassVar[str] = "gaussian"
    integrates_out: ClassVar[bool] = True
    log_constant: ClassVar[float] = -0.5 * math.log(2.0 * math.pi)

    def log_density(self, ssm: SSM, observed: Observed, e: Array, complete: bool = False) -> Array:
        """See `Family.log_density`; innovations are not read."""
        return ssm.log_likelihood(observed.y, complete=complete)

    def measure(self, key: Array, ssm: SSM, trust: Array, y: Array, n_ticks: Array) -> Array:
        """See `Family.measure`: `y` unclipped, which may leave [0, 1]."""
        return y

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`."""
        return trust, np.ones(trust.shape), np.broadcast_to(noise_sd**2, trust.shape)

    def draw_rates(
        self, rng: Generator, trust: ndarray, y: ndarray, noise_sd: ndarray, n_ticks: ndarray
    ) -> ndarray:
        """See `Family.draw_rates`."""
        return y

    def observe(
        self, mean: ndarray, var: ndarray, y: ndarray, n_ticks: ndarray, noise_sd: ndarray
    ) -> Moments:
        """See `Family.observe`; the density without its constant."""
        value = np.broadcast_to(y, mean.shape)
        return value, np.zeros(mean.shape), -0.5 * ((y - mean) ** 2 / var + np.log(var))

    def probabilities(
        self, trust: np.ndarray, noise_sd: np.ndarray, y: np.ndarray, n_ticks: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Family.probabilities`."""
        p = norm.cdf((y - trust) / noise_sd)
        return p, p

    def terms(self, y: np.ndarray, n_ticks: np.ndarray) -> Terms:
        """See `Family.terms`."""
        return Terms.of(np.where(np.isnan(y), NONE, GAUSSIAN))

    def is_density(self, y: np.ndarray) -> np.ndarray:
        """See `Family.is_density`: every rate has a density."""
        return np.ones(y.shape, dtype=bool)
