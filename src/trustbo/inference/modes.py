"""Modes of a density, and the Student-t distributions that fit it there."""

from collections.abc import Callable

import numpy as np
from scipy import optimize

from trustbo.inference.mixture import SKEWS, Mixture

_SLOPE_STEP = 1e-3
"""Step of the finite differences for slopes."""
_CURVATURE_STEP = 3e-2
"""Step of the finite differences for the curvature at a mode."""
_WIDTH_STEP = 0.1
"""Step of the finite differences for curvatures at the start of a search."""
_CURVATURES = (0.5, 1e4)
"""Limits of the curvatures at the start of a search."""
_N_STEPS = 40
"""Largest number of steps of a search for a mode."""
_CLOSE = 0.1
"""A search for a mode ends when a step gains less than this log density."""
_LITTLE = 1.0
"""Gain in log density below which a search is not repeated from its end."""
_LARGEST_COST = 1e10
"""Replacement for an infinite -log density, which searches and finite differences cannot use."""
_LEAST_CURVATURE = 0.3
"""Smallest curvature of -log density at a mode; the prior has curvature 1."""
_LEAST_DROP = 1e-3
"""Smallest drop of the log density from which the width of a side is computed."""
_APART = 1.0
"""Distance in sds from which two modes count as distinct."""
_NEGLIGIBLE = 8.0
"""Modes whose log density is this much below that of the highest mode are left out."""
_SKEW_STEP = 2.0
"""Distance from the mode at which skewness is measured, in sds."""
_FARTHEST = 7.0
"""Largest absolute score of a mode."""

LogDensity = Callable[[np.ndarray], np.ndarray]
"""Log density (point,) of scores (point, score) up to a constant; -inf for zero density.

Scores are coordinates in which the prior is about standard normal.
"""


def at_modes(log_density: LogDensity, starts: np.ndarray) -> Mixture:
    """Fit a component at each distinct mode that is reached from starts (start, score)."""
    found: list[tuple[float, Mixture]] = []
    for start in starts:
        mode = fit_mode(log_density, climb_on(log_density, start))
        found.append((float(log_density(mode.center)[0]), mode))
    found.sort(key=lambda pair: -pair[0])

    highest, first = found[0]
    modes = [first]
    for value, mode in found[1:]:
        gaps = [np.linalg.solve(m.scale[0], mode.center[0] - m.center[0]) for m in modes]
        is_new = min(np.linalg.norm(gap) for gap in gaps) > _APART
        if is_new and value > highest - _NEGLIGIBLE:
            modes.append(mode)
    return Mixture.joined(modes, np.full(len(modes), 1.0 / len(modes)))


def climb(log_density: LogDensity, start: np.ndarray) -> np.ndarray:
    """Search for a mode by L-BFGS, with derivatives from finite differences.

    Returns the mode as an array of shape (score,). The scores are divided by their widths at the
    start to keep the first steps short.
    """
    d = len(start)
    axes = np.eye(d)

    value = log_density(start + _WIDTH_STEP * np.vstack([np.zeros((1, d)), axes, -axes]))
    curvature = (2.0 * value[0] - value[1 : d + 1] - value[d + 1 :]) / _WIDTH_STEP**2
    width = np.nan_to_num(curvature, nan=1.0, posinf=1.0, neginf=1.0).clip(*_CURVATURES) ** -0.5

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        steps = np.vstack([np.zeros((1, d)), _SLOPE_STEP * axes])
        value = -log_density(start + width * (x + steps))
        value = np.minimum(np.nan_to_num(value, nan=np.inf), _LARGEST_COST)
        return value[0], (value[1:] - value[0]) / _SLOPE_STEP

    options = {"maxiter": _N_STEPS, "ftol": _CLOSE / max(1.0, abs(value[0]))}
    farthest = np.stack([-_FARTHEST - start, _FARTHEST - start], axis=1) / width[:, None]
    found = optimize.minimize(
        cost, np.zeros(d), jac=True, method="L-BFGS-B", bounds=farthest, options=options
    )
    return start + width * found.x


def climb_on(log_density: LogDensity, start: np.ndarray) -> np.ndarray:
    """Repeat `climb` from where it ends, which may be a ridge, until it gains little."""
    value = log_density(start[None])[0]
    while True:
        end = climb(log_density, start)
        before, value = value, log_density(end[None])[0]
        if not value > before + _LITTLE:
            return start

        start = end


def fit_mode(log_density: LogDensity, mode: np.ndarray) -> Mixture:
    """Fit one component at a mode, with the curvature there and a separate width on each side."""
    d = len(mode)
    axes = np.eye(d)
    i, j = np.tril_indices(d, -1)
    steps = np.vstack([np.zeros((1, d)), axes, -axes, axes[i] + axes[j]])
    f = _finite(log_density(mode + _CURVATURE_STEP * steps))
    up, down, both = f[1 : d + 1], f[d + 1 : 2 * d + 1], f[2 * d + 1 :]

    # Second differences; flat or rising directions get the smallest curvature.
    hessian = np.diag(up - 2.0 * f[0] + down)
    hessian[i, j] = hessian[j, i] = both - up[i] - up[j] + f[0]
    curvature, vectors = np.linalg.eigh(-hessian / _CURVATURE_STEP**2)
    scale = np.linalg.cholesky(vectors / np.maximum(curvature, _LEAST_CURVATURE) @ vectors.T)

    # A normal distribution with width s drops by (step / s)^2 / 2.
    steps = _SKEW_STEP * np.stack([-scale.T, scale.T])
    there = log_density((mode + steps).reshape(-1, d)).reshape(2, d)
    drop = np.maximum(f[0] - _finite(there), _LEAST_DROP)
    sides = np.clip(_SKEW_STEP / np.sqrt(2.0 * drop), *SKEWS)
    return Mixture.single(mode, scale, sides)


def _finite(log_p: np.ndarray) -> np.ndarray:
    """Replace NaN and -inf by a log density that is very low but finite."""
    return np.nan_to_num(log_p, nan=-_LARGEST_COST, neginf=-_LARGEST_COST)
