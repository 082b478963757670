"""Unbiased estimates of the evidence of each chain by drawing its trust once.

Given the hyperparameters and coefficients, trust is drawn bound by bound from

    q(x_k | x_{k-1}) = p(x_k | x_{k-1}) s_k(x_k) beta_k(x_k) / c_k(x_{k-1}),

with beta_k the Gaussian message from the sites behind and s_k the rate's own term where that can be
drawn from (Gaussian, censored), else its site, by a choice among candidates. As the target is
p(x) prod t_k, the weight prod c_k t_k / (s_k beta_k) averages to the chain's evidence for any
sites: importance sampling with lookahead (twisted particles: Guarniero, Johansen and Lee 2017), one
particle. The closer EP's messages, the more even the weights.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numba import njit

from trustbo.inference.evidence.ep.joint import Chains, backward, propagate, start_sites
from trustbo.models.families.terms import (
    AT_ONE,
    COUNT,
    GAUSSIAN,
    LOG_2PI,
    OPTIONS,
    PART_OPTIONS,
    concentration,
    constants,
    draw_censored,
    draw_count,
    new_table,
    table_at,
)

N_CANDIDATES = 8
_TEMPER = 0.6


@njit(**PART_OPTIONS)
def draw_chain(b0, delta_w, delta_v, x0, chains, c, u, table, constant, lam, eta,
               ahead, x, choice, rng):  # fmt: skip
    """Trust of chain c given its drifts u, into x (bound,); the log weight."""
    n, q, phi = chains.length[c], delta_w * delta_w, concentration(delta_v)
    ahead[n - 1] = 0.0
    for k in range(n - 1, 0, -1):  # message on x_k from the sites of bounds k + 1 on
        p, e = lam[c, k] + ahead[k, 0], eta[c, k] + ahead[k, 1]
        D = 1.0 / (1.0 + p * q)
        ahead[k - 1, 0], ahead[k - 1, 1] = b0 * b0 * p * D, b0 * (e - p * u[k]) * D
    m, v, det = b0 * x0[0] + u[0], (b0 * x0[1]) ** 2 + q, 1.0
    precision = 1.0 / (delta_v * delta_v)
    total = 0.5 * chains.squares[c, 0] * (np.log(precision) - LOG_2PI)
    total -= 0.5 * precision * chains.squares[c, 1]
    for k in range(n):
        kind, (bl, be) = chains.kind[c, k], (ahead[k, 0], ahead[k, 1])
        p, e = bl, be
        if kind == GAUSSIAN or kind == COUNT:
            p, e = p + lam[c, k], e + eta[c, k]
        D = 1.0 + p * v
        total += (m * (e - 0.5 * p * m) + 0.5 * e * e * v) / D
        det *= D
        if det > 1e200:
            total -= 0.5 * np.log(det)
            det = 1.0
        mean, sd = (m + e * v) / D, np.sqrt(v / D)
        if kind <= GAUSSIAN:
            x[k] = mean + sd * rng.standard_normal()
        elif kind < COUNT:
            x[k], log_weight = draw_censored(kind, delta_v, mean, sd, rng)
            total += log_weight
        else:
            case = chains.case[c, k]
            x[k], log_weight = draw_count(
                chains.counts[case], phi, table[case], mean, sd, lam[c, k], eta[c, k], choice, rng
            )
            total += log_weight + constant[case]
        total -= x[k] * (be - 0.5 * bl * x[k])
        if k + 1 < n:
            m, v = b0 * x[k] + u[k + 1], q
    return total - 0.5 * np.log(det)


@njit(**PART_OPTIONS)
def log_student(x, mean, L, nu):
    """Log density of a Student-t of precision LL', without the factor (2 pi)^(-D / 2)."""
    D, square = len(x), 0.0
    total = math.lgamma(0.5 * (nu + D)) - math.lgamma(0.5 * nu) - 0.5 * D * np.log(0.5 * nu)
    for i in range(D):
        z = 0.0
        for k in range(i, D):
            z += L[k, i] * (x[k] - mean[k])
        square += z * z
        total += np.log(L[i, i])
    return total - 0.5 * (nu + D) * np.log(1.0 + square / nu)


@njit(**OPTIONS)
def draw_coefficients(b0, delta_w, delta_v, x0, P, g, chains, kept, n_sweeps, nu, gamma, rng):
    """Coefficients at one value of the hyperparameters, and the log weight of each draw.

    `gamma` (draw, coefficient) holds numbers of a standard Student-t of `nu` degrees, and then
    draws of a mixture of two, with the mean and scale of EP's normal approximation, and of that
    under sites of `_TEMPER` times the precision. Rates at a limit carry little information on one
    side, where the posterior of the coefficients has a tail as wide as their prior; and where many
    are of the same place, EP's normal is too narrow. A weight is the prior density times an
    unbiased estimate of each chain's evidence, over the mixture's density: its mean is the
    evidence, but for |P|^(1/2).
    """
    n, D = gamma.shape
    K, last = chains.y.shape[1], chains.gamma_index.shape[1]
    table, sites = new_table(chains.tables), np.empty(kept.shape)
    table_at(chains.tables, delta_v, table)
    start_sites(chains, delta_v, kept, sites[0], sites[1])
    mean, L = np.empty((2, D)), np.zeros((2, D, D))
    propagate(
        b0, delta_w, delta_v, x0, P, g, chains, table, sites[0], sites[1], n_sweeps, 1.0, mean[0],
        L[0], np.bool_(False),
    )  # fmt: skip
    wide = sites.copy()
    for c in range(len(chains.y)):
        for k in range(K):
            if chains.kind[c, k] >= AT_ONE:
                wide[0, c, k] *= _TEMPER
                wide[1, c, k] *= _TEMPER
    propagate(
        b0, delta_w, delta_v, x0, P, g, chains, table, wide[0], wide[1], np.int64(1), 1.0, mean[1],
        L[1], np.bool_(False),
    )  # fmt: skip
    constant = constants(chains.counts, concentration(delta_v))
    weight, u, x, ahead = np.empty(n), np.empty(K), np.empty(K), np.empty((K, 2))
    choice = np.empty((2, N_CANDIDATES))
    for t in range(n):
        z, component = gamma[t], int(rng.random() < 0.5)
        backward(L[component], z)
        for i in range(D):
            z[i] += mean[component, i]
        a, b = log_student(z, mean[0], L[0], nu), log_student(z, mean[1], L[1], nu)
        total = np.log(2.0) - max(a, b) - np.log1p(np.exp(-abs(a - b)))
        for i in range(D):
            for j in range(D):
                total -= 0.5 * (z[i] - g[i]) * P[i, j] * (z[j] - g[j])
        for c in range(len(chains.y)):
            for k in range(K):
                u[k] = chains.drift[c, k]
                for j in range(last):
                    u[k] += chains.u[c, k, j] * z[chains.gamma_index[c, j]]
            of_robot = b0[chains.robot[c]]
            for k in range(K - 1, -1, -1):  # what trust itself is carried on under
                u[k] -= chains.lost * of_robot * (u[k - 1] if k else x0[0])
            total += draw_chain(
                of_robot, delta_w, delta_v, x0, chains, c, u, table, constant, sites[0], sites[1],
                ahead, x, choice, rng,
            )  # fmt: skip
        weight[t] = total
    return weight


def draw_weighted(
    given: Iterable[tuple[Any, ...]],
    count: np.ndarray,
    nu: float,
    chains: Chains,
    sites: np.ndarray,
    n_sweeps: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (draw, coefficient) at each of some points, and log weights but for |P|^(1/2).

    Args:
        given: Arguments of the kernel at each point: beta0 of the robots, noises, mean and sd of
            x0, prior precision and mean of the coefficients.
        count: Draws at each point.
        nu: Degrees of freedom of the proposals.
        chains: Rates.
        sites: Sites to begin with.
        n_sweeps: Sweeps of EP at each point.
        rng: Random number generator.
    """
    gammas, log_weights = [], []
    for point, n in zip(given, count, strict=True):
        gamma = rng.standard_normal((n, len(point[-1])))
        gamma /= np.sqrt(rng.chisquare(nu, (n, 1)) / nu)
        args: tuple[Any, ...] = *point, chains, sites, n_sweeps, nu, gamma, rng
        weights = draw_coefficients(*args)
        gammas.append(gamma)
        log_weights.append(weights)
    return np.concatenate(gammas), np.concatenate(log_weights)
