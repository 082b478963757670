"""Log density of scores, and its derivatives, for NUTS of models with Gaussian rates.

The log evidence depends on theta through a few arrays. With the residual e = y - m - T u at the
posterior mean of the coefficients, the precision P of the rates of a block, and the posterior
covariance M of its inputs u, its derivatives with respect to these arrays have a closed form:

    of m:  P e,        of T:  P e u' - P T M,        of V:  (P e e' P - P + P T M T' P) / 2,

summed over blocks. They follow from Fisher's identity: the slope of log p(y | theta) is the
posterior mean of the slope of log p(y, c | theta). The arrays themselves are cheap, so their
derivatives with respect to the scores are finite differences. NUTS samples the exact density for
any approximation of its slopes.
"""

import numpy as np

from trustbo.inference.density import Density
from trustbo.inference.engine import covariance_of_inputs, evidence, expected, inputs
from trustbo.inference.factor import upper
from trustbo.statespace.blocks import each

_STEP = 1e-6
"""Step of the finite differences."""


def log_density_and_slopes(density: Density, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute `Density.log_density` (point,) and its derivatives (point, score) at scores z.

    Where the density is 0, the derivatives are 0.
    """
    log_p = np.full(len(z), -np.inf)
    slopes = np.zeros(z.shape)
    with np.errstate(all="ignore"):  # extreme scores overflow and get zero density
        _, log_prior, some = density.possible(z)
        if len(some):
            log_evidence, slopes[some] = _log_evidence_and_slopes(density, z[some])
            log_p[some] = log_evidence + log_prior

    is_finite = np.isfinite(log_p) & np.isfinite(slopes).all(1)
    return np.where(is_finite, log_p, -np.inf), np.where(is_finite[:, None], slopes, 0.0)


def _log_evidence_and_slopes(density: Density, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the log evidence (point,), and the derivatives of the log density (point, score)."""
    n, n_scores = z.shape
    log_p, of_arrays = _slopes_of_arrays(density, z)

    steps = _STEP * np.vstack([np.zeros(n_scores), np.eye(n_scores)])
    near = (z[:, None] + steps).reshape(-1, n_scores)
    arrays, log_rest = _arrays(density, near)
    log_rest = log_rest.reshape(n, -1)

    rise = log_rest[:, 1:] - log_rest[:, :1]
    for values, slope in zip(arrays, of_arrays, strict=True):
        values = values.reshape(n, n_scores + 1, -1)
        rise = rise + ((values[:, 1:] - values[:, :1]) @ slope.reshape(n, -1, 1))[..., 0]
    return log_p, rise / _STEP


def _arrays(density: Density, z: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the arrays (point, ...) through which the density depends on scores z.

    These are m (point, label, row), T (point, label, row, input), V (point, label, row, row), the
    variances (point, kind, row) of each rate's own noise, which are part of V, and the mean and the
    parts of the prior on the coefficients. The second result is the log density (point,) that does
    not depend on rates: of the scores, and of the precision of the coefficients.
    """
    predictor, prior = density.given(density.theta(z))
    noise = 1.0 / density.rate_precision(predictor)
    arrays = [predictor.mean, predictor.response, predictor.covariance]
    arrays.append(np.where(density.blocks.seen, noise, 0.0))
    log_rest = 0.5 * prior.log_det + density.scores.log_prior(z)
    return [*arrays, prior.mean, *prior.parts], log_rest


def _slopes_of_arrays(density: Density, z: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Compute the log evidence (point,), and its derivatives with respect to `_arrays`.

    The derivatives leave out those of the log determinant of the prior.
    """
    predictor, prior = density.given(density.theta(z))
    b = density.blocks
    fit = evidence(b, predictor, prior, density.rate_precision(predictor))
    n = len(z)
    T = each(predictor.response, b.label)
    T_of = each(T, b.kind)
    P = np.swapaxes(fit.W, 2, 3) @ fit.W
    PT = P @ T

    # Posterior mean of the coefficients, relative to the prior mean, and P e there.
    c = fit.F.back(fit.half[:, None])[:, 0]
    at_mean = inputs(b.U, len(b.y), prior.mean + c)
    e = b.y - expected(b, predictor, prior.mean + c)
    Pe = (P[:, b.kind] @ e[..., None])[..., 0]

    # Posterior covariance of the coefficients, and M, summed over the blocks of each kind.
    covariance = fit.F.covariance()
    M = covariance_of_inputs(b, covariance, T.shape[3])

    # The derivatives at the top of this file, by Fisher's identity.
    is_kind = (np.arange(len(b.seen))[:, None] == b.kind).astype(float)
    PTM = PT @ M
    of_m = is_kind @ Pe
    of_T = _per_kind(is_kind, Pe, at_mean) - PTM
    of_V = 0.5 * (
        _per_kind(is_kind, Pe, Pe) - is_kind.sum(1)[:, None, None] * P + PTM @ np.swapaxes(PT, 2, 3)
    )
    of_mean = (b.U.T @ (np.swapaxes(T_of, 2, 3) @ Pe[..., None]).reshape(n, -1).T).T

    of_parts = []
    end = 0
    for part, entries in zip(prior.parts, b.of_prior, strict=True):
        start = end
        end = start + part.shape[1]
        one = c[:, start:end]
        found = covariance[entries].T
        if part.ndim == 2:
            of_parts.append(-0.5 * (2.0 * found + one**2))
            continue

        i, j = upper(part.shape[1])
        cov = np.zeros(part.shape)
        cov[:, i, j] = found  # with half of the diagonal
        cov += np.swapaxes(cov, 1, 2)
        of_parts.append(-0.5 * (cov + one[:, :, None] * one[:, None]))

    of_rates = [
        _per_label(slope, values.shape[1], b.label)
        for slope, values in (
            (of_m, predictor.mean),
            (of_T, predictor.response),
            (of_V, predictor.covariance),
        )
    ]
    of_noise = np.diagonal(of_V, axis1=2, axis2=3)
    return fit.log_p, [*of_rates, of_noise, of_mean, *of_parts]


def _per_kind(is_kind: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Sum the outer products of vectors (point, block, ...) over the blocks of each kind."""
    products = left[..., None] * right[:, :, None]
    n, n_blocks, *shape = products.shape
    return (is_kind @ products.reshape(n, n_blocks, -1)).reshape(n, -1, *shape)


def _per_label(slopes: np.ndarray, n_labels: int, label: np.ndarray) -> np.ndarray:
    """Sum the slopes (point, kind, ...) over the kinds of each label; 1 label stands for all."""
    if n_labels == 1:
        return slopes.sum(1, keepdims=True)
    return np.stack([slopes[:, label == one].sum(1) for one in range(n_labels)], axis=1)
