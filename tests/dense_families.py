"""References of observation families: SciPy's densities, closed forms, and integrals over grids.

Rates whose linear predictors are jointly normal have a density in closed form if all but one of
them are Gaussian, and else an integral over few predictors. Nothing of the package is imported.
"""

import numpy as np
from dense_statespace import conditional, log_density
from scipy import special, stats
from scipy.stats import norm

LOGISTIC = (
    np.array([0.252201, 0.585225, 0.162574]),
    np.sqrt(3.0) / np.pi / np.array([0.90793, 0.577787, 0.364038]),
)
"""Shares and standard deviations of the normal mixture that stands for a logistic distribution with
standard deviation 1 (Monahan and Stefanski 1992)."""


def likelihood(family, y, n_ticks, f, sd):
    """Density or probability of a rate given linear predictors f."""
    if family == "beta_binomial":
        phi, share = sd**-2.0, special.expit(f)
        return stats.betabinom.pmf(round(y * n_ticks), n_ticks, phi * share, phi * (1.0 - share))
    if family == "censored" and y <= 0.0:
        return norm.cdf(0.0, f, sd)
    if family == "censored" and y >= 1.0:
        return norm.sf(1.0, f, sd)
    return norm.pdf(y, f, sd)


def of_one_report(mean, var, level, n_levels, sd):
    """Log probability of a report of a level, with logistic noise, given normal trust."""
    n = n_levels - 1
    ends = [
        -np.inf if level == 0 else (level - 0.5) / n,
        np.inf if level == n else (level + 0.5) / n,
    ]
    shares, sds = LOGISTIC
    p = 0.0
    for share, of_one in zip(shares / shares.sum(), sds, strict=True):
        low, high = norm.cdf(ends, mean, np.hypot(np.sqrt(var), of_one * sd))
        p += share * (high - low)
    return np.log(p)


def with_one_limit(mean, cov, y):
    """Log density of censored rates y (rate,), of which one is 0 or 1 and others are NaN or inside.

    `mean` and `cov` are those of the rates before they are censored, with their own noise.
    """
    [at] = np.flatnonzero((y <= 0.0) | (y >= 1.0))
    others = np.where(np.arange(len(y)) == at, np.nan, y)
    m, v = conditional(mean, cov, cov, mean, cov, others)
    limit = (y[at] - m[at]) / np.sqrt(v[at, at])
    tail = norm.logcdf(limit) if y[at] <= 0.0 else norm.logsf(limit)
    return log_density(mean, cov, others) + tail


def trust_with_one_limit(mean, trust_cov, rate_cov, y):
    """Mean and covariance of trust given rates as in `with_one_limit`."""
    [at] = np.flatnonzero((y <= 0.0) | (y >= 1.0))
    others = np.where(np.arange(len(y)) == at, np.nan, y)

    # Trust and, last, the rate, given the other rates.
    one = [at]
    joint = np.block([[trust_cov, trust_cov[:, one]], [trust_cov[one], rate_cov[np.ix_(one, one)]]])
    cross = np.vstack([trust_cov, rate_cov[one]])
    m, cov = conditional(np.append(mean, mean[at]), joint, cross, mean, rate_cov, others)

    # The rate is normal, and lies beyond the limit.
    sd = np.sqrt(cov[-1, -1])
    truncated = stats.truncnorm(-np.inf, (y[at] - m[-1]) / sd)
    if y[at] >= 1.0:
        truncated = stats.truncnorm((y[at] - m[-1]) / sd, np.inf)
    gain = cov[:-1, -1] / sd
    left = cov[:-1, :-1] - np.outer(gain, gain) * (1.0 - truncated.var())
    return m[:-1] + gain * truncated.mean(), left


def expected_rate(family, trust, sd):
    """Expected rate given trust: of a normal variable that is clipped to [0, 1], or a logistic."""
    if family == "beta_binomial":
        return special.expit(trust)
    if family == "gaussian":
        return trust

    def integral(x):
        return x * special.ndtr(x) + np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)

    return sd * (integral(trust / sd) - integral((trust - 1.0) / sd))  # of P(rate > t) over t


def by_quadrature(family, mean, trust_cov, noise, y, n_ticks, n_points=201):
    """Log density of two rates, NaN if not measured, over a grid of their linear predictors.

    `mean` and `trust_cov` are of trust, and `noise` is the covariance of the noise of the rates.
    """
    if family == "beta_binomial":
        cov, sd = trust_cov, np.sqrt(np.diag(noise))
    else:  # a part of the noise is apart for each rate, and the rest is in the predictors
        own = 0.5 * np.linalg.eigvalsh(noise).min()
        cov, sd = trust_cov + noise - own * np.eye(2), np.sqrt([own, own])

    e = np.linspace(-8.0, 8.0, n_points)
    a, b = np.meshgrid(e, e, indexing="ij")
    root = np.linalg.cholesky(cov)
    f = mean[:, None, None] + np.stack([root[0, 0] * a, root[1, 0] * a + root[1, 1] * b])
    density = norm.pdf(a) * norm.pdf(b)
    for k in np.flatnonzero(~np.isnan(y)):
        density = density * likelihood(family, y[k], n_ticks, f[k], sd[k])
    return np.log(density.sum()) + 2.0 * np.log(e[1] - e[0])


def on_a_grid(family, p, z, y, n_points=1201, *, n_ticks=20):
    """Filter the trust of one robot as point masses on a grid: the trapezoid rule, bound by bound.

    Returns log p(y), and the mean and standard deviation of trust at the last bound.

    Args:
        family: Observation family.
        p: Parameters of the pooled model.
        z: Awareness (bound, feature).
        y: Rates (bound,), NaN where not measured.
        n_points: Number of points of the grid.
        n_ticks: Number of ticks of a bound.
    """
    width = 9.0 if family == "beta_binomial" else 2.5
    x = np.linspace(0.5 - width, 0.5 + width, n_points)
    step = x[1] - x[0]
    weights = norm.pdf(x, p.x0_mean, p.x0_sd) * step
    scale = 1.0 / (p.delta_w * np.sqrt(2.0 * np.pi))  # a normal density over all pairs, by hand
    log_total = 0.0
    for k in range(len(y)):
        mean = p.beta0 * x + p.beta @ z[k] + p.b
        move = scale * np.exp(-0.5 * ((x[:, None] - mean[None]) / p.delta_w) ** 2)
        weights = move @ weights * step
        if not np.isnan(y[k]):
            weights = weights * likelihood(family, y[k], n_ticks, x, p.delta_v)
        log_total += np.log(weights.sum())
        weights /= weights.sum()

    mean = weights @ x
    return log_total, mean, np.sqrt(weights @ (x - mean) ** 2)
