"""Score tests of departures by the standardised innovations of rates at the posterior mean.

Neyman's C(alpha): the score of a departure less its projection on the scores of the parameters that
were estimated. An error of these then enters in second order only, whichever consistent estimate is
plugged in, so that nothing is refitted: e = L^-1 (y - mean), projected off the whitened derivatives
of the mean, has a known distribution, and replicates of it are standard normal vectors, projected
alike and moved by one step of Fisher scoring, as a refit would.
A departure's columns D have the statistic |Q'e|^2, Q an orthonormal basis of M L^-1 C D, chi^2; a
source of correlation U has e'We, W = M L^-1 U L^-T M less its projection, in the Frobenius product,
on the same of the derivatives of the covariance. The strongest label of a departure counts: its
distribution, as that of all that follows, is that of the replicates.
References: Neyman (1959); Bera and Yoon (1993) on departures that explain each other.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from scipy import stats
from scipy.linalg import solve_triangular

from trustbo.criticism.departures import Departure
from trustbo.criticism.joint_normal import Data, Normal, Point, joint_normal, varied

_LEVEL = 0.05
_LEAST = -700.0  # logarithm of the least p
_NORMAL = 0.02  # skewness below which a quadratic form is taken as normal
_RANK = 1e-6  # of a column's norm, below which nuisances explain it


class Outcome(NamedTuple):
    """Test of one departure."""

    p: float
    log_p: float
    """Its logarithm, of the extrapolated tail."""
    label: str
    """Label with the strongest evidence."""
    statistic: float
    """Chi-squared statistic or standardised score of that label."""


@dataclass(frozen=True, eq=False)
class Innovations:
    """Standardised innovations, and those of replicates, projected off the estimated parameters.

    Attributes:
        normal: Joint normal of the rates.
        L: Cholesky factor of its covariance.
        white: Innovations before the projection, (rate,).
        X: Whitened derivatives of the mean by the parameters, (rate, parameter).
        basis: Orthonormal basis of these, (rate, rank).
        noises: Parameters that the covariance depends on.
        e: Projected innovations and replicates, scaled to their expected norm, after one step of
            scoring, (rate, 1 + replicate).
    """

    normal: Normal
    L: np.ndarray
    white: np.ndarray
    X: np.ndarray
    basis: np.ndarray
    noises: "Noises"
    e: np.ndarray

    @classmethod
    def of_rates(
        cls, normal: Normal, y: np.ndarray, by_parameter: "Derivatives", draws: np.ndarray
    ) -> Self:
        """Innovations of rates y (rate,); `draws` are white noise (rate, replicate)."""
        L = np.linalg.cholesky(normal.cov)
        white = solve_triangular(L, y - normal.mean, lower=True)
        X = solve_triangular(L, by_parameter.mean, lower=True)
        every = np.column_stack([white, draws])
        mixed = list(by_parameter.cov)
        mean_only = [i for i in range(X.shape[1]) if i not in mixed]
        part = _orthonormal(X[:, mean_only])
        W = [_project(_whiten(L, derivative), part) for derivative in by_parameter.cov.values()]
        slopes = X[:, mixed] - part @ (part.T @ X[:, mixed])
        gram = np.array([[(a * b).sum() for a in W] for b in W]) + 2.0 * slopes.T @ slopes
        precision = np.linalg.pinv(gram, rcond=1e-10)
        e = _scaled(every, part)
        scores = np.array([(e * (w @ e)).sum(0) - np.trace(w) for w in W]) + 2.0 * slopes.T @ e
        steps = precision @ scores
        moved = e - slopes @ steps
        noises = Noises(part, moved, W, slopes, precision, steps)
        # Whitened by the covariance after that step, to first order.
        moved = moved - 0.5 * sum(w @ moved * step for w, step in zip(W, steps, strict=True))
        basis = _orthonormal(X)
        return cls(normal, L, white, X, basis, noises, _scaled(moved, basis))

    def test(self, departure: Departure) -> Outcome:
        """Test one departure."""
        labels = [*departure.effects, *departure.sources]
        outcomes = [self._effect(columns) for columns in departure.effects.values()]
        outcomes += [self._source(U) for U in departure.sources.values()]
        statistic, log_p = np.swapaxes(outcomes, 0, 1)
        return judge(labels, statistic[:, 0], log_p[:, 0], log_p[:, 1:])

    def estimate(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Effect of each column over the slots alone, and its standard error; 0 and inf if none."""
        D = solve_triangular(self.L, self.normal.carry @ columns, lower=True)
        left = D - self.basis @ (self.basis.T @ D)
        size = (left**2).sum(0)
        size[size < _RANK * (D**2).sum(0)] = 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(left.T @ self.e[:, 0] / size), 1.0 / np.sqrt(size)

    def left_of(self, columns: np.ndarray) -> np.ndarray:
        """Columns over the slots as effects on the rates that no parameter has, (rate, column)."""
        D = solve_triangular(self.L, self.normal.carry @ columns, lower=True)
        return self.L @ (D - self.basis @ (self.basis.T @ D))

    def size_of(self, U: np.ndarray) -> float:
        """Most likely variance of a source of correlation, in units of U."""
        values, vectors = np.linalg.eigh(_whiten(self.L, U))
        square = (vectors.T @ self.e[:, 0]) ** 2
        sizes = np.geomspace(1e-4, 1e4, 200) / max(values[-1], 1e-300)
        spread = 1.0 + sizes[:, None] * np.maximum(values, 0.0)
        return float(sizes[np.argmin((np.log(spread) + square / spread).sum(1))])

    def _effect(self, columns: np.ndarray) -> np.ndarray:
        D = solve_triangular(self.L, self.normal.carry @ columns, lower=True)
        Q = _orthonormal(D, self.basis)
        if not Q.shape[1]:
            return np.zeros((2, self.e.shape[1]))
        statistic = ((Q.T @ self.e) ** 2).sum(0)
        return np.array([statistic, np.maximum(stats.chi2.logsf(statistic, Q.shape[1]), _LEAST)])

    def _source(self, U: np.ndarray) -> np.ndarray:
        noises = self.noises
        W = _project(_whiten(self.L, U), noises.basis)
        shares = np.array([(a * W).sum() for a in noises.W])
        forms = (noises.e * (W @ noises.e)).sum(0) - shares @ noises.steps - np.trace(W)
        shares = noises.precision @ shares
        W = W - sum(share * a for share, a in zip(shares, noises.W, strict=True))
        v = -noises.slopes @ shares
        square = W @ W
        var = 2.0 * np.trace(square) + 4.0 * v @ v
        third = 8.0 * (square * W).sum() + 24.0 * v @ W @ v
        z, skewness = forms / np.sqrt(var), third / var**1.5
        tail = stats.pearson3(skewness) if skewness > _NORMAL else stats.norm()
        return np.array([z, np.maximum(tail.logsf(z), _LEAST)])


class Noises(NamedTuple):
    """Scores of the parameters that the covariance depends on, e'We + 2 slope'e each.

    The mean may depend on them too, as on beta0: their information is that of both together.
    Innovations and their replicates are those after one step of scoring.
    """

    basis: np.ndarray  # orthonormal, (rate, rank), of all other derivatives of the mean
    e: np.ndarray  # innovations without these, and after the step, (rate, 1 + replicate)
    W: list[np.ndarray]
    slopes: np.ndarray  # (rate, noise)
    precision: np.ndarray  # (noise, noise), inverse of their information, halved
    steps: np.ndarray  # (noise, 1 + replicate)


class Derivatives(NamedTuple):
    """Derivatives of the joint normal of the rates by its parameters."""

    names: list[str]
    mean: np.ndarray  # (rate, parameter)
    cov: dict[int, np.ndarray]  # by index of the parameter, where not 0


def judge(labels: list[str], statistic, log_p, replicated) -> Outcome:
    """Outcome for the label of least log p (label,), given those of replicates (label, replicate).

    Up to the 95 % quantile of the replicates, p is the share of them that are as extreme; beyond,
    it falls as the least p of a label does.
    """
    best = int(np.argmin(log_p))
    least = replicated.min(0)
    limit = np.quantile(least, _LEVEL)
    log = np.log(_LEVEL) + log_p[best] - limit
    if log_p[best] > limit:
        log = np.log((1.0 + (least <= log_p[best]).sum()) / (1.0 + len(least)))
    log = min(float(log), 0.0)
    return Outcome(float(np.exp(log)), log, labels[best], float(statistic[best]))


def derivatives(point: Point, data: Data) -> Derivatives:
    """Derivatives by every parameter, as central differences."""
    names, mean, cov = [], [], {}
    for name, where, step, low, high in varied(point):
        a, b = joint_normal(low, data), joint_normal(high, data)
        change = (b.cov - a.cov) / step
        if np.abs(change).max() > 1e-8:
            cov[len(names)] = change
        names.append(name + "".join(f"[{i}]" for i in where))
        mean.append((b.mean - a.mean) / step)
    return Derivatives(names, np.column_stack(mean), cov)


def holm(p: np.ndarray) -> np.ndarray:
    """Adjust p-values for their number by Holm's method."""
    order = np.argsort(p)
    adjusted = np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(adjusted, 1.0)


def _whiten(L: np.ndarray, U: np.ndarray) -> np.ndarray:
    half = solve_triangular(L, U, lower=True)
    return solve_triangular(L, half.T, lower=True)


def _project(W: np.ndarray, basis: np.ndarray) -> np.ndarray:
    W = W - basis @ (basis.T @ W)
    W = W - (W @ basis) @ basis.T
    return 0.5 * (W + W.T)


def _scaled(e: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Columns projected off a basis, scaled to their expected norm."""
    left = e - basis @ (basis.T @ e)
    return left * (np.sqrt(len(e) - basis.shape[1]) / np.linalg.norm(left, axis=0))


def _orthonormal(columns: np.ndarray, basis: np.ndarray | None = None) -> np.ndarray:
    """Orthonormal basis of the columns projected off another basis."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns[:, scale > 0.0] / scale[scale > 0.0]
    if basis is not None:
        columns = columns - basis @ (basis.T @ columns)
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > _RANK**0.5]
