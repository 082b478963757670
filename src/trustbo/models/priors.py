"""Priors of the trust models' parameters."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Self

import jax
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution, constraints

from trustbo import zheng2023
from trustbo.errors import TrustboError, require_positive
from trustbo.models.backend import own_settings
from trustbo.models.floored import Floored
from trustbo.models.likelihood.families import FAMILIES
from trustbo.models.samplers.priors_numpy import floored

_SCALES = ("delta_w", "delta_v", "tau")


@dataclass(frozen=True)
class Priors:
    """Prior of each parameter, any scalar numpyro distribution, and of trust before bound 1.

    `Priors()` is the default of DESIGN: beta0 ~ Beta(2, 2), beta_m ~ N(0, 1), b ~ N(0, 0.5),
    delta_w and delta_v ~ HalfNormal(0.2), the second argument being a standard deviation, and
    x_0 ~ N(0.5, 0.5^2), which the paper leaves open. A model ignores parameters it does not have.

    Attributes:
        beta0: Autoregression; the diagonal of B0 in the coupled model.
        beta: Weight of each feature, independent; the diagonals of B_m in the coupled model. A
            distribution of batch shape (feature,) gives each feature its own.
        b: Intercept.
        delta_w: Standard deviation of the process noise.
        delta_v: Standard deviation of the observation noise, cut off below the resolution of the
            rates; in the beta-binomial family, the
            square root of the ratio of excess to binomial variance (concentration delta_v^-2).
        coupling: Influence of robots on each other: off-diagonals of B0 and B_m, and gamma.
        tau: Spread of the robots' coefficients in the hierarchical model.
        concentration: Concentration of the LKJ prior of noise correlations, coupled model.
        x0_mean: Mean of trust before the first bound.
        x0_sd: Its standard deviation; 0 fixes it.

    Raises:
        TrustboError: A prior is no such distribution, a noise or tau can be negative, or `x0_sd`
            is negative.
    """

    # Built on demand: importing trustbo must create no JAX array.
    beta0: Distribution = None  # pyright: ignore[reportAssignmentType]
    beta: Distribution = None  # pyright: ignore[reportAssignmentType]
    b: Distribution = None  # pyright: ignore[reportAssignmentType]
    delta_w: Distribution = None  # pyright: ignore[reportAssignmentType]
    delta_v: Distribution = None  # pyright: ignore[reportAssignmentType]
    coupling: Distribution = None  # pyright: ignore[reportAssignmentType]
    tau: Distribution = None  # pyright: ignore[reportAssignmentType]
    concentration: float = 2.0
    x0_mean: float = 0.5
    x0_sd: float = 0.5

    def __post_init__(self) -> None:
        with own_settings():
            defaults = {
                "beta0": dist.Beta(2.0, 2.0),
                "beta": dist.Normal(0.0, 1.0),
                "b": dist.Normal(0.0, 0.5),
                "delta_w": dist.HalfNormal(0.2),
                "delta_v": dist.HalfNormal(0.2),
                "coupling": dist.Normal(0.0, 0.1),
                "tau": dist.HalfNormal(0.3),
            }
        for name, default in defaults.items():
            prior = getattr(self, name)
            if prior is None:
                object.__setattr__(self, name, default)
                continue
            scalar = isinstance(prior, Distribution) and not prior.event_shape
            if not scalar or len(prior.batch_shape) > (name == "beta"):
                raise TrustboError(
                    f"Priors.{name} must be a scalar numpyro distribution, e.g. {default!r}; "
                    f"got {prior!r}."
                )
            if name in _SCALES and not _is_positive(prior):
                raise TrustboError(
                    f"Priors.{name} is a standard deviation: its prior must live on (0, inf) or "
                    f"part of it, e.g. {default!r}; got {prior!r}."
                )
        require_positive("Priors.concentration", self.concentration)
        if not np.isfinite(self.x0_mean):
            raise TrustboError(f"Priors.x0_mean must be finite; got {self.x0_mean!r}.")
        if not 0.0 <= self.x0_sd < np.inf:
            raise TrustboError(f"Priors.x0_sd must be finite, not negative; got {self.x0_sd!r}.")

    @classmethod
    def default(cls, observation: str = "gaussian") -> Self:
        """Default priors of a family of observations.

        Counts (`"beta_binomial"`) have wider ones, as trust is a logit: beta_m ~ N(0, 2),
        b ~ N(0, 1), delta_w ~ HalfNormal(0.5), x_0 ~ N(0, 1.5^2).
        """
        return cls(**FAMILIES[observation].priors())

    @classmethod
    def zheng2023(cls) -> Self:
        """Vague priors in the manner of the authors' later code, for comparison.

        All are normal with sd 10, noises half-Cauchy. With few missions the posterior is
        multimodal in practice (beta0 near 1 with small weights, or near 0 with large ones): look at
        R-hat before you use it.
        """
        return cls(**zheng2023.vague_priors())

    def above_resolution(self, resolution: float) -> Self:
        """The same, delta_v being no less than the resolution of a rate."""
        return replace(self, delta_v=floored(self.delta_v, resolution))

    def mean(self, n_features: int) -> dict[str, np.ndarray]:
        """Prior mean of each parameter; 0 for one without a mean, such as a Cauchy."""
        means = {}
        for name in ("beta0", "beta", "b", "delta_w", "delta_v"):
            value = np.asarray(getattr(self, name).mean, dtype=float)
            shape = (n_features,) if name == "beta" else ()
            means[name] = np.broadcast_to(np.where(np.isfinite(value), value, 0.0), shape)
        return means

    def describe(self) -> dict[str, str]:
        """Each prior as text, for the record kept with a result."""
        return {f.name: _as_text(getattr(self, f.name)) for f in fields(self)}


def _flatten(priors: Priors) -> tuple[tuple[object, ...], None]:
    return tuple(getattr(priors, f.name) for f in fields(priors)), None


def _unflatten(_: None, children: Iterable[object]) -> Priors:
    # Not through __init__: in a compiled program the values are tracers, which no check can read.
    priors = object.__new__(Priors)
    for f, child in zip(fields(Priors), children, strict=True):
        object.__setattr__(priors, f.name, child)
    return priors


# A pytree, so that compiled samplers take priors as data: other numbers need no recompilation.
jax.tree_util.register_pytree_node(Priors, _flatten, _unflatten)


def _as_text(prior: Distribution | float) -> str:
    if not isinstance(prior, Distribution):
        return f"{prior:g}"
    if isinstance(prior, Floored):  # the floor is no prior of the user's, but the data's
        return _as_text(prior.base)
    numbers = ", ".join(f"{n}={_numbers(getattr(prior, n))}" for n in type(prior).arg_constraints)
    return f"{type(prior).__name__}({numbers})"


def _numbers(values: object) -> str:
    array = np.asarray(values, dtype=float)
    return f"{array:g}" if not array.ndim else f"[{', '.join(f'{v:g}' for v in array)}]"


def _is_positive(prior: Distribution) -> bool:
    support = prior.support
    if support is constraints.positive or support is constraints.unit_interval:
        return True
    return bool((np.asarray(getattr(support, "lower_bound", -np.inf)) >= 0.0).all())
