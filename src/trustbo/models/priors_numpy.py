"""Prior densities, draws and floors in NumPy: compiling them would take longer than using them."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple, Self

import jax
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution, constraints
from numpyro.distributions.transforms import biject_to
from scipy import special
from scipy.interpolate import CubicSpline

from trustbo.errors import TrustboError
from trustbo.models.backend import call, namespace, own_settings
from trustbo.models.floored import Floored

_LEAST_MASS = 1e-3  # above a floor: with less, rejection would draw for long
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


def log_prob(prior: Distribution, x: np.ndarray) -> np.ndarray:
    """Log density, in closed form for the usual priors; by numpyro for others, and in JAX."""
    if namespace(x) is not np:
        return prior.log_prob(x)  # pyright: ignore
    if isinstance(prior, Floored):
        above = log_prob(prior.base, x) - number(prior, "log_above")
        return np.where(x < number(prior, "low"), -np.inf, above)
    if isinstance(prior, dist.HalfNormal):
        return np.where(x < 0.0, -np.inf, np.log(2.0) + _normal(x, 0.0, number(prior, "scale")))
    if isinstance(prior, dist.Beta):
        a, b = (number(prior, f"concentration{i}") for i in (1, 0))
        return special.xlogy(a - 1.0, x) + special.xlog1py(b - 1.0, -x) - special.betaln(a, b)
    if isinstance(prior, dist.Normal):
        return _normal(x, numbers(prior, "loc"), numbers(prior, "scale"))
    if isinstance(prior, dist.LogNormal):
        log_x = np.log(x)
        return _normal(log_x, number(prior, "loc"), number(prior, "scale")) - log_x
    with own_settings():
        return np.asarray(call(prior, "log_prob", jax.numpy.asarray(x)), dtype=float)


class Table(NamedTuple):
    """A function of a number by its cubic spline; JAX lacks or slowly compiles many quantiles."""

    knots: np.ndarray  # (knot,), evenly spaced
    coefficients: np.ndarray  # (4, interval)

    @classmethod
    def of(
        cls, function: Callable[[np.ndarray], np.ndarray], low: float, high: float, n: int = 4001
    ) -> Self:
        """Table of a function by n values, where these are finite."""
        x = np.linspace(low, high, n)
        with np.errstate(all="ignore"):
            y = function(x)
        some = np.isfinite(y)
        return cls(x[some], CubicSpline(x[some], y[some]).c)

    def __call__(self, x: Any) -> Any:
        """Value at x, constant beyond the knots, in NumPy or JAX; the error is about 1e-12."""
        xp: Any = namespace(x)
        knots, c = xp.asarray(self.knots), xp.asarray(self.coefficients)
        x = xp.clip(x, knots[0], knots[-1])
        i = xp.floor((x - knots[0]) / (knots[1] - knots[0])).astype(int)
        i = xp.clip(i, 0, c.shape[1] - 1)
        d = x - knots[i]
        return ((c[0, i] * d + c[1, i]) * d + c[2, i]) * d + c[3, i]


def half_normal(score: Any, scale: Any) -> Any:
    """Half-normal variable of a score, in NumPy or JAX; accurate in both tails."""
    if namespace(score) is not np:
        return scale * jax.numpy.exp(_log_half_normal()(score))
    low = special.erfinv(special.ndtr(np.minimum(score, 0.0)))
    high = special.erfcinv(special.ndtr(-np.maximum(score, 0.0)))
    return scale * np.sqrt(2.0) * np.where(score < 0.0, low, high)


@cache
def _log_half_normal() -> Table:
    return Table.of(lambda score: np.log(half_normal(score, 1.0)), -12.0, 12.0)


def _normal(x: np.ndarray, loc: float | np.ndarray, scale: float | np.ndarray) -> np.ndarray:
    return -0.5 * ((x - loc) / scale) ** 2 - np.log(scale * np.sqrt(2.0 * np.pi))


def draw(prior: Distribution, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draws of that shape; the last axis is the prior's own, if it is a vector."""
    if isinstance(prior, Floored):
        x, low = draw(prior.base, shape, rng), number(prior, "low")
        while (below := x < low).any():
            x = np.where(below, draw(prior.base, shape, rng), x)
        return x
    if isinstance(prior, dist.HalfNormal):
        return np.abs(rng.normal(0.0, numbers(prior, "scale"), shape))
    if isinstance(prior, dist.Beta):
        return rng.beta(numbers(prior, "concentration1"), numbers(prior, "concentration0"), shape)
    if isinstance(prior, dist.Normal):
        return rng.normal(numbers(prior, "loc"), numbers(prior, "scale"), shape)
    with own_settings():
        key = jax.random.key(int(rng.integers(1 << 31)))
        return np.asarray(call(prior.expand(shape), "sample", key), dtype=float)


def draw_lkj_cholesky(
    concentration: float, shape: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Cholesky factors of correlation matrices, (draw, row, column), for a shape (draw, row).

    The onion method (Lewandowski, Kurowicka and Joe 2009, section 3.2): row by row a direction,
    uniform on the sphere, and a Beta squared length of what is left of the diagonal.
    """
    n_draws, n = shape
    factor = np.zeros((n_draws, n, n))
    factor[:, 0, 0] = 1.0
    for i in range(1, n):
        square = rng.beta(0.5 * i, concentration + 0.5 * (n - 1 - i), n_draws)
        direction = rng.standard_normal((n_draws, i))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        factor[:, i, :i] = np.sqrt(square)[:, None] * direction
        factor[:, i, i] = np.sqrt(1.0 - square)
    return factor


def bijection(support: Any) -> tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]:
    """Map of the real line onto a support, as numpyro's, and its inverse."""
    if support is constraints.unit_interval:
        limits = np.finfo(float)
        return lambda x: np.clip(special.expit(x), limits.tiny, 1.0 - limits.eps), special.logit
    transform = biject_to(support)

    def in_float64(function: Callable[..., Any], x: np.ndarray) -> np.ndarray:
        with own_settings():
            return np.asarray(function(x), dtype=float)

    return partial(in_float64, transform), partial(in_float64, transform.inv)


def floored(prior: Distribution, low: float) -> Distribution:
    """Prior of a standard deviation truncated at `low`; unchanged if its support starts above.

    Raises:
        TrustboError: It has next to no mass above.
    """
    prior = prior.base if isinstance(prior, Floored) else prior
    start, end = (
        float(np.asarray(getattr(prior.support, f"{side}_bound", default)))
        for side, default in (("lower", 0.0), ("upper", np.inf))
    )
    if start >= low:
        return prior
    half = 0.5 * (min(low, end) - start)
    x = start + half * (1.0 + _NODES)
    density = half * _WEIGHTS * np.exp(log_prob(prior, x))
    above = 1.0 - float(density.sum())
    if above < _LEAST_MASS:
        raise TrustboError(
            f"the prior of delta_v has {max(above, 0.0):.1e} of its mass above {low:g}, the "
            f"resolution of the contact rates (1 / n_ticks); got {prior!r}. Give a wider one."
        )
    return Floored(prior, low, (1.0 - above, float(density @ x)))


def of_coefficients(
    beta: Distribution, b: Distribution, n_features: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and precision of normal priors of (beta, b), each (coefficient,)."""
    mean, sd = (
        np.append(np.broadcast_to(numbers(beta, name), n_features), numbers(b, name))
        for name in ("loc", "scale")
    )
    return mean, sd**-2.0


def number(prior: Distribution, name: str) -> float:
    """A scalar argument of a distribution."""
    return float(getattr(prior, name))


def numbers(prior: Distribution, name: str) -> np.ndarray:
    """An argument of a distribution, () or (feature,)."""
    return np.asarray(getattr(prior, name), dtype=float)
