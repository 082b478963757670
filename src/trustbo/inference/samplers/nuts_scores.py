"""NUTS on the scores of hyperparameters, all else integrated out by the evidence.

The unknowns are those of the exact sampler (`posterior.Shared`), some 8 for places and robots, and
near normal. The chains start around the mode of the exact sampler's search, with its covariance as
metric, so that warm-up learns little more than a step size. Weights and effects are drawn given
theta by the evidence itself.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, random
from numpyro.infer.hmc import HMCState
from numpyro.infer.util import ParamInfo
from scipy.interpolate import CubicSpline

from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.evidence.gaussian_jax import GaussianJax, Sums
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.nuts import Chain, kernel, run_chain, step_on
from trustbo.inference.samplers.posterior import Posterior, Shared
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.student import Student
from trustbo.inference.samplers.watching import SILENT, Watch
from trustbo.models.backend import own_settings
from trustbo.models.priors import Priors
from trustbo.parallel import one_blas_thread

_KNOTS = 4001
_FARTHEST = 8.0  # score of beta0
_SIZES = -25.0, 3.4  # log sizes of noises


class Table(NamedTuple):
    """A function of a number by its cubic spline, for JAX, which lacks quantiles of most priors."""

    knots: np.ndarray  # (knot,), evenly spaced
    coefficients: np.ndarray  # (4, interval)

    @classmethod
    def of(cls, function: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> "Table":
        """Table of a function, where it is finite."""
        x = np.linspace(low, high, _KNOTS)
        with np.errstate(all="ignore"):
            y = function(x)
        some = np.isfinite(y)
        return cls(x[some], CubicSpline(x[some], y[some]).c)

    def __call__(self, x: Array) -> Array:
        """Value at x, constant beyond the knots; the error is about 1e-12."""
        knots, c = jnp.asarray(self.knots), jnp.asarray(self.coefficients)
        x = jnp.clip(x, knots[0], knots[-1])
        i = jnp.floor((x - knots[0]) / (knots[1] - knots[0])).astype(int)
        i = jnp.clip(i, 0, c.shape[1] - 1)
        d = x - knots[i]
        return ((c[0, i] * d + c[1, i]) * d + c[2, i]) * d + c[3, i]


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


class _Data(NamedTuple):
    """Arguments of the compiled programs."""

    sums: Sums
    core: Core


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
        return -self.log_density(site["theta"])


def in_jax(posterior: Posterior) -> ScoresInJax:
    """The density of a posterior of shared scores and Gaussian rates, in JAX."""
    coordinates, evidence = cast(Shared, posterior.scores), cast(Gaussian, posterior.evidence)
    data = _Data(Sums.of(evidence), Core.of(coordinates.priors))
    return ScoresInJax(coordinates, GaussianJax(evidence), data)


def _start(posterior: Posterior, fitted: Student, seed: list[int], h: float = 1e-5) -> ParamInfo:
    """Start of a chain, overdispersed (1.5 Laplace sd) so that R-hat means something.

    Its slope is by differences: to compile the gradient a second time would take seconds.
    """
    x = 1.5 * np.random.default_rng(seed).standard_normal(posterior.n_scores)
    steps = h * np.concatenate([np.eye(len(x)), -np.eye(len(x)), np.zeros((1, len(x)))])
    potential = -posterior.log_density(fitted.center + (x + steps) @ fitted.scale.T)
    plus, minus = potential[:-1].reshape(2, -1)
    slope = {"theta": jnp.asarray((plus - minus) / (2.0 * h))}
    return ParamInfo({"theta": jnp.asarray(x)}, jnp.asarray(potential[-1]), slope)


def run_nuts_of_scores(
    settings: NutsSettings, seed: int, posterior: Posterior, watch: Watch = SILENT
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Scores (chain, draw, score) and statistics, each (chain, draw); see `nuts.run_nuts`."""
    fitted = posterior.first()
    with own_settings(), one_blas_thread(), watch.running(settings) as seen:
        density = in_jax(posterior)
        chain = Chain(jnp.asarray(fitted.center), jnp.asarray(fitted.scale))
        length_free = settings._replace(draws=0, n_chains=0)

        def of(data: _Data) -> ScoresInJax:
            return ScoresInJax(density.scores, density.evidence, data)

        @jax.jit
        def begin(chain: Chain, start: ParamInfo, key: Array) -> HMCState:
            return kernel(length_free, density, chain, start, key)[0]

        @jax.jit
        def advance(data: _Data, chain: Chain, state: HMCState, n: int):
            return step_on(length_free, of(data), chain, state, n)

        runs = []
        for i, key in enumerate(random.split(random.key(seed), settings.n_chains)):
            state = begin(chain, _start(posterior, fitted, [seed, i]), key)
            runs.append(run_chain(settings, partial(advance, density.data, chain), state, seen))
        x, stats = jax.tree.map(lambda *a: np.stack(a), *runs)
    return fitted.center + x["theta"] @ fitted.scale.T, stats
