"""How a contact rate says something about trust: three families of observations.

`gaussian`: y = x + v, the paper's. `censored`: the same, cut to [0, 1], so that rates of 0 and 1
say only "at least so bad, so good" (Tobit). `beta_binomial`: n ticks in contact out of N, n ~
BetaBinomial(N, sigma(x)), with the concentration delta_v^-2.

In the first, latent trust integrates out. In the others it is sampled with the parameters, as a
smooth function of standard normal noise that already knows the data: of the censored rates, drawn
beyond their limit bound by bound (GHK); of the trust trajectory, drawn from the smoother of a
Gaussian approximation. What the approximation leaves is a weight. So the noise stays close to
standard normal a posteriori, NUTS meets no funnel, and the mean weight over noise is the likelihood
of a mission with its trust integrated out: all three families can be compared.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jax.scipy.special import gammaln

from trustbo.models import dense
from trustbo.models.statespace import Censoring, Filtered, ScalarSSM, log_normal
from trustbo.models.vectorspace import VectorSSM

OBSERVATIONS = ("gaussian", "censored", "beta_binomial")
SSM = ScalarSSM | VectorSSM


class Observed(NamedTuple):
    """What was measured, bound first: axes (bound, mission, robot)."""

    y: Array
    """Contact rates; NaN where not measured."""
    exposure: Array
    """Ticks of the bound; read by the beta-binomial family only."""
    pilot: Array | None = None
    """Trust around which the likelihood of counts is fitted; by default their logits."""


def log_weight(
    observation: str, ssm: SSM, observed: Observed, noise: Array, *, shared: bool
) -> Array:
    """Log density of the rates, latent trust integrated out or, given the noise, weighted.

    Its exponential's mean over standard normal noise is the marginal likelihood.

    Args:
        observation: The family.
        ssm: The state space.
        observed: The rates.
        noise: Standard normal, shape (bound, mission, robot); the Gaussian family ignores it.
        shared: See `ScalarSSM.filter`.

    Returns:
        Nats, shape (mission, robot) where robots are independent, else (mission, 1).
    """
    if observation == "beta_binomial":
        approximate, filtered = _approximate(ssm, observed)
        trust = approximate.sample_backward(filtered, noise)
        n, R = _counts(observed), _variances(approximate)
        gap = _beta_binomial(n, trust, ssm) - log_normal(filtered.y - trust, R)
        terms = filtered.log_likelihood + jnp.where(filtered.seen > 0.0, gap, 0.0)
    elif (
        observation == "gaussian" and shared and isinstance(ssm, VectorSSM) and dense.is_small(ssm)
    ):
        return dense.log_likelihood(ssm, observed.y)
    else:
        terms = _filter(observation, ssm, observed, noise, shared=shared).log_likelihood
    total = terms.sum(0)
    return total if isinstance(ssm, ScalarSSM) else total.sum(1, keepdims=True)


def draw_trust(observation: str, ssm: SSM, observed: Observed, noise: Array, key: Array) -> Array:
    """One joint draw of latent trust, given the noise that was sampled with the parameters."""
    if observation == "beta_binomial":
        approximate, filtered = _approximate(ssm, observed)
        return approximate.sample_backward(filtered, noise)
    filtered = _filter(observation, ssm, observed, noise, shared=False)
    return ssm.sample_backward(filtered, random.normal(key, noise.shape, noise.dtype))


def trust_moments(
    observation: str, ssm: SSM, observed: Observed, noise: Array
) -> tuple[Array, Array]:
    """Mean and variance of latent trust given parameters and noise, (bound, mission, robot)."""
    if observation == "beta_binomial":
        trust = draw_trust(observation, ssm, observed, noise, random.key(0))
        return trust, jnp.zeros_like(trust)
    return ssm.smooth(_filter(observation, ssm, observed, noise, shared=False))


def simulate(observation: str, ssm: SSM, exposure: Array, key: Array) -> tuple[Array, Array]:
    """Latent trust and contact rates drawn from the model, each (bound, mission, robot)."""
    key_trust, key_rate = random.split(key)
    trust, y = ssm.simulate(key_trust)
    if observation == "censored":
        y = jnp.clip(y, 0.0, 1.0)
    if observation == "beta_binomial":
        y = _draw_beta_binomial(key_rate, trust, ssm, exposure)
    return trust, y


def marginal_log_likelihood(
    observation: str, ssm: SSM, observed: Observed, key: Array, n_noise: int
) -> Array:
    """Log p(rates of each mission), latent trust integrated out, shape (mission,), nats.

    Exact for the Gaussian family; else by importance sampling with antithetic noise.
    """
    if observation == "gaussian":
        zero = jnp.zeros_like(observed.y)
        return log_weight(observation, ssm, observed, zero, shared=False).sum(1)
    observed = refine(observation, ssm, observed)
    half = random.normal(key, (n_noise // 2, *observed.y.shape), observed.y.dtype)

    def weigh(noise: Array) -> Array:
        return log_weight(observation, ssm, observed, noise, shared=False)

    weights = jax.vmap(weigh)(jnp.concatenate([half, -half]))
    # Over noise first, sequence by sequence: these are independent.
    return (jax.nn.logsumexp(weights, axis=0) - np.log(len(weights))).sum(1)


def refine(observation: str, ssm: SSM, observed: Observed, n_steps: int = 6) -> Observed:
    """Fit the likelihood of counts around the most likely trust (Laplace, by smoothing)."""
    if observation != "beta_binomial":
        return observed

    def step(_, trust: Array) -> Array:
        approximate, filtered = _approximate(ssm, observed._replace(pilot=trust))
        return approximate.smooth(filtered).mean

    return observed._replace(pilot=lax.fori_loop(0, n_steps, step, _logits(observed)))


def log_resolution(observation: str, y: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """What turns the log density of each rate into the log probability of its count of ticks.

    A density of rates covers 1/N per tick; a censored rate, and a count, have a probability as they
    are. Shape of `y`; 0 where not measured, NaN where the number of ticks is not known.
    """
    is_density = ~np.isnan(y)
    if observation == "censored":
        is_density &= (y > 0.0) & (y < 1.0)
    if observation == "beta_binomial":
        is_density &= False
    return np.where(is_density, -np.log(np.where(is_density, exposure, 1.0)), 0.0)


def _filter(
    observation: str, ssm: SSM, observed: Observed, noise: Array, *, shared: bool
) -> Filtered:
    censoring = None
    if observation == "censored":
        side = jnp.where(observed.y >= 1.0, 1.0, jnp.where(observed.y <= 0.0, -1.0, 0.0))
        censoring = Censoring(side, noise)
    return ssm.filter(observed.y, shared=shared, censoring=censoring)


def _approximate(ssm: SSM, observed: Observed) -> tuple[SSM, Filtered]:
    """The state space with Gaussian observations in place of counts, and the filter of these."""
    counts = _counts(observed)
    pilot = _logits(observed) if observed.pilot is None else observed.pilot
    slope, curvature = _derivatives(counts, pilot, _concentration(ssm))
    var = 1.0 / jnp.maximum(-curvature, 1e-3)
    y = pilot + jnp.clip(var * slope, -3.0, 3.0)
    if isinstance(ssm, ScalarSSM):
        approximate = ssm._replace(delta_v=jnp.sqrt(var))
    else:
        approximate = ssm._replace(R=var[..., None] * jnp.eye(var.shape[-1])[None, None])
    return approximate, approximate.filter(jnp.where(counts[1] > 0.0, y, jnp.nan))


def _logits(observed: Observed) -> Array:
    n, N = _counts(observed)
    return jnp.log((n + 0.5) / (N - n + 0.5))


def _derivatives(counts: tuple[Array, Array], trust: Array, phi: Array) -> tuple[Array, Array]:
    """First and second derivative of the beta-binomial log probability in trust, nearly.

    digamma(n + a) - digamma(a) is a sum of 1 / (a + j): its first term, and the midpoint rule for
    the others. What this leaves is weighted away; special functions would take ten times as long.
    """
    n, N = counts
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


def _counts(observed: Observed) -> tuple[Array, Array]:
    """Ticks in contact, and ticks; both 0 where nothing was measured."""
    measured = ~jnp.isnan(observed.y) & (observed.exposure > 0.0)
    N = jnp.where(measured, observed.exposure, 0.0)
    return jnp.where(measured, jnp.round(observed.y * N), 0.0), N


def _variances(ssm: SSM) -> Array:
    if isinstance(ssm, ScalarSSM):
        return ssm.delta_v**2
    return jnp.diagonal(ssm.R, axis1=-2, axis2=-1)


def _concentration(ssm: SSM) -> Array:
    """Concentration of the beta distribution, shape (1, 1, robot or 1).

    At most 1e6, where counts are binomial for all purposes and log-gamma still has digits to give.
    """
    variance = ssm.delta_v**2 if isinstance(ssm, ScalarSSM) else jnp.diagonal(ssm.R)
    return 1.0 / (jnp.reshape(variance, (1, 1, -1)) + 1e-6)


def _beta_binomial(counts: tuple[Array, Array], trust: Array, ssm: SSM) -> Array:
    """Log probability of the counts."""
    (n, N), phi = counts, _concentration(ssm)
    a, b = phi * jax.nn.sigmoid(trust), phi * jax.nn.sigmoid(-trust)
    choose = gammaln(N + 1.0) - gammaln(n + 1.0) - gammaln(N - n + 1.0)
    total = gammaln(N + phi) - gammaln(phi)
    return choose + gammaln(n + a) - gammaln(a) + gammaln(N - n + b) - gammaln(b) - total


def _draw_beta_binomial(key: Array, trust: Array, ssm: SSM, exposure: Array) -> Array:
    key_p, key_n = random.split(key)
    phi = _concentration(ssm)
    p = random.beta(key_p, phi * jax.nn.sigmoid(trust), phi * jax.nn.sigmoid(-trust))
    N = lax.stop_gradient(jnp.where(exposure > 0.0, exposure, jnp.nan))
    return random.binomial(key_n, jnp.where(jnp.isnan(N), 0.0, N), p).astype(p.dtype) / N
