"""Adaptive importance sampling of normal scores, for any log density.

Hyperparameters are sampled as *scores* z, which are standard normal a priori. All other variables
(coefficients, effects, trust) are integrated out of the density and drawn given the scores.

1. `climb` searches for a mode from each start, and `fit_mode` fits a skewed Student-t at the mode
   by finite differences.
2. Each round draws points from the current proposal, from the fits at the modes if there are
   several modes, and from a defensive proposal, which covers regions that other proposals miss. All
   proposals so far form a mixture q, and every point has the weight p(z) / q(z).
3. A skewed Student-t is fitted to the weighted points for the next round. As long as few points are
   effective, the fit stays near the first proposal. If k-hat is bad after round 2 or later, half of
   the points of all later rounds are drawn from kernels (West 1993), because kernels can also
   describe curved densities. The kernels are centred at points drawn by weight. Sampling stops when
   k-hat and the effective number of points are good.

The weights are Pareto-smoothed (Vehtari, Simpson, Gelman, Yao and Gabry 2024). The mean weight
before smoothing is an estimate of the evidence.
"""

import json
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
from arviz_stats.base.array import array_stats
from scipy import optimize, special, stats
from scipy.linalg import solve_triangular

GOOD_KHAT = 0.5
"""Pareto shape k-hat of the weights below which sampling may stop."""
MAX_KHAT = 0.7
"""Largest k-hat of acceptable results."""
ENOUGH = 400.0
"""Effective number of points at which sampling stops."""
ROUNDS = 8
"""Largest number of rounds by default."""
DEGREES = 8.0
"""Degrees of freedom of the proposals."""
_PRIOR_SCALE = 1.2
"""Scale of the usual defensive proposal; the prior has scale 1."""
_WIDER = 1.1
"""Scale of a proposal relative to the points to which it is fitted."""
_KERNELS = 16
"""Number of kernels."""
_KERNEL_SCALE = 0.7
"""Scale of a kernel relative to that of all points."""
_DEFENSIVE = 8
"""Number of points from other proposals per defensive point after the first round."""
_EFFICIENCY = 0.6
"""Expected number of effective points per point, used to choose the size of the last rounds."""
_LEAST_ROUND = 4
"""Smallest round, as a divisor of the usual number of points."""
_PER_AXIS = 4.0
"""Number of effective points per dimension that is needed to estimate moments."""
_FLATTENED = 6
"""Largest number of times that uneven weights are replaced by their square roots."""
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
_MISSED = np.log(1000.0)
"""Log ratio of the posterior to the points' proposal above which points miss a mode."""
_SKEW_STEP = 2.0
"""Distance from the mode at which skewness is measured, in sds."""
_SKEWS = (0.3, 3.0)
"""Limits of the width of one side relative to that of both sides."""
_SHIFTS = np.linspace(-1.5, 1.5, 31)
"""Differences between the center and the mean that are tried, in sds."""
_FARTHEST = 7.0
"""Largest absolute score of a mode."""
_EDGE = 1e-12
"""Smallest distance of uniform numbers from 0 and 1, where quantiles are infinite."""
_EVEN = 1e-6
"""Range of log ratios within which weights count as equal."""
_BELOW_ALL = 100.0
"""Distance of the log ratio of points without density below the smallest finite log ratio."""

LogDensity = Callable[[np.ndarray], np.ndarray]
"""Log density (point,) of scores (point, score) up to a constant; -inf for zero density."""


class Student(NamedTuple):
    """Multivariate Student-t distribution, which may be wider on one side of its center.

    A point is center + scale x. The elements of x have a standard Student-t distribution, stretched
    by the first row of sides where negative and by the second row where positive. The density is
    continuous, so the probabilities of the two signs are proportional to the sides.
    """

    center: np.ndarray  # (score,)
    scale: np.ndarray  # (score, score), lower triangular
    sides: np.ndarray = np.ones((2, 1))  # (2, score), factors of negative and positive elements

    @classmethod
    def from_points(cls, z: np.ndarray, weight: np.ndarray, near: Self) -> Self:
        """Fit points z (point, score) with weights (point,) that sum to 1.

        Since a covariance has many elements, it is averaged with the covariance of `near`, which
        counts as one point for each element. The sides are fitted by `two_piece`.
        """
        d = z.shape[1]
        per_score = d * (weight**2).sum()  # reciprocal of the effective points per score
        share = per_score * (d + 1) / (1.0 + per_score * (d + 1))  # of `near` in the covariance

        mean = weight @ z
        covariance = (z - mean).T * weight @ (z - mean)
        before = near.scale * near.sides.mean(0)
        scale = np.linalg.cholesky((1.0 - share) * covariance + share * before @ before.T)

        white = solve_triangular(scale, (z - mean).T, lower=True).T
        shift, sides = two_piece(white, weight, per_score)
        return cls(mean + scale @ shift, scale, sides)

    @property
    def text(self) -> str:
        """The distribution as JSON, from which `from_text` restores it exactly."""
        return json.dumps([array.tolist() for array in self])

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Read a distribution from JSON."""
        return cls(*(np.array(values) for values in json.loads(text)))

    def scaled(self, factor: float) -> Self:
        """Return the distribution with its scale multiplied by a factor."""
        return self._replace(scale=factor * self.scale)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw points (n, score) with a scrambled Sobol sequence; n must be a power of 2."""
        d = len(self.center)
        uniform = np.clip(stats.qmc.Sobol(d + 1, rng=rng).random(n), _EDGE, 1.0 - _EDGE)
        chi2 = 2.0 * special.gammaincinv(0.5 * DEGREES, uniform[:, d:]) / DEGREES

        u = uniform[:, :d]
        negative = self.sides[0] / self.sides.sum(0)  # probability of a negative element
        below = 0.5 * u / negative
        above = 0.5 + 0.5 * (u - negative) / (1.0 - negative)
        x = special.ndtri(np.where(u < negative, below, above)) / np.sqrt(chi2)
        return self.center + (np.where(x < 0.0, *self.sides) * x) @ self.scale.T

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Compute the log density (point,) of points (point, score)."""
        nu = DEGREES
        d = len(self.center)
        x = solve_triangular(self.scale, (z - self.center).T, lower=True).T
        square = ((x / np.where(x < 0.0, *self.sides)) ** 2).sum(1)

        constant = special.gammaln(0.5 * (nu + d)) - special.gammaln(0.5 * nu)
        constant -= 0.5 * d * np.log(nu * np.pi)
        constant -= np.log(np.diag(self.scale) * self.sides.mean(0)).sum()
        return constant - 0.5 * (nu + d) * np.log1p(square / nu)


def two_piece(
    x: np.ndarray, weight: np.ndarray, n_standard: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a two-piece normal distribution to each column of x (point, score).

    For a given center, the sums of squares S on both sides give the maximum-likelihood widths
    S^(1/3) (S_below^(1/3) + S_above^(1/3))^(1/2), and the likelihood decreases with the sum of the
    cube roots (John 1982, Communications in Statistics 11). `n_standard` points of a standard
    normal distribution are added to the points, whose weights (point,) sum to 1.

    Returns:
        Centers (score,) and widths (2, score) below and above the centers.
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
    return _SHIFTS[best], np.clip(chosen * np.sqrt(chosen.sum(0)), *_SKEWS)


class Points(NamedTuple):
    """Weighted points of a posterior.

    Attributes:
        z: Normal scores, shape (point, score).
        log_p: Log density of the points, shape (point,).
        log_ratio: Log density relative to the mixture of all proposals, shape (point,).
        weight: Pareto-smoothed weights with sum 1, shape (point,).
        k_hat: Pareto shape of the weights, which is good below 0.5 and bad above 0.7.
        log_evidence: Log of the integral of the density.
        near: Proposal to which `proposal` is close if few points are effective.
        is_far: Whether too few points of the first round were effective to estimate moments. A
            first proposal that is given is then far from the posterior.
    """

    z: np.ndarray
    log_p: np.ndarray
    log_ratio: np.ndarray
    weight: np.ndarray
    k_hat: float
    log_evidence: float
    near: Student
    is_far: bool = False

    @classmethod
    def from_log_weights(
        cls, z: np.ndarray, log_p: np.ndarray, log_ratio: np.ndarray, near: Student
    ) -> Self:
        """Build weighted points by smoothing the importance weights."""
        return cls(z, log_p, log_ratio, *smoothed(log_ratio), near)

    @property
    def kish(self) -> float:
        """Effective number of points, which is 1 / sum of squared weights."""
        return 1.0 / float((self.weight**2).sum())

    @property
    def _n_for_moments(self) -> float:
        """Effective number of points that is needed to estimate moments."""
        return _PER_AXIS * self.z.shape[1]

    @property
    def proposal(self) -> Student:
        """Fit a Student-t to the points; if few points dominate, flatten their weights.

        If no point has a positive density, there is nothing to fit, and it is `near`.
        """
        if not np.isfinite(self.log_ratio).any():
            return self.near

        weight = self.weight
        for _ in range(_FLATTENED):
            if (weight**2).sum() * self._n_for_moments <= 1.0:
                break
            weight = np.sqrt(weight) / np.sqrt(weight).sum()

        return Student.from_points(self.z, weight, self.near)

    @property
    def is_enough_for_moments(self) -> bool:
        """Whether enough points are effective to estimate moments."""
        return self.kish >= self._n_for_moments

    def misses(self, log_density: LogDensity, mode: np.ndarray) -> bool:
        """Return whether the density at a mode (score,) is far above that of the points."""
        log_p = log_density(mode[None]) - self.log_evidence
        return bool(log_p[0] - self.proposal.log_density(mode[None])[0] > _MISSED)

    def resample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw indices of `n` equally weighted points; see `resampled`."""
        return resampled(self.weight, n, rng)


def sample(
    log_density: LogDensity,
    starts: np.ndarray,
    rng: np.random.Generator,
    *,
    size: int = 256,
    enough: float = ENOUGH,
    most: int = ROUNDS,
    defensive: Callable[[Student], Student] | None = None,
    first: Student | None = None,
    visit: LogDensity | None = None,
) -> Points:
    """Sample a posterior of scores; the caller must check `k_hat`.

    Args:
        log_density: Log posterior density of scores.
        starts: Starting points of the search for modes, shape (start, score).
        rng: Random number generator.
        size: Number of points per round, a power of 2. In the first round, half of the points are
            drawn from the defensive proposal; later rounds draw an additional eighth from it.
        enough: Effective number of points at which sampling stops if k-hat is good.
        most: Maximum number of rounds.
        defensive: Function that returns a proposal for regions that the current proposal may miss;
            the default is a Student-t slightly wider than the prior.
        first: First proposal, such as that of a similar posterior. By default, proposals are fitted
            at the modes that the search finds. With `first`, the first round is like the later
            rounds.
        visit: Log density of the drawn points, in the order of `Points.z`, for callers that record
            something with each point; by default `log_density`.
    """
    d = starts.shape[1]
    prior = Student(np.zeros(d), _PRIOR_SCALE * np.eye(d))
    visit = visit or log_density

    # Step 1: the proposals of the first round.
    modes = [first] if first else find_modes(log_density, starts)
    several = modes if len(modes) > 1 else []
    current = modes[0]
    if first:  # the region of the posterior is known
        n_own = size
        n_others = size // _DEFENSIVE
    else:
        n_own = size // 2
        n_others = size // 2
    own = _shares([current.scaled(_WIDER), *several], n_own)

    z = np.empty((0, d))
    log_p = np.empty(0)
    mixture = []
    uneven = False
    is_far = False
    n_rounds = 0
    while True:
        # Step 2: draw points, and weight all points so far by the mixture of all proposals so far.
        n_rounds += 1
        others = defensive(current) if defensive else prior
        for density, n in [*own, (others, n_others)]:
            new = density.draw(n, rng)
            z = np.vstack([z, new])
            log_p = np.append(log_p, visit(new))
            mixture.append((density, n))

        log_q = [density.log_density(z) + np.log(n) for density, n in mixture]
        log_q = special.logsumexp(log_q, axis=0) - np.log(len(z))
        log_ratio = np.where(np.isfinite(log_p), log_p, -np.inf) - log_q
        points = Points.from_log_weights(z, log_p, log_ratio, modes[0])
        is_far = is_far or (n_rounds == 1 and not points.is_enough_for_moments)

        good = points.k_hat < GOOD_KHAT
        if (good and points.kish > enough and n_rounds > 1) or n_rounds == most:
            return points._replace(is_far=is_far)

        # Step 3: fit the proposal of the next round, whose size depends on how many points are
        # missing.
        current = points.proposal
        uneven = uneven or (not good and n_rounds > 1)
        if uneven:
            n_own = size
            kernel = current.scaled(_KERNEL_SCALE)
            chosen = points.resample(_KERNELS, rng)
            kernels = [kernel._replace(center=center) for center in points.z[chosen]]
            own = [(current.scaled(_WIDER), size // 2), *_shares(kernels, size // 2)]
        else:
            missing = max(enough - points.kish, 1.0) / _EFFICIENCY
            n_own = int(np.clip(2 ** np.ceil(np.log2(missing)), size // _LEAST_ROUND, size))
            own = _shares([current.scaled(_WIDER), *several], n_own)
        n_others = n_own // _DEFENSIVE


def _shares(densities: list[Student], n: int) -> list[tuple[Student, int]]:
    """Divide n points among densities, in powers of 2."""
    return [(density, 1 << int(np.log2(n / len(densities)))) for density in densities]


def find_modes(log_density: LogDensity, starts: np.ndarray) -> list[Student]:
    """Fit proposals at the distinct modes reached from the starts; the highest mode comes first."""
    found: list[tuple[float, Student]] = []
    for start in starts:
        mode = fit_mode(log_density, climb(log_density, start))
        found.append((float(log_density(mode.center[None])[0]), mode))
    found.sort(key=lambda pair: -pair[0])

    highest, first = found[0]
    modes = [first]
    for value, mode in found[1:]:
        gaps = [np.linalg.solve(m.scale, mode.center - m.center) for m in modes]
        is_new = min(np.linalg.norm(gap) for gap in gaps) > _APART
        if is_new and value > highest - _NEGLIGIBLE:
            modes.append(mode)
    return modes


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


def fit_mode(log_density: LogDensity, mode: np.ndarray) -> Student:
    """Fit a Student-t at a mode, with the curvature at the mode and a separate width on each side.

    A split Student-t fits skewed posteriors (Geweke 1989, Econometrica 57).
    """
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
    return Student(mode, scale, np.clip(_SKEW_STEP / np.sqrt(2.0 * drop), *_SKEWS))


def _finite(log_p: np.ndarray) -> np.ndarray:
    """Replace NaN and -inf by a log density that is very low but finite."""
    return np.nan_to_num(log_p, nan=-_LARGEST_COST, neginf=-_LARGEST_COST)


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
