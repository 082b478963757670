"""Censored (Tobit) rates: trust plus noise, clipped to [0, 1]."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.random import Generator
from scipy.stats import norm

from trustbo.models.backend import special_functions
from trustbo.models.families.family import Array, Drawn, Moments, Near
from trustbo.models.families.gaussian import Gaussian
from trustbo.models.families.moments import draw_between, match_interval
from trustbo.statespace.matrices import namespace


@dataclass(frozen=True)
class Censored(Gaussian):
    """Gaussian rates censored at 0 and 1."""

    name: ClassVar[str] = "censored"
    gaussian: ClassVar[bool] = False
    expected_rate: ClassVar[str] = "clipped"

    def sample(self, trust: Array, sd: Array, N: Array, rng: Generator) -> Array:
        """See `Family.sample`."""
        return np.clip(super().sample(trust, sd, N, rng), 0.0, 1.0)

    def log_prob(self, y: Array, N: Array, trust: Array, sd: Array) -> Array:
        """See `Family.log_prob`."""
        xp = namespace(trust)
        log_ndtr = special_functions(trust).log_ndtr
        inside = super().log_prob(y, N, trust, sd)
        beyond = xp.where(y >= 1.0, log_ndtr((trust - 1.0) / sd), inside)
        return xp.where(y <= 0.0, log_ndtr(-trust / sd), beyond)

    def _match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        """See `Family._match`; a rate of 0 or 1 only limits the unclipped rate (Tobin 1958)."""
        cut, low, high = _limits(y)
        return np.where(cut, match_interval(low, high, m, v, sd), super()._match(y, N, m, v, sd))

    def _draw(
        self, y: Array, N: Array, m: Array, v: Array, sd: Array, rng: Generator, near: Near
    ) -> Drawn:
        """Draw the rate before clipping, then the predictor given this rate, both exactly."""
        cut, low, high = _limits(y)
        total = np.sqrt(v + sd**2)
        e = draw_between((low - m) / total, (high - m) / total, rng)
        f, _ = super()._draw(np.where(cut, m + total * e, y), N, m, v, sd, rng, near)
        return f, self._match(y, N, m, v, sd)[0]

    @np.errstate(under="ignore")  # small weights and tails round to 0
    def mean_rate(self, trust: Array, sd: Array) -> Array:
        """See `Family.mean_rate`; the mean of a normal variable clipped to [0, 1]."""
        low = -trust / sd
        high = (1.0 - trust) / sd
        inside = trust * (norm.cdf(high) - norm.cdf(low))
        return inside + sd * (norm.pdf(low) - norm.pdf(high)) + norm.sf(high)

    def is_density(self, y: Array) -> Array:
        """See `Family.is_density`; rates of 0 and 1 have a probability instead."""
        return (y > 0.0) & (y < 1.0)


def _limits(y: Array) -> tuple[Array, Array, Array]:
    """Return whether each rate is 0 or 1, and the interval of the rate before clipping."""
    is_one = y >= 1.0
    low = np.where(is_one, 1.0, -np.inf)
    high = np.where(is_one, np.inf, 0.0)
    return is_one | (y <= 0.0), low, high
