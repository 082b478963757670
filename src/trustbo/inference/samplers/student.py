"""Mixtures of multivariate Student-t densities, by components: proposals of any dimension."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from scipy import special, stats
from scipy.linalg import solve_triangular

_SKEWS = np.linspace(-0.9, 0.9, 181)


def _mean(skew: np.ndarray) -> np.ndarray:
    """Mean of a normal number times 1 + skew where it is positive, 1 - skew where not."""
    return np.sqrt(8.0 / np.pi) * skew


def _variance(skew: np.ndarray) -> np.ndarray:
    """Variance of the same."""
    return 1.0 + (3.0 - 8.0 / np.pi) * skew**2


def _skewness(skew: np.ndarray) -> np.ndarray:
    """Skewness of the same, which rises with `skew`."""
    return _mean(skew) * (1.0 + (16.0 / np.pi - 5.0) * skew**2) / _variance(skew) ** 1.5


class Student(NamedTuple):
    """Multivariate Student-t, of skewed axes (Fernandez and Steel 1998).

    With x from a symmetric one, a point is center + scale @ (x (1 + skew sign(x))), the sign being
    positive with probability (1 + skew) / 2, so that the density is continuous, and that of x.
    """

    center: np.ndarray  # (axis,)
    scale: np.ndarray  # (axis, axis), lower triangular
    nu: float = 8.0
    skew: np.ndarray | float = 0.0  # (axis,), between -1 and 1

    @classmethod
    def of(cls, z: np.ndarray, log_w: np.ndarray, ridge: float = 0.0) -> Self:
        """Student-t with the mean, and as scale the covariance, of weighted points."""
        w = np.exp(log_w)
        mean = w @ z
        off = z - mean
        cov = (off * w[:, None]).T @ off + ridge * np.eye(z.shape[1])
        return cls(mean, np.linalg.cholesky(cov))

    def skewed(self, z: np.ndarray, log_w: np.ndarray) -> Self:
        """Give the whitened axes the skewness of weighted points, mean and scale being kept."""
        white = solve_triangular(self.scale, (z - self.center).T, lower=True)
        skew = np.interp(white**3 @ np.exp(log_w), _skewness(_SKEWS), _SKEWS)
        scale = self.scale / np.sqrt(_variance(skew))
        return self._replace(center=self.center - scale @ _mean(skew), scale=scale, skew=skew)

    def widened(self, factor: float) -> Self:
        """Multiply the scale by a factor."""
        return self._replace(scale=factor * self.scale)

    def draw(self, n: int, seed: int) -> np.ndarray:
        """Points of a scrambled Sobol sequence, (n, axis)."""
        d = len(self.center)
        u = stats.qmc.Sobol(d + 1, scramble=True, rng=seed).random(n)
        u = np.clip(u, 1e-12, 1.0 - 1e-12)
        chi2 = 2.0 * special.gammaincinv(0.5 * self.nu, u[:, d]) / self.nu
        left, right = 1.0 - self.skew, 1.0 + self.skew  # twice the probabilities of the signs
        negative = u[:, :d] < 0.5 * left
        p = np.where(negative, u[:, :d] / left, 1.0 - (1.0 - u[:, :d]) / right)
        white = np.where(negative, left, right) * special.ndtri(p)
        return self.center + (white / np.sqrt(chi2)[:, None]) @ self.scale.T

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log density, shape (point,)."""
        d, nu = len(self.center), self.nu
        white = solve_triangular(self.scale, (z - self.center).T, lower=True)
        white = white / (1.0 + np.sign(white) * np.reshape(self.skew, (-1, 1)))
        return (
            special.gammaln(0.5 * (nu + d))
            - special.gammaln(0.5 * nu)
            - 0.5 * d * np.log(nu * np.pi)
            - np.log(np.diag(self.scale)).sum()
            - 0.5 * (nu + d) * np.log1p((white**2).sum(0) / nu)
        )


class Spanning(NamedTuple):
    """Proposal with one score from its prior N(0, 1), the others from their regression on it.

    The others have a Student-t around their regression on Phi(score), which is bounded: far out,
    where the score of a noise has a long, thin tail, they do not extrapolate.
    """

    axis: int
    slope: np.ndarray  # (other,), in Phi(score)
    others: Student
    sd: float = 1.3

    @classmethod
    def of(cls, proposal: Student, axis: int, widen: float = 1.4) -> Self:
        """Proposal with the regression, and the spread around it, of another."""
        cov = proposal.scale @ proposal.scale.T
        rest = np.delete(np.arange(len(cov)), axis)
        mean, sd = proposal.center[axis], np.sqrt(cov[axis, axis])
        x, weights = np.polynomial.hermite_e.hermegauss(30)
        weights = weights / weights.sum()
        share = special.ndtr(mean + sd * x)
        center = weights @ share
        var = weights @ (share - center) ** 2
        slope = cov[rest, axis] / sd * (weights @ (x * (share - center))) / var
        left = cov[np.ix_(rest, rest)] - var * np.outer(slope, slope)
        scale = widen * np.linalg.cholesky(left)
        intercept = proposal.center[rest] - slope * center
        return cls(axis, slope, Student(intercept, scale, proposal.nu))

    def draw(self, n: int, seed: int) -> np.ndarray:
        """See `Student.draw`; the score from a separate sequence."""
        rng = np.random.default_rng([seed, 1])
        u = stats.qmc.Sobol(1, scramble=True, rng=rng).random(n)[:, 0]
        score = self.sd * special.ndtri(np.clip(u, 1e-12, 1.0 - 1e-12))
        others = self.others.draw(n, seed) + special.ndtr(score)[:, None] * self.slope
        return np.insert(others, self.axis, score, axis=1)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """See `Student.log_density`."""
        score = z[:, self.axis]
        others = np.delete(z, self.axis, axis=1) - special.ndtr(score)[:, None] * self.slope
        marginal = -0.5 * (score / self.sd) ** 2 - np.log(self.sd * np.sqrt(2.0 * np.pi))
        return marginal + self.others.log_density(others)


Proposal = Student | Spanning
"""A density to draw from."""


def log_mixture(components: Sequence[Proposal], sizes: Sequence[int], z: np.ndarray) -> np.ndarray:
    """Log density of the mixture that `sizes` points of each component are drawn from."""
    shares = np.log(np.asarray(sizes, dtype=float) / sum(sizes))
    terms = [s + component.log_density(z) for s, component in zip(shares, components, strict=True)]
    return np.logaddexp.reduce(terms, axis=0)


def proposal_of(posterior: xr.DataTree | None) -> Student | None:
    """Proposal that a posterior was drawn by; None for no posterior, or one of another sampler."""
    if posterior is None or "proposal_center" not in posterior.attrs:
        return None
    center = np.atleast_1d(posterior.attrs["proposal_center"]).astype(float)
    scale = np.reshape(posterior.attrs["proposal_scale"], (len(center), len(center)))
    return Student(center, scale.astype(float))
