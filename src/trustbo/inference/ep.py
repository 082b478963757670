"""Expectation propagation (EP) for observations that are not linear in the predictor.

Each likelihood term t(f) is replaced by a site exp(-lam f^2 / 2 + eta f). Given the sites, `engine`
computes the marginals of the linear predictors exactly. Dividing a marginal by its site gives the
cavity. The site is then updated so that the product of the cavity and the site has the moments of
the product of the cavity and the likelihood term. The log evidence is the log evidence of the sites
plus, for each term, the log ratio of the masses of these products. Importance weights correct the
draws.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import special

from trustbo.inference.engine import Blocks, Prior, evidence, expected, marginals, whiten
from trustbo.inference.factor import Factor, cholesky
from trustbo.models.families import Family
from trustbo.models.families.moments import log_normal
from trustbo.statespace.blocks import LinearPredictor, each

_LEAST = 1e-9  # smallest precision of a cavity or a site
_TEMPERED = 0.6  # factor on the site precisions in the wider proposal


class Terms(NamedTuple):
    """Observations of all blocks and their family; each block must be a separate kind."""

    family: Family
    y: np.ndarray  # (block, row), NaN where not measured
    n_ticks: np.ndarray  # (block, row)

    @property
    def linear(self) -> np.ndarray:
        """Mask (block, row) of the observations whose sites are exact."""
        return ~np.isnan(self.y) & self.family.is_density(self.y)


class Joint(NamedTuple):
    """Blocks, linear predictors, prior and observations at each theta."""

    blocks: Blocks
    predictor: LinearPredictor
    prior: Prior
    terms: Terms


class Sites(NamedTuple):
    """Gaussian sites (point, block, row) with precision lam and precision-weighted mean eta."""

    lam: np.ndarray
    eta: np.ndarray

    @property
    def y(self) -> np.ndarray:
        """Means of the sites, 0 where there is no site."""
        some = self.lam != 0.0
        return np.where(some, self.eta / np.where(some, self.lam, 1.0), 0.0)

    def at(self, terms: Terms, sd: np.ndarray) -> "Sites":
        """Return the sites, with exact values for linear observations given the noise sd."""
        lam = np.where(terms.linear, sd**-2.0, self.lam)
        eta = np.where(terms.linear, np.nan_to_num(terms.y) * sd**-2.0, self.eta)
        return Sites(*np.broadcast_arrays(lam, eta))


def first_sites(terms: Terms) -> Sites:
    """Make initial sites (1, block, row), matched under a vague distribution of trust."""
    unit, zero = terms.family.line_of_sight
    y = terms.y
    m, v = np.full(y.shape, unit * (0.5 - zero)), np.full(y.shape, (0.3 * unit) ** 2)
    noise = np.full(y.shape, 0.2)
    _, mean, var = terms.family.match(y, terms.n_ticks, m, v, noise)
    return _matched(terms, 1.0 / v[None], m / v, mean, var)


def _matched(
    terms: Terms, rest: np.ndarray, slope: np.ndarray, mean: np.ndarray, var: np.ndarray
) -> Sites:
    """Find the sites whose products with cavities N(slope / rest, 1 / rest) match mean and var."""
    seen = ~np.isnan(terms.y)
    lam = np.where(seen, np.maximum(1.0 / var - rest, _LEAST), 0.0)
    return Sites(lam, np.where(seen, mean * (lam + rest) - slope, 0.0))


def log_evidence(
    joint: Joint, sites: Sites, n_sweeps: int, damp: float = 1.0
) -> tuple[np.ndarray, Sites]:
    """Compute the EP log evidence (point,) and the sites after `n_sweeps` sweeps."""
    blocks, predictor, prior, terms = joint
    seen, sd = ~np.isnan(terms.y), predictor.noise_sd
    sites = sites.at(terms, sd)
    total = np.zeros(len(sd))
    for sweep in range(n_sweeps + 1):
        lam, eta, y = *sites, sites.y
        fit = evidence(blocks, predictor, prior, lam, y)
        mean, var = marginals(blocks, predictor, prior, fit, y)
        rest = np.maximum(1.0 / var - lam, _LEAST)  # precision of the cavities
        slope = mean / var - eta
        m, v = slope / rest, 1.0 / rest
        log_mass, mean, var = terms.family.match(terms.y, terms.n_ticks, m, v, sd)
        total = fit.log_p + np.where(seen, log_mass - _overlap(y, lam, m, v), 0.0).sum((1, 2))
        if sweep < n_sweeps:
            new = _matched(terms, rest, slope, mean, np.maximum(var, 1e-12))
            sites = Sites(lam + damp * (new.lam - lam), eta + damp * (new.eta - eta))
            sites = sites.at(terms, sd)
    return total, sites


def _overlap(y: np.ndarray, lam: np.ndarray, m: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Compute the log mass of N(f; m, v) times the site N(y; f, 1 / lam), or 0 without a site."""
    some = lam > 0.0
    total = v + 1.0 / np.where(some, lam, 1.0)
    return np.where(some, log_normal(y - m, total), 0.0)


def draw(
    joint: Joint, sites: Sites, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw coefficients and predictors at each theta, with weights whose mean is the evidence.

    Coefficients are drawn from a mixture of two Student-t distributions, one centred on the
    EP posterior and one on a posterior with less precise sites.

    Returns:
        Coefficients (point, column), linear predictors (point, block, row) and log weights
        (point,).
    """
    blocks, predictor, prior, terms = joint
    n, p = len(predictor.noise_sd), blocks.U.shape[1]
    nu = max(8.0, 2.0 * p)
    proposals = []
    for share in (1.0, _TEMPERED):
        share = np.where(terms.linear, 1.0, share)
        lam, y = share * sites.lam, sites.y
        fit = evidence(blocks, predictor, prior, lam, y)
        proposals.append((prior.mean + fit.F.back(fit.half[:, None])[:, 0], fit.F))
    wide, t = rng.random(n) < 0.5, rng.standard_normal((n, 1, proposals[0][1].size))
    t /= np.sqrt(rng.chisquare(nu, (n, 1, 1)) / nu)
    narrow, wider = (center + F.back(t)[:, 0] for center, F in proposals)
    c = np.where(wide[:, None], wider, narrow)
    log_q = np.logaddexp(*(_log_student(c, *one, nu) for one in proposals)) - np.log(2.0)  # pyright: ignore[reportCallIssue]
    f, log_block = draw_predictors(joint, expected(blocks, predictor, c), sites, rng)
    return c, f, prior.log_density(c) - log_q + log_block.sum(1)


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
        Signals (draw, block, row) and log weights (draw, block). The mean weight is the likelihood
        of a block given the coefficients.
    """
    blocks, predictor, _, terms = joint
    lam, eta, y = *sites, sites.y
    seen = ~np.isnan(terms.y)
    W, log_sites = whiten(blocks, predictor, lam)
    V = each(predictor.covariance, blocks.label)
    gain = V @ (np.swapaxes(W, 2, 3) @ W)
    w = (W @ (y - at)[..., None])[..., 0]
    mean = at + (gain @ (y - at)[..., None])[..., 0]
    C = V - gain @ V
    G = cholesky(0.5 * (C + np.swapaxes(C, 2, 3)) + 1e-12 * np.eye(V.shape[-1]))
    sd = np.broadcast_to(predictor.noise_sd, (len(predictor.noise_sd), 1, V.shape[-1]))
    f, e = np.zeros(mean.shape), np.zeros(mean.shape)
    total = log_sites - 0.5 * (w**2).sum(2)
    for k in range(V.shape[-1]):
        a, d = mean[..., k] + (G[..., k, :k] * e[..., :k]).sum(-1), G[..., k, k]
        d2 = np.broadcast_to(d**2, a.shape)
        rest = np.maximum(1.0 / d2 - lam[..., k], _LEAST)
        m, v = (a / d2 - eta[..., k]) / rest, 1.0 / rest
        of_row = terms.y[:, k], terms.n_ticks[:, k]
        own, log_p = terms.family.draw(*of_row, m, v, sd[..., k], rng)
        exact = ~seen[:, k] | terms.linear[:, k]
        f[..., k] = np.where(exact, a + d * rng.standard_normal(a.shape), own)
        total = total + np.where(exact, 0.0, log_p - _overlap(y[..., k], lam[..., k], m, v))
        e[..., k] = (f[..., k] - a) / d
    return f, total


def _log_student(c: np.ndarray, center: np.ndarray, F: Factor, nu: float) -> np.ndarray:
    """Compute the log density of a Student-t distribution; F factors the precision matrix."""
    p, z = c.shape[1], F.whitened(c - center)
    constant: Any = special.gammaln(0.5 * (nu + p)) - special.gammaln(0.5 * nu)
    constant = constant - 0.5 * p * np.log(nu * np.pi)
    return constant + F.log_det - 0.5 * (nu + p) * np.log1p((z**2).sum(1) / nu)
