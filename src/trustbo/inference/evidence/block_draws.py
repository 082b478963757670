"""Draws of trust in dense blocks, and of the coefficients they share: kernels of `blocks`.

Given c, each block's trust is drawn row by row from its prior times the sites of later rows
times the row's own term, and weighted by the ratio of masses of term and site (twisted particles,
as in `ep.draws`). The mean weight of some particles is an unbiased estimate of the block's
likelihood; draws of c with the product of these as weights are exact for any number of particles
(importance sampling squared). The own effects follow from the trust that is drawn.
"""

import math

import numpy as np
from numba import njit

from trustbo.inference.evidence.block_sites import condition, gather, new_room, prepare, sweep
from trustbo.inference.evidence.ep.draws import log_student
from trustbo.inference.evidence.ep.joint import backward, cavity, solve
from trustbo.models.families.terms import (
    INTERVAL,
    OPTIONS,
    PART_OPTIONS,
    draw_interval,
    log_overlap,
)

_TEMPER, _TEMPER_AT_END = 0.8, 0.5  # precision of the wide proposal's sites
_SHARES = (0.5, 0.4, 0.1)  # of the proposals of the shared coefficients


@njit(**PART_OPTIONS)
def _draw_block(given, t, rows, i, lam, eta, c, room, x, e, rng):
    """One particle of a block into x; its log weight."""
    f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
    G, total = room.L[i], 0.0
    for r in range(n):
        mean = room.a[f + r]
        for k in range(len(c)):
            mean += room.AV[f + r, k] * c[k]
        for k in range(r):
            mean += G[r, k] * e[k]
        d = G[r, r]
        if rows.kind[f + r] == INTERVAL:
            m, v = cavity(mean, d * d, lam[f + r], eta[f + r])
            low, high = given.limits[t, rows.case[f + r]]
            x[r], log_p = draw_interval(
                low, high, given.delta_v[t], given.noise, m, math.sqrt(v), rng
            )
            total += log_p - log_overlap(m, v, lam[f + r], eta[f + r])
        else:
            x[r] = mean + d * rng.standard_normal()
        e[r] = (x[r] - mean) / d if d > 1e-12 else 0.0
    return total


@njit(**PART_OPTIONS)
def _factor(A, n, G):
    """Lower factor of a covariance, its pivots kept from 0."""
    for r in range(n):
        for k in range(r + 1):
            z = A[r, k]
            for j in range(k):
                z -= G[r, j] * G[k, j]
            G[r, k] = math.sqrt(max(z, 1e-14 + 1e-12 * A[r, r])) if k == r else z / G[k, k]


@njit(**PART_OPTIONS)
def _draw_own(given, t, rows, i, c, x, room, own, rng):
    """Own effects of a block given its trust x."""
    V, m, w, G = room.V, room.m, room.w, room.work
    f, n, L = rows.start[i], rows.start[i + 1] - rows.start[i], rows.own.shape[1]
    _factor(room.S[i], n, G)
    e, B = np.empty(n), np.empty((n, L))
    for r in range(n):  # G^-1 (x - m - V c), and G^-1 W diag(sd)
        z = x[r] - m[f + r]
        for k in range(len(c)):
            z -= V[f + r, k] * c[k]
        for k in range(r):
            z -= G[r, k] * e[k]
        e[r] = z / G[r, r]
        for a in range(L):
            z = w[f + r, a] * given.own_sd[t, a]
            for k in range(r):
                z -= G[r, k] * B[k, a]
            B[r, a] = z / G[r, r]
    left, root, noise = np.empty((L, L)), np.zeros((L, L)), np.empty(L)
    for a in range(L):
        noise[a] = rng.standard_normal()
        for b in range(L):
            z = 1.0 if a == b else 0.0
            for r in range(n):
                z -= B[r, a] * B[r, b]
            left[a, b] = z
    _factor(left, L, root)
    for a in range(L):
        z = 0.0
        for r in range(n):
            z += B[r, a] * e[r]
        for b in range(a + 1):
            z += root[a, b] * noise[b]
        own[a] = given.own_sd[t, a] * z


@njit(**PART_OPTIONS)
def _propose(given, t, mean, F, nu, exact, c, rng):
    """Shared coefficients of numbers c, in place; log prior density less that of the proposal.

    Proposals are EP's normal, a wider one, and the prior, which bounds the weights.
    """
    D, j, total, share = len(c), 0, 0.0, rng.random()
    if not exact:
        j = 0 if share < _SHARES[0] else 1 if share < _SHARES[0] + _SHARES[1] else 2
    backward(F[j], c)
    for k in range(D):
        c[k] += mean[j, k]
        z = (c[k] - given.mean[t, k]) / given.sd[t, k]
        total -= 0.5 * z * z + math.log(given.sd[t, k])
    if exact:
        return total
    top, mass = -np.inf, 0.0
    for i in range(3):
        a = log_student(c, mean[i], F[i], nu) + math.log(_SHARES[i])
        if a > top:
            top, mass = a, mass * math.exp(top - a) + 1.0
        else:
            mass += math.exp(a - top)
    return total - top - math.log(mass)


@njit(**PART_OPTIONS)
def _log_given(rows, i, room, c):
    """Log integral of a block under its sites given c."""
    total = room.constant[i]
    for r in range(rows.start[i], rows.start[i + 1]):
        z = room.Kd[r]
        for k in range(len(c)):
            z -= room.KV[r, k] * c[k]
        total -= 0.5 * z * z
    return total


@njit(**OPTIONS)
def draw_blocks(given, x0, lasting, rows, kept, n_sweeps, nu, n_particles, count, c, x, log_block,
                own, log_weight, exact, rng):  # fmt: skip
    """Draws at each point in turn: trust, likelihoods of blocks, own effects and log weights.

    With nu > 0 the rows of `c` are numbers of a standard Student-t, or normal ones if `exact`, and
    become draws of the shared coefficients; with nu = 0 they are these.
    """
    D, n_blocks = rows.U.shape[1], len(rows.start) - 1
    room, lam, eta, Q, h = new_room(rows)
    mean, F = np.zeros((3, D)), np.zeros((3, D, D))
    wide_lam, wide_eta = np.empty(len(rows.y)), np.empty(len(rows.y))
    most = len(room.work)
    particle, best, e = np.empty(most), np.empty(most), np.empty(most)
    d = 0
    for t in range(len(count)):
        prepare(given, t, x0, lasting, rows, room, kept, lam, eta)
        if not exact:
            for _ in range(n_sweeps + 1):
                sweep(given, t, rows, lam, eta, room, Q, h, F[0], mean[0], 1.0)
        if not exact and nu > 0.0:
            for r in range(len(rows.y)):
                factor = 1.0
                if rows.kind[r] == INTERVAL:
                    low, high = given.limits[t, rows.case[r]]
                    factor = _TEMPER if np.isfinite(high - low) else _TEMPER_AT_END
                wide_lam[r], wide_eta[r] = factor * lam[r], factor * eta[r]
            gather(given, t, rows, wide_lam, wide_eta, room, Q, h)
            solve(Q, h, F[1], mean[1])
            for k in range(D):
                mean[2, k], F[2, k, k] = given.mean[t, k], 1.0 / given.sd[t, k]
        gather(given, t, rows, lam, eta, room, Q, h)
        solve(Q, h, F[0], mean[0])
        for i in range(n_blocks):
            condition(rows, i, lam, room, True)
            _factor(room.C[i], rows.start[i + 1] - rows.start[i], room.L[i])
        for _ in range(count[t]):
            total = 0.0
            if nu > 0.0:
                total = _propose(given, t, mean, F, nu, exact, c[d], rng)
            for i in range(n_blocks):
                f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
                log_sum = -np.inf
                for _p in range(1 if exact else n_particles):
                    w = _draw_block(given, t, rows, i, lam, eta, c[d], room, particle, e, rng)
                    top = max(log_sum, w)
                    log_sum = top + math.log(math.exp(log_sum - top) + math.exp(w - top))
                    if math.log(1.0 - rng.random()) <= w - log_sum:  # a choice by weight
                        for r in range(n):
                            best[r] = particle[r]
                log_sum -= math.log(1 if exact else n_particles)
                log_block[d, i] = _log_given(rows, i, room, c[d]) + log_sum
                total += log_block[d, i]
                for r in range(n):
                    x[d, f + r] = best[r]
                _draw_own(given, t, rows, i, c[d], best, room, own[d, i], rng)
            log_weight[d] = total
            d += 1
