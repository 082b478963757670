"""Hyperparameters as normal scores of their priors: without data, the density is Gaussian.

A parameter is the quantile of its prior at Phi(score), so a score is N(0, 1) a priori. The two
noises are a size and an angle of their half-normal scores, as the data determine the size best:
with half-normal priors log size has the density of a Rayleigh variable's logarithm, and the angle
over pi / 2 is uniform. On log and logit scales tails are exponential, and weights uneven.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution
from scipy import special

from trustbo.errors import TrustboError
from trustbo.models.backend import call, namespace, own_settings
from trustbo.models.effects.effect import Effect, Theta, rest_of, scales_of
from trustbo.models.floored import Floored
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import half_normal, number

LOG_ROOT_2PI = 0.5 * np.log(2.0 * np.pi)


def log_normal_density(scores: np.ndarray) -> np.ndarray:
    """Log density of independent standard normals (..., score), shape (...,)."""
    return -0.5 * (scores**2).sum(-1) - scores.shape[-1] * LOG_ROOT_2PI


def log_prior(z: np.ndarray) -> np.ndarray:
    """Log prior density of scores (point, score), the second being the log size of the noises.

    In NumPy or JAX.
    """
    xp: Any = namespace(z)
    normal = log_normal_density(xp.delete(z, 1, axis=1))
    return 2.0 * z[:, 1] - 0.5 * xp.exp(z[:, 1]) ** 2 + normal


def beta0_and_noises(priors: Priors, z: np.ndarray) -> np.ndarray:
    """Parameters beta0, delta_w and delta_v (point, 3) of the first three scores."""
    size, r = np.exp(z[:, 1]), z[:, 2]
    theta = np.zeros((len(z), 3))
    theta[:, 0] = quantile(priors.beta0, z[:, 0])
    for i, prior, side in ((1, priors.delta_w, 1.0), (2, priors.delta_v, -1.0)):
        angle = 0.5 * np.pi * special.ndtr(side * r)
        theta[:, i] = noise(prior, size * np.sin(angle))
    return theta


class Quantiles(NamedTuple):
    """Parameters at scores, by the quantiles of their priors."""

    priors: Priors

    def core(self, z: np.ndarray) -> np.ndarray:
        """See `beta0_and_noises`."""
        return beta0_and_noises(self.priors, z)

    def tau(self, z: np.ndarray) -> np.ndarray:
        """Spreads of robots at scores (point, spread)."""
        return quantile(self.priors.tau, z)


def with_data[Kind](*names: str) -> Callable[[type[Kind]], type[Kind]]:
    """Make a class an argument of compiled code, in which all but the named attributes are."""

    def flatten(one: Any) -> tuple[list[Any], tuple[Any, ...]]:
        others = tuple((name, x) for name, x in vars(one).items() if name not in names)
        return [getattr(one, name) for name in names], others

    def register(cls: type[Kind]) -> type[Kind]:
        def unflatten(others: tuple[Any, ...], data: list[Any]) -> Any:
            one: Any = object.__new__(cls)
            vars(one).update(others, **dict(zip(names, data, strict=True)))
            return one

        jax.tree_util.register_pytree_node(cls, flatten, unflatten)
        return cls

    return register


@with_data("quantiles")
class Scores:
    """Scores of beta0 and the noises, which all robots share, and of the effects' scales.

    Coordinates are standard normal a priori, but for the second, see `log_prior`. Subclasses have
    those of other hyperparameters.
    """

    fixed = True
    """Whether `recentre` leaves the coordinates unchanged."""
    pools = False
    """Whether there are spreads of robots."""
    n_core = 3
    """Number of the first coordinates, of memory and noises, which the rates determine."""

    def __init__(
        self,
        priors: Priors,
        effects: Sequence[Effect],
        memory: str = "level",
        *,
        carries: bool = True,
    ) -> None:
        """Take the priors; `memory` as in `evidence.gaussian`.

        Where nothing `carries` on, beta0 = 0, and the first score is of nothing.
        """
        self.quantiles: Any = Quantiles(priors)
        self.carried = float(carries)
        self.effects, self.memory = tuple(e for e in effects if e.names), memory
        self.n_scores = self.n_core + sum(len(effect.names) for effect in effects)

    def theta(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Hyperparameters that the evidence takes, by name, of scores (point, score)."""
        return self.with_core(self.quantiles.core(z), z)

    def named(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters of the model among them, by name."""
        return {name: values for name, values in self.theta(z).items() if name != "rest"}

    def log_prior(self, z: np.ndarray) -> np.ndarray:
        """Log prior density of scores (point,)."""
        return log_prior(z)

    def recentre(self, z: np.ndarray, log_density: Callable[[Theta], np.ndarray]) -> np.ndarray:
        """Choose coordinates for the posterior around a point z (score,); z in these.

        Args:
            z: Scores.
            log_density: Log density of the rates at each theta.
        """
        return z

    def with_core(self, core: Any, z: Any) -> dict[str, Any]:
        """Hyperparameters of scores, given beta0 and the noises (point, 3), in NumPy or JAX."""
        beta0, delta_w, delta_v = core.T
        beta0 = beta0 * self.carried
        rest = rest_of(beta0, self.memory)
        theta = {"beta0": beta0, "delta_w": delta_w, "delta_v": delta_v, "rest": rest}
        return theta | scales_of(self.effects, z[:, self.n_core :])


def quantile(prior: Distribution, score: np.ndarray) -> np.ndarray:
    """Quantile of a prior at Phi(score)."""
    if isinstance(prior, dist.Beta):
        a, b = (number(prior, f"concentration{i}") for i in (1, 0))
        low = special.betaincinv(a, b, special.ndtr(np.minimum(score, 0.0)))
        high = 1.0 - special.betaincinv(b, a, special.ndtr(-np.maximum(score, 0.0)))
        return np.where(score < 0.0, low, high)
    if isinstance(prior, dist.HalfNormal):
        return half_normal(score, number(prior, "scale"))
    if isinstance(prior, dist.Normal):
        return number(prior, "loc") + number(prior, "scale") * score
    if isinstance(prior, dist.LogNormal):
        return np.exp(number(prior, "loc") + number(prior, "scale") * score)
    return _by_numpyro(prior, special.ndtr(score))


def noise(prior: Distribution, size: np.ndarray) -> np.ndarray:
    """Noise of a half-normal score: the quantile at which |N(0, 1)| is `size`."""
    base, below = prior, 0.0
    if isinstance(prior, Floored):
        base, below = prior.base, 1.0 - np.exp(number(prior, "log_above"))
    if isinstance(base, dist.HalfNormal):
        if below == 0.0:
            return number(base, "scale") * size
        above = special.erfc(size / np.sqrt(2.0)) * (1.0 - below)
        return number(base, "scale") * np.sqrt(2.0) * special.erfcinv(above)
    return _by_numpyro(base, below + (1.0 - below) * special.erf(size / np.sqrt(2.0)))


def why_no_quantiles(priors: Priors, *, partial_pooling: bool = False) -> str | None:
    """Reason why priors have no scores: one has no quantiles. None if all have."""
    for name in ("beta0", "delta_w", "delta_v", *("tau",) * partial_pooling):
        prior = getattr(priors, name)
        prior = prior.base if isinstance(prior, Floored) else prior
        try:
            quantile(prior, np.zeros(1))
        except TrustboError:
            return f"the prior of {name} has no quantiles; got {prior!r}"
    return None


def _by_numpyro(prior: Distribution, p: np.ndarray) -> np.ndarray:
    try:
        with own_settings():
            share = jnp.asarray(np.clip(p, 1e-300, 1.0 - 1e-16))
            return np.asarray(call(prior, "icdf", share), dtype=float)
    except (NotImplementedError, ImportError):  # quantiles of a few need another package
        raise TrustboError(
            f'sampler "exact" needs the quantiles of priors here; {prior!r} has none. Use another '
            'prior, or sampler="nuts".'
        ) from None
