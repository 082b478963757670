"""Sites of dense blocks, matched by expectation propagation: kernels of `blocks`.

Given hyperparameters, trust at the rows is

    x = m + V c + e,  e ~ N(0, S),  S = autoregression + W diag(sd^2) W',

c the coefficients that all missions share, V their columns, of which those that last are carried
on by beta0, and W those of the mission's own effects. Each report's term is replaced by a site
exp(-lam (x - z)^2 / 2), exact for a Gaussian one, so that c integrates out by one Cholesky factor
of as many rows as there are shared columns, for any number of missions. Marginals of x give
cavities, and sites are matched, all at once, as in `ep.joint`, of which a block is a dense form.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.inference.evidence.ep.joint import cavity, cholesky, solve
from trustbo.models.families.terms import (
    GAUSSIAN,
    INTERVAL,
    LOG_2PI,
    OPTIONS,
    PART_OPTIONS,
    match_interval,
)


class Rows(NamedTuple):
    """Rows of all blocks; block i has those from `start[i]` to `start[i + 1]`."""

    start: np.ndarray  # (block + 1,), of measured rows
    step: np.ndarray  # (block + 1,), of bounds
    U: np.ndarray  # (bound, column), shared columns of the drift
    own: np.ndarray  # (bound, own column)
    begins: np.ndarray  # (bound,), whether it is the first of its chain
    row: np.ndarray  # (bound,), its row, or -1
    y: np.ndarray  # (row,), 0 where a report is an interval or none
    kind: np.ndarray  # (row,), NONE, GAUSSIAN or INTERVAL
    case: np.ndarray  # (row,), index of its limits


class Given(NamedTuple):
    """Hyperparameters of the kernels, leading axis (point,)."""

    beta0: np.ndarray
    delta_w: np.ndarray
    delta_v: np.ndarray
    mean: np.ndarray  # (point, column), prior of the shared coefficients
    sd: np.ndarray
    own_sd: np.ndarray  # (point, own column)
    limits: np.ndarray  # (point, case, 2)
    noise: np.ndarray  # (component, 2), weights and sds by delta_v, see `Scale.noise`


class Room(NamedTuple):
    """Arrays that the kernels write to."""

    V: np.ndarray  # (row, column), columns before reports
    m: np.ndarray  # (row,), mean
    S: np.ndarray  # (block, row, row), covariance
    w: np.ndarray  # (row, own column)
    P: np.ndarray  # (row, 2), variance and bound of each row of a block
    L: np.ndarray  # (block, row, row), see `_whiten`; at last factors of C
    C: np.ndarray  # (block, row, row), see `condition`
    KV: np.ndarray  # (row, column)
    Kd: np.ndarray  # (row,)
    AV: np.ndarray  # (row, column)
    a: np.ndarray  # (row,)
    constant: np.ndarray  # (block,)
    work: np.ndarray  # (row, row)


@njit(**PART_OPTIONS)
def _prior(given, t, x0, lasting, rows, i, room):
    """Fill in the columns, the mean and the covariance of the rows of a block, before reports."""
    V, m, S, w, P = room.V, room.m, room.S[i], room.w, room.P
    b0, q = given.beta0[t], given.delta_w[t] ** 2
    D, L, first = rows.U.shape[1], rows.own.shape[1], rows.start[i]
    v, own, constant, var, chain = np.zeros(D), np.zeros(L), 0.0, 0.0, 0
    for s in range(rows.step[i], rows.step[i + 1]):
        if rows.begins[s]:
            v[:], own[:], constant, var, chain = 0.0, 0.0, x0[0], x0[1] * x0[1], s
        for a in range(D):
            v[a] = b0 * lasting[0][a] * v[a] + rows.U[s, a]
        for a in range(L):
            own[a] = b0 * lasting[1][a] * own[a] + rows.own[s, a]
        constant, var = b0 * constant, b0 * b0 * var + q
        r = rows.row[s] - first
        if r < 0:
            continue
        m[first + r] = constant
        for a in range(D):
            V[first + r, a] = v[a]
        for a in range(L):
            w[first + r, a] = own[a]
        P[r, 0], P[r, 1] = var, s
        for k in range(r + 1):
            z = 0.0
            for a in range(L):
                z += own[a] * given.own_sd[t, a] ** 2 * w[first + k, a]
            if P[k, 1] >= chain:
                z += b0 ** (s - P[k, 1]) * P[k, 0]
            S[r, k] = S[k, r] = z


@njit(**PART_OPTIONS)
def _whiten(rows, i, lam, eta, room):
    """Factor L of a block under its sites, and `constant`, the log of its integral over x.

    With T the sites' precisions, z their centres and LL' = T^(1/2) S T^(1/2) + 1, `KV` becomes
    L^-1 T^(1/2) V (row, column) and `Kd` L^-1 T^(1/2) (z - m) (row,).
    """
    f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
    S, L, work, KV, Kd = room.S[i], room.L[i], room.work, room.KV, room.Kd
    D, constant = room.V.shape[1], 0.0
    for r in range(n):
        for k in range(r + 1):
            work[r, k] = S[r, k] * math.sqrt(lam[f + r] * lam[f + k])
        work[r, r] += 1.0
    if not cholesky(work[:n, :n], L[:n, :n]):
        room.constant[i] = np.nan
        return
    for r in range(n):
        p = lam[f + r]
        root, scale = math.sqrt(p), 1.0 / L[r, r]
        constant += math.log(scale)
        for k in range(D):
            KV[f + r, k] = root * scale * room.V[f + r, k]
        Kd[f + r] = root * scale * (eta[f + r] / p - room.m[f + r]) if p > 0.0 else 0.0
        for j in range(r):
            z = L[r, j] * scale
            for k in range(D):
                KV[f + r, k] -= z * KV[f + j, k]
            Kd[f + r] -= z * Kd[f + j]
        if rows.kind[f + r] == GAUSSIAN:
            constant += 0.5 * (math.log(p) - LOG_2PI)
        elif rows.kind[f + r] == INTERVAL:
            constant += 0.5 * eta[f + r] ** 2 / p
    room.constant[i] = constant


@njit(**PART_OPTIONS)
def condition(rows, i, lam, room, whole):
    """Mean AV c + a and covariance C of a whitened block's x given c.

    Of C its diagonal alone unless `whole`, then its lower triangle. `work` holds L^-1 T^(1/2) S.
    """
    f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
    S, L, C, work, AV, a = room.S[i], room.L[i], room.C[i], room.work, room.AV, room.a
    D = room.V.shape[1]
    for r in range(n):
        root, scale = math.sqrt(lam[f + r]), 1.0 / L[r, r]
        for k in range(n):
            work[r, k] = root * scale * S[r, k]
        for j in range(r):
            z = L[r, j] * scale
            for k in range(n):
                work[r, k] -= z * work[j, k]
        for k in range(D):
            AV[f + r, k] = room.V[f + r, k]
        a[f + r] = room.m[f + r]
        for k in range(0 if whole else r, r + 1):
            C[r, k] = S[r, k]
    for j in range(n):
        for r in range(n):
            z = work[j, r]
            for k in range(D):
                AV[f + r, k] -= z * room.KV[f + j, k]
            a[f + r] += z * room.Kd[f + j]
            for k in range(0 if whole else r, r + 1):
                C[r, k] -= z * work[j, k]


@njit(**PART_OPTIONS)
def new_room(rows):
    """New arrays, and sites lam and eta (row,), and Q and h of the shared coefficients."""
    n, n_blocks, most = len(rows.y), len(rows.start) - 1, 0
    for i in range(n_blocks):
        most = max(most, rows.start[i + 1] - rows.start[i])
    D, square = rows.U.shape[1], (n_blocks, most, most)
    room = Room(
        np.zeros((n, D)), np.zeros(n), np.zeros(square), np.zeros((n, rows.own.shape[1])),
        np.zeros((most, 2)), np.zeros(square), np.zeros(square), np.zeros((n, D)), np.zeros(n),
        np.zeros((n, D)), np.zeros(n), np.zeros(n_blocks), np.zeros((most, most)),
    )  # fmt: skip
    return room, np.empty(n), np.empty(n), np.zeros((D, D)), np.zeros(D)


@njit(**PART_OPTIONS)
def _start(given, t, rows, kept, lam, eta):
    """Sites to begin with: exact ones of Gaussian terms, those kept of intervals."""
    precision = 1.0 / given.delta_v[t] ** 2
    for r in range(len(rows.y)):
        lam[r], eta[r] = kept[0, r], kept[1, r]
        if rows.kind[r] == GAUSSIAN:
            lam[r], eta[r] = precision, precision * rows.y[r]


@njit(**PART_OPTIONS)
def gather(given, t, rows, lam, eta, room, Q, h):
    """Quadratic form of the shared coefficients, prior included; the log constant, without it."""
    D, total = len(h), 0.0
    for a in range(D):
        for b in range(D):
            Q[a, b] = 0.0
        p = given.sd[t, a] ** -2.0
        Q[a, a], h[a] = p, p * given.mean[t, a]
        total -= 0.5 * h[a] * given.mean[t, a] + math.log(given.sd[t, a])
    for i in range(len(rows.start) - 1):
        _whiten(rows, i, lam, eta, room)
        total += room.constant[i]
    KV, Kd = room.KV, room.Kd
    for r in range(len(rows.y)):
        total -= 0.5 * Kd[r] * Kd[r]
        for a in range(D):
            h[a] += KV[r, a] * Kd[r]
            for b in range(a + 1):
                Q[a, b] += KV[r, a] * KV[r, b]
    return total


@njit(**PART_OPTIONS)
def sweep(given, t, rows, lam, eta, room, Q, h, F, mean, damp):
    """Log evidence under the sites, which are matched then, in place if `damp` > 0."""
    D, total = len(h), gather(given, t, rows, lam, eta, room, Q, h)
    total += 0.5 * solve(Q, h, F, mean)
    if not np.isfinite(total):
        return np.nan
    AV, u = room.AV, np.empty(D)
    for i in range(len(rows.start) - 1):
        f, g = rows.start[i], rows.start[i + 1]
        some = False
        for r in range(f, g):
            some = some or rows.kind[r] == INTERVAL
        if not some:
            continue
        condition(rows, i, lam, room, False)
        for r in range(f, g):
            if rows.kind[r] != INTERVAL:
                continue
            x, v = room.a[r], room.C[i, r - f, r - f]
            for j in range(D):  # AV' Q^-1 AV = |F^-1 AV|^2
                x += AV[r, j] * mean[j]
                z = AV[r, j]
                for k in range(j):
                    z -= F[j, k] * u[k]
                u[j] = z / F[j, j]
                v += u[j] * u[j]
            low, high = given.limits[t, rows.case[r]]
            m, rest = cavity(x, v, lam[r], eta[r])
            mass, new, slope = match_interval(
                low, high, given.delta_v[t], given.noise, m, rest, lam[r], eta[r]
            )
            total += mass
            lam[r] += damp * (new - lam[r])
            eta[r] += damp * (slope - eta[r])
    return total


@njit(**PART_OPTIONS)
def prepare(given, t, x0, lasting, rows, room, kept, lam, eta):
    """Lay out all blocks at a point, and the sites to begin with."""
    for i in range(len(rows.start) - 1):
        _prior(given, t, x0, lasting, rows, i, room)
    _start(given, t, rows, kept, lam, eta)


@njit(**OPTIONS)
def log_evidence(given, x0, lasting, rows, kept, n_sweeps):
    """Log evidence at each point; the last sweep only evaluates."""
    room, lam, eta, Q, h = new_room(rows)
    F, mean, out = np.zeros(Q.shape), np.zeros(len(h)), np.empty(len(given.beta0))
    for t in range(len(out)):
        prepare(given, t, x0, lasting, rows, room, kept, lam, eta)
        for s in range(n_sweeps):
            damp = 1.0 if s + 1 < n_sweeps else 0.0
            out[t] = sweep(given, t, rows, lam, eta, room, Q, h, F, mean, damp)
    return out


@njit(**OPTIONS)
def settle(given, x0, lasting, rows, kept, n_sweeps):
    """Sites (2, row) after damped sweeps at the first point."""
    room, _, _, Q, h = new_room(rows)
    F, mean, sites = np.zeros(Q.shape), np.zeros(len(h)), kept.copy()
    prepare(given, 0, x0, lasting, rows, room, kept, sites[0], sites[1])
    for _ in range(n_sweeps):
        sweep(given, 0, rows, sites[0], sites[1], room, Q, h, F, mean, 0.8)
    return sites


@njit(**OPTIONS)
def moments_of(given, x0, lasting, rows, i, c, mean, cov):
    """Mean and covariance of the rows of block i at each point, before reports."""
    room, f, n = new_room(rows)[0], rows.start[i], rows.start[i + 1] - rows.start[i]
    for t in range(len(c)):
        _prior(given, t, x0, lasting, rows, i, room)
        for r in range(n):
            z = room.m[f + r]
            for a in range(c.shape[1]):
                z += room.V[f + r, a] * c[t, a]
            mean[t, r] = z
            for k in range(n):
                cov[t, r, k] = room.S[i, r, k]
