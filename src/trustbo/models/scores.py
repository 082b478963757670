"""Normal scores of hyperparameters, which are the coordinates that the samplers use.

A score is standard normal a priori, except for pairs of standard deviations that add to the same
variance, such as the two noises. Their half-normal scores are (a, b) = size (sin(angle),
cos(angle)), and the coordinates are log size and a normal score of the angle. The data usually
determine the size well, but often not the angle. In these coordinates, a standard deviation that
may be 0 has a light tail, like the prior; its own score would have a long one.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution
from scipy import special, stats
from scipy.interpolate import CubicSpline

from trustbo.errors import TrustboError
from trustbo.models.backend import call, namespace, own_settings, special_functions

NOISES = "delta_w", "delta_v"
_LOG_ROOT_2PI = 0.5 * np.log(2.0 * np.pi)
_FARTHEST, _N_KNOTS = 9.0, 2001  # largest score and number of knots of quantiles in JAX


class Scores:
    """Conversion between scores (point, score) and hyperparameters with independent priors."""

    def __init__(
        self, priors: Mapping[str, Distribution], pairs: Sequence[tuple[str, str]] = ()
    ) -> None:
        """Set the priors; scores have the same order.

        Args:
            priors: Scalar or vector priors by name, which include the two noises.
            pairs: Names of pairs of standard deviations, besides the noises, that have a common
                size.
        """
        self.priors = dict(priors)
        self.pairs = (NOISES, *pairs)
        sizes = {name: int(np.prod(prior.batch_shape)) for name, prior in priors.items()}
        ends = np.cumsum([0, *sizes.values()])
        self.at = {n: slice(a, b) for n, a, b in zip(sizes, ends[:-1], ends[1:], strict=True)}
        self.n_scores = int(ends[-1])
        for name, prior in self.priors.items():
            quantile(prior, np.zeros(sizes[name]), name)  # raises if there are no quantiles

    @property
    def core(self) -> np.ndarray:
        """Indices of beta0, the noises and all log sizes, which the data determine best."""
        names = {"beta0", *NOISES, *(first for first, _ in self.pairs)}
        return self._indices([name for name in self.at if name in names])

    @property
    def noises(self) -> slice:
        """Slice of the scores that are the log sizes of the noises."""
        return self.at[NOISES[0]]

    @cached_property
    def sizes(self) -> np.ndarray:
        """Indices of the scores that are log sizes."""
        return self._indices([first for first, _ in self.pairs])

    def _indices(self, names: Sequence[str]) -> np.ndarray:
        """Return the indices of the scores of some hyperparameters."""
        return np.concatenate([np.arange(self.n_scores)[self.at[name]] for name in names])

    @cached_property
    def terms(self) -> np.ndarray:
        """Coefficients (power, interval, score) of splines through the quantiles of the priors."""
        knots = np.linspace(-_FARTHEST, _FARTHEST, _N_KNOTS)
        columns = []
        for name, prior in self.priors.items():
            n = self.at[name].stop - self.at[name].start
            at = np.broadcast_to(knots[:, None], (_N_KNOTS, n))
            columns.append(quantile(prior, at, name))
        return CubicSpline(knots, np.concatenate(columns, axis=1)).c

    def values(self, z: Any) -> dict[str, Any]:
        """Convert scores (point, score) to hyperparameters (point,) or (point, k) by name."""
        xp = namespace(z)
        half_normal = {}
        for first, second in self.pairs:
            size, angle = xp.exp(z[:, self.at[first]]), z[:, self.at[second]]
            for name, side in (first, 1.0), (second, -1.0):  # sines are accurate near 0
                share = 0.5 * np.pi * special_functions(z).ndtr(side * angle)
                half_normal[name] = size * xp.sin(share)

        others = None if xp is np else _interpolated(self.terms, z)
        found = {}
        for name, prior in self.priors.items():
            if name in half_normal:
                values = of_half_normal(prior, half_normal[name], name)
            elif others is None:
                values = quantile(prior, z[:, self.at[name]], name)
            else:
                values = others[:, self.at[name]]
            found[name] = values if prior.batch_shape else values[:, 0]
        return found

    def log_prior(self, z: Any) -> Any:
        """Compute the log prior density (point,) of scores (point, score)."""
        xp, size = namespace(z), z[:, self.sizes]
        n_others = z.shape[1] - size.shape[1]
        normal = -0.5 * ((z**2).sum(1) - (size**2).sum(1)) - n_others * _LOG_ROOT_2PI
        return normal + (2.0 * size - 0.5 * xp.exp(2.0 * size)).sum(1)

    def draw(
        self, n: int, rng: np.random.Generator, *, even: bool = False
    ) -> dict[str, np.ndarray]:
        """Draw hyperparameters from their priors, with shapes (draw,) or (draw, k).

        With `even`, the draws are evenly spaced quantiles of each prior in random order.
        """
        found = {}
        for name, prior in self.priors.items():
            score = rng.standard_normal((n, *prior.batch_shape))
            if even:
                spread = special.ndtri((np.arange(n) + 0.5) / n)
                score = spread[np.argsort(score, axis=0)]
            found[name] = quantile(prior, score, name)
        return found


def quantile(prior: Distribution, score: np.ndarray, name: str) -> np.ndarray:
    """Compute the quantile of a prior at probability Phi(score), accurate in both tails."""
    prior = _base(prior)
    if isinstance(prior, dist.Normal):
        return np.asarray(prior.loc) + np.asarray(prior.scale) * score
    if isinstance(prior, dist.LogNormal):
        return np.exp(np.asarray(prior.loc) + np.asarray(prior.scale) * score)
    if isinstance(prior, dist.Beta):
        a, b = np.asarray(prior.concentration1), np.asarray(prior.concentration0)
        low = special.betaincinv(a, b, special.ndtr(np.minimum(score, 0.0)))
        high = 1.0 - special.betaincinv(b, a, special.ndtr(-np.maximum(score, 0.0)))
        return np.where(score < 0.0, low, high)
    if isinstance(prior, dist.HalfNormal):
        low = special.erfinv(special.ndtr(np.minimum(score, 0.0)))
        high = special.erfcinv(special.ndtr(-np.maximum(score, 0.0)))
        return np.asarray(prior.scale) * np.sqrt(2.0) * np.where(score < 0.0, low, high)
    return _by_numpyro(prior, special.ndtr(score), name)


def _interpolated(terms: np.ndarray, score: jax.Array) -> jax.Array:
    """Interpolate quantiles in JAX, which lacks the quantiles of some distributions.

    Args:
        terms: Coefficients of cubic polynomials (power, interval, score); see `Scores.terms`.
        score: Scores (point, score).
    """
    step = 2.0 * _FARTHEST / (_N_KNOTS - 1)
    interval = jnp.clip(jnp.floor((score + _FARTHEST) / step), 0, _N_KNOTS - 2).astype(int)
    x = score + _FARTHEST - step * interval

    a, b, c, d = jnp.asarray(terms)[:, interval, np.arange(score.shape[1])]
    return ((a * x + b) * x + c) * x + d


def of_half_normal(prior: Distribution, score: Any, name: str) -> Any:
    """Compute the quantile of a prior at the probability P(|N(0, 1)| < score)."""
    prior = _base(prior)
    if isinstance(prior, dist.HalfNormal):
        return np.asarray(prior.scale) * score
    if namespace(score) is not np:
        return prior.icdf(jax.scipy.special.erf(score / np.sqrt(2.0)))
    return _by_numpyro(prior, special.erf(score / np.sqrt(2.0)), name)


def log_density(prior: Distribution, x: np.ndarray) -> np.ndarray:
    """Compute the log density of a prior, in closed form for common priors."""
    prior = _base(prior)
    if isinstance(prior, dist.HalfNormal):
        return stats.halfnorm.logpdf(x, scale=np.asarray(prior.scale))
    if isinstance(prior, dist.Beta):
        a, b = np.asarray(prior.concentration1), np.asarray(prior.concentration0)
        return stats.beta.logpdf(x, a, b)
    if isinstance(prior, dist.Normal):
        return stats.norm.logpdf(x, np.asarray(prior.loc), np.asarray(prior.scale))
    if isinstance(prior, dist.LogNormal):
        scale = np.exp(np.asarray(prior.loc))
        return stats.lognorm.logpdf(x, np.asarray(prior.scale), scale=scale)
    with own_settings():
        return np.asarray(call(prior, "log_prob", jnp.asarray(x)), dtype=float)


def _base(prior: Any) -> Any:
    """Return the distribution of one element of a vector of i.i.d. variables."""
    return prior.base_dist if isinstance(prior, dist.ExpandedDistribution) else prior


def _by_numpyro(prior: Distribution, p: np.ndarray, name: str) -> np.ndarray:
    """Compute quantiles with NumPyro; raises TrustboError if the prior on `name` has none."""
    try:
        with own_settings():
            share = jnp.asarray(np.clip(p, 1e-300, 1.0 - 1e-16))
            return np.asarray(call(prior, "icdf", share), dtype=float)
    except (NotImplementedError, ImportError):  # some quantiles need another package
        raise TrustboError(
            f"the prior on {name} must have quantiles (icdf), but {prior!r} has none. Give another "
            "prior, or sample model.program with a NumPyro kernel."
        ) from None
