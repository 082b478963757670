"""Mixtures of multivariate Student-t densities, by components: proposals of any dimension."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy import special, stats
from scipy.linalg import solve_triangular


class Student(NamedTuple):
    """Multivariate Student-t."""

    center: np.ndarray  # (axis,)
    scale: np.ndarray  # (axis, axis), lower triangular
    nu: float = 8.0

    @classmethod
    def of(cls, z: np.ndarray, log_w: np.ndarray, ridge: float = 0.0) -> Self:
        """Student-t with the mean, and as scale the covariance, of weighted points."""
        w = np.exp(log_w)
        mean = w @ z
        off = z - mean
        cov = (off * w[:, None]).T @ off + ridge * np.eye(z.shape[1])
        return cls(mean, np.linalg.cholesky(cov))

    def widened(self, factor: float) -> Self:
        """The same, the scale times a factor."""
        return self._replace(scale=factor * self.scale)

    def draw(self, n: int, seed: int) -> np.ndarray:
        """Points of a scrambled Sobol sequence, (n, axis)."""
        d = len(self.center)
        u = stats.qmc.Sobol(d + 1, scramble=True, rng=seed).random(n)
        u = np.clip(u, 1e-12, 1.0 - 1e-12)
        chi2 = 2.0 * special.gammaincinv(0.5 * self.nu, u[:, d]) / self.nu
        return self.center + (special.ndtri(u[:, :d]) / np.sqrt(chi2)[:, None]) @ self.scale.T

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log density, shape (point,)."""
        d, nu = len(self.center), self.nu
        white = solve_triangular(self.scale, (z - self.center).T, lower=True)
        return (
            special.gammaln(0.5 * (nu + d))
            - special.gammaln(0.5 * nu)
            - 0.5 * d * np.log(nu * np.pi)
            - np.log(np.diag(self.scale)).sum()
            - 0.5 * (nu + d) * np.log1p((white**2).sum(0) / nu)
        )


def log_mixture(components: Sequence[Student], sizes: Sequence[int], z: np.ndarray) -> np.ndarray:
    """Log density of the mixture that `sizes` points of each component are drawn from."""
    shares = np.log(np.asarray(sizes, dtype=float) / sum(sizes))
    terms = [s + each.log_density(z) for s, each in zip(shares, components, strict=True)]
    return np.logaddexp.reduce(terms, axis=0)
