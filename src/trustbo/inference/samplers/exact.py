"""Near-independent draws from the pooled model's posterior, without Markov chains.

Method: collapsed importance sampling. Latent trust and the linear coefficients c = (beta, b)
integrate out in closed form (`gram`: generalised least squares under normal priors), which leaves
the density of z = (beta0 on the real line, t, r), t = log hypot(delta_w, s), r = log(delta_w / s),
in three dimensions; s^2 = delta_v^2 - floor^2, so that the floor of delta_v is no boundary.

1. Newton's searches from the local maxima of a grid find the modes (`laplace`).
2. Some 1000 weighted points around them give the means and covariances of a mixture of heavy-tailed
   densities, one for each mode; the posterior is skewed, and its curvature at a mode alone makes a
   far worse proposal (`proposal`).
3. 4096 scrambled Sobol points of the proposal get Pareto-smoothed importance weights (Vehtari,
   Simpson, Gelman, Yao and Gabry 2024). Where k-hat shows them uneven, a mixture fitted to the
   weighted points takes the proposal's place, up to four times (adaptive importance sampling).
4. Systematic resampling makes the points equally weighted; c is drawn from its normal conditional.

State: weighted points with the conditional moments of c at each. Invariant: for any proposal,
weights are target over proposal density, so averages converge to the posterior's; k-hat measures
how fast. The only errors are the number of points and the smoothing of the largest weights. Above
`MAX_KHAT` the caller falls back on NUTS. Derivation: docs/derivations/exact-sampler.md.
"""

from typing import NamedTuple

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import constraints
from scipy import special
from scipy.ndimage import maximum_filter

from trustbo.errors import TrustboError
from trustbo.inference.evidence.gram import SufficientStatistics
from trustbo.inference.samplers.convergence import GOOD_KHAT
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.proposal import Mixture
from trustbo.inference.samplers.weights import smoothed_weights, systematic
from trustbo.models.floored import Floored
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import log_prob, number, of_coefficients
from trustbo.parallel import one_blas_thread

_LOG2_POINTS, _LOG2_AROUND = 12, 10
_FEW = 50  # points
_N_STARTS, _SAME_MODE, _LEAST_LOG_MASS = 6, 0.5, 12.0  # sd of the fit at a mode, and nats
_MAX_ROUNDS, _N_AROUND, _KEPT = 4, 32, 0.15  # of adapting; local components, share of the others
_CHUNK = 1024  # parameter values evaluated at once: bounds the memory of long missions


class ExactDraws(NamedTuple):
    """Equally weighted draws and their importance-sampling diagnostics."""

    params: dict[str, np.ndarray]  # (draw, ...)
    log_weight: np.ndarray  # (draw,), of the point each draw was resampled from, normalised
    lp: np.ndarray  # (draw,), log posterior density of (beta0, t, r), coefficients integrated out
    khat: float
    kish: float
    """Effective number of points, (sum w)^2 / sum w^2."""
    log_evidence: float


class _Target(NamedTuple):
    """The collapsed posterior of z = (beta0 on the real line, t, r)."""

    statistics: SufficientStatistics
    priors: Priors
    mean: np.ndarray  # (coefficient,), prior of (beta, b)
    precision: np.ndarray  # (coefficient,)
    floor: float  # of delta_v

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Unnormalised log posterior density of z (point, 3), shape (point,)."""
        return self.evaluate(z)[0]

    def evaluate(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log density at each z; there the mean of (beta, b) and its precision's Cholesky factor.

        The last two are laid out for `small_cholesky`, the point last.
        """
        parts = [z[i : i + _CHUNK] for i in range(0, len(z), _CHUNK)]
        # Far out the noises underflow: such a point has no density, and is no reason to warn.
        with np.errstate(all="ignore"):
            done = [self._evaluate(part) for part in parts]
        log_density, mean, factor = (
            np.concatenate(pieces, axis=-1) for pieces in zip(*done, strict=True)
        )
        return np.where(np.isfinite(log_density), log_density, -np.inf), mean, factor

    def _evaluate(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        beta0, delta_w, delta_v, log_jacobian = self.constrain(z)
        theta = np.stack([beta0, delta_w**2, delta_v**2], axis=1)
        quadratic = self.statistics.evaluate(theta, self.priors.x0_sd)
        # Of the coefficients, or of those of stationary trust, which are 1 / (1 - beta0) as large.
        rest = (1.0 - beta0)[:, None] if self.priors.stationary else np.ones((len(z), 1))
        mean, precision = self.mean * rest, self.precision / rest**2
        diagonal = precision[:, :, None] * np.eye(len(self.mean))
        factor = small_cholesky((quadratic.P + diagonal).transpose(1, 2, 0))
        half = forward(factor, (quadratic.h + precision * mean).T)
        misfit = quadratic.alpha + (precision * mean**2).sum(1) - (half**2).sum(0)
        log_det = 2.0 * np.log(np.einsum("ccn->cn", factor)).sum(0)
        log_likelihood = -0.5 * (
            misfit
            + quadratic.log_det
            + self.statistics.n_measured * np.log(2.0 * np.pi)
            + log_det
            - np.log(precision).sum(1)
        )
        log_prior = (
            log_prob(self.priors.beta0, beta0)
            + log_prob(self.priors.delta_w, delta_w)
            + log_prob(self.priors.delta_v, delta_v)
        )
        return log_likelihood + log_jacobian + log_prior, backward(factor, half), factor

    def constrain(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Parameters beta0, delta_w, delta_v of z, and the log Jacobian of the map."""
        x, t, r = z.T
        log_w = t - 0.5 * np.logaddexp(0.0, -2.0 * r)
        log_s = t - 0.5 * np.logaddexp(0.0, 2.0 * r)
        delta_v = np.hypot(self.floor, np.exp(log_s))
        # Of exp and hypot; (t, r) -> (log_w, log_s) has Jacobian 1.
        log_jacobian = log_w + 2.0 * log_s - np.log(delta_v)
        if self.priors.beta0.support is constraints.unit_interval:
            log_jacobian = log_jacobian - np.logaddexp(0.0, x) - np.logaddexp(0.0, -x)
            x = special.expit(x)
        return x, np.exp(log_w), delta_v, log_jacobian


class _Weighted(NamedTuple):
    """Weighted points."""

    z: np.ndarray  # (point, 3)
    log_p: np.ndarray  # (point,)
    log_w: np.ndarray  # (point,), smoothed and normalised
    mean: np.ndarray  # (coefficient, point), of (beta, b)
    factor: np.ndarray  # (coefficient, coefficient, point), Cholesky's, of their precision
    khat: float
    log_evidence: float


def sample_exact(
    statistics: SufficientStatistics, priors: Priors, n_draws: int, seed: int
) -> ExactDraws:
    """Draw from the posterior of robots that share their parameters.

    Args:
        statistics: Statistics of all missions.
        priors: Priors, normal for beta and b, on (0, 1) or the real line for beta0, on (0, inf)
            for the noises.
        n_draws: Number of equally weighted draws.
        seed: Seed; the same seed gives the same draws.

    Raises:
        TrustboError: A prior is of another kind; NUTS takes any.
    """
    if reason := why_not_conjugate(priors):
        raise TrustboError(f'sampler "exact": {reason}. Use sampler="nuts", which takes any.')
    # Matrices are small: a second BLAS thread costs more than it brings.
    with one_blas_thread():
        target = _target(statistics, priors)
        first = _matched(target, _modes(target), seed)
        points = last = _weigh(target, first, seed)
        for k in range(_MAX_ROUNDS):
            if points.khat < GOOD_KHAT:
                break
            last = _weigh(target, _adapted(last, first, seed + k), seed)
            points = min(points, last, key=lambda candidate: candidate.khat)
    rng = np.random.default_rng(seed)
    weights = np.exp(points.log_w)
    chosen = rng.permutation(systematic(weights, n_draws, rng))
    beta0, delta_w, delta_v, _ = target.constrain(points.z[chosen])
    mean, factor = points.mean[:, chosen], points.factor[..., chosen]
    coefficients = mean + backward(factor, rng.standard_normal(mean.shape))
    params = {
        "beta0": beta0,
        "beta": coefficients[:-1].T,
        "b": coefficients[-1],
        "delta_w": delta_w,
        "delta_v": delta_v,
    }
    kish = float(1.0 / (weights**2).sum())
    log_w, log_p = points.log_w[chosen], points.log_p[chosen]
    return ExactDraws(params, log_w, log_p, points.khat, kish, points.log_evidence)


def _target(statistics: SufficientStatistics, priors: Priors) -> _Target:
    mean, precision = of_coefficients(priors.beta, priors.b, statistics.n_features)
    floor = number(priors.delta_v, "low") if isinstance(priors.delta_v, Floored) else 0.0
    return _Target(statistics, priors, mean, precision, floor)


def _modes(target: _Target) -> Mixture:
    """Gaussian fits at the distinct modes, each with its share of the mass."""
    z, value, scale = laplace(target.log_density, _starts(target))
    log_mass = value + np.log(np.einsum("sii->si", scale)).sum(1)
    kept: list[int] = []
    for i in np.argsort(-value, kind="stable"):
        apart = [np.linalg.solve(scale[j], z[i] - z[j]) for j in kept]
        if log_mass[i] > log_mass.max() - _LEAST_LOG_MASS and all(
            np.abs(gap).max() > _SAME_MODE for gap in apart
        ):
            kept.append(i)
    shares = np.exp(log_mass[kept] - log_mass[kept].max())
    return Mixture(z[kept], scale[kept], shares / shares.sum())


def _matched(target: _Target, modes: Mixture, seed: int) -> Mixture:
    """Proposal with the mean and covariance of weighted points around each mode."""
    n = len(modes.weights)
    around = Mixture(modes.centers, 1.3 * modes.scales, 0.5 * modes.weights + 0.5 / n)
    z, _, log_w, *_ = _weigh(target, around, seed, _LOG2_AROUND)
    centers, scales, shares = [], [], []
    for scale, near in zip(modes.scales, around.responsibilities(z), strict=True):
        weights = np.exp(log_w) * near
        shares.append(weights.sum())
        weights /= max(shares[-1], 1e-300)
        mean = weights @ z
        covariance = ((z - mean) * weights[:, None]).T @ (z - mean)
        if not (kish := 1.0 / (weights**2).sum()) > _FEW:  # fewer points than a covariance needs
            covariance += scale @ scale.T / kish
        centers.append(mean)
        scales.append(np.linalg.cholesky(covariance))
    shares = 0.9 * np.array(shares) / sum(shares) + 0.1 / n
    return Mixture(np.array(centers), np.array(scales), shares)


def _weigh(
    target: _Target, proposal: Mixture, seed: int, log2_points: int = _LOG2_POINTS
) -> _Weighted:
    """Points of the proposal with Pareto-smoothed importance weights."""
    z = proposal.draw(2**log2_points, seed)
    log_p, mean, factor = target.evaluate(z)
    raw = log_p - proposal.log_density(z)
    finite = np.isfinite(raw)
    if finite.sum() < _FEW:  # the proposal missed: equal weights, and an infinite k-hat
        nothing = np.full(len(z), -np.log(len(z)))
        return _Weighted(z, log_p, nothing, mean, factor, np.inf, -np.inf)
    log_w, khat, log_evidence = smoothed_weights(raw)
    return _Weighted(z, log_p, log_w, mean, factor, khat, log_evidence)


def _starts(target: _Target) -> np.ndarray:
    """Points to search a mode from: the local maxima of a grid around the scatter of the rates.

    The first is the best point of a coarse grid.
    """
    unit = target.priors.beta0.support is constraints.unit_interval
    scatter = np.log(max(target.statistics.spread, target.floor, 1e-3))

    def grid(x: np.ndarray, t: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axes = np.stack(np.meshgrid(x, scatter + t, r, indexing="ij"), axis=-1)
        return axes, target.log_density(axes.reshape(-1, 3)).reshape(axes.shape[:3])

    x = np.array([-3.0, -1.0, 0.0, 1.0, 2.0]) if unit else np.linspace(-0.5, 1.1, 5)
    coarse, value = grid(x, np.linspace(-2.5, 0.5, 5), np.array([-2.0, 0.0, 2.0]))
    first = coarse[np.unravel_index(value.argmax(), value.shape)]
    x = np.linspace(-6.0, 4.0, 9) if unit else np.r_[-1.5, -1.0, np.linspace(-0.6, 1.2, 19), 1.5]
    fine, value = grid(x, np.linspace(-3.5, 1.0, 6), np.linspace(-4.0, 4.0, 5))
    peak = (value == maximum_filter(value, 3, mode="nearest")) & np.isfinite(value)
    best = np.argsort(-value[peak])[:_N_STARTS]
    return np.vstack([first, fine[peak][best]])


def _adapted(points: _Weighted, first: Mixture, seed: int) -> Mixture:
    """Mixture around resampled points, each component as wide as the mass nearby.

    It follows any shape of the posterior. A component over all points, for tails, and the first
    proposal keep fixed shares: no mode is lost, and no weight exceeds its first value divided by
    that share.
    """
    z, weights = points.z, np.exp(points.log_w)
    mean = weights @ z
    off = z - mean
    covariance = (off * weights[:, None]).T @ off
    covariance += 1e-6 * np.trace(covariance) * np.eye(3)  # in case one point has all the weight
    whole = np.linalg.cholesky(covariance)
    white = np.linalg.solve(whole, z.T).T
    order = np.argsort(z[:, 2])
    drawn = order[systematic(weights[order], _N_AROUND, np.random.default_rng(seed))]
    scales = []
    for center in white[drawn]:
        near = weights * np.exp(-0.5 * ((white - center) ** 2).sum(1))
        near /= near.sum()
        off = z - near @ z
        scales.append(np.linalg.cholesky((off * near[:, None]).T @ off + 0.02 * covariance))
    shares = np.append(np.full(_N_AROUND, (1.0 - 2.0 * _KEPT) / _N_AROUND), _KEPT)
    local = Mixture(np.vstack([z[drawn], mean]), np.array([*scales, 1.5 * whole]), shares)
    kept = first._replace(weights=_KEPT * first.weights)
    return Mixture(*(np.concatenate(both) for both in zip(local, kept, strict=True)))


def why_not_conjugate(priors: Priors, *, coupled: bool = False) -> str | None:
    """Reason why the sampler cannot treat these priors; None if it can."""
    for name, allowed, kind in (
        ("coupling", lambda p: not coupled or isinstance(p, dist.Normal), "a Normal distribution"),
        ("beta", lambda p: isinstance(p, dist.Normal), "a Normal distribution"),
        ("b", lambda p: isinstance(p, dist.Normal), "a Normal distribution"),
        ("beta0", lambda p: p.support in _LINES, "on (0, 1) or the real line"),
        ("delta_w", lambda p: p.support is constraints.positive, "on (0, inf)"),
        ("delta_v", lambda p: p.support is constraints.positive, "on (0, inf)"),
    ):
        prior = getattr(priors, name)
        prior = prior.base if isinstance(prior, Floored) else prior
        if not allowed(prior):
            return f"it needs the prior of {name} to be {kind}; got {prior!r}"
    return None


_LINES = (constraints.unit_interval, constraints.real)


def small_cholesky(A: np.ndarray) -> np.ndarray:
    """Lower factors of many small matrices, (row, column, point); NaN where one is not positive.

    NumPy's takes the point first, one matrix at a time, and raises for all if one is not positive.
    """
    L = np.zeros_like(A)
    for j in range(len(A)):
        L[j, j] = np.sqrt(A[j, j] - (L[j, :j] ** 2).sum(0))
        for i in range(j + 1, len(A)):
            L[i, j] = (A[i, j] - (L[i, :j] * L[j, :j]).sum(0)) / L[j, j]
    return L


def forward(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """L^-1 b for factors (row, column, point) and vectors (row, point)."""
    x = np.empty_like(b)
    for i in range(len(b)):
        x[i] = (b[i] - (L[i, :i] * x[:i]).sum(0)) / L[i, i]
    return x


def backward(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """L'^-1 b for factors (row, column, point) and vectors (row, point)."""
    x = np.empty_like(b)
    for i in reversed(range(len(b))):
        x[i] = (b[i] - (L[i + 1 :, i] * x[i + 1 :]).sum(0)) / L[i, i]
    return x
