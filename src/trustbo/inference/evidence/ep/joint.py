"""Evidence of rates that are no linear function of trust, coefficients integrated out with it.

Method: expectation propagation (Minka 2001) on a Gauss-Markov chain for each mission and robot, all
chains sharing coefficients gamma ~ N(g, P^-1): weights of features, intercepts, effects of places.

    x_1 ~ N(b0 m0 + u_1, b0^2 s0^2 + dw^2),  x_k ~ N(b0 x_{k-1} + u_k, dw^2),  u_k = a_k + U_k gamma

Where the deviation from u lasts, not trust, u_k - b0 u_{k-1} takes the place of u_k, u_0 = m0.
Each rate's term (`terms`) is replaced by a site exp(-lam x^2 / 2 + eta x). Under the sites all is
Gaussian: a scalar filter of each chain carries the mean of x as a linear function of gamma, one
column for each of its coefficients, so that a chain's sites give its evidence as a quadratic form
in gamma; these add up to gamma's precision Q = P + ... and its mean, by one Cholesky factor. A
smoother returns the marginals of each x, the cavities follow, and sites are matched, all at once.

Sweeps start from sites kept at the mode of the hyperparameters. The last only evaluates:
log Z = log Gaussian integral + sum log(mass of cavity times term / mass of cavity times site) is
stationary in the sites, so that their error enters squared, and two sweeps suffice. Where all terms
are Gaussian the first sweep is exact. The remaining error is corrected by the weights of `draws`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.models.families import Family
from trustbo.models.families.terms import (
    AT_ONE,
    GAUSSIAN,
    LOG_2PI,
    OPTIONS,
    PART_OPTIONS,
    count_tables,
    match,
    new_table,
    table_at,
)


class Chains(NamedTuple):
    """Sequences of rates, one for each mission and robot with a rate; the kernels' arguments."""

    y: np.ndarray  # (chain, bound), 0 where missing
    kind: np.ndarray  # (chain, bound), of each term, see `terms`
    case: np.ndarray  # (chain, bound), of each count
    u: np.ndarray  # (chain, bound, column), drift that each of its coefficients gives
    gamma_index: np.ndarray  # (chain, column), their indices in gamma
    robot: np.ndarray  # (chain,), index of its beta0
    length: np.ndarray  # (chain,), bounds up to the last rate
    first: np.ndarray  # (chain,), the first bound whose term is not Gaussian; else the length
    squares: np.ndarray  # (chain, 2), number of Gaussian terms and sum of their squared rates
    drift: np.ndarray  # (chain, bound), fixed part of the drift
    counts: np.ndarray  # (case, 2): ticks in contact, ticks
    tables: np.ndarray  # (phi, case, x), see `terms.count_tables`
    lost: float  # share of the drift before that is not carried on: 0, or 1 where deviations last


def chains_of(
    family: Family,
    y: np.ndarray,
    n_ticks: np.ndarray,
    u: np.ndarray,
    column: np.ndarray,
    length: np.ndarray | None = None,
) -> tuple[Chains, np.ndarray]:
    """Chains of rates, of robots that share beta0, and the sites to begin with, (2, chain, bound).

    Args:
        family: Family of observations.
        y: Rates (chain, bound), NaN where not measured.
        n_ticks: Ticks of that shape.
        u: Drift that each of a chain's coefficients gives, (chain, bound, column).
        column: Indices of these coefficients, (chain, column).
        length: Bounds of each chain; by default up to its last rate.
    """
    terms, seen = family.terms(y, n_ticks), ~np.isnan(y)
    gaussian, late = terms.kind == GAUSSIAN, terms.kind >= AT_ONE
    rates = np.where(seen, y, 0.0)
    ends = y.shape[1] - np.argmax(seen[:, ::-1], axis=1) if length is None else length
    chains = Chains(
        rates,
        terms.kind,
        terms.case,
        np.ascontiguousarray(u),
        np.ascontiguousarray(column),
        np.zeros(len(y), dtype=int),
        ends,
        np.where(late.any(1), np.argmax(late, axis=1), ends),
        np.stack([gaussian.sum(1), (np.where(gaussian, rates, 0.0) ** 2).sum(1)], axis=1),
        np.zeros(y.shape),
        terms.counts,
        count_tables(terms.counts),
        0.0,
    )
    return chains, np.stack([terms.lam, terms.eta])


@njit(**PART_OPTIONS)
def _filter(
    b0, q, x0, chain, u, drift, n, lost, lam, eta, predicted, filtered, var, Q, h
):  # fmt: skip
    """Filter a chain under its sites: log integral at gamma = 0; adds to a quadratic form in gamma.

    Columns of `predicted` and `filtered` (bound, column + 1) are the mean's coefficients, the last
    its constant; of `var` (bound, 2), the variances before and after the site.
    """
    last = u.shape[2]
    total, det = 0.0, 1.0
    v = b0 * b0 * x0[1] * x0[1] + q
    for j in range(last):
        predicted[0, j] = u[chain, 0, j]
    predicted[0, last] = b0 * (1.0 - lost) * x0[0] + drift[chain, 0]
    for k in range(n):
        p, e = lam[chain, k], eta[chain, k]
        D = 1.0 + p * v
        i = 1.0 / D
        det *= D
        if det > 1e200:
            total -= 0.5 * np.log(det)
            det = 1.0
        m, w = predicted[k, last], p * i
        total += (m * (e - 0.5 * p * m) + 0.5 * e * e * v) * i
        r = (e - p * m) * i
        for a in range(last):
            pa = predicted[k, a]
            if pa != 0.0:
                h[a] += r * pa
                for b in range(a + 1):
                    Q[a, b] += w * pa * predicted[k, b]
        var[k, 0], var[k, 1] = v, v * i
        for j in range(last):
            filtered[k, j] = predicted[k, j] * i
        filtered[k, last] = (m + e * v) * i
        if k + 1 < n:
            for j in range(last):
                carried = filtered[k, j] - lost * u[chain, k, j]
                predicted[k + 1, j] = b0 * carried + u[chain, k + 1, j]
            carried = filtered[k, last] - lost * drift[chain, k]
            predicted[k + 1, last] = b0 * carried + drift[chain, k + 1]
            v = b0 * b0 * v * i + q
    return total - 0.5 * np.log(det)


@njit(**PART_OPTIONS)
def copy(source, target):
    """Copy a matrix by loops; slice assignment takes two seconds to compile."""
    for i in range(len(source)):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@njit(**PART_OPTIONS)
def cholesky(A, L):
    """Lower factor of A's lower triangle; whether it is positive definite."""
    for i in range(len(A)):
        for j in range(i):
            z = A[i, j]
            for k in range(j):
                z -= L[i, k] * L[j, k]
            L[i, j] = z / L[j, j]
        d = A[i, i]
        for k in range(i):
            d -= L[i, k] * L[i, k]
        if not d > 0.0:
            return False
        L[i, i] = np.sqrt(d)
    return True


@njit(**PART_OPTIONS)
def backward(L, b):
    """L'^-1 b, in place."""
    for i in range(len(b) - 1, -1, -1):
        for k in range(i + 1, len(b)):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@njit(**PART_OPTIONS)
def solve(Q, h, L, mean):
    """Factor of Q and mean Q^-1 h; returns h'Q^-1 h - log |Q|, or NaN."""
    total = 0.0
    if not cholesky(Q, L):
        return np.nan
    for i in range(len(h)):
        z = h[i]
        for k in range(i):
            z -= L[i, k] * mean[k]
        mean[i] = z / L[i, i]
        total += mean[i] * mean[i] - 2.0 * np.log(L[i, i])
    backward(L, mean)
    return total


@njit(**PART_OPTIONS)
def cavity(m, v, lam, eta):
    """Mean and variance of what is left of N(m, v) without a site."""
    rest = max(1.0 / v - lam, 1e-9)
    return (m / v - eta) / rest, 1.0 / rest


@njit(**PART_OPTIONS)
def _invert(L, inverse, covariance):
    """L^-1 and (LL')^-1, by rows: the inner loops run along the memory, and beat LAPACK's."""
    D = len(L)
    for i in range(D):
        scale = 1.0 / L[i, i]
        for j in range(i + 1):
            inverse[i, j] = covariance[i, j] = 0.0
        for k in range(i):
            z = L[i, k] * scale
            for j in range(k + 1):
                inverse[i, j] -= z * inverse[k, j]
        inverse[i, i] = scale
    for k in range(D):
        for i in range(k + 1):
            z = inverse[k, i]
            for j in range(i + 1):
                covariance[i, j] += z * inverse[k, j]
    for i in range(D):
        for j in range(i):
            covariance[j, i] = covariance[i, j]


@njit(**PART_OPTIONS)
def _match_chain(b0, chain, chains, delta_v, table, predicted, filtered, var, mean, cov,
                 lam, eta, damp, gamma, Sigma, s):  # fmt: skip
    """Smooth a chain, match its sites, in place if `damp` > 0; log of the masses' ratios."""
    kind, case, columns = chains.kind, chains.case, chains.gamma_index
    precision, n, last = 1.0 / (delta_v * delta_v), chains.length[chain], columns.shape[1]
    total = 0.5 * chains.squares[chain, 0] * (np.log(precision) - LOG_2PI)
    total -= 0.5 * precision * chains.squares[chain, 1]
    if chains.first[chain] >= n:
        return total
    for a in range(last):
        gamma[a] = mean[columns[chain, a]]
        for b in range(last):
            Sigma[a, b] = cov[columns[chain, a], columns[chain, b]]
    v = 0.0
    for k in range(n - 1, chains.first[chain] - 1, -1):
        if k == n - 1:
            for j in range(last + 1):
                s[j] = filtered[k, j]
            v = var[k, 1]
        else:
            A = b0 * var[k, 1] / var[k + 1, 0]
            for j in range(last + 1):
                s[j] = filtered[k, j] + A * (s[j] - predicted[k + 1, j])
            v = var[k, 1] + A * A * (v - var[k + 1, 0])
        if kind[chain, k] >= AT_ONE:
            m, spread = s[last], v
            for a in range(last):
                m += s[a] * gamma[a]
                z = 0.0
                for b in range(last):
                    z += Sigma[a, b] * s[b]
                spread += s[a] * z
            lv, e = lam[chain, k], eta[chain, k]
            m, rest = cavity(m, spread, lv, e)
            mass, new, slope = match(kind[chain, k], delta_v, table[case[chain, k]], m, rest, lv, e)
            total += mass
            lam[chain, k] += damp * (new - lv)
            eta[chain, k] += damp * (slope - e)
    return total


@njit(**PART_OPTIONS)
def start_sites(chains, delta_v, kept, lam, eta):
    """Sites to begin with: exact ones of Gaussian terms, those kept of the others."""
    for c in range(len(chains.y)):
        for k in range(chains.y.shape[1]):
            lam[c, k], eta[c, k] = kept[0, c, k], kept[1, c, k]
            if chains.kind[c, k] == GAUSSIAN:
                lam[c, k] = 1.0 / (delta_v * delta_v)
                eta[c, k] = lam[c, k] * chains.y[c, k]


@njit(**PART_OPTIONS)
def propagate(b0, delta_w, delta_v, x0, P, g, chains, table, lam, eta, n_sweeps, damp, mean, L,
              evaluate):  # fmt: skip
    """Log evidence at one value of the hyperparameters, without the term log |P| / 2.

    Sites are updated in place by all sweeps but the last; mean and L are those of gamma and of the
    factor of its precision at the last. Without `evaluate` only these are computed.
    """
    (n_chains, K), D, last = chains.y.shape, len(g), chains.gamma_index.shape[1]
    # One by one: numba takes arrays unpacked from a larger one for strided, and loops run slower.
    predicted, filtered = np.empty((n_chains, K, last + 1)), np.empty((n_chains, K, last + 1))
    var, inverse, cov = np.empty((n_chains, K, 2)), np.empty((D, D)), np.empty((D, D))
    Q, h, own_Q, own_h = np.empty((D, D)), np.empty(D), np.empty((last, last)), np.empty(last)
    gamma, Sigma, s = np.empty(last), np.empty((last, last)), np.empty(last + 1)
    easy = not (chains.kind >= AT_ONE).any()
    total = np.nan
    for sweep in range(1 if easy else n_sweeps):
        total = 0.0
        for i in range(D):
            h[i] = 0.0
            for j in range(D):
                Q[i, j] = P[i, j]
                h[i] += P[i, j] * g[j]
            total -= 0.5 * g[i] * h[i]
        for c in range(n_chains):
            own_Q[:], own_h[:] = 0.0, 0.0
            total += _filter(
                b0[chains.robot[c]], delta_w * delta_w, x0, c, chains.u, chains.drift,
                chains.length[c], chains.lost, lam, eta, predicted[c], filtered[c], var[c], own_Q,
                own_h,
            )  # fmt: skip
            for a in range(last):
                i = chains.gamma_index[c, a]
                h[i] += own_h[a]
                for b in range(a + 1):
                    j = chains.gamma_index[c, b]
                    # A bound made twice: both columns have one index in gamma.
                    twice = 2.0 if i == j and a != b else 1.0
                    Q[max(i, j), min(i, j)] += twice * own_Q[a, b]
        total += 0.5 * solve(Q, h, L, mean)
        if not np.isfinite(total):
            return -np.inf
        if sweep + 1 == n_sweeps and not evaluate:
            return np.nan
        _invert(L, inverse, cov)
        for c in range(n_chains):
            total += _match_chain(
                b0[chains.robot[c]], c, chains, delta_v, table, predicted[c], filtered[c],
                var[c], mean, cov, lam, eta, damp if sweep + 1 < n_sweeps else 0.0, gamma,
                Sigma, s,
            )  # fmt: skip
    return total


@njit(**OPTIONS)
def log_evidence(b0, delta_w, delta_v, x0, P, g, chains, kept, n_sweeps):
    """Log evidence (point,) without log |P| / 2, at hyperparameters with a leading axis (point,).

    Args:
        b0: Shape (point, robot).
        delta_w: Shape (point,).
        delta_v: Shape (point,).
        x0: Mean and sd of trust before the first bound.
        P: Prior precision of gamma, (point, coefficient, coefficient).
        g: Its prior mean, (point, coefficient).
        chains: Rates.
        kept: Sites to begin with (2, chain, bound), lam and eta.
        n_sweeps: Sweeps, the last without an update.
    """
    n, D = g.shape
    out = np.empty(n)
    lam, eta = np.empty(chains.y.shape), np.empty(chains.y.shape)
    table = new_table(chains.tables)
    mean, L = np.empty(D), np.zeros((D, D))
    for t in range(n):
        table_at(chains.tables, delta_v[t], table)
        start_sites(chains, delta_v[t], kept, lam, eta)
        out[t] = propagate(
            b0[t], delta_w[t], delta_v[t], x0, P[t], g[t], chains, table, lam, eta, n_sweeps, 1.0,
            mean, L, np.bool_(True),
        )  # fmt: skip
    return out


@njit(**OPTIONS)
def settle(b0, delta_w, delta_v, x0, P, g, chains, kept, n_sweeps):
    """Sites after damped sweeps at one value of the hyperparameters, (2, chain, bound)."""
    sites = np.empty(kept.shape)
    table = new_table(chains.tables)
    table_at(chains.tables, delta_v, table)
    start_sites(chains, delta_v, kept, sites[0], sites[1])
    propagate(
        b0, delta_w, delta_v, x0, P, g, chains, table, sites[0], sites[1], n_sweeps + 1, 0.8,
        np.empty(len(g)), np.zeros(P.shape), np.bool_(False),
    )  # fmt: skip
    return sites
