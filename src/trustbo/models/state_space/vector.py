"""Exact inference in the coupled state space (1)-(2) in JAX: the robots of a mission, together.

With the robots' trust as one vector,

    x_k = B0 x_{k-1} + c_k + w_k,   y_k = x_k + v_k,   w ~ N(0, Q), v ~ N(0, R),

and each mission one sequence. Rates enter one robot at a time, as rank-one updates of the joint
covariance of (x_k, y_k): no matrix is factorised, and a missing rate is skipped.
Covariances do not depend on the rates, so missions without gaps share them. Interface and axes are
those of `scalar.ScalarSSM`.
"""

from typing import NamedTuple, Self

import jax.numpy as jnp
from jax import Array, lax, random
from jax.scipy.linalg import cho_solve, solve_triangular

from trustbo.models.state_space import dense
from trustbo.models.state_space.scalar import (
    Censoring,
    Filtered,
    Smoothed,
    draw_censored,
    gather_filtered,
)


class VectorSSM(NamedTuple):
    """Parameters of the recursion."""

    B0: Array  # (robot, robot')
    drift: Array  # (bound, mission, robot)
    Q: Array  # (robot, robot')
    R: Array  # (robot, robot'), or (bound, mission, robot, robot')
    x0_mean: Array  # ()
    x0_sd: Array  # ()

    @property
    def rate_variance(self) -> Array:
        """Variance of a rate given trust."""
        return jnp.diagonal(self.R, axis1=-2, axis2=-1)

    def with_rate_variance(self, var: Array) -> Self:
        """The same dynamics with a separate variance for each rate, (bound, mission, robot)."""
        return self._replace(R=var[..., None] * jnp.eye(var.shape[-1])[None, None])

    def per_sequence(self, terms: Array) -> Array:
        """Sums of (bound, mission, robot) over each independent sequence, (mission, 1)."""
        return terms.sum(0).sum(1, keepdims=True)

    def log_likelihood(self, y: Array, *, complete: bool = False) -> Array:
        """Log density of the rates, latent trust integrated out, (mission, 1), nats."""
        if complete and dense.is_small(self):
            return dense.log_likelihood(self, y)
        return self.per_sequence(self.filter(y, complete=complete).log_likelihood)

    def filter(
        self, y: Array, *, complete: bool = False, censoring: Censoring | None = None
    ) -> Filtered:
        """See `ScalarSSM.filter`; `var` is (bound, mission, robot, robot')."""
        seen = jnp.where(jnp.isnan(y), 0.0, 1.0)
        y = jnp.where(seen > 0.0, y, 0.0)
        n = y.shape[-1]
        mask = jnp.ones_like(y[:, :1]) if complete else seen
        F = jnp.concatenate([self.B0, self.B0])
        R = jnp.broadcast_to(self.R, (*mask.shape, n)) if jnp.ndim(self.R) < 4 else self.R

        def advance(P, inputs):
            R_k, seen_k = inputs
            noise = jnp.tile(self.Q, (2, 2))[None] + jnp.pad(R_k, [(0, 0), (n, 0), (n, 0)])
            J = F @ P @ F.T + noise
            S, gains = [], []
            for i in range(n, 2 * n):
                s, column = J[:, i, i], J[:, :, i]
                gain = column / s[:, None] * seen_k[:, i - n, None]
                J = J - gain[:, :, None] * column[:, None, :]
                S.append(s)
                gains.append(gain)
            P_k = J[:, :n, :n]
            P_k = 0.5 * (P_k + jnp.swapaxes(P_k, 1, 2))
            return P_k, (jnp.stack(S, 1), jnp.stack(gains, 1), P_k)

        P0 = jnp.broadcast_to(self.x0_sd**2 * jnp.eye(n), (mask.shape[1], n, n))
        _, (S, gain, P) = lax.scan(advance, P0, (R, mask))

        def step(m, inputs):
            y_k, seen_k, c_k, S_k, gain_k, *rest = inputs
            joint = m @ F.T + jnp.tile(c_k, 2)
            errors, completed, log_masses = [], [], []
            for i in range(n):
                y_i, predicted = y_k[:, i], joint[:, n + i]
                if rest:
                    one = Censoring(*(a[:, i] for a in rest))
                    y_i, log_mass = draw_censored(y_i, predicted, jnp.sqrt(S_k[:, i]), one)
                    completed.append(y_i)
                    log_masses.append(log_mass)
                e = (y_i - predicted) * seen_k[:, i]
                joint = joint + gain_k[:, i] * e[:, None]
                errors.append(e)
            out = [jnp.stack(a, 1) for a in (errors, completed, log_masses) if a]
            return joint[:, :n], (joint[:, :n], *out)

        S = jnp.broadcast_to(S, y.shape)
        m0 = jnp.full(y.shape[1:], self.x0_mean)
        columns = (y, seen, self.drift, S, gain, *(censoring or ()))
        _, (m, e, *rest) = lax.scan(step, m0, columns)
        return gather_filtered(m, P, e, S, y, seen, censoring, rest)

    def smooth(self, filtered: Filtered) -> Smoothed:
        """See `ScalarSSM.smooth`; variances only, no covariances between robots."""
        A, a, L = self._backward(filtered)
        V = cho_solve((L, True), jnp.broadcast_to(jnp.eye(L.shape[-1]), L.shape))

        def step(carry, inputs):
            m_next, P_next = carry
            A_k, a_k, V_k = inputs
            m = jnp.einsum("sij,sj->si", A_k, m_next) + a_k
            P = V_k + A_k @ P_next @ jnp.swapaxes(A_k, 1, 2)
            return (m, P), (m, P)

        last = (filtered.mean[-1], filtered.var[-1])
        _, earlier = lax.scan(step, last, (A, a, V), reverse=True)
        m, P = (jnp.concatenate([e, f[None]]) for e, f in zip(earlier, last, strict=True))
        return Smoothed(m, jnp.diagonal(P, axis1=-2, axis2=-1))

    def sample_backward(self, filtered: Filtered, innovations: Array) -> Array:
        """See `ScalarSSM.sample_backward`."""
        A, a, L = self._backward(filtered)
        spread = solve_triangular(L, innovations[:-1, ..., None], trans=1, lower=True)[..., 0]

        def step(x_next, inputs):
            A_k, a_k, e = inputs
            x = jnp.einsum("sij,sj->si", A_k, x_next) + a_k + e
            return x, x

        factor = jnp.linalg.cholesky(filtered.var[-1])
        last = filtered.mean[-1] + jnp.einsum("sij,sj->si", factor, innovations[-1])
        _, earlier = lax.scan(step, last, (A, a, spread), reverse=True)
        return jnp.concatenate([earlier, last[None]])

    def simulate(self, key: Array) -> tuple[Array, Array]:
        """See `ScalarSSM.simulate`."""
        key_x0, key_w, key_v = random.split(key, 3)
        shape, dtype = self.drift.shape, self.drift.dtype
        w = random.normal(key_w, shape, dtype) @ jnp.linalg.cholesky(self.Q).T
        v = random.normal(key_v, shape, dtype) @ jnp.linalg.cholesky(self.R).T

        def step(x, inputs):
            c_k, w_k = inputs
            x_k = x @ self.B0.T + c_k + w_k
            return x_k, x_k

        x0 = self.x0_mean + self.x0_sd * random.normal(key_x0, shape[1:], dtype)
        trust = lax.scan(step, x0, (self.drift, w))[1]
        return trust, trust + v

    def _backward(self, filtered: Filtered) -> tuple[Array, Array, Array]:
        """A, a and the Cholesky factor of V^-1, with x_k | x_{k+1}, y ~ N(A x_{k+1} + a, V)."""
        Q_inverse, P_inverse = jnp.linalg.inv(self.Q), jnp.linalg.inv(filtered.var[:-1])
        BQ = self.B0.T @ Q_inverse
        L = jnp.linalg.cholesky(P_inverse + (BQ @ self.B0)[None, None])
        A = cho_solve((L, True), jnp.broadcast_to(BQ, L.shape))
        information = (
            jnp.einsum("ksij,ksj->ksi", P_inverse, filtered.mean[:-1]) - self.drift[1:] @ BQ.T
        )
        return A, cho_solve((L, True), information[..., None])[..., 0], L
