"""Expectation propagation (EP) for observations that are not linear in the predictor.

Each likelihood term t(f) is replaced by a site exp(-lam f^2 / 2 + eta f). Given the sites, `engine`
computes the marginals of the linear predictors exactly. Dividing a marginal by its site gives the
cavity. The site is then updated to match moments: the product of the cavity and the new site has
the same moments as the product of the cavity and the likelihood term (Minka 2001; Rasmussen and
Williams 2006, section 3.6). The log evidence is the log evidence of the sites plus, for each term,
the log ratio of the masses of these products.

Sweeps over all sites run at one theta only. From there, `nearby` finds the sites at other theta,
which takes a single factorisation. Importance weights correct the draws for the errors.
"""

from typing import NamedTuple, Self

import numpy as np
from scipy.interpolate import CubicSpline

from trustbo.inference.engine import Blocks, Fit, Prior, evidence, marginals, whiten
from trustbo.inference.factor import cholesky
from trustbo.models.families import Family
from trustbo.models.families.moments import log_normal
from trustbo.statespace.blocks import LinearPredictor, each

_LEAST = 1e-9
"""Smallest precision of a cavity or a site."""
_LEAST_VARIANCE = 1e-12
"""Smallest variance of a matched product."""
_VAGUE_SD = 0.3
"""Sd of trust, on the scale of rates, under which the initial sites are matched."""
_USUAL_NOISE = 0.2
"""Sd of the observation noise with which the initial sites are matched."""
_LOG_SDS = np.arange(np.log(1e-3), np.log(5.0), 0.2)
"""Logs of the noise sds between which sites are interpolated."""
_SPLINE = CubicSpline(_LOG_SDS, np.eye(len(_LOG_SDS)))
"""Weights of the sites at `_LOG_SDS` as functions of a log noise sd."""
_JITTER = 1e-12
"""Number added to the covariance of the predictors of a block."""


class Rates(NamedTuple):
    """Observations of all blocks and their family; each block must be a separate kind."""

    likelihood: Family
    y: np.ndarray  # (block, row), NaN where not measured
    n_ticks: np.ndarray  # (block, row)

    @property
    def linear(self) -> np.ndarray:
        """Mask (block, row) of the observations whose sites are exact."""
        return ~np.isnan(self.y) & self.likelihood.is_density(self.y)


class Joint(NamedTuple):
    """Blocks, linear predictors, prior and observations at each theta."""

    blocks: Blocks
    predictor: LinearPredictor
    prior: Prior
    rates: Rates


class Sites(NamedTuple):
    """Gaussian sites (point, block, row) with precision lam and precision-weighted mean eta."""

    lam: np.ndarray
    eta: np.ndarray

    @property
    def y(self) -> np.ndarray:
        """Means of the sites, 0 where there is no site."""
        some = self.lam != 0.0
        return np.where(some, self.eta / np.where(some, self.lam, 1.0), 0.0)

    def of(self, index: np.ndarray | slice) -> "Sites":
        """Return the sites of the points with this index."""
        return Sites(self.lam[index], self.eta[index])

    def close_to(self, other: "Sites", share: float) -> bool:
        """Return whether no site differs from another by more than a share of the largest one."""
        return all(
            np.abs(a - b).max() <= share * np.abs(b).max() for a, b in zip(self, other, strict=True)
        )

    def at(self, rates: Rates, sd: np.ndarray) -> "Sites":
        """Return the sites, with exact values for linear observations given the noise sd."""
        lam = np.where(rates.linear, sd**-2.0, self.lam)
        eta = np.where(rates.linear, np.nan_to_num(rates.y) * sd**-2.0, self.eta)
        return Sites(*np.broadcast_arrays(lam, eta))


def first_sites(rates: Rates) -> Sites:
    """Make initial sites (1, block, row), matched under a vague distribution of trust."""
    unit, zero = rates.likelihood.line_of_sight
    y = rates.y
    m = np.full(y.shape, unit * (0.5 - zero))
    v = np.full(y.shape, (_VAGUE_SD * unit) ** 2)
    noise = np.full(y.shape, _USUAL_NOISE)

    _, mean, var = rates.likelihood.moment_match(y, rates.n_ticks, m, v, noise)
    return _matched(rates, 1.0 / v[None], m / v, mean, var)


class Nearby(NamedTuple):
    """Sites for all theta near the one at which EP has run; see `nearby`.

    If the noise of a rate is added to the predictor, these are sites of the sum of both, which do
    not depend on theta. Otherwise, they are sites of the predictor at several values of the noise
    sd (node,).
    """

    lam: np.ndarray  # (node, block, row), like the next two
    eta: np.ndarray
    log_ratio: np.ndarray
    """Log ratio of the masses of the cavity times the likelihood term, and times the site.

    A site is the density N(y; f, 1 / lam) if noise is added to the predictor. Otherwise, it is
    exp(eta f - lam f^2 / 2), which changes smoothly with the noise sd even if lam is nearly 0.
    """

    @classmethod
    def from_sites(cls, joint: Joint, sites: Sites) -> Self:
        """Match the sites in the cavities that given sites have at one theta."""
        rates = joint.rates
        _, cavity = _cavities(joint, sites)
        if rates.likelihood.adds_noise:
            v = cavity.var + joint.predictor.noise_sd**2
            sd = np.zeros((1, 1, 1))
        else:
            v = cavity.var
            sd = np.exp(_LOG_SDS)[:, None, None]

        m, v = (np.broadcast_to(x, (len(sd), *rates.y.shape)) for x in (cavity.mean, v))
        log_mass, mean, var = rates.likelihood.moment_match(rates.y, rates.n_ticks, m, v, sd)
        found = _matched(rates, 1.0 / v, m / v, mean, np.maximum(var, _LEAST_VARIANCE))
        log_ratio = _log_ratios(rates, found, log_mass, m, v)
        if not rates.likelihood.adds_noise:
            log_ratio = log_ratio + _log_constants(rates, found)
        return cls(*found, log_ratio)

    def at(self, rates: Rates, sd: np.ndarray) -> tuple[Sites, np.ndarray]:
        """Return the sites of the predictors, and the log ratios of all rates (point,)."""
        if rates.likelihood.adds_noise:
            lam = self.lam / (1.0 + self.lam * sd**2)
            eta = self.eta / (1.0 + self.lam * sd**2)
            log_ratio = self.log_ratio.sum((1, 2))
        else:
            w = _SPLINE(np.clip(np.log(sd), _LOG_SDS[0], _LOG_SDS[-1]))
            lam, eta, log_ratio = (_weighted(w, values) for values in self)
            lam = np.where(np.isnan(rates.y), 0.0, np.maximum(lam, _LEAST))
            log_ratio = (log_ratio - _log_constants(rates, Sites(lam, eta))).sum((1, 2))
        return Sites(lam, eta).at(rates, sd), log_ratio


def _weighted(w: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum values (node, block, row) with weights w (point, 1, 1 or row, node)."""
    if w.shape[2] > 1:
        return np.einsum("pqrn,nbr->pbr", w, values)
    return (w[:, 0, 0] @ values.reshape(len(values), -1)).reshape(len(w), *values.shape[1:])


def nearby(joint: Joint, near: Nearby) -> Fit:
    """Approximate EP at each theta, given the sites near another theta.

    The log evidence of EP is stationary in the sites and in the cavities (Minka 2001). Therefore,
    errors of the cavities change it only to second order. Cavities of the predictor plus its noise
    change less with theta than cavities of the predictor, because the data determine the sum of the
    variances of trust and noise.
    """
    blocks, predictor, prior, rates = joint
    sites, log_ratio = near.at(rates, predictor.noise_sd)
    fit = evidence(blocks, predictor, prior, sites.lam, sites.y)
    return fit._replace(log_p=fit.log_p + log_ratio)


def _log_constants(rates: Rates, sites: Sites) -> np.ndarray:
    """Compute log N(y; f, 1 / lam) - (eta f - lam f^2 / 2) of each site, which is constant in f."""
    is_exact = np.isnan(rates.y) | rates.linear
    lam = np.where(is_exact, 1.0, sites.lam)
    constant = 0.5 * (np.log(lam / (2.0 * np.pi)) - sites.eta**2 / lam)
    return np.where(is_exact, 0.0, constant)


def _log_ratios(
    rates: Rates, sites: Sites, log_mass: np.ndarray, m: np.ndarray, v: np.ndarray
) -> np.ndarray:
    """Compute log ratios of the masses of N(f; m, v) times each term and times its site (3.65)."""
    is_exact = np.isnan(rates.y) | rates.linear
    return np.where(is_exact, 0.0, log_mass - _overlap(sites.y, sites.lam, m, v))


def _matched(
    rates: Rates, rest: np.ndarray, slope: np.ndarray, mean: np.ndarray, var: np.ndarray
) -> Sites:
    """Find the sites whose products with cavities N(slope / rest, 1 / rest) match mean and var."""
    seen = ~np.isnan(rates.y)
    lam = np.where(seen, np.maximum(1.0 / var - rest, _LEAST), 0.0)
    eta = np.where(seen, mean * (lam + rest) - slope, 0.0)
    return Sites(lam, eta)


def swept(joint: Joint, sites: Sites, n_sweeps: int, damp: float = 1.0) -> Sites:
    """Return the sites at each theta after `n_sweeps` sweeps, which each update all of them."""
    rates = joint.rates
    sd = joint.predictor.noise_sd
    sites = sites.at(rates, sd)
    for _ in range(n_sweeps):
        _, cavity = _cavities(joint, sites)
        _, mean, var = rates.likelihood.moment_match(
            rates.y, rates.n_ticks, cavity.mean, cavity.var, sd
        )

        # The site that gives these moments (Rasmussen and Williams 2006, equation 3.59), damped.
        var = np.maximum(var, _LEAST_VARIANCE)
        new = _matched(rates, cavity.precision, cavity.slope, mean, var)
        lam, eta = sites
        sites = Sites(lam + damp * (new.lam - lam), eta + damp * (new.eta - eta)).at(rates, sd)
    return sites


def log_evidence(joint: Joint, sites: Sites) -> np.ndarray:
    """Compute the EP log evidence (point,) with the given sites."""
    rates = joint.rates
    sd = joint.predictor.noise_sd
    sites = sites.at(rates, sd)
    log_sites, cavity = _cavities(joint, sites)

    m = cavity.mean
    v = cavity.var
    log_mass, _, _ = rates.likelihood.moment_match(rates.y, rates.n_ticks, m, v, sd)
    return log_sites + _log_ratios(rates, sites, log_mass, m, v).sum((1, 2))


class _Cavities(NamedTuple):
    """Normal distributions (point, block, row) of the predictors without the site of each one."""

    precision: np.ndarray
    slope: np.ndarray  # mean times precision

    @property
    def mean(self) -> np.ndarray:
        return self.slope / self.precision

    @property
    def var(self) -> np.ndarray:
        return 1.0 / self.precision


def _cavities(joint: Joint, sites: Sites) -> tuple[np.ndarray, _Cavities]:
    """Return the log evidence (point,) of the sites, and the cavities."""
    blocks, predictor, prior, _ = joint
    lam, eta = sites
    y = sites.y
    fit = evidence(blocks, predictor, prior, lam, y)
    mean, var = marginals(blocks, predictor, prior, fit, y)

    # Divide the marginal by its site (Rasmussen and Williams 2006, equation 3.56).
    precision = np.maximum(1.0 / var - lam, _LEAST)
    return fit.log_p, _Cavities(precision, mean / var - eta)


def _overlap(y: np.ndarray, lam: np.ndarray, m: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Compute the log mass of N(f; m, v) times the site N(y; f, 1 / lam), or 0 without a site."""
    some = lam > 0.0
    total = v + 1.0 / np.where(some, lam, 1.0)
    return np.where(some, log_normal(y - m, total), 0.0)


def draw_predictors(
    joint: Joint, at: np.ndarray, sites: Sites, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw linear predictors row by row, given the means and the observations.

    Args:
        joint: Blocks, linear predictors, prior and observations.
        at: Mean linear predictors (draw, block, row) given the coefficients.
        sites: Sites that approximate the likelihood of later rows.
        rng: Random number generator.

    Returns:
        Linear predictors (draw, block, row) and log weights (draw, block). The mean weight is the
        likelihood of a block given the coefficients.
    """
    blocks, predictor, _, rates = joint
    lam, eta = sites
    y = sites.y
    seen = ~np.isnan(rates.y)

    # Normal distribution of the predictors of a block given its sites.
    W, log_sites = whiten(blocks.label, predictor, lam)
    V = each(predictor.covariance, blocks.label)
    n_rows = V.shape[-1]
    gain = V @ (np.swapaxes(W, 2, 3) @ W)
    w = (W @ (y - at)[..., None])[..., 0]
    mean = at + (gain @ (y - at)[..., None])[..., 0]
    C = V - gain @ V
    G = cholesky(0.5 * (C + np.swapaxes(C, 2, 3)) + _JITTER * np.eye(n_rows))

    sd = np.broadcast_to(predictor.noise_sd, mean.shape)
    f = np.zeros(mean.shape)
    e = np.zeros(mean.shape)
    log_weight = log_sites - 0.5 * (w**2).sum(2)
    for k in range(n_rows):
        # Given the rows before it, row k is N(a, d^2) with its own site and N(m, v) without it.
        a = mean[..., k] + (G[..., k, :k] * e[..., :k]).sum(-1)
        d = G[..., k, k]
        d2 = np.broadcast_to(d**2, a.shape)
        rest = np.maximum(1.0 / d2 - lam[..., k], _LEAST)
        m = (a / d2 - eta[..., k]) / rest
        v = 1.0 / rest

        own, log_mass = rates.likelihood.draw(
            rates.y[:, k], rates.n_ticks[:, k], m, v, sd[..., k], rng, (a, d2)
        )
        is_exact = ~seen[:, k] | rates.linear[:, k]
        f[..., k] = np.where(is_exact, a + d * rng.standard_normal(a.shape), own)
        e[..., k] = (f[..., k] - a) / d

        # The likelihood replaces the site.
        ratio = log_mass - _overlap(y[..., k], lam[..., k], m, v)
        log_weight = log_weight + np.where(is_exact, 0.0, ratio)
    return f, log_weight
