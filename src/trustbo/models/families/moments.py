"""Moments and draws of a normal linear predictor times the likelihood of a rate."""

from collections.abc import Callable

import numpy as np
from numpy import ndarray
from numpy.random import Generator
from scipy import special

from trustbo.models.families.family import Array, Drawn, Moments
from trustbo.statespace.matrices import namespace

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
_LOG_WEIGHTS = np.log(_WEIGHTS / _WEIGHTS.sum())
_STEP = 0.05  # step of finite differences in the search for the mode
_N_NEWTON_STEPS = 3
_LONGEST_STEP = 2.0  # limit on a Newton step, in units of the linear predictor
_WIDER = 1.1  # ratio of the sd of the nodes or strata to that of the product
_N_STRATA = 12  # number of draws from which one is chosen
_LEAST_VARIANCE = 1e-9
_LARGEST_LOG = -1e-300  # largest log ratio of probabilities, so that 1 minus the ratio is not 0


def log_normal(e: Array, variance: Array) -> Array:
    """Compute the log density of N(0, variance) at e."""
    return -0.5 * (e**2 / variance + namespace(variance).log(2.0 * np.pi * variance))


def match_interval(low: ndarray, high: ndarray, m: ndarray, v: ndarray, noise: ndarray) -> Moments:
    """Compute moments of N(f; m, v) given that f plus normal noise lies between low and high."""
    total = v + noise**2
    sd = np.sqrt(total)
    log_p, e, spread = truncated((low - m) / sd, (high - m) / sd)
    return log_p, m + v / sd * e, v - v**2 / total * (1.0 - spread)


def truncated(a: ndarray, b: ndarray) -> Moments:
    """Compute the log probability, mean and variance of a standard normal between a and b."""
    mirror = a > -b  # use the lower tail, which is more accurate
    a, b = np.where(mirror, -b, a), np.where(mirror, -a, b)

    with np.errstate(divide="ignore"):  # log(Phi(b) - Phi(a)), accurate for a + b <= 0
        log_b = special.log_ndtr(b)
        gap = np.minimum(special.log_ndtr(a) - log_b, _LARGEST_LOG)
        log_p = log_b + np.log(-np.expm1(gap))

    with np.errstate(invalid="ignore"):
        at_a, at_b = (np.exp(-0.5 * x**2 - 0.5 * np.log(2.0 * np.pi) - log_p) for x in (a, b))
        slope = np.where(np.isfinite(a), a, 0.0) * at_a - np.where(np.isfinite(b), b, 0.0) * at_b

    mean = at_a - at_b
    var = np.clip(1.0 + slope - mean**2, 0.0, 1.0)
    return log_p, np.where(mirror, -mean, mean), var


def draw_between(a: ndarray, b: ndarray, rng: Generator) -> ndarray:
    """Draw standard normal variables truncated to the interval from a to b."""
    mirror = a > -b
    a, b = np.where(mirror, -b, a), np.where(mirror, -a, b)

    with np.errstate(divide="ignore"):
        log_b = special.log_ndtr(b)
        below = np.exp(np.minimum(special.log_ndtr(a) - log_b, 0.0))
        share = rng.random(np.broadcast(a, b).shape)
        z = special.ndtri_exp(log_b + np.log(below + (1.0 - below) * share))

    z = np.clip(z, a, b)
    return np.where(mirror, -z, z)


def draw_by_strata(
    log_prob: Callable[[ndarray], ndarray],
    m: ndarray,
    v: ndarray,
    center: ndarray,
    var: ndarray,
    rng: Generator,
) -> Drawn:
    """Draw from N(m, v) times a likelihood; the mean weight is the mass of the product.

    Of stratified draws of a distribution a little wider than N(center, var), one is chosen by
    weight. `log_prob` returns log likelihoods of draws (..., stratum).
    """
    n = _N_STRATA
    x = special.ndtri((np.arange(n) + rng.random((*m.shape, 1))) / n)
    f = center[..., None] + _WIDER * np.sqrt(var)[..., None] * x

    # The normal densities relative to each other: constants are added at the end.
    log_w = log_prob(f) - 0.5 * (f - m[..., None]) ** 2 / v[..., None] + 0.5 * x**2
    largest = log_w.max(-1, keepdims=True)
    total = np.cumsum(np.exp(log_w - largest), axis=-1)

    level = total[..., -1:] * rng.random((*m.shape, 1))
    chosen = np.minimum((total < level).sum(-1, keepdims=True), n - 1)
    drawn = np.take_along_axis(f, chosen, axis=-1)[..., 0]
    log_mean = largest[..., 0] + np.log(total[..., -1] / n)
    return drawn, log_mean + np.log(_WIDER) + 0.5 * np.log(var / v)


def match_by_nodes(
    log_prob: Callable[[ndarray], ndarray], start: ndarray, m: ndarray, v: ndarray
) -> Moments:
    """Compute moments of N(f; m, v) times a likelihood by Gauss-Hermite quadrature at the mode.

    `log_prob` returns log likelihoods at nodes (..., node); the mode search begins at `start`.
    """
    x = np.array(start)
    q = 1.0 / v
    for _ in range(_N_NEWTON_STEPS):
        low, middle, high = np.moveaxis(log_prob(x[..., None] + _STEP * np.arange(-1, 2)), -1, 0)
        q = 1.0 / v - np.minimum((high - 2.0 * middle + low) / _STEP**2, 0.0)
        x = x + np.clip(
            ((high - low) / (2.0 * _STEP) - (x - m) / v) / q, -_LONGEST_STEP, _LONGEST_STEP
        )

    sd = _WIDER / np.sqrt(q)
    node = x[..., None] + sd[..., None] * _NODES
    log_f = log_prob(node) - 0.5 * (node - m[..., None]) ** 2 / v[..., None]
    log_f += _LOG_WEIGHTS + 0.5 * _NODES**2

    log_mass = special.logsumexp(log_f, axis=-1)
    weight = np.exp(log_f - log_mass[..., None])  # pyright: ignore[reportArgumentType, reportCallIssue]
    mean = (weight * node).sum(-1)
    var = (weight * (node - mean[..., None]) ** 2).sum(-1)
    return log_mass + np.log(sd / np.sqrt(v)), mean, np.maximum(var, _LEAST_VARIANCE)
