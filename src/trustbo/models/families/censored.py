"""Censored rates (Tobit): y = x + v clipped to [0, 1], so rates of 0 and 1 are only limits."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np
from numpy import ndarray
from numpy.random import Generator
from scipy import special
from scipy.stats import norm

from trustbo.models.backend import namespace
from trustbo.models.families.family import Moments, draw_between, match_interval
from trustbo.models.families.gaussian import Gaussian


@dataclass(frozen=True)
class Censored(Gaussian):
    """Gaussian rates censored at 0 and 1."""

    name: ClassVar[str] = "censored"
    gaussian: ClassVar[bool] = False
    expected_rate: ClassVar[str] = "clipped"

    def sample(self, trust: ndarray, delta_v: ndarray, n_ticks: ndarray, rng: Generator) -> ndarray:
        """See `Family.sample`."""
        return np.clip(super().sample(trust, delta_v, n_ticks, rng), 0.0, 1.0)

    def log_prob(self, y: Any, n_ticks: Any, trust: Any, delta_v: Any) -> Any:
        """See `Family.log_prob`."""
        xp = namespace(trust)
        log_ndtr = special.log_ndtr if xp is np else jax.scipy.special.log_ndtr
        inside = super().log_prob(y, n_ticks, trust, delta_v)
        beyond = xp.where(y >= 1.0, log_ndtr((trust - 1.0) / delta_v), inside)
        return xp.where(y <= 0.0, log_ndtr(-trust / delta_v), beyond)

    def match(
        self, y: ndarray, n_ticks: ndarray, m: ndarray, v: ndarray, delta_v: ndarray
    ) -> Moments:
        """See `Family.match`: of a normal censored at a limit (Tobin 1958)."""
        inside, (cut, low, high) = super().match(y, n_ticks, m, v, delta_v), _limits(y)
        beyond = match_interval(low, high, m, v, delta_v)
        one, mean, var = (np.where(cut, b, i) for b, i in zip(beyond, inside, strict=True))
        return one, mean, var

    def draw(
        self,
        y: ndarray,
        n_ticks: ndarray,
        m: ndarray,
        v: ndarray,
        delta_v: ndarray,
        rng: Generator,
    ) -> tuple[ndarray, ndarray]:
        """See `Family.draw`: the rate before clipping, then the signal given it; exact."""
        (cut, low, high), sd = _limits(y), np.sqrt(v + delta_v**2)
        e = draw_between((low - m) / sd, (high - m) / sd, rng)
        uncut = np.where(cut, m + sd * e, y)
        f, _ = super().draw(uncut, n_ticks, m, v, delta_v, rng)
        return f, self.match(y, n_ticks, m, v, delta_v)[0]

    def probabilities(
        self, trust: ndarray, noise_sd: ndarray, y: ndarray, n_ticks: ndarray
    ) -> tuple[ndarray, ndarray]:
        """See `Family.probabilities`."""
        p, _ = super().probabilities(trust, noise_sd, np.clip(y, 0.0, 1.0), n_ticks)
        return np.where(y <= 0.0, 0.0, p), np.where(y >= 1.0, 1.0, p)

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`: of a normal variable clipped to [0, 1]."""
        low, high = -trust / noise_sd, (1.0 - trust) / noise_sd
        inside = norm.cdf(high) - norm.cdf(low)
        first = norm.pdf(low) - norm.pdf(high)
        second = inside + low * norm.pdf(low) - high * norm.pdf(high)
        above = norm.sf(high)
        mean = trust * inside + noise_sd * first + above
        square = trust**2 * inside + 2.0 * trust * noise_sd * first + noise_sd**2 * second + above
        return mean, inside, np.maximum(square - mean**2, 1e-12)

    def is_density(self, y: ndarray) -> ndarray:
        """See `Family.is_density`: rates of 0 and 1 have a probability."""
        return (y > 0.0) & (y < 1.0)


def _limits(y: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Whether a rate is a limit, and what the rate before clipping lay between."""
    one = y >= 1.0
    return one | (y <= 0.0), np.where(one, 1.0, -np.inf), np.where(one, np.inf, 0.0)
