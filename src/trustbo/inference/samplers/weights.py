"""Importance weights: Pareto smoothing, and resampling to equal weights."""

import numpy as np
from arviz_stats.base.array import array_stats


def smoothed_weights(raw: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Pareto-smooth log importance weights (point,), some of them finite.

    Returns:
        Normalised log weights, k-hat, and the log mean of the raw weights (the evidence).
    """
    finite = np.isfinite(raw)
    log_evidence = float(np.logaddexp.reduce(raw) - np.log(len(raw)))
    if finite.all() and np.ptp(raw) < 1e-6:  # none is in a tail, and the fit of one fails
        return raw - np.logaddexp.reduce(raw), -np.inf, log_evidence
    # Minus the log weights, points without density far below all others.
    smoothed, khat = array_stats.psislw(-np.where(finite, raw, raw[finite].min() - 100.0))
    log_w = smoothed - np.logaddexp.reduce(smoothed)
    return log_w, float(np.nan_to_num(khat, nan=np.inf)), log_evidence


def systematic(weights: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of n equally weighted draws, by systematic resampling."""
    points = (rng.random() + np.arange(n)) / n
    return np.searchsorted(np.cumsum(weights)[:-1] / weights.sum(), points)
