"""Exact inference in the scalar state space (3)-(4) in JAX: filter, smoother, backward sampling.

Every robot of every mission is one independent sequence

    x_k = beta0 x_{k-1} + c_k + w_k,   y_k = x_k + v_k,   k = 1..K,

with x_0 ~ N(x0_mean, x0_sd^2) and the drift c_k = sum_m beta_m z_{m,k} + b. A rate that is NaN was
not measured: the filter predicts through it. Sequences run side by side, so arrays are (bound,
mission, robot) with the bound first, the axis `lax.scan` walks.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import jax.numpy as jnp
from jax import Array, lax, random
from jax.scipy.special import log_ndtr, ndtr, ndtri

from trustbo.models.state_space.kalman import innovation, look_back, update

_LOG_2PI = 1.8378770664093453


class Censoring(NamedTuple):
    """Rates known only to lie beyond a limit, and the innovations that complete them."""

    side: Array
    """-1 for rates of 0 or below, 1 for rates of 1 or above, 0 for those measured."""
    innovations: Array
    """Standard normal; one draw of the censored rates is a function of them."""


class Filtered(NamedTuple):
    """Moments of x_k given y_1..y_k, bound first."""

    mean: Array
    var: Array
    """Variance, or, of coupled robots, covariance; its axes after the bound broadcast."""
    log_likelihood: Array
    """Increments, nats; 0 where the rate was not measured."""
    y: Array
    """The rates, censored ones completed; 0 where not measured."""
    seen: Array
    """1 where a rate was measured, else 0."""


class Smoothed(NamedTuple):
    """Moments of x_k given all of a sequence's rates; shape (bound, mission, robot)."""

    mean: Array
    var: Array


class ScalarSSM(NamedTuple):
    """Parameters of the recursion; shapes () or (robot,), unless stated."""

    beta0: Array
    drift: Array  # (bound, mission, robot)
    delta_w: Array
    delta_v: Array  # or (bound, mission, robot)
    x0_mean: Array
    x0_sd: Array

    @property
    def rate_variance(self) -> Array:
        """Variance of a rate given trust."""
        return self.delta_v**2

    def with_rate_variance(self, var: Array) -> Self:
        """The same dynamics with a separate variance for each rate, (bound, mission, robot)."""
        return self._replace(delta_v=jnp.sqrt(var))

    def per_sequence(self, terms: Array) -> Array:
        """Sums of (bound, mission, robot) over each independent sequence, (mission, robot)."""
        return terms.sum(0)

    def log_likelihood(self, y: Array, *, complete: bool = False) -> Array:
        """Log density of the rates, latent trust integrated out, (mission, robot), nats."""
        return self.per_sequence(self.filter(y, complete=complete).log_likelihood)

    def filter(
        self, y: Array, *, complete: bool = False, censoring: Censoring | None = None
    ) -> Filtered:
        """Moments of the latent trust given the rates so far.

        Args:
            y: Contact rates, shape (bound, mission, robot); NaN where not measured.
            complete: Whether no rate is missing before the last of a mission, so that all missions
                have the same variances; moments after the last rate are then meaningless.
            censoring: Sides and innovations of censored rates, of the shape of `y`.
        """
        seen = jnp.where(jnp.isnan(y), 0.0, 1.0)
        # NaN must not reach the arithmetic even where its result is discarded: its gradient would.
        y = jnp.where(seen > 0.0, y, 0.0)
        beta0, Q, x0_mean = (row(p) for p in (self.beta0, self.delta_w**2, self.x0_mean))
        R = self.delta_v**2

        def advance(P, inputs):
            R_k, seen_k = inputs
            S, C = innovation(beta0, Q, R_k, P)
            gain = C / S * seen_k
            P_k = update(beta0, Q, P, gain, S)
            return P_k, (S, gain, P_k)

        mask = jnp.ones_like(y[:, :1]) if complete else seen
        R = jnp.broadcast_to(row(R), mask.shape) if jnp.ndim(R) < 3 else R
        P0 = jnp.broadcast_to(row(self.x0_sd**2), mask.shape[1:])
        _, (S, gain, P) = lax.scan(advance, P0, (R, mask))

        def step(m, inputs):
            y_k, seen_k, c_k, S_k, gain_k, *rest = inputs
            predicted = beta0 * m + c_k
            completed = ()
            if rest:
                completed = draw_censored(y_k, predicted, jnp.sqrt(S_k), Censoring(*rest))
                y_k = completed[0]
            e = (y_k - predicted) * seen_k
            m = beta0 * m + c_k + gain_k * e
            return m, (m, e, *completed)

        S, gain = (jnp.broadcast_to(a, y.shape) for a in (S, gain))
        m0 = jnp.broadcast_to(x0_mean, y.shape[1:])
        columns = (y, seen, self.drift, S, gain, *(censoring or ()))
        _, (m, e, *completed) = lax.scan(step, m0, columns)
        return gather_filtered(m, P, e, S, y, seen, censoring, completed)

    def smooth(self, filtered: Filtered) -> Smoothed:
        """Rauch-Tung-Striebel smoother; `filtered` without `complete`."""
        A, a, V = self._backward(filtered)

        def step(carry, inputs):
            m_next, P_next = carry
            A_k, a_k, V_k = inputs
            m, P = A_k * m_next + a_k, V_k + A_k**2 * P_next
            return (m, P), Smoothed(m, P)

        last = (filtered.mean[-1], jnp.broadcast_to(filtered.var[-1], filtered.mean[-1].shape))
        _, earlier = lax.scan(step, last, (A, a, V), reverse=True)
        return Smoothed(
            *(jnp.concatenate([e, f[None]]) for e, f in zip(earlier, last, strict=True))
        )

    def sample_backward(self, filtered: Filtered, innovations: Array) -> Array:
        """One exact joint draw of the latent trust given all rates, shape (bound, mission, robot).

        Backward sampling (Carter and Kohn 1994; Fruehwirth-Schnatter 1994), as a smooth function of
        standard normal innovations of that shape.
        """
        A, a, V = self._backward(filtered)

        def step(x_next, inputs):
            A_k, a_k, sd, e = inputs
            x = A_k * x_next + a_k + sd * e
            return x, x

        last = filtered.mean[-1] + jnp.sqrt(filtered.var[-1]) * innovations[-1]
        _, earlier = lax.scan(step, last, (A, a, jnp.sqrt(V), innovations[:-1]), reverse=True)
        return jnp.concatenate([earlier, last[None]])

    def simulate(self, key: Array) -> tuple[Array, Array]:
        """Latent trust and contact rates drawn from the model, each (bound, mission, robot)."""
        key_x0, key_w, key_v = random.split(key, 3)
        shape, dtype = self.drift.shape, self.drift.dtype
        beta0, delta_w, delta_v = (row(p) for p in (self.beta0, self.delta_w, self.delta_v))

        def step(x, inputs):
            c_k, w, v = inputs
            x_k = beta0 * x + c_k + delta_w * w
            return x_k, (x_k, x_k + delta_v * v)

        x0 = row(self.x0_mean) + row(self.x0_sd) * random.normal(key_x0, shape[1:], dtype)
        w, v = (random.normal(key, shape, dtype) for key in (key_w, key_v))
        return lax.scan(step, x0, (self.drift, w, v))[1]

    def _backward(self, filtered: Filtered) -> tuple[Array, Array, Array]:
        """A, a, V with x_k | x_{k+1}, y ~ N(A x_{k+1} + a, V), for each bound but the last."""
        beta0, Q = (row(p)[None] for p in (self.beta0, self.delta_w**2))
        m, P = filtered.mean[:-1], filtered.var[:-1]
        A, V = look_back(beta0, Q, P)
        a = V * (m / P - beta0 / Q * self.drift[1:])
        return A, a, V


def gather_filtered(
    mean: Array,
    var: Array,
    error: Array,
    S: Array,
    y: Array,
    seen: Array,
    censoring: Censoring | None,
    completed: Sequence[Array],
) -> Filtered:
    """Gather the results of a filter's pass; `completed` are rates and log masses if censored."""
    increments = log_normal(error, S)
    if censoring is not None:
        y, log_mass = completed
        increments = jnp.where(censoring.side == 0.0, increments, log_mass)
    return Filtered(mean, var, increments * seen, y * seen, seen)


def draw_censored(
    y: Array, predicted: Array, sd: Array, censoring: Censoring
) -> tuple[Array, Array]:
    """Draw censored rates beyond their limit from the prediction; the log mass there.

    The step of the GHK simulator (Geweke 1989; Hajivassiliou and McFadden 1998; Keane 1994).
    """
    side, innovations = censoring
    toward = jnp.where(side == 0.0, 1.0, side)
    limit = jnp.where(side > 0.0, 1.0, 0.0)
    z = toward * (predicted - limit) / sd
    # Beyond -35 sd the draw is clipped; its log mass, below -600, is not.
    inner = ndtri(jnp.clip(ndtr(innovations) * ndtr(jnp.clip(z, -35.0, 35.0)), 1e-290, 1.0 - 1e-16))
    drawn = predicted - toward * sd * inner
    return jnp.where(side == 0.0, y, drawn), log_ndtr(z)


def row(p: Array | float) -> Array:
    """A parameter of shape () or (robot,) as a row to broadcast over missions."""
    return jnp.reshape(p, (1, -1))


def log_normal(e: Array, var: Array) -> Array:
    """Log density of N(0, var) at e."""
    return -0.5 * (e**2 / var + jnp.log(var) + _LOG_2PI)
