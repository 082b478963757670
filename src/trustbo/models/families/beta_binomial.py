"""Tick counts n ~ BetaBinomial(N, sigma(x)) out of N ticks, with concentration delta_v^-2.

Trust is a logit. Any two ticks of a bound have the correlation delta_v^2 / (1 + delta_v^2).
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpyro.distributions as dist
from numpy.random import Generator
from scipy import special

from trustbo.models.backend import own_flags, special_functions
from trustbo.models.families.family import Array, Drawn, Family, Moments, Near
from trustbo.models.families.moments import draw_by_strata, match_by_nodes
from trustbo.statespace.matrices import namespace

_LEAST = 1e-12  # smallest parameter of a beta distribution that draws are taken from
_LEAST_VARIANCE = 1e-6  # limits the concentration


@dataclass(frozen=True)
class BetaBinomial(Family):
    """Number of ticks in contact out of all ticks of a bound."""

    name: ClassVar[str] = "beta_binomial"
    needs_ticks: ClassVar[bool] = True
    adds_noise: ClassVar[bool] = False
    expected_rate: ClassVar[str] = "logistic"
    line_of_sight: ClassVar[tuple[float, float]] = 5.0, 0.5  # rate 0.5 at sight 0.5, 0.92 at 1

    def priors(self) -> dict[str, Any]:
        """See `Family.priors`; wider than the defaults because trust is a logit."""
        with own_flags():
            return {
                "beta": dist.Normal(0.0, 2.0),
                "b": dist.Normal(0.0, 1.0),
                "delta_w": dist.HalfNormal(0.5),
                "x0_mean": 0.0,
                "x0_sd": 1.5,
            }

    def sample(self, trust: Array, sd: Array, N: Array, rng: Generator) -> Array:
        """See `Family.sample`."""
        phi = _concentration(sd)
        p = special.expit(trust)
        N = np.where(N > 0.0, N, np.nan)
        a, b, N = np.broadcast_arrays(phi * p, phi * (1.0 - p), N)

        share = rng.beta(np.maximum(a, _LEAST), np.maximum(b, _LEAST))
        counted = np.where(np.isnan(N), 0.0, N).astype(int)
        return rng.binomial(counted, share) / N

    def log_prob(self, y: Array, N: Array, trust: Array, sd: Array) -> Array:
        """See `Family.log_prob`."""
        phi = _concentration(sd)
        return self._constant(y, N, trust, phi) + self._of_trust(y, N, trust, phi)

    def _constant(self, y: Array, N: Array, trust: Array, phi: Array) -> Array:
        """Compute the terms of the log probability that do not depend on trust."""
        log_gamma = special_functions(trust).gammaln
        n = namespace(trust).round(y * N)
        choose = log_gamma(N + 1.0) - log_gamma(n + 1.0) - log_gamma(N - n + 1.0)
        return choose + log_gamma(phi) - log_gamma(phi + N)

    def _of_trust(self, y: Array, N: Array, trust: Array, phi: Array) -> Array:
        """Compute the terms of the log probability that depend on trust."""
        library = special_functions(trust)
        log_gamma = library.gammaln
        n = namespace(trust).round(y * N)
        a = phi * library.expit(trust)
        b = phi * library.expit(-trust)
        return log_gamma(n + a) - log_gamma(a) + log_gamma(N - n + b) - log_gamma(b)

    def _match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        """See `Family._match`; uses Gauss-Hermite quadrature around the mode."""
        # The search for the mode starts from the empirical logit, combined with the prior.
        n = np.round(y * N)
        lam = 1.0 / (1.0 / (n + 0.5) + 1.0 / (N - n + 0.5) + 0.2)
        start = (m / v + lam * np.log((n + 0.5) / (N - n + 0.5))) / (1.0 / v + lam)

        constant = self._constant(y, N, start, _concentration(sd))
        y = y[..., None]
        N = N[..., None]
        phi = _concentration(sd)[..., None]
        log_mass, mean, var = match_by_nodes(lambda f: self._of_trust(y, N, f, phi), start, m, v)
        return log_mass + constant, mean, var

    def _draw(
        self, y: Array, N: Array, m: Array, v: Array, sd: Array, rng: Generator, near: Near
    ) -> Drawn:
        """See `Family._draw`; chooses from stratified draws of a normal distribution."""
        phi = _concentration(sd)
        center, var = self._match(y, N, m, v, sd)[1:] if near is None else near
        constant = self._constant(y, N, m, phi)
        y, N, phi = (a[..., None] for a in (y, N, phi))

        f, log_weight = draw_by_strata(
            lambda f: self._of_trust(y, N, f, phi), m, v, center, var, rng
        )
        return f, log_weight + constant

    def mean_rate(self, trust: Array, sd: Array) -> Array:
        """See `Family.mean_rate`."""
        return special.expit(trust)


def _concentration(sd: Any) -> Any:
    """Return the concentration of the beta distribution, limited to 1e6 (nearly binomial)."""
    return 1.0 / (sd**2 + _LEAST_VARIANCE)
