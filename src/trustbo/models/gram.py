"""The marginal likelihood of the pooled model as a quadratic form in its linear coefficients.

With c = (beta, b), one robot's mission is r = y - beta0 y_lag - U c, where y_lag starts with the
mean of x_0. Its entries are w_k + v_k - beta0 v_{k-1}: an MA(1), so r is normal with covariance

    Sigma = T + kappa e_1 e_1',   T tridiagonal Toeplitz,   kappa = beta0^2 (x0_sd^2 - delta_v^2),

and y -> r has Jacobian 1. The type-I sine transform diagonalises T for every parameter value, and
the corner is a rank-one update (Sherman and Morrison). So the data enter through sums of products
over missions of one length, computed once: additive, and cheap to weight, to add to, or to take
from. Missions with gaps go through a Kalman filter that carries the same coefficients along.

Everything is NumPy, batched over parameter values theta = (beta0, delta_w^2, delta_v^2).
"""

from typing import NamedTuple, Self

import numpy as np

from trustbo.stacking import MissionBatch


class Quadratic(NamedTuple):
    """-2 log-likelihood = alpha - 2 c'h + c'Pc + log_det + n log 2 pi, for each theta."""

    alpha: np.ndarray  # (theta,)
    h: np.ndarray  # (theta, coefficient)
    P: np.ndarray  # (theta, coefficient, coefficient)
    log_det: np.ndarray  # (theta,)

    def __add__(self, other: Self) -> Self:  # pyright: ignore[reportIncompatibleMethodOverride]
        return type(self)(*(a + b for a, b in zip(self, other, strict=True)))


class LengthGram(NamedTuple):
    """Sums over the complete sequences of one length, of columns (y, y_lag, features, 1)."""

    n_sequences: float
    spectral: np.ndarray  # (frequency, column, column)
    corner: np.ndarray  # (bound, bound, column, column)

    def evaluate(self, theta: np.ndarray, x0_sd: float) -> Quadratic:
        """The quadratic form at parameter values of shape (theta, 3)."""
        n_bounds, p = self.spectral.shape[:2]
        beta0, Q, R = theta.T
        sines = _sine_basis(n_bounds)
        cosine = np.cos(np.pi * np.arange(1, n_bounds + 1) / (n_bounds + 1))
        eigenvalues = (Q + R * (1.0 + beta0**2))[:, None] - 2.0 * (beta0 * R)[:, None] * cosine
        kappa = beta0**2 * (x0_sd**2 - R)
        first = sines[0] / eigenvalues
        g = first @ sines  # T^-1 e_1
        tau = first @ sines[0]  # e_1' T^-1 e_1
        shrink = kappa / (1.0 + kappa * tau)
        M = (1.0 / eigenvalues) @ self.spectral.reshape(n_bounds, p * p)
        outer = (g[:, :, None] * g[:, None, :]).reshape(len(theta), -1)
        M -= shrink[:, None] * (outer @ self.corner.reshape(n_bounds**2, p * p))
        log_det = np.log(eigenvalues).sum(1) + np.log1p(kappa * tau)
        return _collapse_lag(M.reshape(-1, p, p), beta0, self.n_sequences * log_det)


class GapSequences(NamedTuple):
    """Sequences in which a rate between the first and the last bound is missing."""

    y: np.ndarray  # (sequence, bound), NaN where not measured
    u: np.ndarray  # (sequence, bound, coefficient)
    x0_mean: float

    def evaluate(self, theta: np.ndarray, x0_sd: float) -> Quadratic:
        """The quadratic form at parameter values of shape (theta, 3), by the Kalman filter.

        The state's mean is linear in c: column 0 carries what comes from x_0 and the rates, column
        j the weight of coefficient j. The innovation is column 0 minus c times the others.
        """
        n, (n_sequences, n_bounds, d) = len(theta), self.u.shape
        beta0, Q, R = (column[:, None] for column in theta.T)
        m = np.zeros((n, n_sequences, 1 + d))
        m[..., 0] = self.x0_mean
        variance = np.full((n, n_sequences), x0_sd**2)
        M, log_det = np.zeros((n, 1 + d, 1 + d)), np.zeros(n)
        for k in range(n_bounds):
            m = beta0[..., None] * m
            m[..., 1:] += self.u[:, k]
            variance = beta0**2 * variance + Q
            seen = ~np.isnan(self.y[:, k])
            S = variance + R
            e = -m
            e[..., 0] += np.where(seen, self.y[:, k], 0.0)
            e[..., 1:] *= -1.0
            weight = np.where(seen, 1.0 / S, 0.0)
            M += np.einsum("nsi,nsj,ns->nij", e, e, weight, optimize=True)
            log_det += np.where(seen, np.log(S), 0.0).sum(1)
            gain = variance * weight
            m[..., 0] += gain * e[..., 0]
            m[..., 1:] -= gain[..., None] * m[..., 1:]
            variance = (1.0 - gain) * variance
        return Quadratic(M[:, 0, 0], M[:, 0, 1:], M[:, 1:, 1:], log_det)


class SufficientStatistics(NamedTuple):
    """All that the marginal likelihood needs of a batch of missions."""

    grams: dict[int, LengthGram]
    gaps: tuple[GapSequences, ...]
    n_measured: float
    level: float
    """Mean contact rate."""
    spread: float
    """Standard deviation of the contact rates."""

    def evaluate(self, theta: np.ndarray, x0_sd: float) -> Quadratic:
        """The quadratic form at theta = (beta0, delta_w^2, delta_v^2), shape (theta, 3)."""
        parts = [*self.grams.values(), *self.gaps]
        total = parts[0].evaluate(theta, x0_sd)
        for part in parts[1:]:
            total = total + part.evaluate(theta, x0_sd)
        return total


def sufficient_statistics(batch: MissionBatch, x0_mean: float) -> SufficientStatistics:
    """Gather the statistics of a batch; rates missing at a mission's end only shorten it."""
    z, y = batch.awareness, batch.contact_rate
    u = np.concatenate([z, np.ones_like(z[..., :1])], axis=-1)
    # One row per robot and mission: (sequence, bound[, coefficient]).
    y = np.swapaxes(y, 1, 2).reshape(-1, y.shape[1])
    u = np.swapaxes(u, 1, 2).reshape(len(y), y.shape[1], -1)
    seen = ~np.isnan(y)
    last = np.where(seen.any(1), y.shape[1] - np.argmax(seen[:, ::-1], axis=1), 0)
    complete = (last > 0) & (seen.sum(1) == last)
    grams = {
        int(n): _length_gram(y[rows, :n], u[rows, :n], x0_mean)
        for n in np.unique(last[complete])
        for rows in [complete & (last == n)]
    }
    with_gaps = (last > 0) & ~complete
    gaps = ()
    if with_gaps.any():
        n = last[with_gaps].max()
        gaps = (GapSequences(y[with_gaps, :n], u[with_gaps, :n], x0_mean),)
    rates = y[seen]
    return SufficientStatistics(grams, gaps, float(len(rates)), rates.mean(), rates.std())


def _length_gram(y: np.ndarray, u: np.ndarray, x0_mean: float) -> LengthGram:
    n_sequences, n_bounds, _ = u.shape
    lag = np.concatenate([np.full((n_sequences, 1), x0_mean), y[:, :-1]], axis=1)
    columns = np.concatenate([y[..., None], lag[..., None], u], axis=-1)
    transformed = np.einsum("kl,skp->slp", _sine_basis(n_bounds), columns, optimize=True)
    return LengthGram(
        float(n_sequences),
        np.einsum("slp,slq->lpq", transformed, transformed, optimize=True),
        np.einsum("skp,sjq->kjpq", columns, columns, optimize=True),
    )


def _collapse_lag(M: np.ndarray, beta0: np.ndarray, log_det: np.ndarray) -> Quadratic:
    """From columns (y, y_lag, u) to y - beta0 y_lag and u."""
    ones = np.ones_like(beta0)
    v = np.stack([ones, -beta0], axis=1)
    alpha = np.einsum("ni,nij,nj->n", v, M[:, :2, :2], v, optimize=True)
    h = np.einsum("ni,nij->nj", v, M[:, :2, 2:], optimize=True)
    return Quadratic(alpha, h, M[:, 2:, 2:], log_det)


def _sine_basis(n: int) -> np.ndarray:
    """The orthonormal, symmetric matrix of the type-I discrete sine transform, (n, n)."""
    k = np.arange(1, n + 1)
    return np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * np.outer(k, k) / (n + 1))
