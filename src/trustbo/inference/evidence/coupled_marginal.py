"""Rates of coupled robots with the linear coefficients integrated out, at many parameter values.

Given B0 and the noises, with x_k = B0 x_{k-1} + (coefficients . inputs)_k + noise, the rates
are normal and linear in the coefficients c, which have normal priors. The Kalman filter of
`vector` is linear in rates and drift, and its covariances depend on neither: the innovations of
the rates, and of the response to each coefficient alone, are columns of one recursion. Whitened,
they are the rows of a regression e = y - X c with unit noise. With prior precision L and mean m,

    [ X'X + L     X'y + L m    ]
    [ (.)'        y'y + m' L m ]   has the Cholesky factor   [ F   0 ]
                                                             [ h'  s ],

and -2 log p(y) = s^2 + sum log S + 2 log |F| - log |L| + n log 2 pi, c | y ~ N(F'^-1 h, (F F')^-1).
A missing rate gives no row; a mission's weight multiplies the squares of its rows.
"""

from typing import NamedTuple

import numba as nb
import numpy as np

from trustbo.inference.evidence.ep.joint import copy
from trustbo.parallel import PART, over_rows, plain

LOG_2PI = np.log(2.0 * np.pi)


class Sequences(NamedTuple):
    """Missions grouped by pattern of gaps, and the layout of the coefficients."""

    y: np.ndarray  # (mission, bound, robot), 0 where missing
    seen: np.ndarray  # (mission, bound, robot)
    inputs: np.ndarray  # (mission, bound, coefficient), covariate of each coefficient
    weight: np.ndarray  # (mission,)
    length: np.ndarray  # (mission,), bounds up to the last rate
    kind: np.ndarray  # (mission,), missions of one kind have the same gaps up to their lengths
    robot: np.ndarray  # (coefficient,), whose trust it moves
    x0: tuple[float, float]  # mean and sd of trust before the first bound


class Dynamics(NamedTuple):
    """Parameter values with a leading axis (point,)."""

    B0: np.ndarray  # (point, robot, robot')
    Q: np.ndarray  # (point, robot, robot')
    R: np.ndarray  # (point, robot, robot')
    mean: np.ndarray  # (point, coefficient), prior
    precision: np.ndarray  # (point, coefficient)


def gather_sequences(
    awareness: np.ndarray,
    contact_rate: np.ndarray,
    weight: np.ndarray,
    robot: np.ndarray,
    source: np.ndarray,
    x0: tuple[float, float],
) -> Sequences:
    """Missions of awareness (mission, bound, robot, feature) and rates (mission, bound, robot).

    A coefficient moves the trust of `robot`. `source` is its covariate, an index into the awareness
    of all robots, (robot x feature), with a 1 behind.
    """
    seen = ~np.isnan(contact_rate)
    length = np.where(seen.any(2), np.arange(1, seen.shape[1] + 1), 0).max(1)
    kept = np.flatnonzero((weight > 0.0) & (length > 0))
    # Longest first within the same gaps: a short mission has the leading covariances of a long one.
    gaps = [~seen[j, : length[j]] for j in range(len(seen))]
    where = [np.argwhere(gap).tobytes() for gap in gaps]
    order = sorted(kept, key=lambda j: (where[j], -length[j]))
    kind = np.cumsum([where[j] != where[order[max(i - 1, 0)]] for i, j in enumerate(order)])
    flat = np.nan_to_num(awareness[order]).reshape(len(order), seen.shape[1], -1)
    inputs = np.append(flat, np.ones((*flat.shape[:2], 1)), axis=2)[..., source]
    return Sequences(
        y=plain(np.where(seen, contact_rate, 0.0)[order]),
        seen=plain(seen[order]),
        inputs=plain(inputs),
        weight=plain(weight[order] * 1.0),
        length=plain(length[order]),
        kind=plain(kind),
        robot=plain(robot),
        x0=x0,
    )


def integrate(sequences: Sequences, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Log density of the rates (point,), and the bordered factors (point, c + 1, c + 1).

    The density is NaN where a covariance is not positive definite.
    """
    n, q = len(dynamics.B0), dynamics.mean.shape[1] + 1
    value, factor = np.empty(n), np.zeros((n, q, q))
    dynamics = Dynamics(*(plain(a) for a in dynamics))
    over_rows(lambda i, j: _integrate(sequences, dynamics, i, j, value, factor), n)
    return value, factor


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _integrate(data, dynamics, first, last, value, factor):
    n_missions, n_bounds, n = data.y.shape
    p = len(data.robot)
    rows = np.zeros((n_missions * n_bounds * n, p + 1))
    gain, scale = np.zeros((n_bounds, n, 2 * n)), np.zeros((n_bounds, n))
    m, J, of_bound = np.empty((n, p + 1)), np.empty((2 * n, p + 1)), np.empty(n_bounds)
    spread = np.empty((n, p))
    for t in range(first, last):
        for c in range(p):
            for i in range(n):
                spread[i, c] = 1.0 if i == data.robot[c] else 0.0
        total, n_rows = 0.0, np.int64(0)  # an int64 throughout
        for s in range(n_missions):
            if s == 0 or data.kind[s] != data.kind[s - 1]:
                _filter(data.seen[s], data.length[s], dynamics.B0[t], dynamics.Q[t],
                        dynamics.R[t], data.x0[1], gain, scale, of_bound)  # fmt: skip
            total += data.weight[s] * of_bound[: data.length[s]].sum()
            n_rows = _whiten(data, s, dynamics.B0[t], spread, gain, scale, m, J, rows, n_rows)
        A = factor[t]
        copy(rows[:n_rows].T @ rows[:n_rows], A)
        for c in range(p):
            of_prior = dynamics.precision[t, c]
            A[c, c] += of_prior
            # The recursion gives columns of -X: drifts enter the innovations with a minus.
            A[p, c] = of_prior * dynamics.mean[t, c] - A[p, c]
            A[p, p] += of_prior * dynamics.mean[t, c] ** 2
            total -= np.log(of_prior)
        _cholesky(A)
        for c in range(p):
            total += 2.0 * np.log(A[c, c])
        value[t] = -0.5 * (total + A[p, p] ** 2)


@nb.njit(error_model="numpy", **PART)
def _filter(seen, length, B0, Q, R, x0_sd, gain, scale, of_bound):
    """Gains and inverse scales of innovations of each bound, robot by robot (`vector`)."""
    n = len(B0)
    F, J = np.empty((2 * n, n)), np.empty((2 * n, 2 * n))
    copy(B0, F[:n])
    copy(B0, F[n:])
    P = np.zeros((n, n))
    for i in range(n):
        P[i, i] = x0_sd**2
    half = np.empty((2 * n, n))
    for k in range(length):
        for a in range(2 * n):
            for j in range(n):
                half[a, j] = 0.0
                for i in range(n):
                    half[a, j] += F[a, i] * P[i, j]
        for a in range(2 * n):
            for b in range(2 * n):
                J[a, b] = Q[a % n, b % n]
                for j in range(n):
                    J[a, b] += half[a, j] * F[b, j]
        for a in range(n):
            for b in range(n):
                J[n + a, n + b] += R[a, b]
        of_bound[k] = 0.0
        for i in range(n):
            if seen[k, i]:
                var = J[n + i, n + i]
                scale[k, i] = 1.0 / np.sqrt(var) if var > 0.0 else np.nan
                of_bound[k] += np.log(var) + LOG_2PI if var > 0.0 else np.nan
                for a in range(2 * n):
                    gain[k, i, a] = J[n + i, a] / var
                for a in range(2 * n):
                    for b in range(2 * n):
                        J[a, b] -= gain[k, i, a] * gain[k, i, b] * var
        copy(J[:n, :n], P)


@nb.njit(error_model="numpy", **PART)
def _whiten(data, s, B0, spread, gain, scale, m, J, rows, n_rows):
    """Write the whitened innovations of one mission as rows; number of rows then."""
    n, q = m.shape
    m[:, :] = 0.0
    m[:, q - 1] = data.x0[0]
    w = np.sqrt(data.weight[s])
    for k in range(data.length[s]):
        for a in range(n):
            for c in range(q - 1):
                J[a, c] = spread[a, c] * data.inputs[s, k, c]
            J[a, q - 1] = 0.0
            for j in range(n):
                f = B0[a, j]
                for c in range(q):
                    J[a, c] += f * m[j, c]
            for c in range(q):
                J[n + a, c] = J[a, c]
        for i in range(n):
            if data.seen[s, k, i]:
                e, row = J[n + i], rows[n_rows]
                for c in range(q):
                    e[c] = -e[c]
                e[q - 1] += data.y[s, k, i]
                for c in range(q):
                    row[c] = w * scale[k, i] * e[c]
                for a in range(n + n):
                    if a < n or a > n + i:
                        g = gain[k, i, a]
                        for c in range(q):
                            J[a, c] += g * e[c]
                n_rows += 1
        copy(J[:n], m)
    return n_rows


@nb.njit(error_model="numpy", **PART)
def _cholesky(A):
    """Factor of A's lower triangle, in place, zeros above; NaN where it is not positive."""
    n = len(A)
    column = np.empty(n)
    for j in range(n):
        d = np.sqrt(A[j, j]) if A[j, j] > 0.0 else np.nan
        for i in range(j, n):
            column[i] = A[i, j] / d
            A[i, j] = column[i]
        A[j, j + 1 :] = 0.0
        for i in range(j + 1, n):
            f = column[i]
            for k in range(j + 1, i + 1):
                A[i, k] -= f * column[k]
