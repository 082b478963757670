"""Near-independent draws from the pooled model's posterior, without Markov chains.

Latent trust and the linear coefficients (beta, b) integrate out in closed form (`gram`). What is
left is three-dimensional: beta0, and the noises as t = log hypot(delta_w, delta_v) and r =
log(delta_w / delta_v), on the real line. A few points around its mode tell its mean and spread; a
Student-t that has these is drawn from by a scrambled Sobol sequence and corrected by
Pareto-smoothed importance weights. Where these are uneven, a mixture along the ridge of r takes its
place. k-hat says how far to trust the result; above 0.7 the caller falls back on NUTS.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import numpyro.distributions as dist
from arviz_stats.base.array import array_stats
from numpyro.distributions import constraints
from scipy import special, stats
from threadpoolctl import ThreadpoolController

from trustbo.errors import TrustboError
from trustbo.models.gram import Quadratic, SufficientStatistics
from trustbo.models.laplace import laplace
from trustbo.models.numeric import log_prob, numbers
from trustbo.models.priors import Priors

KHAT_GOOD, KHAT_LIMIT = 0.5, 0.7
_LOG2_POINTS, _LOG2_PILOT = 12, 10
_DEGREES = 5.0
_RIDGE_STEPS, _RIDGE_DROP = 12, 8.0  # at most so many components a side, so far down in nats
_CHUNK = 1024  # parameter values evaluated at once: bounds the memory of long missions


class ExactDraws(NamedTuple):
    """Equally weighted draws, and how well they were got."""

    params: dict[str, np.ndarray]  # (draw, ...)
    log_weight: np.ndarray  # (draw,), of the point each draw was resampled from, normalised
    lp: np.ndarray  # (draw,), log posterior density of (beta0, t, r), coefficients integrated out
    khat: float
    kish: float
    """Effective number of points, (sum w)^2 / sum w^2."""
    log_evidence: float


class _Target(NamedTuple):
    """The collapsed posterior."""

    statistics: SufficientStatistics
    priors: Priors
    mean: np.ndarray  # (coefficient,), prior of (beta, b)
    precision: np.ndarray  # (coefficient,)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Unnormalised log posterior density of z = (beta0 on the line, t, r), shape (point,)."""
        # Far out the noise underflows: such a point has no density, and is no reason to warn.
        with np.errstate(all="ignore"):
            return np.concatenate([self._log_density(part) for part in _parts(z)])

    def _log_density(self, z: np.ndarray) -> np.ndarray:
        beta0, delta_w, delta_v, log_jacobian = self.constrain(z)
        quadratic = self._quadratic(beta0, delta_w, delta_v)
        mean, cholesky = self.coefficients(quadratic)
        rhs = quadratic.h + self.precision * self.mean
        misfit = quadratic.alpha + self.precision @ self.mean**2 - np.einsum("nc,nc->n", rhs, mean)
        log_det = 2.0 * np.log(np.diagonal(cholesky, axis1=1, axis2=2)).sum(1)
        log_likelihood = -0.5 * (
            misfit
            + quadratic.log_det
            + self.statistics.n_measured * np.log(2.0 * np.pi)
            + log_det
            - np.log(self.precision).sum()
        )
        return (
            log_likelihood
            + log_jacobian
            + log_prob(self.priors.beta0, beta0)
            + log_prob(self.priors.delta_w, delta_w)
            + log_prob(self.priors.delta_v, delta_v)
        )

    def constrain(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """beta0, delta_w, delta_v, and the log Jacobian of the way there."""
        x, t, r = z.T
        log_w = t - 0.5 * np.logaddexp(0.0, -2.0 * r)
        log_v = t - 0.5 * np.logaddexp(0.0, 2.0 * r)
        log_jacobian = log_w + log_v  # of exp; (t, r) -> (log_w, log_v) has Jacobian 1
        if self.priors.beta0.support is constraints.unit_interval:
            log_jacobian = log_jacobian - np.logaddexp(0.0, x) - np.logaddexp(0.0, -x)
            x = special.expit(x)
        return x, np.exp(log_w), np.exp(log_v), log_jacobian

    def coefficients(self, quadratic: Quadratic) -> tuple[np.ndarray, np.ndarray]:
        """Mean of (beta, b) given theta, and the Cholesky factor of their precision."""
        precision = quadratic.P + np.diag(self.precision)
        rhs = quadratic.h + self.precision * self.mean
        finite = np.isfinite(precision).all((1, 2))
        precision = np.where(finite[:, None, None], precision, np.eye(rhs.shape[1]))
        try:
            cholesky = np.linalg.cholesky(precision)
        except np.linalg.LinAlgError:  # noise so small that rounding took the sign of an eigenvalue
            positive = np.linalg.eigvalsh(precision)[:, 0] > 0.0
            finite &= positive
            precision = np.where(positive[:, None, None], precision, np.eye(rhs.shape[1]))
            cholesky = np.linalg.cholesky(precision)
        mean = np.linalg.solve(precision, rhs[..., None])[..., 0]
        return np.where(finite[:, None], mean, np.nan), cholesky

    def draw_coefficients(self, z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """One exact draw of (beta, b) given each z, shape (point, coefficient)."""
        drawn = []
        for part in _parts(z):
            mean, cholesky = self.coefficients(self._quadratic(*self.constrain(part)[:3]))
            noise = rng.standard_normal((*mean.shape, 1))
            drawn.append(mean + np.linalg.solve(np.swapaxes(cholesky, 1, 2), noise)[..., 0])
        return np.concatenate(drawn)

    def _quadratic(self, beta0: np.ndarray, delta_w: np.ndarray, delta_v: np.ndarray) -> Quadratic:
        theta = np.stack([beta0, delta_w**2, delta_v**2], axis=1)
        return self.statistics.evaluate(theta, self.priors.x0_sd)


class _Mixture(NamedTuple):
    """Multivariate Student-t components, to draw from."""

    centers: np.ndarray  # (component, 3)
    scales: np.ndarray  # (component, 3, 3), lower triangular
    weights: np.ndarray  # (component,)

    def draw(self, n: int, seed: int) -> np.ndarray:
        """Points of a scrambled Sobol sequence, mapped to the mixture; shape (n, 3)."""
        uniform = stats.qmc.Sobol(5, scramble=True, rng=seed).random(n)
        uniform = np.clip(uniform, 1e-12, 1.0 - 1e-12)
        normal = special.ndtri(uniform[:, :3])
        chi2 = 2.0 * special.gammaincinv(0.5 * _DEGREES, uniform[:, 3])
        which = np.searchsorted(np.cumsum(self.weights)[:-1], uniform[:, 4], side="right")
        steps = np.einsum("nij,nj->ni", self.scales[which], normal)
        return self.centers[which] + steps * np.sqrt(_DEGREES / chi2)[:, None]

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log density, shape (point,)."""
        d, nu = z.shape[1], _DEGREES
        norm = special.gammaln(0.5 * (nu + d)) - special.gammaln(0.5 * nu)
        norm -= 0.5 * d * np.log(nu * np.pi)
        terms = []
        for center, scale, weight in zip(*self, strict=True):
            distance2 = (np.linalg.solve(scale, (z - center).T) ** 2).sum(0)
            term = norm - np.log(np.diag(scale)).sum() - 0.5 * (nu + d) * np.log1p(distance2 / nu)
            terms.append(np.log(weight) + term)
        return np.logaddexp.reduce(terms, axis=0)


def sample_exact(
    statistics: SufficientStatistics, priors: Priors, n_draws: int, seed: int
) -> ExactDraws:
    """Draw from the posterior of robots that share their parameters.

    Args:
        statistics: Of all missions.
        priors: Normal for beta and b, on (0, 1) or the real line for beta0, on (0, inf) for the
            noises.
        n_draws: How many equally weighted draws.
        seed: Same seed, same draws.

    Raises:
        TrustboError: A prior of another kind; NUTS takes any.
    """
    _require_conjugate(priors)
    # Matrices are small: a second BLAS thread costs more than it brings.
    with _blas().limit(limits=1, user_api="blas"):
        target = _target(statistics, priors)
        mode, scale = laplace(target.log_density, _start(target))
        z, log_p, log_w, khat, evidence = _weigh(target, _matched(target, mode, scale, seed), seed)
        if not khat < KHAT_GOOD:
            ridge = _weigh(target, _along_the_ridge(target, mode, scale), seed)
            if ridge[3] < khat or not np.isfinite(khat):
                z, log_p, log_w, khat, evidence = ridge
        rng = np.random.default_rng(seed)
        weights = np.exp(log_w)
        chosen = rng.permutation(_systematic(weights, n_draws, rng))
        kept = z[chosen]
        beta0, delta_w, delta_v, _ = target.constrain(kept)
        coefficients = target.draw_coefficients(kept, rng)
    params = {
        "beta0": beta0,
        "beta": coefficients[:, :-1],
        "b": coefficients[:, -1],
        "delta_w": delta_w,
        "delta_v": delta_v,
    }
    kish = float(1.0 / (weights**2).sum())
    return ExactDraws(params, log_w[chosen], log_p[chosen], khat, kish, evidence)


@cache
def _blas() -> ThreadpoolController:
    """The BLAS libraries that are loaded: to look for them takes a fifth as long as to sample."""
    return ThreadpoolController()


def _target(statistics: SufficientStatistics, priors: Priors) -> _Target:
    n_features = statistics.n_features

    def each(name: str) -> np.ndarray:
        return np.append(np.broadcast_to(numbers(priors.beta, name), n_features),
                         numbers(priors.b, name))  # fmt: skip

    return _Target(statistics, priors, each("loc"), each("scale") ** -2.0)


def _matched(target: _Target, mode: np.ndarray, scale: np.ndarray, seed: int) -> _Mixture:
    """A Student-t with the mean and 1.2 times the spread of a few points around the mode.

    The posterior is skewed: its moments make a far better proposal than its curvature at the mode.
    """
    around = _Mixture(mode[None], 1.3 * scale[None], np.ones(1))
    z, _, log_w, _, _ = _weigh(target, around, seed, _LOG2_PILOT)
    weights = np.exp(log_w)
    mean = weights @ z
    covariance = ((z - mean) * weights[:, None]).T @ (z - mean)
    return _Mixture(mean[None], 1.2 * np.linalg.cholesky(covariance)[None], np.ones(1))


def _weigh(target: _Target, proposal: _Mixture, seed: int, log2_points: int = _LOG2_POINTS):
    """Points, their log densities, smoothed and normalised log weights, k-hat, log evidence."""
    z = proposal.draw(2**log2_points, seed)
    log_p = target.log_density(z)
    log_p = np.where(np.isfinite(log_p), log_p, -np.inf)
    raw = log_p - proposal.log_density(z)
    finite = np.where(np.isfinite(raw), raw, raw[np.isfinite(raw)].min() - 100.0)
    smoothed, khat = array_stats.psislw(-finite)  # it takes the log weights' negative
    log_evidence = float(np.logaddexp.reduce(raw) - np.log(len(raw)))
    return z, log_p, smoothed - np.logaddexp.reduce(smoothed), float(khat), log_evidence


def _start(target: _Target) -> np.ndarray:
    """The best point of a coarse grid around the scatter of the rates."""
    unit = target.priors.beta0.support is constraints.unit_interval
    x = np.array([-3.0, -1.0, 0.0, 1.0, 2.0]) if unit else np.linspace(-0.5, 1.1, 5)
    t = np.log(max(target.statistics.spread, 1e-3)) + np.linspace(-2.5, 0.5, 5)
    grid = np.stack(np.meshgrid(x, t, [-2.0, 0.0, 2.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.nanargmax(target.log_density(grid))]


def _along_the_ridge(target: _Target, mode: np.ndarray, scale: np.ndarray) -> _Mixture:
    """Components along r, each at the mode of (beta0, t) given its r, as far as there is mass."""
    spacing = float(np.clip(np.sqrt((scale @ scale.T)[2, 2]), 0.4, 1.0))
    centers, scales, log_mass = [], [], []

    def add(r: float, start: np.ndarray) -> np.ndarray:
        def given_r(xt: np.ndarray) -> np.ndarray:
            return target.log_density(np.column_stack([xt, np.full(len(xt), r)]))

        center, factor = laplace(given_r, start)
        full = np.zeros((3, 3))
        full[:2, :2], full[2, 2] = factor, spacing
        centers.append([*center, r])
        scales.append(1.2 * full)
        log_mass.append(float(given_r(center[None])[0]) + np.log(np.diag(factor)).sum())
        return center

    middle = add(mode[2], mode[:2])
    for direction in (-1.0, 1.0):
        start = middle
        for step in range(1, _RIDGE_STEPS + 1):
            start = add(mode[2] + direction * step * spacing, start)
            if log_mass[-1] < max(log_mass) - _RIDGE_DROP:
                break
    weights = np.exp(np.array(log_mass) - np.max(log_mass))
    weights = 0.9 * weights / weights.sum() + 0.1 / len(weights)
    return _Mixture(np.array(centers), np.array(scales), weights)


def _systematic(weights: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of n equally weighted draws, by systematic resampling."""
    points = (rng.random() + np.arange(n)) / n
    return np.searchsorted(np.cumsum(weights)[:-1] / weights.sum(), points)


def _parts(z: np.ndarray) -> list[np.ndarray]:
    return [z[i : i + _CHUNK] for i in range(0, len(z), _CHUNK)]


def _require_conjugate(priors: Priors) -> None:
    for name, allowed, what in (
        ("beta", lambda p: isinstance(p, dist.Normal), "a Normal distribution"),
        ("b", lambda p: isinstance(p, dist.Normal), "a Normal distribution"),
        ("beta0", lambda p: p.support in _LINES, "on (0, 1) or the real line"),
        ("delta_w", lambda p: p.support is constraints.positive, "on (0, inf)"),
        ("delta_v", lambda p: p.support is constraints.positive, "on (0, inf)"),
    ):
        prior = getattr(priors, name)
        if not allowed(prior):
            raise TrustboError(
                f'sampler "exact" needs the prior of {name} to be {what}; got {prior!r}. Use '
                'sampler="nuts", which takes any.'
            )


_LINES = (constraints.unit_interval, constraints.real)
