"""Slow, obvious references that share no code with trustbo."""

import math
import struct
from typing import NamedTuple

import numpy as np
import shapely
from scipy import special, stats
from scipy.linalg import block_diag
from scipy.stats import norm


def dense_log_likelihood(beta0, beta, b, delta_w, delta_v, x0_mean, x0_sd, awareness, contact_rate):
    """Log density of one robot's measured rates, from their joint normal written out in full.

    With x = A x_prev + c + w stacked over bounds, x = L^-1 (c + beta0 x0 e_1 + w), L bidiagonal.
    awareness: (bound, feature); contact_rate: (bound,), NaN where not measured.
    """
    K = len(contact_rate)
    L = np.eye(K) - beta0 * np.eye(K, k=-1)
    inverse = np.linalg.inv(L)
    drift = awareness @ beta + b
    first = np.zeros(K)
    first[0] = beta0
    mean = inverse @ (drift + first * x0_mean)
    cov_x = inverse @ (np.diag(np.full(K, delta_w**2)) + np.outer(first, first) * x0_sd**2)
    cov_x = cov_x @ inverse.T
    seen = ~np.isnan(contact_rate)
    cov = (cov_x + delta_v**2 * np.eye(K))[np.ix_(seen, seen)]
    residual = (contact_rate - mean)[seen]
    _, log_det = np.linalg.slogdet(cov)
    quadratic = residual @ np.linalg.solve(cov, residual)
    return -0.5 * (quadratic + log_det + seen.sum() * math.log(2.0 * math.pi))


def dense_posterior_of_trust(
    beta0, beta, b, delta_w, delta_v, x0_mean, x0_sd, awareness, contact_rate
):
    """Mean and covariance of one robot's trust given its measured rates, by conditioning."""
    K = len(contact_rate)
    inverse = np.linalg.inv(np.eye(K) - beta0 * np.eye(K, k=-1))
    first = np.zeros(K)
    first[0] = beta0
    mean = inverse @ (awareness @ beta + b + first * x0_mean)
    prior = inverse @ (delta_w**2 * np.eye(K) + np.outer(first, first) * x0_sd**2) @ inverse.T
    seen = ~np.isnan(contact_rate)
    gain = prior[:, seen] @ np.linalg.inv((prior + delta_v**2 * np.eye(K))[np.ix_(seen, seen)])
    return mean + gain @ (contact_rate - mean)[seen], prior - gain @ prior[seen]


class Joint(NamedTuple):
    """Joint normal of a mission's trust x and rates y, each flat over (bound, robot)."""

    mean_x: np.ndarray
    cov_x: np.ndarray
    cov_xy: np.ndarray
    mean_y: np.ndarray
    cov_y: np.ndarray


def dense_joint(B0, drift, Q, R, x0_mean, x0_sd):
    """Moments of a mission's trust and rates, drift (bound, robot).

    Trust as one vector of all bounds and robots: A x = d + B0 x_0 e_1 + w; rates y = x + v.
    """
    K, n = drift.shape
    eye, first = np.eye(K), np.eye(K)[:, :1]
    inverse = np.linalg.inv(np.eye(K * n) - np.kron(np.eye(K, k=-1), B0))
    start = np.kron(first, B0)  # how x_0 enters
    x0 = np.full(n, x0_mean)
    mean_x = inverse @ (drift.ravel() + start @ x0)
    cov_x = inverse @ (np.kron(eye, Q) + start @ start.T * x0_sd**2) @ inverse.T
    return Joint(mean_x, cov_x, cov_x, mean_x, cov_x + np.kron(eye, R))


def dense_coupled(B0, drift, Q, R, x0_mean, x0_sd, contact_rate):
    """Log density of a mission's rates, and moments of its trust, from one joint normal.

    drift, contact_rate: (bound, robot), rates NaN where not measured.
    """
    mean_x, cov_x, cov_xy, mean_y, cov_y = dense_joint(B0, drift, Q, R, x0_mean, x0_sd)
    y = contact_rate.ravel()
    seen = ~np.isnan(y)
    cov, residual = cov_y[np.ix_(seen, seen)], (y - mean_y)[seen]
    log_det = np.linalg.slogdet(cov)[1]
    quadratic = residual @ np.linalg.solve(cov, residual)
    log_density = -0.5 * (quadratic + log_det + seen.sum() * math.log(2.0 * math.pi))
    gain = cov_xy[:, seen] @ np.linalg.inv(cov)
    mean = mean_x + gain @ residual
    return log_density, mean.reshape(drift.shape), cov_x - gain @ cov_xy[:, seen].T


def pooled_posterior(missions, n_points=(60, 30), reach=0.12, floor=0.0, power=1):
    """Posterior of the pooled model under the default priors, by the midpoint rule.

    Given beta0, delta_w and delta_v, rates are jointly normal with a mean linear in (beta, b):
    these integrate out in closed form, the other three over a grid.

    Args:
        missions: Complete missions.
        n_points: Points of the grid for beta0, and for each of the other two.
        reach: Largest standard deviation on the grid, far in the tail.
        floor: Least delta_v.
        power: Points are equally spaced in this root, for posteriors close to (0, 0, floor).

    Returns:
        For each of (beta0, delta_w, delta_v): its points and their weights; for each of (beta, b):
        means and standard deviations of normals, and their weights.
    """
    units = [(np.arange(n) + 0.5) / n for n in n_points]
    beta0, deltas = (u**power for u in units)
    deltas *= reach
    width, widths = ((power - 1) * np.log(u) for u in units)
    w, v = np.meshgrid(deltas, floor + deltas, indexing="ij")
    n_weights = missions[0].awareness.shape[-1] + 1
    prior_precision = np.diag(1.0 / np.r_[np.ones(n_weights - 1), 0.5] ** 2)
    log_weight = np.empty((len(beta0), *w.shape))
    mean, sd = (np.empty((*log_weight.shape, n_weights)) for _ in range(2))
    for i, a in enumerate(beta0):
        precision = np.broadcast_to(prior_precision, (*w.shape, n_weights, n_weights)).copy()
        h = np.zeros((*w.shape, n_weights))
        log_density = np.log(a * (1.0 - a)) - 0.5 * (w**2 + v**2) / 0.2**2
        log_density += width[i] + widths[:, None] + widths
        noise = {}  # by length of the mission
        for n in {len(mission.contact_rate) for mission in missions}:
            roll = np.linalg.inv(np.eye(n) - a * np.eye(n, k=-1))
            start = a * roll[:, 0]
            cov = w[..., None, None] ** 2 * roll @ roll.T + v[..., None, None] ** 2 * np.eye(n)
            cov += 0.5**2 * np.outer(start, start)
            noise[n] = roll, start, np.linalg.inv(cov), np.linalg.slogdet(cov)[1]
        for mission in missions:
            roll, start, inverse, log_det = noise[len(mission.contact_rate)]
            for robot in range(mission.contact_rate.shape[1]):
                design = roll @ np.c_[mission.awareness[:, robot], np.ones(len(roll))]
                residual = mission.contact_rate[:, robot] - 0.5 * start
                weighted = inverse @ residual
                precision += design.T @ inverse @ design
                h += weighted @ design
                log_density -= 0.5 * (weighted @ residual + log_det)
        cov = np.linalg.inv(precision)
        mean[i] = (cov @ h[..., None])[..., 0]
        sd[i] = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
        log_weight[i] = log_density + 0.5 * ((h * mean[i]).sum(-1) + np.linalg.slogdet(cov)[1])
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    marginals = [weight.sum(axes) for axes in ((1, 2), (0, 2), (0, 1))]
    return list(zip((beta0, deltas, floor + deltas), marginals, strict=True)), (mean, sd, weight)


def on_a_grid(family, p, z, y, n_points=1201, *, n_ticks=20, last_trust=False):
    """p(y) of one robot by filtering point masses of trust: the trapezoid rule, bound by bound.

    Log p(y); with `last_trust` also the mean and sd of trust at the last bound.
    """
    width = 9.0 if family == "beta_binomial" else 2.5
    x = np.linspace(0.5 - width, 0.5 + width, n_points)
    step = x[1] - x[0]
    likelihood = np.ones(n_points)
    weights = norm.pdf(x, p.x0_mean, p.x0_sd) * step
    scale = 1.0 / (p.delta_w * np.sqrt(2.0 * np.pi))  # a normal density over all pairs, by hand
    log_total = 0.0
    for k in range(len(y)):
        mean = p.beta0 * x + z[k] @ p.beta + p.b
        move = scale * np.exp(-0.5 * ((x[:, None] - mean[None]) / p.delta_w) ** 2)
        weights = move @ weights * step
        if np.isnan(y[k]):
            likelihood = np.ones(n_points)
        elif family == "beta_binomial":
            phi = p.delta_v**-2.0
            share = special.expit(x)
            likelihood = stats.betabinom.pmf(
                round(y[k] * n_ticks), n_ticks, phi * share, phi * (1 - share)
            )
        elif y[k] <= 0.0:
            likelihood = norm.cdf(0.0, x, p.delta_v)
        elif y[k] >= 1.0:
            likelihood = norm.sf(1.0, x, p.delta_v)
        else:
            likelihood = norm.pdf(y[k], x, p.delta_v)
        weights = weights * likelihood
        log_total += np.log(weights.sum())
        weights /= weights.sum()
    if last_trust:
        mean = weights @ x
        return log_total, mean, np.sqrt(weights @ (x - mean) ** 2)
    return log_total


def named(mean, mu, taus, delta_w, delta_v, own):
    """Parameters of partially pooled robots by name.

    Args:
        mean: Mean of beta0, shape (draw,).
        mu: Means of the two weights and of b, shape (draw, 3).
        taus: Spreads of beta0, the weights and b, shape (draw, 4).
        delta_w: Process noise, shape (draw,).
        delta_v: Noise of the rates, shape (draw,).
        own: For each robot its beta0 and coefficients, shape (draw, 4).
    """
    own = np.stack(own, axis=1)
    return {"mean_beta0": mean, "mean_beta": mu[:, :2], "mean_b": mu[:, 2], "delta_w": delta_w,
            "delta_v": delta_v, "tau_beta0": taus[:, 0], "tau_beta": taus[:, 1:3],
            "tau_b": taus[:, 3], "beta0": own[..., 0],
            "beta": own[..., 1:3].reshape(len(own), -1), "b": own[..., 3]}  # fmt: skip


def geometry_of_blob(blob):
    """A GeoPackage's geometry: a header, by whose flags an envelope follows, then WKB."""
    magic, version, flags, srs = struct.unpack("<2sBBi", blob[:8])
    assert (magic, version, flags & 1) == (b"GP", 0, 1)
    doubles = {0: 0, 1: 4, 2: 6, 3: 6, 4: 8}[flags >> 1 & 7]
    return srs, shapely.from_wkb(blob[8 + 8 * doubles :])


class DenseOfPlaces:
    """Joint normal of all rates with effects of places, over missions, robots and bounds.

    theta = beta0, noises, tau_s, length scale, tau_e.
    """

    def __init__(self, missions, place, theta, priors):
        beta0, w, v, tau_s, ell, tau_e = theta
        T, V, mean, U, rows = [], [], [], [], []
        for m in missions:
            K = len(m.bounds)
            lag = np.subtract.outer(np.arange(K), np.arange(K))
            t = np.where(lag >= 0, beta0 ** np.maximum(lag, 0.0), 0.0)
            start = beta0 ** np.arange(1, K + 1)
            cov = priors.x0_sd**2 * np.outer(start, start) + w**2 * t @ t.T + v**2 * np.eye(K)
            for i in range(m.contact_rate.shape[1]):
                T.append(t)
                V.append(cov)
                mean.append(priors.x0_mean * start)
                U.append(np.column_stack([m.awareness[:, i], np.ones(K)]))
                rows += [(i, a, c) for a, c in zip(m.path[:-1], m.path[1:], strict=True)]
        self.rows, self.T = rows, block_diag(*T)
        y = np.concatenate([m.contact_rate[:, i] for m in missions for i in range(3)])
        self.seen, self.U = ~np.isnan(y), np.concatenate(U)
        cells, before = (np.array([r[k] for r in rows]) for k in (2, 1))
        gap = np.linalg.norm(cells[:, None] - cells[None], axis=2) * np.sqrt(3.0) / ell
        self.K_s = tau_s**2 * (1.0 + gap) * np.exp(-gap)
        met = (cells[:, None] == cells[None]).all(2) & (before[:, None] == before[None]).all(2)
        self.K_e = tau_e**2 * met
        rest = 1.0 - beta0 if priors.stationary else 1.0
        n = self.U.shape[1] - 1
        self.c_mean = rest * np.append(np.broadcast_to(priors.beta.loc, n), priors.b.loc)
        sd = rest * np.append(np.broadcast_to(priors.beta.scale, n), priors.b.scale)
        self.c_cov = np.diag(sd**2)
        inside = self.U @ self.c_cov @ self.U.T + self.K_s + self.K_e
        full = block_diag(*V) + self.T @ inside @ self.T.T
        self.cov = full[np.ix_(self.seen, self.seen)]
        self.off = (y - np.concatenate(mean) - self.T @ self.U @ self.c_mean)[self.seen]

    def log_likelihood(self):
        return stats.multivariate_normal(cov=self.cov).logpdf(self.off)

    def posterior(self, prior_cross, prior_cov, prior_mean):
        """Moments of what has this prior covariance with T'y's argument."""
        cross = prior_cross @ self.T.T[:, self.seen]
        gain = np.linalg.solve(self.cov, cross.T).T
        return prior_mean + gain @ self.off, prior_cov - gain @ cross.T


def require_weighted(drawn, log_evidence, prior, log_weight, *, kish, nats, shift, log_ratio):
    """Require draws and evidence to be those of draws from the prior, weighted by likelihood.

    `kish` is the least effective number of the latter, `nats` the sampler's error of the evidence,
    `shift` that of a mean, in sds, and `log_ratio` that of the log of an sd.
    """
    weight = np.exp(log_weight - log_weight.max())
    effective = weight.sum() ** 2 / (weight**2).sum()
    assert effective > kish
    expected = special.logsumexp(log_weight) - np.log(len(weight))
    assert abs(log_evidence - expected) < 4 / np.sqrt(effective) + nats
    weight /= weight.sum()
    for name, draws in drawn.items():
        theirs = prior[name].reshape(len(weight), -1)
        for a, b in zip(draws.reshape(len(draws), -1).T, theirs.T, strict=True):
            mean = weight @ b
            sd = np.sqrt(weight @ (b - mean) ** 2)
            assert abs(a.mean() - mean) < shift * sd, name
            assert abs(np.log(a.std() / sd)) < log_ratio, name
