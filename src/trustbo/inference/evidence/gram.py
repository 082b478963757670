"""The marginal likelihood of the pooled model as a quadratic form in its linear coefficients.

Method: generalised least squares for an MA(1), by the discrete sine transform. With c = (beta, b),
one robot's mission is r = y - beta0 y_lag - beta0 x0_mean e_1 - U c. Its entries are an MA(1),
w_k + v_k - beta0 v_{k-1}, so r is normal with covariance

    Sigma = T + kappa e_1 e_1',   T tridiagonal Toeplitz,   kappa = beta0^2 (x0_sd^2 - R).

Why exact: y -> r is unit triangular, so its Jacobian is 1; the type-I sine transform diagonalises T
for every parameter value (Strang 1999); the corner is a rank-one update (Sherman and Morrison
1950). State: sums of products of (y, y_lag, x0_mean e_1, U) over the missions of one length, by
frequency and by pair of bounds. Invariant: they do not depend on parameters and add up, so missions
are weighted, added and taken away by their sums. Missions with gaps go through a Kalman filter that
carries the same coefficients along. Derivation: docs/derivations/exact-sampler.md.

Everything is NumPy, batched over parameter values theta = (beta0, delta_w^2, delta_v^2).
"""

from typing import NamedTuple, Self

import numpy as np

from trustbo.errors import ShapeError, TrustboError
from trustbo.models.state_space.kalman import innovation, update
from trustbo.models.ticks import TickWeights, add_ticks, weigh_ticks
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
    """Weighted sums over the complete sequences of one length.

    Products of the columns (y, y_lag, x0_mean e_1, features, 1).
    """

    weight: float
    """Number of sequences, weighted."""
    spectral: np.ndarray  # (frequency, column, column)
    corner: np.ndarray  # (bound, bound, column, column)

    def scaled(self, factor: float) -> Self:
        """Multiply the weight of the data by a factor."""
        return type(self)(factor * self.weight, factor * self.spectral, factor * self.corner)

    def plus(self, other: Self) -> Self:
        """Add the data of both."""
        return type(self)(
            self.weight + other.weight,
            self.spectral + other.spectral,
            self.corner + other.corner,
        )

    def evaluate(self, theta: np.ndarray, x0_sd: float) -> Quadratic:
        """The quadratic form at parameter values of shape (theta, 3)."""
        n_bounds, p = self.spectral.shape[:2]
        beta0, Q, R = theta.T
        sines = _sine_basis(n_bounds)
        diagonal, beside = Q + R * (1.0 + beta0**2), -beta0 * R  # of T
        cosines = np.cos(np.pi * np.arange(1, n_bounds + 1) / (n_bounds + 1))
        values = diagonal[:, None] + 2.0 * beside[:, None] * cosines  # its eigenvalues
        first = sines[0] / values
        g = first @ sines  # T^-1 e_1
        tau = first @ sines[0]  # e_1' T^-1 e_1
        kappa = beta0**2 * x0_sd**2 - beta0**2 * R
        shrink = kappa / (1.0 + kappa * tau)
        M = (1.0 / values) @ self.spectral.reshape(n_bounds, p * p)
        # (k, j, column, column) and (j, k, column, column) have one transpose's sum: half will do.
        k, j = np.triu_indices(n_bounds)
        both = self.corner[k, j] + self.corner[j, k] * (k != j)[:, None, None]
        outer = g[:, k] * g[:, j]
        M -= shrink[:, None] * (outer @ both.reshape(len(k), p * p))
        log_det = np.log(values).sum(1) + np.log1p(kappa * tau)
        return _collapse_lag(M.reshape(-1, p, p), beta0, self.weight * log_det)


class GapSequences(NamedTuple):
    """Sequences in which a rate between the first and the last bound is missing."""

    y: np.ndarray  # (sequence, bound), NaN where not measured
    u: np.ndarray  # (sequence, bound, coefficient)
    weight: np.ndarray  # (sequence,)
    x0_mean: float

    def scaled(self, factor: float) -> Self:
        """Multiply the weight of the data by a factor."""
        return self._replace(weight=factor * self.weight)

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
            seen = ~np.isnan(self.y[:, k])
            predicted = beta0[..., None] * m
            predicted[..., 1:] += self.u[:, k]
            S, C = innovation(beta0, Q, R, variance)
            e = -predicted
            e[..., 0] += np.where(seen, self.y[:, k], 0.0)
            precision = np.where(seen, 1.0 / S, 0.0)
            gain = C * precision
            m = beta0[..., None] * m
            m[..., 1:] += self.u[:, k]
            m += gain[..., None] * e
            e[..., 1:] *= -1.0
            M += np.einsum("nsi,nsj,ns->nij", e, e, precision * self.weight, optimize=True)
            log_det += (np.where(seen, np.log(S), 0.0) * self.weight).sum(1)
            variance = update(beta0, Q, variance, gain, S)
        return Quadratic(M[:, 0, 0], M[:, 0, 1:], M[:, 1:, 1:], log_det)


class SufficientStatistics(NamedTuple):
    """Sufficient statistics of missions for the marginal likelihood; they add up.

    `a + b` are the statistics of the missions of both, `a.scaled(w)` those of missions that count
    w times as much: forgetting is `old.scaled(0.9) + new`.
    """

    grams: dict[int, LengthGram]
    gaps: tuple[GapSequences, ...]
    n_measured: float
    """Rates measured, weighted."""
    sums: tuple[float, float]
    """Sums of the rates and of their squares, weighted."""
    x0_mean: float
    ticks: TickWeights
    """Weight of the rates by their number of ticks."""
    n_features: int

    def __add__(self, other: Self) -> Self:  # pyright: ignore[reportIncompatibleMethodOverride]
        if self.x0_mean != other.x0_mean:
            raise TrustboError(
                "statistics gathered under different x0_mean do not add up: "
                f"{self.x0_mean} and {other.x0_mean}."
            )
        if self.n_features != other.n_features:
            raise ShapeError(
                f"statistics of {self.n_features} and {other.n_features} features do not add up."
            )
        grams = dict(self.grams)
        for length, gram in other.grams.items():
            mine = grams.get(length)
            grams[length] = gram if mine is None else mine.plus(gram)
        return type(self)(
            grams,
            self.gaps + other.gaps,
            self.n_measured + other.n_measured,
            (self.sums[0] + other.sums[0], self.sums[1] + other.sums[1]),
            self.x0_mean,
            add_ticks([self.ticks, other.ticks]),
            self.n_features,
        )

    def scaled(self, factor: float) -> Self:
        """Multiply the weight of the missions by a factor."""
        return self._replace(
            grams={length: gram.scaled(factor) for length, gram in self.grams.items()},
            gaps=tuple(gap.scaled(factor) for gap in self.gaps),
            n_measured=factor * self.n_measured,
            sums=(factor * self.sums[0], factor * self.sums[1]),
            ticks=add_ticks([self.ticks], factor),
        )

    @property
    def spread(self) -> float:
        """Standard deviation of the rates; 0 if there are none."""
        if not self.n_measured:
            return 0.0
        mean, square = (total / self.n_measured for total in self.sums)
        return float(np.sqrt(max(square - mean**2, 0.0)))

    def evaluate(self, theta: np.ndarray, x0_sd: float) -> Quadratic:
        """The quadratic form at theta = (beta0, delta_w^2, delta_v^2), shape (theta, 3)."""
        n, d = len(theta), self.n_features + 1
        total = Quadratic(np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d)), np.zeros(n))
        for part in (*self.grams.values(), *self.gaps):
            total = total + part.evaluate(theta, x0_sd)
        return total


Statistics = tuple[SufficientStatistics, ...]
"""Statistics of all robots together, or of each robot if these share nothing."""


def require_forgetting(forgetting: float) -> float:
    """Refuse a factor outside (0, 1].

    Raises:
        TrustboError: It is.
    """
    if not (isinstance(forgetting, float | int) and 0.0 < forgetting <= 1.0):
        raise TrustboError(f"forgetting must be in (0, 1]; got {forgetting!r}.")
    return float(forgetting)


def sufficient_statistics(
    batch: MissionBatch, x0_mean: float, weight: np.ndarray | None = None
) -> SufficientStatistics:
    """Gather the statistics of a batch; rates missing at a mission's end only shorten it.

    Args:
        batch: Missions, padded with NaN.
        x0_mean: Mean of trust before the first bound.
        weight: Weight of each mission, shape (mission,); 1 by default.
    """
    z, y = batch.awareness, batch.contact_rate
    u = np.concatenate([z, np.ones_like(z[..., :1])], axis=-1)
    row_weight = np.repeat(np.ones(len(y)) if weight is None else weight, y.shape[2])
    # One row per robot and mission: (sequence, bound[, coefficient]).
    y = np.swapaxes(y, 1, 2).reshape(-1, y.shape[1])
    u = np.swapaxes(u, 1, 2).reshape(len(y), y.shape[1], -1)
    seen = ~np.isnan(y)
    length, complete = lengths(seen)
    counted = (length > 0) & (row_weight > 0.0)
    grams = {
        int(n): _length_gram(y[rows, :n], u[rows, :n], row_weight[rows], x0_mean)
        for n in np.unique(length[counted & complete])
        for rows in [counted & complete & (length == n)]
    }
    gappy = counted & ~complete
    gaps = ()
    if gappy.any():
        n = length[gappy].max()
        gaps = (GapSequences(y[gappy, :n], u[gappy, :n], row_weight[gappy], x0_mean),)
    weights, rates = (seen * row_weight[:, None])[seen], y[seen]
    sums = (float(weights @ rates), float(weights @ rates**2))
    ticks, n_features = weigh_ticks(batch, weight), z.shape[-1]
    total = float(weights.sum())
    return SufficientStatistics(grams, gaps, total, sums, x0_mean, ticks, n_features)


def lengths(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds up to the last measured one, and whether no rate is missing before it.

    Args:
        seen: Mask of the measured rates, shape (sequence, bound).

    Returns:
        Lengths and completeness, each (sequence,).
    """
    length = np.where(seen.any(1), seen.shape[1] - np.argmax(seen[:, ::-1], axis=1), 0)
    return length, seen.sum(1) == length


def _length_gram(y: np.ndarray, u: np.ndarray, weight: np.ndarray, x0_mean: float) -> LengthGram:
    n_sequences, n_bounds, _ = u.shape
    columns = np.concatenate([y[..., None], np.zeros((n_sequences, n_bounds, 2)), u], axis=-1)
    columns[:, 1:, 1] = y[:, :-1]
    columns[:, 0, 2] = x0_mean
    columns *= np.sqrt(weight)[:, None, None]
    transformed = np.einsum("kl,skp->slp", _sine_basis(n_bounds), columns, optimize=True)
    return LengthGram(
        float(weight.sum()),
        np.einsum("slp,slq->lpq", transformed, transformed, optimize=True),
        np.einsum("skp,sjq->kjpq", columns, columns, optimize=True),
    )


def _collapse_lag(M: np.ndarray, beta0: np.ndarray, log_det: np.ndarray) -> Quadratic:
    """From columns (y, y_lag, x0_mean e_1, u) to y - beta0 y_lag - beta0 x0_mean e_1 and u."""
    v = np.stack([np.ones_like(beta0), -beta0, -beta0], axis=1)
    rows = (v[:, None] @ M[:, :3])[:, 0]
    return Quadratic((rows[:, :3] * v).sum(1), rows[:, 3:], M[:, 3:, 3:], log_det)


def _sine_basis(n: int) -> np.ndarray:
    """Orthonormal, symmetric matrix of the type-I discrete sine transform, (n, n)."""
    k = np.arange(1, n + 1)
    return np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * np.outer(k, k) / (n + 1))
