"""Counts of ticks: n in contact out of N, n ~ BetaBinomial(N, sigma(x)), concentration delta_v^-2.

Trust is a logit. The ticks of a bound are not independent: delta_v^2 is the ratio of the excess to
the binomial variance.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np
import numpyro.distributions as dist
from numpy import ndarray
from numpy.random import Generator
from scipy import special
from scipy.stats import betabinom

from trustbo.models.backend import namespace, own_settings
from trustbo.models.families.family import (
    Family,
    Moments,
    draw_between_knots,
    log_normal,
    match_by_nodes,
)

_N_TICKS = 200.0  # of future missions, whose number of ticks is unknown
_KNOTS = np.linspace(-5.0, 5.0, 21)  # of a draw, in sds from the mean


@dataclass(frozen=True)
class BetaBinomial(Family):
    """Ticks in contact out of all ticks of a bound."""

    name: ClassVar[str] = "beta_binomial"
    needs_ticks: ClassVar[bool] = True
    rounds: ClassVar[bool] = False
    correlates: ClassVar[bool] = False
    expected_rate: ClassVar[str] = "logistic"

    @property
    def line_of_sight(self) -> tuple[float, float]:
        """See `Family.line_of_sight`: the logit, a line through it at .5 and at .92."""
        return 5.0, 0.5

    def priors(self) -> dict[str, Any]:
        """See `Family.priors`: trust is a logit, so all are wider."""
        with own_settings():
            return {
                "beta": dist.Normal(0.0, 2.0),
                "b": dist.Normal(0.0, 1.0),
                "delta_w": dist.HalfNormal(0.5),
                "x0_mean": 0.0,
                "x0_sd": 1.5,
            }

    def sample(self, trust: ndarray, delta_v: ndarray, n_ticks: ndarray, rng: Generator) -> ndarray:
        """See `Family.sample`."""
        phi, p = _concentration(delta_v), special.expit(trust)
        N = np.where(n_ticks > 0.0, n_ticks, np.nan)
        a, b, N = np.broadcast_arrays(phi * p, phi * (1.0 - p), N)
        counted = np.where(np.isnan(N), 0.0, N).astype(int)
        return rng.binomial(counted, rng.beta(np.maximum(a, 1e-12), np.maximum(b, 1e-12))) / N

    def log_prob(self, y: Any, n_ticks: Any, trust: Any, delta_v: Any) -> Any:
        """See `Family.log_prob`."""
        xp = namespace(trust)
        library: Any = special if xp is np else jax.scipy.special
        phi, p = _concentration(delta_v), library.expit(trust)
        n, a, b = xp.round(y * n_ticks), phi * p, phi * (1.0 - p)
        choose = -library.betaln(n + 1.0, n_ticks - n + 1.0) - xp.log(n_ticks + 1.0)
        return choose + library.betaln(n + a, n_ticks - n + b) - library.betaln(a, b)

    def match(
        self, y: ndarray, n_ticks: ndarray, m: ndarray, v: ndarray, delta_v: ndarray
    ) -> Moments:
        """See `Family.match`; by Gauss-Hermite nodes around the mode."""
        y, n_ticks, m, v, delta_v = np.broadcast_arrays(y, n_ticks, m, v, delta_v)
        seen = ~np.isnan(y) & (n_ticks > 0.0)
        N, y = np.where(seen, n_ticks, 1.0), np.where(seen, y, 0.0)
        n = np.round(y * N)
        lam = 1.0 / (1.0 / (n + 0.5) + 1.0 / (N - n + 0.5) + 0.2)  # of an empirical logit
        start = (m / v + lam * np.log((n + 0.5) / (N - n + 0.5))) / (1.0 / v + lam)

        def log_prob(node: ndarray) -> ndarray:
            return self.log_prob(y[..., None], N[..., None], node, delta_v[..., None])

        log_p, mean, var = match_by_nodes(log_prob, start, m, v)
        return np.where(seen, log_p, 0.0), np.where(seen, mean, m), np.where(seen, var, v)

    def draw(
        self,
        y: ndarray,
        n_ticks: ndarray,
        m: ndarray,
        v: ndarray,
        delta_v: ndarray,
        rng: Generator,
    ) -> tuple[ndarray, ndarray]:
        """See `Family.draw`: from log-linear pieces of the density between knots."""
        _, mean, var = self.match(y, n_ticks, m, v, delta_v)
        seen = ~np.isnan(y) & (n_ticks > 0.0)
        N, counted = (np.where(seen, a, b)[..., None] for a, b in ((n_ticks, 1.0), (y, 0.0)))
        noise = np.broadcast_to(delta_v, mean.shape)[..., None]
        m, v = (np.broadcast_to(a, mean.shape)[..., None] for a in (m, v))

        def log_density(f: ndarray) -> ndarray:
            term = np.where(seen[..., None], self.log_prob(counted, N, f, noise), 0.0)
            return term + log_normal(f - m, v)

        knots = mean[..., None] + np.sqrt(var)[..., None] * _KNOTS
        f, log_q = draw_between_knots(knots, log_density(knots), rng)
        return f, log_density(f[..., None])[..., 0] - log_q

    def probabilities(
        self, trust: ndarray, noise_sd: ndarray, y: ndarray, n_ticks: ndarray
    ) -> tuple[ndarray, ndarray]:
        """See `Family.probabilities`."""
        phi, n, p = _concentration(noise_sd), np.round(y * n_ticks), special.expit(trust)
        counts = betabinom(n_ticks.astype(int), phi * p, phi * (1.0 - p))
        return counts.cdf(n - 1.0), counts.cdf(n)

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`."""
        mean = special.expit(trust)
        slope, phi = mean * (1.0 - mean), _concentration(noise_sd)
        excess = 1.0 + (_N_TICKS - 1.0) / (phi + 1.0)
        return mean, slope, slope * excess / _N_TICKS


def _concentration(delta_v: Any) -> Any:
    """Concentration of the beta distribution, at most 1e6: counts are then binomial."""
    return 1.0 / (delta_v**2 + 1e-6)
