"""Prior densities and draws in NumPy: compiling them would take longer than using them."""

import jax
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution
from scipy import special

from trustbo.models.backend import own_settings


def log_prob(prior: Distribution, x: np.ndarray) -> np.ndarray:
    """Log density, in closed form for the usual priors, by numpyro for others."""
    if isinstance(prior, dist.HalfNormal):
        return np.where(x < 0.0, -np.inf, np.log(2.0) + _normal(x, 0.0, number(prior, "scale")))
    if isinstance(prior, dist.Beta):
        a, b = (number(prior, f"concentration{i}") for i in (1, 0))
        return special.xlogy(a - 1.0, x) + special.xlog1py(b - 1.0, -x) - special.betaln(a, b)
    if isinstance(prior, dist.Normal):
        return _normal(x, number(prior, "loc"), number(prior, "scale"))
    if isinstance(prior, dist.LogNormal):
        log_x = np.log(x)
        return _normal(log_x, number(prior, "loc"), number(prior, "scale")) - log_x
    with own_settings():
        return np.asarray(prior.log_prob(jax.numpy.asarray(x)), dtype=float)


def _normal(x: np.ndarray, loc: float, scale: float) -> np.ndarray:
    return -0.5 * ((x - loc) / scale) ** 2 - np.log(scale * np.sqrt(2.0 * np.pi))


def draw(prior: Distribution, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draws of that shape; the last axis is the prior's own, if it is a vector."""
    if isinstance(prior, dist.HalfNormal):
        return np.abs(rng.normal(0.0, numbers(prior, "scale"), shape))
    if isinstance(prior, dist.Beta):
        return rng.beta(numbers(prior, "concentration1"), numbers(prior, "concentration0"), shape)
    if isinstance(prior, dist.Normal):
        return rng.normal(numbers(prior, "loc"), numbers(prior, "scale"), shape)
    with own_settings():
        key = jax.random.key(int(rng.integers(1 << 31)))
        return np.asarray(prior.expand(shape).sample(key), dtype=float)


def number(prior: Distribution, name: str) -> float:
    """A scalar argument of a distribution."""
    return float(getattr(prior, name))


def numbers(prior: Distribution, name: str) -> np.ndarray:
    """An argument of a distribution, () or (feature,)."""
    return np.asarray(getattr(prior, name), dtype=float)
