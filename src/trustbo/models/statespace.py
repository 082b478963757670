"""Exact inference in the scalar state space (3)-(4): filter, smoother, backward sampling.

Every robot of every mission is one independent sequence

    x_k = beta0 x_{k-1} + c_k + N(0, delta_w^2),   y_k = x_k + N(0, delta_v^2),   k = 1..K,

with x_0 ~ N(x0_mean, x0_sd^2) and the drift c_k = sum_m beta_m z_{m,k} + b. A rate that is NaN was
not measured: the filter predicts through it. Sequences share the parameters and run side by side,
so arrays are (bound, sequence) with the bound first, the axis `lax.scan` walks.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax, random
from jax.scipy.stats import norm


class ScalarSSM(NamedTuple):
    """Parameters of the recursion; scalars, except the drift."""

    beta0: Array
    drift: Array  # (bound, sequence)
    delta_w: Array
    delta_v: Array
    x0_mean: Array
    x0_sd: Array


class Filtered(NamedTuple):
    """Moments of x_k given y_1..y_{k-1} (predicted) and y_1..y_k (filtered); (bound, sequence)."""

    predicted_mean: Array
    predicted_var: Array
    mean: Array
    var: Array
    log_likelihood: Array  # increments, nats; 0 where the rate was not measured


def kalman_filter(ssm: ScalarSSM, y: Array) -> Filtered:
    """Moments of the latent trust given the rates so far.

    Args:
        ssm: The model.
        y: Contact rates, shape (bound, sequence); NaN where not measured.
    """
    Q, R = ssm.delta_w**2, ssm.delta_v**2
    measured = ~jnp.isnan(y)
    # NaN must not reach the arithmetic even where its result is discarded: its gradient would stay.
    y = jnp.where(measured, y, 0.0)

    def step(carry, inputs):
        m, P = carry
        c_k, y_k, seen = inputs
        m, P = ssm.beta0 * m + c_k, ssm.beta0**2 * P + Q
        S = P + R
        gain = jnp.where(seen, P / S, 0.0)
        increment = jnp.where(seen, norm.logpdf(y_k, m, jnp.sqrt(S)), 0.0)
        m_k, P_k = m + gain * (y_k - m), (1.0 - gain) * P
        return (m_k, P_k), Filtered(m, P, m_k, P_k, increment)

    start = (jnp.full_like(y[0], ssm.x0_mean), jnp.full_like(y[0], ssm.x0_sd**2))
    return lax.scan(step, start, (ssm.drift, y, measured))[1]


class Smoothed(NamedTuple):
    """Moments of x_k given all of a sequence's rates; shape (bound, sequence)."""

    mean: Array
    var: Array


def smooth(ssm: ScalarSSM, filtered: Filtered) -> Smoothed:
    """Rauch-Tung-Striebel smoother."""

    def step(carry, inputs):
        m_next, P_next = carry
        f, predicted_mean, predicted_var = inputs
        gain = ssm.beta0 * f.var / predicted_var
        m = f.mean + gain * (m_next - predicted_mean)
        P = f.var + gain**2 * (P_next - predicted_var)
        return (m, P), Smoothed(m, P)

    last = (filtered.mean[-1], filtered.var[-1])
    _, earlier = lax.scan(step, last, _pairs(filtered), reverse=True)
    return Smoothed(*(jnp.concatenate([e, f[None]]) for e, f in zip(earlier, last, strict=True)))


def sample_backward(ssm: ScalarSSM, filtered: Filtered, key: Array) -> Array:
    """One exact joint draw of the latent trust given all rates, shape (bound, sequence).

    Backward sampling (Carter and Kohn 1994; Fruehwirth-Schnatter 1994).
    """
    noise = random.normal(key, filtered.mean.shape, filtered.mean.dtype)

    def step(x_next, inputs):
        (f, predicted_mean, predicted_var), e = inputs
        gain = ssm.beta0 * f.var / predicted_var
        m = f.mean + gain * (x_next - predicted_mean)
        # Var(x_k | x_{k+1}, y) = P_k Q / predicted_var: this form cannot turn negative.
        x = m + jnp.sqrt(f.var * ssm.delta_w**2 / predicted_var) * e
        return x, x

    last = filtered.mean[-1] + jnp.sqrt(filtered.var[-1]) * noise[-1]
    _, earlier = lax.scan(step, last, (_pairs(filtered), noise[:-1]), reverse=True)
    return jnp.concatenate([earlier, last[None]])


def simulate(ssm: ScalarSSM, key: Array) -> tuple[Array, Array]:
    """Latent trust and contact rates drawn from the model, each of shape (bound, sequence)."""
    key_x0, key_w, key_v = random.split(key, 3)
    shape, dtype = ssm.drift.shape, ssm.drift.dtype

    def step(x, inputs):
        c_k, w = inputs
        x = ssm.beta0 * x + c_k + ssm.delta_w * w
        return x, x

    x0 = ssm.x0_mean + ssm.x0_sd * random.normal(key_x0, shape[1:], dtype)
    _, trust = lax.scan(step, x0, (ssm.drift, random.normal(key_w, shape, dtype)))
    return trust, trust + ssm.delta_v * random.normal(key_v, shape, dtype)


def _pairs(filtered: Filtered) -> tuple[Filtered, Array, Array]:
    """Each bound but the last, with the prediction of the one after it."""
    earlier = Filtered(*(field[:-1] for field in filtered))
    return earlier, filtered.predicted_mean[1:], filtered.predicted_var[1:]
