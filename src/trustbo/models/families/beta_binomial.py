"""Counts of ticks: n in contact out of N, n ~ BetaBinomial(N, sigma(x)), concentration delta_v^-2.

Trust is a logit. The ticks of a bound are not independent: delta_v^2 is the ratio of the excess to
the binomial variance.

Around a linearisation point the log probability is a parabola: Gaussian rates with a variance each.
Trust is drawn from the smoother of these rates as a function of the innovations, and weighted by
the ratio of the two likelihoods, so the result is exact for any point (importance sampling from the
Laplace approximation of a state space; Durbin and Koopman 1997).
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import Array, lax, random
from jax.scipy.special import gammaln
from numpy import ndarray
from numpy.random import Generator
from scipy.special import expit
from scipy.stats import betabinom

from trustbo.models.backend import own_settings
from trustbo.models.families.family import SSM, Family, Moments, Observed
from trustbo.models.families.terms import COUNT, NONE, Terms, count_moments
from trustbo.models.state_space.scalar import Filtered, log_normal

Data = tuple[Array, Array]
_N_TICKS = 200.0  # of future missions, whose number of ticks is unknown
_N_STEPS = 6  # passes of the smoother after which the linearisation point moves no more


@dataclass(frozen=True)
class BetaBinomial(Family):
    """Ticks in contact out of all ticks of a bound."""

    name: ClassVar[str] = "beta_binomial"
    needs_ticks: ClassVar[bool] = True
    rounds: ClassVar[bool] = False
    correlates: ClassVar[bool] = False
    observes_trust: ClassVar[bool] = True
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

    def log_density(self, ssm: SSM, observed: Observed, e: Array, complete: bool = False) -> Array:
        """See `Family.log_density`; each rate has a separate variance, complete or not."""
        approximate, filtered = _approximate(ssm, observed)
        trust = approximate.sample_backward(filtered, e)
        R = approximate.rate_variance
        gap = _log_prob(ssm, _counts(observed), trust) - log_normal(filtered.y - trust, R)
        return ssm.per_sequence(filtered.log_likelihood + jnp.where(filtered.seen > 0.0, gap, 0.0))

    def refine(self, ssm: SSM, observed: Observed) -> Observed:
        """Move the linearisation point to the most likely trust (Laplace, by smoothing)."""

        def step(_, trust: Array) -> Array:
            approximate, filtered = _approximate(ssm, observed._replace(linearisation=trust))
            return approximate.smooth(filtered).mean

        point = lax.fori_loop(0, _N_STEPS, step, _empirical_logits(observed))
        return observed._replace(linearisation=point)

    def measure(self, key: Array, ssm: SSM, trust: Array, y: Array, n_ticks: Array) -> Array:
        """See `Family.measure`."""
        key_p, key_n = random.split(key)
        phi = _concentration(ssm)
        p = random.beta(key_p, phi * jax.nn.sigmoid(trust), phi * jax.nn.sigmoid(-trust))
        N = lax.stop_gradient(jnp.where(n_ticks > 0.0, n_ticks, jnp.nan))
        return random.binomial(key_n, jnp.where(jnp.isnan(N), 0.0, N), p).astype(p.dtype) / N

    def rate_moments(self, trust: ndarray, noise_sd: ndarray) -> Moments:
        """See `Family.rate_moments`."""
        p, N = expit(trust), _N_TICKS
        excess = 1.0 / (1.0 + 1.0 / (noise_sd**2 + 1e-6))  # correlation of two ticks of a bound
        return p, p * (1.0 - p), p * (1.0 - p) * (1.0 + (N - 1.0) * excess) / N

    def draw_rates(
        self, rng: Generator, trust: ndarray, y: ndarray, noise_sd: ndarray, n_ticks: ndarray
    ) -> ndarray:
        """See `Family.draw_rates`."""
        phi = 1.0 / (noise_sd**2 + 1e-6)
        p = rng.beta(phi * expit(trust), phi * expit(-trust))
        N = np.where(n_ticks > 0.0, n_ticks, np.nan)
        return rng.binomial(np.where(np.isnan(N), 0.0, N).astype(int), p) / N

    def observe(
        self, mean: ndarray, var: ndarray, y: ndarray, n_ticks: ndarray, noise_sd: ndarray
    ) -> Moments:
        """See `Family.observe`; by Gauss-Hermite nodes around the mode."""
        args = np.broadcast_arrays(mean, var, y, n_ticks, noise_sd)
        shape = args[0].shape
        flat = (np.array(a, dtype=float).ravel() for a in args)  # a broadcast one cannot be written
        moments = count_moments(*flat)
        return moments[0].reshape(shape), moments[1].reshape(shape), moments[2].reshape(shape)

    def probabilities(
        self, trust: np.ndarray, noise_sd: np.ndarray, y: np.ndarray, n_ticks: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Family.probabilities`."""
        phi, n = 1.0 / (noise_sd**2 + 1e-6), np.round(y * n_ticks)
        counts = betabinom(n_ticks.astype(int), phi * expit(trust), phi * expit(-trust))
        return counts.cdf(n - 1.0), counts.cdf(n)

    def terms(self, y: np.ndarray, n_ticks: np.ndarray) -> Terms:
        """See `Family.terms`; each distinct count is a case."""
        seen = ~np.isnan(y) & (n_ticks > 0.0)
        N = np.where(seen, n_ticks, 1.0)
        n = np.where(seen, np.round(np.where(seen, y, 0.0) * N), 0.0)
        # An empirical logit and its variance, that of trust at one bound of typical noise added.
        lam = np.where(seen, 1.0 / (1.0 / (n + 0.5) + 1.0 / (N - n + 0.5) + 0.2), 0.0)
        counts, case = np.unique(np.stack([n, N], -1).reshape(-1, 2), axis=0, return_inverse=True)
        kind = np.where(seen, COUNT, NONE)
        return Terms.of(
            kind, lam, lam * np.log((n + 0.5) / (N - n + 0.5)), case.reshape(y.shape), counts
        )

    def is_density(self, y: np.ndarray) -> np.ndarray:
        """See `Family.is_density`: counts have probabilities."""
        return np.zeros(y.shape, dtype=bool)


def _concentration(ssm: SSM) -> Array:
    """Concentration of the beta distribution, shape (1, 1, robot or 1).

    At most 1e6, where counts are binomial for all purposes and log-gamma still has digits to give.
    """
    return 1.0 / (jnp.reshape(ssm.rate_variance, (1, 1, -1)) + 1e-6)


def _counts(observed: Observed) -> Data:
    """Ticks in contact, and ticks; both 0 where not measured."""
    measured = ~jnp.isnan(observed.y) & (observed.n_ticks > 0.0)
    N = jnp.where(measured, observed.n_ticks, 0.0)
    return jnp.where(measured, jnp.round(observed.y * N), 0.0), N


def _empirical_logits(observed: Observed) -> Array:
    """Trust equivalent of each rate alone, finite where not measured too."""
    n, N = _counts(observed)
    return jnp.log((n + 0.5) / (N - n + 0.5))


def _approximate(ssm: SSM, observed: Observed) -> tuple[SSM, Filtered]:
    """The state space with Gaussian rates in place of counts, and their filter."""
    data, point = _counts(observed), observed.linearisation
    point = _empirical_logits(observed) if point is None else point
    slope, curvature = _derivatives(ssm, data, point)
    var = 1.0 / jnp.maximum(-curvature, 1e-3)
    y = point + jnp.clip(var * slope, -3.0, 3.0)
    approximate = ssm.with_rate_variance(var)
    return approximate, approximate.filter(jnp.where(data[1] > 0.0, y, jnp.nan))


def _log_prob(ssm: SSM, data: Data, trust: Array) -> Array:
    """Log probability of each count given trust; any finite number where not measured."""
    (n, N), phi = data, _concentration(ssm)
    a, b = phi * jax.nn.sigmoid(trust), phi * jax.nn.sigmoid(-trust)
    choose = gammaln(N + 1.0) - gammaln(n + 1.0) - gammaln(N - n + 1.0)
    total = gammaln(N + phi) - gammaln(phi)
    return choose + gammaln(n + a) - gammaln(a) + gammaln(N - n + b) - gammaln(b) - total


def _derivatives(ssm: SSM, data: Data, trust: Array) -> tuple[Array, Array]:
    """First and second derivative of `_log_prob` in trust, approximately.

    digamma(n + a) - digamma(a) is a sum of 1 / (a + j): its first term, and the midpoint rule for
    the others. Special functions would take ten times as long.
    """
    (n, N), phi = data, _concentration(ssm)
    p = jax.nn.sigmoid(trust)

    def sums(n: Array, a: Array) -> tuple[Array, Array]:
        n, some = jnp.maximum(n, 1.0), jnp.where(n > 0.0, 1.0, 0.0)
        first = jnp.log((n + a - 0.5) / (a + 0.5)) + 1.0 / a
        second = 1.0 / (a + 0.5) - 1.0 / (n + a - 0.5) + 1.0 / a**2
        return some * first, some * second

    A, A2 = sums(n, phi * p)
    B, B2 = sums(N - n, phi * (1.0 - p))
    rate = p * (1.0 - p) * phi
    slope = rate * (A - B)
    return slope, (1.0 - 2.0 * p) * slope - rate**2 * (A2 + B2)
