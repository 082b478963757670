"""Pareto-smoothed importance weights, and draws of equally weighted points."""

import numpy as np
from arviz_stats.base.array import array_stats
from scipy import special

GOOD_KHAT = 0.5
"""Pareto shape k-hat of the weights below which sampling may stop."""
MAX_KHAT = 0.7
"""Largest k-hat of acceptable results."""
_EVEN = 1e-6
"""Range of log ratios within which weights count as equal."""
_BELOW_ALL = 100.0
"""Distance of the log ratio of points without density below the smallest finite log ratio."""


def smoothed(log_ratio: np.ndarray, relative: float = 1.0) -> tuple[np.ndarray, float, float]:
    """Smooth log importance ratios (point,) with a Pareto tail.

    If no ratio is finite, all weights are equal, and k-hat is infinite. If one ratio exceeds the
    others so far that the tail has no Pareto fit, weights are not smoothed, and k-hat is infinite.

    Args:
        log_ratio: Log importance ratios.
        relative: Effective number of points relative to the number of points, below 1 for draws of
            a Markov chain. The smaller it is, the more points the tail has.

    Returns:
        Weights that sum to 1, k-hat, and the log of the mean ratio.
    """
    finite = np.isfinite(log_ratio)
    equal = np.full(len(log_ratio), 1.0 / len(log_ratio))
    if not finite.any():
        return equal, np.inf, -np.inf

    log_mean = float(special.logsumexp(log_ratio) - np.log(len(log_ratio)))
    if finite.all() and np.ptp(log_ratio) < _EVEN:  # equal weights have no tail
        return equal, -np.inf, log_mean

    # Vehtari et al. (2024), as implemented in ArviZ, which takes log likelihoods: the sign is the
    # opposite.
    kept = np.where(finite, log_ratio, log_ratio[finite].min() - _BELOW_ALL)
    with np.errstate(all="ignore"):  # weights in a very long tail overflow
        log_weight, k_hat = array_stats.psislw(-kept, r_eff=relative)  # pyright: ignore[reportArgumentType]
    if np.isnan(log_weight).any():
        return special.softmax(kept), np.inf, log_mean

    k_hat = float(np.nan_to_num(k_hat, nan=np.inf))
    return special.softmax(log_weight), k_hat, log_mean


def resampled(weight: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw indices of `n` equally weighted points, given the weights (point,) of points.

    Points are in random order, but repetitions of a point are next to each other. Therefore, the
    effective sample size that ArviZ computes from autocorrelations is close to that of the weights.
    """
    order = rng.permutation(len(weight))
    return order[systematic(weight[order], n, rng)]


def systematic(weight: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return sorted indices of `n` equally weighted draws by systematic resampling."""
    points = (rng.random() + np.arange(n)) / n
    return np.searchsorted(np.cumsum(weight)[:-1] / weight.sum(), points)
