"""Importance sampling of a hazard's hyperparameters, and of where lost missions failed.

Target: z, the hyperparameters in coordinates whose priors are standard normal (see `BetaPriors`),
and the bound k_j at which each mission lost somewhere unknown failed, with the chances of all
bounds integrated out:

    p(z, k | data) ~ N(z; 0, I) prod_e B(a_e + f_e, b_e + n_e - f_e) / B(a_e, b_e),

a_e = s m_e, b_e = s (1 - m_e), n and f counting, for given k, exposures and failures of bound e.
Points z come from Student-t densities around the modes; given z, places are imputed one mission
after the other, each from its predictive distribution given those before (sequential imputation;
Kong, Liu and Wong 1994), times a lookahead factor for later missions that share its bounds. The
weight is the density of z and of the known outcomes, times the predictive probabilities of the
places over those they were drawn with, over the density of the proposal: unbiased for any number of
lost missions, paths that share bounds included, so that the weighted (z, k) are of the joint
posterior.

The modes are those of a density in which lost missions are independent given z; only the proposal
depends on it.
"""

from typing import Any, NamedTuple, Self

import numpy as np
from scipy import special, stats

from trustbo.hazard.exposures import Exposures
from trustbo.hazard.mixture import mixture_quantile
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.weights import smoothed_weights

LIMIT = 0.7
"""Largest k-hat of a posterior that is not refused."""
_GOOD = 0.5  # k-hat beyond which the proposal is refitted to its weighted points
_PASSES = 3  # at most
_KERNELS, _NARROW = 32, 0.9  # components of the refitted proposal; width in units of all points'
_STRONGEST = 50.0
"""Clip for log parameters: Newton trial points can overflow exp."""
_LOG2_POINTS = 11
_DEGREES = 5.0
_WIDTH = 1.2  # scale of the proposals in units of the curvature's
_DEFENCE = 0.1  # weight of the prior as defensive component
FLOOR = 1e-12
"""Lower limit of alpha and beta of a prior Beta: the logistic of a mean may round to 0 or 1."""
TILT = "tilt"
"""Measure of difficulty to which the slope limit applies."""
LIMIT_NAMES = ("margin", "width")
"""Parameters of the robots' slope limit, degrees."""
_NORMAL = 0.5 * np.log(2.0 * np.pi)


class Points(NamedTuple):
    """Weighted points of the joint posterior of hyperparameters and places."""

    z: np.ndarray  # (point, parameter), in units of the priors
    places: np.ndarray  # (point, lost mission), bound of its path, from 0
    weights: np.ndarray  # (point,), sum 1, Pareto-smoothed
    k_hat: float


class BetaPriors(NamedTuple):
    """Beta priors of the chances of the bounds met, as functions of the hyperparameters.

    Hyperparameters are center + scale z, or the exponential of it. The margin's prior has a second,
    wider normal, so that it is a function of z that bends; see `mixture_quantile`.
    """

    center: np.ndarray  # (parameter,), means of the priors
    scale: np.ndarray  # (parameter,), their sds
    is_log: np.ndarray  # (parameter,), whether the prior is of the log
    difficulty: np.ndarray  # (bound, measure)
    steepness: np.ndarray | None  # (bound,), degrees beyond the assumed limit; None: no limit
    doubt: tuple[float, float]  # share and sd of the margin's wide normal

    def of(self, bounds: np.ndarray) -> Self:
        """Restrict to some of the bounds."""
        steepness = None if self.steepness is None else self.steepness[bounds]
        return self._replace(difficulty=self.difficulty[bounds], steepness=steepness)

    def __call__(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Alpha and beta of each Beta, each (point, bound)."""
        return prior_betas(*self.split(self.values(z)), self.difficulty, self.steepness)

    def split(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights (point, 1 + measure), limit (point, 0 or 2) and strength (point,) of values."""
        n = 1 + self.difficulty.shape[1]
        return values[:, :n], values[:, n:-1], values[:, -1]

    def values(self, z: np.ndarray) -> np.ndarray:
        """Intercept, coefficients, margin and width of the limit, and strength.

        Shape (point, parameter); without a limit, margin and width are absent.
        """
        values = self.center + self.scale * z
        if self.steepness is not None and self.doubt[0] > 0.0:
            at = -1 - len(LIMIT_NAMES)
            wide = mixture_quantile(z[:, at], float(self.scale[at]), *self.doubt)
            values[:, at] = self.center[at] + wide
        values[:, self.is_log] = np.exp(np.clip(values[:, self.is_log], -_STRONGEST, _STRONGEST))
        return values


def steepness_of(tilt: np.ndarray, max_slope: float) -> np.ndarray:
    """Degrees by which a tilt, as a share of the limit's tangent, is beyond the limit, rad."""
    return np.rad2deg(np.arctan(tilt * np.tan(max_slope)) - max_slope)


def prior_betas(
    weights: np.ndarray,
    limit: np.ndarray,
    strength: np.ndarray,
    difficulty: np.ndarray,
    steepness: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute alpha and beta of the prior Beta of each bound, each (point, bound).

    A bound is passed if neither its difficulty nor the limit stops the robots: 1 - m is the product
    of sigma(-logit) and sigma(-(steepness + margin) / width).

    Args:
        weights: Intercept and coefficients, (point, 1 + measure).
        limit: Margin and width, (point, 2), degrees; not used where `steepness` is None.
        strength: Strength, (point,).
        difficulty: Difficulty less its reference, (bound, measure).
        steepness: Degrees by which each bound is beyond the assumed limit, (bound,), or None.
    """
    logit = weights[:, :1] + weights[:, 1:] @ difficulty.T
    fails, passes = special.expit(logit), special.expit(-logit)
    if steepness is not None:
        beyond = (steepness + limit[:, :1]) / limit[:, 1:]
        fails, passes = fails + passes * special.expit(beyond), passes * special.expit(-beyond)
    return strength[:, None] * fails + FLOOR, strength[:, None] * passes + FLOOR


def sample(betas: BetaPriors, exposures: Exposures, seed: int) -> Points:
    """Draw weighted points of the posterior; the caller checks k-hat."""
    density = _Density(betas, exposures)
    d = len(betas.center)
    starts = np.zeros((3, d))
    starts[1:, -1] = -1.5, 1.5  # modes of strength: certain outcomes, equal bounds
    modes, values, factors = laplace(density, starts)
    apart = [0]
    for i in (1, 2):
        gap = [np.linalg.norm(np.linalg.solve(factors[j], modes[i] - modes[j])) for j in apart]
        if min(gap) > 1.0 and values[i] > values.max() - 8.0:
            apart.append(i)
    proposal = _Mixture.around(modes[apart], _WIDTH * factors[apart], values[apart])
    points = best = _weigh(betas, exposures, density, proposal, seed)
    for _ in range(_PASSES):
        if best.k_hat <= _GOOD:
            break
        mean = points.weights @ points.z
        off = points.z - mean
        covariance = (off * points.weights[:, None]).T @ off + 1e-3 * np.eye(d)
        # Kernels around resampled points follow a curved posterior.
        share = (np.arange(_KERNELS) + 0.5) / _KERNELS
        kernels = points.z[np.searchsorted(points.weights.cumsum()[:-1], share)]
        width = np.repeat(_NARROW * np.linalg.cholesky(covariance)[None], _KERNELS, axis=0)
        again = _Mixture.around(
            np.vstack([modes[apart], kernels]),
            np.concatenate([_WIDTH * factors[apart], width]),
            np.zeros(len(apart) + _KERNELS),
        )
        points = _weigh(betas, exposures, density, again, seed)
        best = min(best, points, key=lambda candidate: candidate.k_hat)
    return best


def _weigh(
    betas: BetaPriors, exposures: Exposures, density: "_Density", proposal: "_Mixture", seed: int
) -> Points:
    z = proposal.draw(2**_LOG2_POINTS, seed)
    places, log_fail = impute(betas, exposures, z, np.random.default_rng([seed, 1]))
    raw = density.log_observed(z) + log_fail - proposal.log_density(z)
    log_w, k_hat, _ = smoothed_weights(raw)
    return Points(z, places, np.exp(log_w), k_hat)


def impute(
    betas: BetaPriors, exposures: Exposures, z: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw where lost missions failed, one after the other, given each point's hyperparameters.

    Returns places (point, mission), bounds of their paths from 0; and log weights (point,), whose
    exponential has for its mean the probability that all of them fail.
    """
    places, log_weight = np.zeros((len(z), len(exposures.lost)), int), np.zeros(len(z))
    if not exposures.lost:
        return places, log_weight
    alpha, beta = betas(z)
    a, b = alpha + exposures.failed, beta + exposures.n - exposures.failed
    uniform = rng.random(places.shape)
    for j, (path, weight) in enumerate(zip(exposures.lost, exposures.lost_weights, strict=True)):
        survived, within = np.ones(len(z)), np.empty((len(z), len(path)))
        done = b.copy()
        for k, e in enumerate(path):
            fails = a[:, e] / (a[:, e] + done[:, e])
            within[:, k] = survived * fails
            survived = survived * (1.0 - fails)
            done[:, e] += 1.0  # a path may enter a cell again
        favour = _lookahead(path, exposures.lost[j + 1 :], a, b)
        cumulative = (within * favour).cumsum(1)
        total = cumulative[:, -1]
        places[:, j] = (cumulative < uniform[:, j, None] * total[:, None]).sum(1)
        drawn = np.take_along_axis(favour, places[:, j, None], axis=1)[:, 0]
        fail = within.sum(1)
        log_weight += weight * np.log(fail) + np.log(total / (fail * drawn))
        add_lost(path, weight, places[:, j], a, b)
    return places, log_weight


def _lookahead(
    path: np.ndarray, later: tuple[np.ndarray, ...], a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """Factor by which a failure at each bound of a path makes that of later missions likelier.

    Shape (point, bound). Without it, the rare points that blame a bound that several missions share
    would have large weights.
    """
    favour = np.ones((len(a), len(path)))
    for other in later:
        shared = [k for k, e in enumerate(path) if e in other]
        if not shared:
            continue
        chance = a[:, other] / (a[:, other] + b[:, other])
        arrives = (1.0 - chance).prod(1)
        for k in shared:
            e = path[k]
            ratio = (a[:, e] + b[:, e]) / (a[:, e] + b[:, e] + 1.0)  # of the chances to survive
            favour[:, k] *= (1.0 - arrives * ratio) / np.maximum(1.0 - arrives, 1e-12)
    return favour


def add_lost(
    path: np.ndarray, weight: float, place: np.ndarray, a: np.ndarray, b: np.ndarray
) -> None:
    """Add a mission that failed at `place` (point,) of its path to Betas a, b (point, bound).

    A negative index in the path is of a bound that is not among these.
    """
    for k, e in enumerate(path):
        if e < 0:
            continue
        a[:, e] += weight * (place == k)
        b[:, e] += weight * (place > k)


class _Density:
    """Log density of z, with and without an approximation for lost missions."""

    def __init__(self, betas: BetaPriors, exposures: Exposures) -> None:
        self._betas, self._exposures = betas, exposures
        self._met = exposures.n > 0.0
        self._known_betas = betas.of(self._met)

    def log_observed(self, z: np.ndarray) -> np.ndarray:
        """Prior and outcomes of known exposures, shape (point,)."""
        alpha, beta = self._known_betas(z)
        n, failed = self._exposures.n[self._met], self._exposures.failed[self._met]
        bad = failed > 0.0
        total = -(0.5 * z**2 + _NORMAL).sum(1)
        total += _rising(beta, n - failed).sum(1) + _rising(alpha[:, bad], failed[bad]).sum(1)
        many, index = np.unique(n, return_inverse=True)
        counts = np.bincount(index, minlength=len(many))
        strength = self._betas.values(z)[:, -1:]
        return total - _rising(strength + 2.0 * FLOOR, many) @ counts

    def __call__(self, z: np.ndarray) -> np.ndarray:
        total, lost = self.log_observed(z), self._exposures.lost
        if lost:
            alpha, beta = self._betas(z)
            a = alpha + self._exposures.failed
            chance = a / (alpha + beta + self._exposures.n)
            for path, weight in zip(lost, self._exposures.lost_weights, strict=True):
                survived = np.log1p(-np.minimum(chance[:, path], 1.0 - 1e-12)).sum(1)
                total += weight * np.log(-np.expm1(survived))
        return total


def _rising(x: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Log of Gamma(x + k) / Gamma(x), shape of x (point, bound), for counts k (bound,)."""
    out = np.zeros(np.broadcast_shapes(x.shape, k.shape))
    few = (k == np.round(k)) & (k <= 8.0)
    for i in range(8):  # logs of few factors take a tenth of the time of two gamma functions
        columns = np.flatnonzero(few & (k > i))
        if len(columns):
            out[:, columns] += np.log((x[:, columns] if x.shape[1] > 1 else x) + i)
    if (columns := np.flatnonzero(~few)).size:
        entries = x[:, columns] if x.shape[1] > 1 else x
        out[:, columns] = special.gammaln(entries + k[columns]) - special.gammaln(entries)
    return out


class _Mixture(NamedTuple):
    """Student-t densities around modes, and the prior, a standard normal, with a small share."""

    centers: np.ndarray  # (component, parameter)
    factors: np.ndarray  # (component, parameter, parameter), lower triangular
    shares: np.ndarray  # (component,), without the prior's

    @classmethod
    def around(cls, modes: np.ndarray, factors: np.ndarray, values: np.ndarray) -> "_Mixture":
        mass = values + np.array([np.log(np.diag(factor)).sum() for factor in factors])
        shares = 0.9 * special.softmax(mass) + 0.1 / len(mass)
        return cls(modes, factors, (1.0 - _DEFENCE) * shares)

    def draw(self, n: int, seed: int) -> np.ndarray:
        """Points of a scrambled Sobol sequence, shape (n, parameter)."""
        d = self.centers.shape[1]
        uniform: Any = stats.qmc.Sobol(d + 2, scramble=True, rng=seed).random(n)
        uniform = np.clip(uniform, 1e-12, 1.0 - 1e-12)
        normal = special.ndtri(uniform[:, :d])
        radius = 2.0 * special.gammaincinv(0.5 * _DEGREES, uniform[:, d])
        which = np.searchsorted(np.cumsum(self.shares), uniform[:, d + 1], side="right")
        heavy = normal * np.sqrt(_DEGREES / radius)[:, None]
        for i, (center, factor) in enumerate(zip(self.centers, self.factors, strict=True)):
            mine = which == i
            normal[mine] = center + heavy[mine] @ factor.T
        return normal

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log density, shape (point,)."""
        d, nu = z.shape[1], _DEGREES
        terms = [np.log(_DEFENCE) - (0.5 * z**2 + _NORMAL).sum(1)]
        norm = special.gammaln(0.5 * (nu + d)) - special.gammaln(0.5 * nu)
        norm -= 0.5 * d * np.log(nu * np.pi)
        for center, factor, share in zip(*self, strict=True):
            r2 = (np.linalg.solve(factor, (z - center).T) ** 2).sum(0)
            shape = norm - np.log(np.diag(factor)).sum() - 0.5 * (nu + d) * np.log1p(r2 / nu)
            terms.append(np.log(share) + shape)
        return np.logaddexp.reduce(terms, axis=0)
