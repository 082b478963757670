"""Student-t rates: y = x + delta_v t, with 4 degrees of freedom, for logs with outliers.

Method: a rate is Gaussian with variance delta_v^2 / w given its weight w ~ Gamma(2, 2). The
linearisation takes w at its mean given trust, 5 / (4 + e^2) for a standardised error e, as in
iteratively reweighted least squares (Lange, Little and Taylor 1989): an outlier has little weight.
"""

from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array, random
from numpy import ndarray
from numpy.random import Generator
from scipy import special

from trustbo.models.families.family import SSM, Moments, Observed
from trustbo.models.families.linearised import Data, Linearised

NU = 4.0
"""Degrees of freedom: small, for heavy tails, but with a finite variance."""
_WIDER = 0.75  # precision of the Gaussian, for tails that are heavier
_N_NODES = 32
_LOG_NORM = float(
    special.gammaln(0.5 * (NU + 1.0)) - special.gammaln(0.5 * NU) - 0.5 * np.log(NU * np.pi)
)


@dataclass(frozen=True)
class StudentT(Linearised):
    """Rates with heavy tails around trust."""

    name: ClassVar[str] = "student_t"
    allows_change: ClassVar[bool] = False
    correlates: ClassVar[bool] = False
    observes_trust: ClassVar[bool] = True
    propagates: ClassVar[bool] = False

    def log_prob(self, ssm: SSM, data: Data, trust: Array) -> Array:
        """See `Linearised.log_prob`."""
        e2, s2 = _squares(ssm, data, trust)
        return _LOG_NORM - 0.5 * jnp.log(s2) - 0.5 * (NU + 1.0) * jnp.log1p(e2 / (NU * s2))

    def derivatives(self, ssm: SSM, data: Data, trust: Array) -> tuple[Array, Array]:
        """See `Linearised.derivatives`; the second is nearly that of the mean weight."""
        e2, s2 = _squares(ssm, data, trust)
        weight = (NU + 1.0) / (NU * s2 + e2)
        return weight * (data[0] - trust), -_WIDER * weight

    def start(self, observed: Observed) -> Array:
        """See `Linearised.start`: the rates."""
        return self.read(observed)[0]

    def measure(self, key: Array, ssm: SSM, trust: Array, y: Array, n_ticks: Array) -> Array:
        """See `Family.measure`: the Gaussian error over the root of a weight."""
        weight = random.gamma(key, 0.5 * NU, y.shape, y.dtype) / (0.5 * NU)
        return trust + (y - trust) / jnp.sqrt(weight)

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`."""
        var = NU / (NU - 2.0) * noise_sd**2
        return trust, np.ones(trust.shape), np.broadcast_to(var, trust.shape)

    def draw_rates(
        self, rng: Generator, trust: ndarray, y: ndarray, noise_sd: ndarray, n_ticks: ndarray
    ) -> ndarray:
        """See `Family.draw_rates`."""
        return trust + noise_sd * rng.standard_t(NU, trust.shape)

    def observe(
        self, mean: ndarray, var: ndarray, y: ndarray, n_ticks: ndarray, noise_sd: ndarray
    ) -> Moments:
        """See `Family.observe`: a mixture of Gaussian rates, the weights on quadrature nodes."""
        weight, log_p = _nodes()
        mean, var, y, sd = np.broadcast_arrays(mean, var, y, noise_sd)
        S = var[..., None] + sd[..., None] ** 2 / weight
        e = (y - mean)[..., None]
        log_terms = log_p - 0.5 * (e**2 / S + np.log(2.0 * np.pi * S))
        total = np.logaddexp.reduce(log_terms, axis=-1)
        share, gain = np.exp(log_terms - total[..., None]), var[..., None] / S
        center = mean + (share * gain * e).sum(-1)
        spread = (1.0 - gain) * var[..., None] + (
            mean[..., None] + gain * e - center[..., None]
        ) ** 2
        return center, (share * spread).sum(-1), total

    def probabilities(
        self, trust: np.ndarray, noise_sd: np.ndarray, y: np.ndarray, n_ticks: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Family.probabilities`."""
        p = special.stdtr(NU, (y - trust) / noise_sd)
        return p, p

    def is_density(self, y: np.ndarray) -> np.ndarray:
        """See `Family.is_density`: every rate has a density."""
        return np.ones(y.shape, dtype=bool)


def _squares(ssm: SSM, data: Data, trust: Array) -> tuple[Array, Array]:
    """Squared errors, and the squared scale, shape (1, 1, robot or 1)."""
    return (data[0] - trust) ** 2, jnp.reshape(ssm.rate_variance, (1, 1, -1))


@cache
def _nodes() -> tuple[np.ndarray, np.ndarray]:
    """Weights of a rate, Gamma(nu / 2, nu / 2), evenly spaced in the log, and their log masses.

    The trapezoid rule over the whole line converges faster than any power of the step.
    """
    log_weight = np.linspace(-9.0, 2.5, _N_NODES)
    half, step = 0.5 * NU, log_weight[1] - log_weight[0]
    log_density = half * (np.log(half) + log_weight - np.exp(log_weight)) - special.gammaln(half)
    return np.exp(log_weight), log_density + np.log(step)
