"""Censored rates (Tobit): y = x + v clipped to [0, 1], so rates of 0 and 1 are only limits.

Trust is Gaussian given the censored rates, which are drawn beyond their limits bound by bound from
the filter's predictions (GHK), as functions of the innovations.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy import ndarray
from numpy.random import Generator
from scipy import special
from scipy.stats import norm

from trustbo.models.families.family import SSM, Moments, Observed
from trustbo.models.families.gaussian import Gaussian
from trustbo.models.families.terms import AT_ONE, AT_ZERO, Terms
from trustbo.models.state_space.scalar import Censoring


@dataclass(frozen=True)
class Censored(Gaussian):
    """Gaussian rates censored at 0 and 1."""

    name: ClassVar[str] = "censored"
    integrates_out: ClassVar[bool] = False
    expected_rate: ClassVar[str] = "clipped"

    def log_density(self, ssm: SSM, observed: Observed, e: Array, complete: bool = False) -> Array:
        """See `Family.log_density`."""
        side = jnp.where(observed.y >= 1.0, 1.0, jnp.where(observed.y <= 0.0, -1.0, 0.0))
        filtered = ssm.filter(observed.y, complete=complete, censoring=Censoring(side, e))
        return ssm.per_sequence(filtered.log_likelihood)

    def measure(self, key: Array, ssm: SSM, trust: Array, y: Array, n_ticks: Array) -> Array:
        """See `Family.measure`: `y` clipped to [0, 1]."""
        return jnp.clip(y, 0.0, 1.0)

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`: of a normal variable clipped to [0, 1] (Tobin 1958)."""
        low, high = -trust / noise_sd, (1.0 - trust) / noise_sd
        inside = norm.cdf(high) - norm.cdf(low)
        first = norm.pdf(low) - norm.pdf(high)
        second = inside + low * norm.pdf(low) - high * norm.pdf(high)
        above = norm.sf(high)
        mean = trust * inside + noise_sd * first + above
        square = trust**2 * inside + 2.0 * trust * noise_sd * first + noise_sd**2 * second + above
        return mean, inside, np.maximum(square - mean**2, 1e-12)

    def draw_rates(
        self, rng: Generator, trust: ndarray, y: ndarray, noise_sd: ndarray, n_ticks: ndarray
    ) -> ndarray:
        """See `Family.draw_rates`."""
        return np.clip(y, 0.0, 1.0)

    def observe(
        self, mean: ndarray, var: ndarray, y: ndarray, n_ticks: ndarray, noise_sd: ndarray
    ) -> Moments:
        """See `Family.observe`: of a normal censored at a limit (Tobin 1958)."""
        value, zero, density = super().observe(mean, var, y, n_ticks, noise_sd)
        at_one, cut, S = y >= 1.0, (y >= 1.0) | (y <= 0.0), np.sqrt(var)
        side, limit = np.where(at_one, 1.0, -1.0), np.where(at_one, 1.0, 0.0)
        h = side * (mean - limit) / S
        log_p = special.log_ndtr(h)
        ratio = np.exp(-0.5 * h**2 - 0.5 * np.log(2.0 * np.pi) - log_p)
        left = np.clip(1.0 - ratio * (ratio + h), 0.0, 1.0)
        # On the scale of the densities of the others, which lack their constant.
        log_p = log_p + 0.5 * np.log(2.0 * np.pi)
        return (
            np.where(cut, mean + side * S * ratio, value),
            np.where(cut, var * left, zero),
            np.where(cut, log_p, density),
        )

    def probabilities(
        self, trust: np.ndarray, noise_sd: np.ndarray, y: np.ndarray, n_ticks: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Family.probabilities`."""
        p, _ = super().probabilities(trust, noise_sd, np.clip(y, 0.0, 1.0), n_ticks)
        return np.where(y <= 0.0, 0.0, p), np.where(y >= 1.0, 1.0, p)

    def terms(self, y: np.ndarray, n_ticks: np.ndarray) -> Terms:
        """See `Family.terms`."""
        inside = super().terms(y, n_ticks).kind
        kind = np.where(y >= 1.0, AT_ONE, np.where(y <= 0.0, AT_ZERO, inside))
        lam = np.where(kind >= AT_ONE, 10.0, 0.0)
        return Terms.of(kind, lam, lam * np.where(kind == AT_ONE, 1.1, -0.1))

    def is_density(self, y: np.ndarray) -> np.ndarray:
        """See `Family.is_density`: rates of 0 and 1 have a probability."""
        return (y > 0.0) & (y < 1.0)
