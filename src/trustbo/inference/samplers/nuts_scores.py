"""NUTS on the scores of hyperparameters, all else integrated out by the evidence.

The unknowns are those of the exact sampler (`posterior.Scores`), some 8 for places and robots, and
near normal once the ridge of the noises is straightened. The mean and the covariance of the exact
sampler's points, which it weighs in a second, are start and metric, so that warm-up learns a step
size alone. Weights and effects are drawn given theta by the evidence itself.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple, Self, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpyro.infer.util import ParamInfo

from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.evidence.gaussian_jax import GaussianJax
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.importance import Points, weighted_points
from trustbo.inference.samplers.nuts import Chain, run_nuts
from trustbo.inference.samplers.posterior import Posterior
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.student import Student
from trustbo.inference.samplers.watching import SILENT, Watch
from trustbo.models.backend import namespace, own_settings
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import Table
from trustbo.parallel import one_blas_thread

_FARTHEST = 8.0  # score of beta0, or of the angle
_SIZES = -25.0, 3.4  # log sizes of noises
_RIDGE = 1e-6  # of covariances
_HALVINGS = 60  # of their range, to the last digit
_KNOTS = 401  # of the ridge, which may be a rough one
_POINTS = 32  # of a proposal for each score, enough for a mean and a covariance


class Tables(NamedTuple):
    """`scores.Quantiles` as tables, for JAX."""

    beta0: Table
    log_noises: tuple[Table, Table]
    log_tau: Table | None  # where robots have spreads

    @classmethod
    def of(cls, priors: Priors, *, by_robot: bool = False) -> Self:
        """Tables of priors."""

        def log_noise(prior) -> Table:
            return Table.of(lambda x: np.log(scores.noise(prior, np.exp(x))), *_SIZES)

        def at_scores(function: Callable[[np.ndarray], np.ndarray]) -> Table:
            return Table.of(function, -_FARTHEST, _FARTHEST)

        noises = log_noise(priors.delta_w), log_noise(priors.delta_v)
        tau = at_scores(lambda z: np.log(scores.quantile(priors.tau, z))) if by_robot else None
        return cls(at_scores(partial(scores.quantile, priors.beta0)), noises, tau)

    def core(self, z: Array) -> Array:
        """See `scores.beta0_and_noises`."""
        noises = []
        for table, side in zip(self.log_noises, (1.0, -1.0), strict=True):
            angle = 0.5 * np.pi * jax.scipy.special.ndtr(side * z[:, 2])
            noises.append(jnp.exp(table(z[:, 1] + jnp.log(jnp.sin(angle)))))
        return jnp.stack([self.beta0(z[:, 0]), *noises], axis=1)

    def tau(self, z: Array) -> Array:
        """See `scores.Quantiles.tau`."""
        return jnp.exp(cast(Table, self.log_tau)(z))


class Ridge(NamedTuple):
    """Coordinates in which the noises' total, which the rates determine, is one axis.

    Along the score of the noises' angle, the log size that keeps the total bends: the distance from
    it takes its place. The Jacobian is 1.
    """

    log_size: Table

    @classmethod
    def of(cls, priors: Priors, z: np.ndarray) -> "Ridge":
        """Ridge through scores (score,)."""

        def log_total(log_size: np.ndarray, angle: np.ndarray) -> np.ndarray:
            z = np.column_stack([np.zeros(len(angle)), log_size, angle])
            return np.log(np.hypot(*scores.beta0_and_noises(priors, z)[:, 1:].T))

        def log_size(angle: np.ndarray) -> np.ndarray:
            total = log_total(z[1:2], z[2:3])
            low, high = (np.full(len(angle), size) for size in _SIZES)
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                above = log_total(middle, angle) > total
                low, high = np.where(above, low, middle), np.where(above, middle, high)
            return low

        return cls(Table.of(log_size, -_FARTHEST, _FARTHEST, _KNOTS))

    def to_scores(self, x: Any) -> Any:
        """Scores (..., score) of coordinates, in NumPy or JAX."""
        return self._moved(x, 1.0)

    def of_scores(self, z: np.ndarray) -> np.ndarray:
        """Coordinates (..., score) of scores."""
        return self._moved(z, -1.0)

    def _moved(self, x: Any, sign: float) -> Any:
        xp: Any = namespace(x)
        size = x[..., 1:2] + sign * self.log_size(x[..., 2:3])
        return xp.concatenate([x[..., :1], size, x[..., 2:]], axis=-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScoresInJax:
    """Log posterior density of scores in JAX, equal to `Posterior.log_density`."""

    learns: ClassVar[bool] = False  # a metric: that of the points is better
    scores: Any  # `posterior.Scores` by `Tables`
    evidence: GaussianJax
    ridge: Ridge

    @classmethod
    def of(cls, posterior: Posterior, center: np.ndarray) -> Self:
        """The density of a posterior under `evidence.gaussian`, its `Ridge` through a point."""
        coordinates: Any = copy.copy(posterior.scores)
        priors = coordinates.quantiles.priors
        coordinates.quantiles = Tables.of(priors, by_robot=coordinates.pools)
        evidence = GaussianJax.of(cast(Gaussian, posterior.evidence))
        return cls(coordinates, evidence, Ridge.of(priors, center))

    def log_density(self, z: Array) -> Array:
        """Log density of scores (score,), -inf where there is none."""
        value = self.evidence.log_density(self.scores.theta(z[None]))
        value += self.scores.log_prior(z[None])[0]
        return jnp.where(jnp.isnan(value), -jnp.inf, value)

    def potential(self, site: dict[str, Array]) -> Array:
        """See `nuts.Density`."""
        return -self.log_density(self.ridge.to_scores(site["theta"]))


class _Around(NamedTuple):
    """Log posterior density in coordinates of mean 0 and covariance 1, about."""

    posterior: Posterior
    ridge: Ridge
    center: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, posterior: Posterior, ridge: Ridge, points: Points) -> "_Around":
        """Take the moments of weighted points."""
        fitted = Student.of(ridge.of_scores(points.z), points.log_w, _RIDGE)
        return cls(posterior, ridge, fitted.center, fitted.scale)

    def scores(self, x: np.ndarray) -> np.ndarray:
        """Scores (..., score) of coordinates."""
        return self.ridge.to_scores(self.center + x @ self.scale.T)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density of coordinates (point, axis)."""
        return self.posterior.log_density(self.scores(x))

    def start(self, seed: list[int], h: float = 1e-5) -> ParamInfo:
        """Start of a chain, overdispersed (1.5 sd) so that R-hat means something.

        Its slope is by differences: to compile the gradient a second time would take seconds.
        """
        x = 1.5 * np.random.default_rng(seed).standard_normal(len(self.center))
        steps = h * np.concatenate([np.eye(len(x)), -np.eye(len(x)), np.zeros((1, len(x)))])
        potential = -self.log_density(x + steps)
        plus, minus = potential[:-1].reshape(2, -1)
        slope = {"theta": jnp.asarray((plus - minus) / (2.0 * h))}
        return ParamInfo({"theta": jnp.asarray(x)}, jnp.asarray(potential[-1]), slope)


def run_nuts_of_scores(
    settings: NutsSettings, seed: int, posterior: Posterior, watch: Watch = SILENT
) -> tuple[np.ndarray, dict[str, np.ndarray], Points]:
    """Scores (chain, draw, score), statistics, each (chain, draw), and the points before these."""
    enough = 1 << (_POINTS * posterior.n_scores).bit_length()
    posterior.n_pilot = min(posterior.n_pilot, enough)
    posterior.n_final = min(posterior.n_final, enough)
    with one_blas_thread():
        points, fitted = weighted_points(posterior, seed, None, watch)
    with own_settings(), one_blas_thread():
        density = ScoresInJax.of(posterior, fitted.center)
        around = _Around.of(posterior, density.ridge, points)
        chain = Chain(jnp.asarray(around.center), jnp.asarray(around.scale))
        starts = [around.start([seed, i]) for i in range(settings.n_chains)]
        x, stats = run_nuts(settings, seed, density, chain, starts, watch)
    return around.scores(x["theta"]), stats, points
