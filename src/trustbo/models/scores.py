"""Normal scores of hyperparameters, which are the coordinates that the samplers use.

A score is standard normal a priori, except for pairs of standard deviations that add to the same
variance, such as the two noises. Their half-normal scores are (a, b) = size (sin(angle),
cos(angle)), and the coordinates are log size and a normal score of the angle. The data usually
determine the size well, but often not the angle. In these coordinates, a standard deviation that
may be 0 has a light tail, like the prior; its own score would have a long tail.

If the data determine only the product of a and a factor that depends on other hyperparameters, this
product replaces a. For example, a Gaussian process with a long length scale differs little between
neighbours, even if its standard deviation is large.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution
from scipy import special, stats

from trustbo.errors import TrustboError
from trustbo.models.backend import call, own_settings

NOISES = "delta_w", "delta_v"
_LOG_ROOT_2PI = 0.5 * np.log(2.0 * np.pi)
_SMALLEST_P = 1e-300  # probabilities at which NumPyro computes quantiles are in this range
_LARGEST_P = 1.0 - 1e-16


class Pair(NamedTuple):
    """Pair of standard deviations whose common size is a coordinate."""

    first: str
    second: str
    given: str = ""
    """Hyperparameter on which the factor of the first standard deviation depends; empty without
    one."""
    factor: Callable[[Any], Any] = np.ones_like
    """Function of `given` (point, 1) that multiplies the first standard deviation."""


class NormalScores:
    """Conversion between scores (point, score) and hyperparameters with independent priors."""

    def __init__(self, priors: Mapping[str, Distribution], pairs: Sequence[Pair] = ()) -> None:
        """Set the priors; the scores have the same order.

        Args:
            priors: Scalar or vector priors by name, which include the two noises.
            pairs: Pairs of standard deviations that have a common size, in addition to the noises.
        """
        self.priors = dict(priors)
        self.pairs = (Pair(*NOISES), *pairs)

        sizes = {name: int(np.prod(prior.batch_shape)) for name, prior in priors.items()}
        ends = np.cumsum([0, *sizes.values()])
        self.at = {n: slice(a, b) for n, a, b in zip(sizes, ends[:-1], ends[1:], strict=True)}
        self.n_scores = int(ends[-1])

        for name, prior in self.priors.items():
            quantile(prior, np.zeros(sizes[name]), name)  # raises if there are no quantiles

    @property
    def core(self) -> np.ndarray:
        """Indices of beta0, the noises and all log sizes, which the data determine best."""
        names = {"beta0", *NOISES, *(pair.first for pair in self.pairs)}
        return self._indices([name for name in self.at if name in names])

    @property
    def noises(self) -> slice:
        """Slice of the scores that are the log sizes of the noises."""
        return self.at[NOISES[0]]

    @cached_property
    def sizes(self) -> np.ndarray:
        """Indices of the scores that are log sizes."""
        return self._indices([pair.first for pair in self.pairs])

    def _indices(self, names: Sequence[str]) -> np.ndarray:
        """Return the indices of the scores of some hyperparameters."""
        return np.concatenate([np.arange(self.n_scores)[self.at[name]] for name in names])

    def values(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Convert scores (point, score) to hyperparameters (point,) or (point, k) by name."""
        half_normal = {}
        for pair in self.pairs:
            half_normal |= self._half_normal(pair, z)

        found = {}
        for name, prior in self.priors.items():
            if name in half_normal:
                values = of_half_normal(prior, half_normal[name], name)
            else:
                values = self._value(name, z)
            found[name] = values if prior.batch_shape else values[:, 0]

        return found

    def _value(self, name: str, z: np.ndarray) -> np.ndarray:
        """Return values (point, k) of a hyperparameter that is in no pair."""
        return quantile(self.priors[name], z[:, self.at[name]], name)

    def _factor(self, pair: Pair, z: np.ndarray) -> np.ndarray | float:
        """Return the factor (point, 1) of the first standard deviation of a pair."""
        return pair.factor(self._value(pair.given, z)) if pair.given else 1.0

    def _half_normal(self, pair: Pair, z: np.ndarray) -> dict[str, np.ndarray]:
        """Return the half-normal scores (point, k) of a pair by name."""
        size = np.exp(z[:, self.at[pair.first]])
        angle = z[:, self.at[pair.second]]

        # The cosine of an angle is the sine of its complement, which is accurate near 0.
        first = size * np.sin(0.5 * np.pi * special.ndtr(angle))
        second = size * np.sin(0.5 * np.pi * special.ndtr(-angle))
        return {pair.first: first / self._factor(pair, z), pair.second: second}

    def log_prior(self, z: np.ndarray) -> np.ndarray:
        """Compute the log prior density (point,) of scores (point, score)."""
        log_size = z[:, self.sizes]

        # Scores other than log sizes are standard normal.
        n_others = z.shape[1] - log_size.shape[1]
        total = -0.5 * ((z**2).sum(1) - (log_size**2).sum(1)) - n_others * _LOG_ROOT_2PI

        # In polar coordinates, the density of half-normal scores (a, b) contains the size as a
        # factor. The Jacobian of the log size is the size once more.
        total = total + 2.0 * log_size.sum(1)
        for pair in self.pairs:
            squares = sum((a**2).sum(1) for a in self._half_normal(pair, z).values())
            total = total - 0.5 * squares
            if pair.given:
                total = total - np.log(self._factor(pair, z))[:, 0]

        return total

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
                evenly_spaced = special.ndtri((np.arange(n) + 0.5) / n)
                score = evenly_spaced[np.argsort(score, axis=0)]
            found[name] = quantile(prior, score, name)

        return found


def quantile(prior: Distribution, score: np.ndarray, name: str) -> np.ndarray:
    """Compute the quantile of a prior at probability Phi(score), accurate in both tails."""
    prior = _base(prior)

    if isinstance(prior, dist.Normal):
        return np.asarray(prior.loc) + np.asarray(prior.scale) * score
    if isinstance(prior, dist.LogNormal):
        return np.exp(np.asarray(prior.loc) + np.asarray(prior.scale) * score)

    # Each half uses its own tail probability, because 1 - Phi(score) rounds to 0 in the upper tail.
    if isinstance(prior, dist.Beta):
        a = np.asarray(prior.concentration1)
        b = np.asarray(prior.concentration0)
        low = special.betaincinv(a, b, special.ndtr(np.minimum(score, 0.0)))
        high = 1.0 - special.betaincinv(b, a, special.ndtr(-np.maximum(score, 0.0)))
        return np.where(score < 0.0, low, high)
    if isinstance(prior, dist.HalfNormal):
        low = special.erfinv(special.ndtr(np.minimum(score, 0.0)))
        high = special.erfcinv(special.ndtr(-np.maximum(score, 0.0)))
        return np.asarray(prior.scale) * np.sqrt(2.0) * np.where(score < 0.0, low, high)

    return _by_numpyro(prior, special.ndtr(score), name)


def of_half_normal(prior: Distribution, score: np.ndarray, name: str) -> np.ndarray:
    """Compute the quantile of a prior at the probability P(|N(0, 1)| < score)."""
    prior = _base(prior)
    if isinstance(prior, dist.HalfNormal):
        return np.asarray(prior.scale) * score
    return _by_numpyro(prior, special.erf(score / np.sqrt(2.0)), name)


def log_density(prior: Distribution, x: np.ndarray) -> np.ndarray:
    """Compute the log density of a prior, in closed form for common priors."""
    prior = _base(prior)

    if isinstance(prior, dist.HalfNormal):
        return stats.halfnorm.logpdf(x, scale=np.asarray(prior.scale))
    if isinstance(prior, dist.Beta):
        a = np.asarray(prior.concentration1)
        b = np.asarray(prior.concentration0)
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
    """Compute quantiles with NumPyro; raise TrustboError if the prior on `name` has none."""
    try:
        with own_settings():
            inside = jnp.asarray(np.clip(p, _SMALLEST_P, _LARGEST_P))
            return np.asarray(call(prior, "icdf", inside), dtype=float)
    except (NotImplementedError, ImportError):  # some quantiles need another package
        raise TrustboError(
            f"the prior on {name} must have quantiles (icdf), but {prior!r} has none. Give another "
            "prior, or sample model.program with a NumPyro kernel."
        ) from None
