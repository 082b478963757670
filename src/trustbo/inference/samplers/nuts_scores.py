"""NUTS on the scores of hyperparameters, all else integrated out by the evidence.

The unknowns are those of the exact sampler (`posterior.Shared`), some 8 for places and robots, and
near normal once the ridge of the noises is straightened. The mean and the covariance of the exact
sampler's points, which it weighs in a second, are start and metric, so that warm-up learns a step
size alone. Weights and effects are drawn given
theta by the evidence itself.
"""

from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, random
from numpyro.infer.hmc import HMCState
from numpyro.infer.util import ParamInfo

from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.evidence.gaussian_jax import GaussianJax, Sums
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.importance import Points, weighted_points
from trustbo.inference.samplers.nuts import Chain, kernel, run_chains, step_on
from trustbo.inference.samplers.posterior import Posterior, Shared
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


class Core(NamedTuple):
    """Beta0 and the noises of the first three scores, see `scores.beta0_and_noises`."""

    beta0: Table
    log_noises: tuple[Table, Table]

    @classmethod
    def of(cls, priors: Priors) -> "Core":
        """Tables of priors."""

        def log_noise(prior) -> Table:
            return Table.of(lambda x: np.log(scores.noise(prior, np.exp(x))), *_SIZES)

        beta0 = Table.of(partial(scores.quantile, priors.beta0), -_FARTHEST, _FARTHEST)
        return cls(beta0, (log_noise(priors.delta_w), log_noise(priors.delta_v)))

    def at(self, z: Array) -> Array:
        """Parameters beta0, delta_w and delta_v (3,) of scores (score,)."""
        noises = []
        for table, side in zip(self.log_noises, (1.0, -1.0), strict=True):
            angle = 0.5 * np.pi * jax.scipy.special.ndtr(side * z[2])
            noises.append(jnp.exp(table(z[1] + jnp.log(jnp.sin(angle)))))
        return jnp.stack([self.beta0(z[0]), *noises])


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

        return cls(Table.of(log_size, -_FARTHEST, _FARTHEST))

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


class _Data(NamedTuple):
    """Arguments of the compiled programs."""

    sums: Sums
    core: Core
    ridge: Ridge


class ScoresInJax:
    """Log posterior density of scores in JAX, equal to `Posterior.log_density`."""

    def __init__(self, coordinates: Shared, evidence: GaussianJax, data: _Data) -> None:
        """Take the scores and the evidence."""
        self.scores, self.evidence, self.data = coordinates, evidence, data

    def theta(self, z: Array) -> dict[str, Array]:
        """Hyperparameters, each (1,), of scores (score,)."""
        return self.scores.with_core(self.data.core.at(z)[None], z[None])

    def log_density(self, z: Array) -> Array:
        """Log density of scores (score,), -inf where there is none."""
        value = self.evidence.log_density(self.theta(z), self.data.sums)
        value += scores.log_prior(z[None])[0]  # pyright: ignore
        return jnp.where(jnp.isnan(value), -jnp.inf, value)

    def potential(self, site: dict[str, Array]) -> Array:
        """See `nuts.Density`."""
        return -self.log_density(self.data.ridge.to_scores(site["theta"]))


def in_jax(posterior: Posterior, center: np.ndarray) -> ScoresInJax:
    """The density of a posterior of shared scores and Gaussian rates, in JAX.

    Args:
        posterior: The posterior.
        center: Scores (score,) that the `Ridge` goes through.
    """
    coordinates, evidence = cast(Shared, posterior.scores), cast(Gaussian, posterior.evidence)
    priors = coordinates.priors
    data = _Data(Sums.of(evidence), Core.of(priors), Ridge.of(priors, center))
    return ScoresInJax(coordinates, GaussianJax(evidence), data)


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
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Scores (chain, draw, score) and statistics, each (chain, draw); see `nuts.run_nuts`."""
    with one_blas_thread():
        points, fitted = weighted_points(posterior, seed, None, watch)
    with own_settings(), one_blas_thread(), watch.running(settings) as seen:
        density = in_jax(posterior, fitted.center)
        around = _Around.of(posterior, density.data.ridge, points)
        chain = Chain(jnp.asarray(around.center), jnp.asarray(around.scale))
        length_free = settings._replace(draws=0, n_chains=0)

        def of(data: _Data) -> ScoresInJax:
            return ScoresInJax(density.scores, density.evidence, data)

        @jax.jit
        def begin(chain: Chain, start: ParamInfo, key: Array) -> HMCState:
            return kernel(length_free, density, chain, start, key, adapt=False)[0]

        @jax.jit
        def advance(data: _Data, chain: Chain, state: HMCState, n: int):
            return step_on(length_free, of(data), chain, state, n, adapt=False)

        keys = random.split(random.key(seed), settings.n_chains)
        starts = [begin(chain, around.start([seed, i]), key) for i, key in enumerate(keys)]
        go_on = [partial(advance, density.data, chain)] * settings.n_chains
        x, stats = run_chains(settings, go_on, starts, seen)
    return around.scores(x["theta"]), stats
