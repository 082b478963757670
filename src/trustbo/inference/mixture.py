"""Mixtures of Student-t distributions, the proposals of importance sampling."""

import json
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy import special, stats
from scipy.linalg import solve_triangular

DEGREES = 8.0
"""Degrees of freedom of the components."""
MANY = 10
"""Number of coordinates above which fits take fewer steps, to save time."""
_MOST_COMPONENTS = 8
_LEAST_COMPONENTS = 2
_COORDINATES = 100
"""Number of coordinates of all components together, which limits their number."""
STEPS = 6
"""Steps of expectation maximisation of a fit; fewer would lose modes in a search."""
STEPS_OF_MANY = 3
"""The same, for fits of many coordinates after the search."""
_POINTS_PER_AXIS = 2.0
"""Effective points per coordinate below which a component is dropped."""
_NEGLIGIBLE = 1e-6
"""Weight relative to the largest one below which a point has no effect on a fit."""
_RIDGE = 1e-10
"""Variance that is added to all covariances."""
_NUMBERS = 1 << 18
"""Most numbers of the points whose densities are computed at once, in memory near the processor."""
_EDGE = 1e-12
"""Smallest distance of uniform numbers from 0 and 1, where quantiles are infinite."""
SKEWS = (0.3, 3.0)
"""Limits of the width of one side relative to that of both sides."""
_SHIFTS = np.linspace(-1.5, 1.5, 31)
"""Differences between the center and the mean that are tried, in sds."""


class Mixture(NamedTuple):
    """Mixture of multivariate Student-t distributions, which may be wider on one side.

    A point of a component is center + scale e. The elements of e have standard Student-t
    distributions, stretched by the first row of sides where negative and by the second row where
    positive (Geweke 1989, Econometrica 57). The density of a component is continuous, so the
    probabilities of the two signs are proportional to the sides.
    """

    share: np.ndarray  # (component,), with sum 1
    center: np.ndarray  # (component, coordinate)
    scale: np.ndarray  # (component, coordinate, coordinate), lower triangular
    sides: np.ndarray  # (component, side, coordinate), factors of negative and positive elements

    @classmethod
    def even(cls, share: np.ndarray, center: np.ndarray, scale: np.ndarray) -> Self:
        """Return the mixture whose components are as wide on both sides."""
        return cls(share, center, scale, np.ones((len(share), 2, center.shape[1])))

    @classmethod
    def single(cls, center: np.ndarray, scale: np.ndarray, sides: np.ndarray | None = None) -> Self:
        """Return a single component, by default as wide on both sides."""
        one = cls.even(np.ones(1), center[None], scale[None])
        return one if sides is None else one._replace(sides=sides[None])

    @classmethod
    def near(
        cls, x: np.ndarray, weight: np.ndarray, n_components: int, rng: np.random.Generator
    ) -> Self:
        """Return components at points drawn by weight, each with the covariance of all points."""
        chosen = x[rng.choice(len(x), n_components, p=weight)]
        scale = np.linalg.cholesky(covariance_of(x, weight))
        share = np.full(n_components, 1.0 / n_components)
        return cls.even(share, chosen, np.repeat(scale[None], n_components, axis=0))

    @classmethod
    def joined(cls, mixtures: Sequence[Self], shares: Sequence[float] | np.ndarray) -> Self:
        """Return the mixture of mixtures with these shares."""
        share = [p * one.share for p, one in zip(shares, mixtures, strict=True)]
        others = zip(*(one[1:] for one in mixtures), strict=True)
        return cls(np.concatenate(share), *(np.concatenate(arrays) for arrays in others))

    @classmethod
    def of_points(cls, x: np.ndarray, weight: np.ndarray, toward: Self) -> Self:
        """Fit one component to points x (point, coordinate) with weights (point,) of sum 1.

        Since a covariance has many elements, it is averaged with that of `toward`, which counts as
        one point for each element. The sides are fitted by `two_piece`. Without this average, the
        proposals of few points would be too narrow, and estimates of the evidence biased.
        """
        d = x.shape[1]
        per_axis = d * (weight**2).sum()  # reciprocal of the effective points per coordinate
        share = per_axis * (d + 1) / (1.0 + per_axis * (d + 1))  # of `toward` in the covariance

        mean = weight @ x
        away = x - mean
        covariance = (1.0 - share) * away.T * weight @ away + share * toward.total
        scale = np.linalg.cholesky(covariance)

        white = solve_triangular(scale, away.T, lower=True).T
        shift, sides = two_piece(white, weight, per_axis)
        return cls.single(mean + scale @ shift, scale, sides)

    @property
    def covariance(self) -> np.ndarray:
        """Covariances (component, coordinate, coordinate), up to a common factor."""
        wide = self.scale * self.sides.mean(1)[:, None]
        return wide @ np.swapaxes(wide, 1, 2)

    @property
    def within(self) -> np.ndarray:
        """Mean covariance (coordinate, coordinate) of the components, up to a factor."""
        return np.tensordot(self.share, self.covariance, 1)

    @property
    def mean(self) -> np.ndarray:
        """Mean center (coordinate,) of the components."""
        return self.share @ self.center

    @property
    def total(self) -> np.ndarray:
        """Covariance (coordinate, coordinate) of all components together, up to a factor."""
        away = self.center - self.mean
        return self.within + (away.T * self.share) @ away

    @property
    def text(self) -> str:
        """The mixture as JSON, from which `from_text` restores it exactly."""
        return json.dumps([array.tolist() for array in self])

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Read a mixture from JSON."""
        return cls(*(np.array(values) for values in json.loads(text)))

    def scaled(self, factor: float) -> Self:
        """Return the mixture with the scales of its components multiplied by a factor."""
        return self._replace(scale=factor * self.scale)

    def evened(self) -> Self:
        """Return the mixture with shares half way to equal ones.

        A mode whose components do not fit it yet has too little weight. With its share it would
        lose its points, and soon be lost.
        """
        return self._replace(share=0.5 * (self.share + 1.0 / len(self.share)))

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw points (n, coordinate) with a scrambled Sobol sequence; n must be a power of 2.

        The first numbers of the sequence choose the component.
        """
        d = self.center.shape[1]
        uniform = np.clip(stats.qmc.Sobol(d + 2, rng=rng).random(n), _EDGE, 1.0 - _EDGE)
        which = np.searchsorted(np.cumsum(self.share)[:-1], uniform[:, 0])
        chi2 = 2.0 * special.gammaincinv(0.5 * DEGREES, uniform[:, 1:2]) / DEGREES

        u = uniform[:, 2:]
        below, above = self.sides[which, 0], self.sides[which, 1]
        negative = below / (below + above)  # probability of a negative element
        in_side = np.where(
            u < negative, 0.5 * u / negative, 0.5 + 0.5 * (u - negative) / (1.0 - negative)
        )
        x = special.ndtri(in_side) / np.sqrt(chi2)
        x *= np.where(x < 0.0, below, above)
        for k in range(len(self.share)):
            own = which == k
            x[own] = self.center[k] + x[own] @ self.scale[k].T
        return x

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Compute the log density (point,) of points (point, coordinate)."""
        log_parts = self._log_parts()
        at_once = max(_NUMBERS // self.center.size, 1)
        parts = [x[k : k + at_once] for k in range(0, len(x), at_once)]
        return np.concatenate([_log_sum(log_parts(part)[0]) for part in parts])

    def nearest(self, x: np.ndarray) -> np.ndarray:
        """Return the component (point,) that is most probable at points (point, coordinate)."""
        return self._log_parts()(x)[0].argmax(0)

    def _log_parts(self) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Return a function of points that computes log (share times density), (component, point).

        It also returns squared distances from the centers, of the same shape.
        """
        nu = DEGREES
        d = self.center.shape[1]
        whitening = np.linalg.inv(self.scale)
        center = (whitening @ self.center[..., None]).reshape(-1, 1)
        whitening = whitening.reshape(-1, d)
        below, above = self.sides[:, 0, :, None], self.sides[:, 1, :, None]
        is_even = (self.sides == 1.0).all()

        constant = special.gammaln(0.5 * (nu + d)) - special.gammaln(0.5 * nu)
        constant -= 0.5 * d * np.log(nu * np.pi)
        root = np.diagonal(self.scale, axis1=1, axis2=2) * self.sides.mean(1)
        log_part = (np.log(self.share) + constant - np.log(root).sum(1))[:, None]

        def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            white = whitening @ x.T - center  # (component * coordinate, point)
            white = white.reshape(-1, d, len(x))
            if not is_even:
                white /= np.where(white < 0.0, below, above)
            square = np.einsum("kdn,kdn->kn", white, white)
            return log_part - 0.5 * (nu + d) * np.log1p(square / nu), square

        return at

    def fitted(self, x: np.ndarray, weight: np.ndarray, n_steps: int = STEPS) -> Self:
        """Fit the mixture to points x (point, coordinate) with weights (point,) of sum 1.

        Each step is that of expectation maximisation for Student-t distributions with known degrees
        of freedom (Peel and McLachlan 2000). Components of few points are dropped. The covariances
        of the others are averaged with the mean covariance, which counts as 2 d points. All
        components are as wide on both sides.
        """
        relevant = weight > _NEGLIGIBLE * weight.max()
        x = x[relevant]
        weight = weight[relevant] / weight[relevant].sum()

        d = x.shape[1]
        n_effective = 1.0 / (weight**2).sum()
        mixture = self
        for _ in range(n_steps):
            log_part, square = mixture._log_parts()(x)
            own = weight * np.exp(log_part - special.logsumexp(log_part, axis=0))
            share = own.sum(1)
            kept = share * n_effective > _POINTS_PER_AXIS * d
            if not kept.any():
                scale = np.linalg.cholesky(covariance_of(x, weight))
                return type(self).single(weight @ x, scale)

            own, square, share = own[kept], square[kept], share[kept]
            near = own * (DEGREES + d) / (DEGREES + square)
            center = near @ x / near.sum(1)[:, None]
            covariance = np.empty((len(share), d, d))
            for k in range(len(share)):
                away = x - center[k]
                covariance[k] = (away.T * near[k]) @ away / share[k]

            within = np.tensordot(share / share.sum(), covariance, 1) + _RIDGE * np.eye(d)
            from_others = (2.0 * d / (2.0 * d + share * n_effective))[:, None, None]
            covariance = (1.0 - from_others) * covariance + from_others * within
            mixture = type(self).even(share / share.sum(), center, np.linalg.cholesky(covariance))
        return mixture


def two_piece(
    x: np.ndarray, weight: np.ndarray, n_standard: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a two-piece normal distribution to each column of x (point, coordinate).

    For a given center, the sums of squares S on both sides give the maximum-likelihood widths
    S^(1/3) (S_below^(1/3) + S_above^(1/3))^(1/2), and the likelihood decreases with the sum of the
    cube roots (John 1982, Communications in Statistics 11). `n_standard` points of a standard
    normal distribution are added to the points, whose weights (point,) sum to 1.

    Returns:
        Centers (coordinate,) and widths (side, coordinate) below and above the centers.
    """
    roots = np.empty((len(_SHIFTS), 2, x.shape[1]))
    for k, shift in enumerate(_SHIFTS):
        for side, sign in enumerate((-1.0, 1.0)):
            own = weight @ np.maximum(sign * (x - shift), 0.0) ** 2

            # E[max(e - a, 0)^2] of a standard normal e
            a = sign * shift
            density = np.exp(-0.5 * a**2) / np.sqrt(2.0 * np.pi)
            standard = (1.0 + a**2) * special.ndtr(-a) - a * density
            roots[k, side] = np.cbrt((own + n_standard * standard) / (1.0 + n_standard))

    best = roots.sum(1).argmin(0)
    chosen = roots[best, :, np.arange(x.shape[1])].T
    return _SHIFTS[best], np.clip(chosen * np.sqrt(chosen.sum(0)), *SKEWS)


def n_components(d: int) -> int:
    """Return the number of components for d coordinates; each has d (d + 1) / 2 covariances."""
    return int(np.clip(_COORDINATES // d, _LEAST_COMPONENTS, _MOST_COMPONENTS))


def covariance_of(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Compute the covariance (coordinate, coordinate) of points with weights of sum 1."""
    away = x - weight @ x
    return (away.T * weight) @ away + _RIDGE * np.eye(x.shape[1])


def _log_sum(log_part: np.ndarray) -> np.ndarray:
    """Compute the logarithms of sums over the first axis; at least one part is finite."""
    most = log_part.max(0)
    return np.log(np.exp(log_part - most).sum(0)) + most
