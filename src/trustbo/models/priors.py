"""Priors of the trust models' parameters."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Self

import jax
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution

from trustbo.errors import TrustboError


@dataclass(frozen=True)
class Priors:
    """Prior of each parameter, any scalar numpyro distribution, and of trust before bound 1.

    `Priors()` is the default of DESIGN: beta0 ~ Beta(2, 2), beta_m ~ N(0, 1), b ~ N(0, 0.5),
    delta_w and delta_v ~ HalfNormal(0.2), the second argument being a standard deviation, and
    x_0 ~ N(0.5, 0.5^2), which the paper leaves open.

    Attributes:
        beta0: Autoregression.
        beta: Weight of each feature, independent.
        b: Intercept.
        delta_w: Standard deviation of the process noise.
        delta_v: Standard deviation of the observation noise.
        x0_mean: Mean of trust before the first bound.
        x0_sd: Its standard deviation; 0 fixes it.

    Raises:
        TrustboError: Something that is no scalar distribution, or a negative `x0_sd`.
    """

    # Built on demand: importing trustbo must create no JAX array.
    beta0: Distribution = None  # pyright: ignore[reportAssignmentType]
    beta: Distribution = None  # pyright: ignore[reportAssignmentType]
    b: Distribution = None  # pyright: ignore[reportAssignmentType]
    delta_w: Distribution = None  # pyright: ignore[reportAssignmentType]
    delta_v: Distribution = None  # pyright: ignore[reportAssignmentType]
    x0_mean: float = 0.5
    x0_sd: float = 0.5

    def __post_init__(self) -> None:
        with jax.enable_x64(True):
            defaults = {
                "beta0": dist.Beta(2.0, 2.0),
                "beta": dist.Normal(0.0, 1.0),
                "b": dist.Normal(0.0, 0.5),
                "delta_w": dist.HalfNormal(0.2),
                "delta_v": dist.HalfNormal(0.2),
            }
        for name, default in defaults.items():
            prior = getattr(self, name)
            if prior is None:
                object.__setattr__(self, name, default)
            elif not isinstance(prior, Distribution) or prior.shape():
                raise TrustboError(
                    f"Priors.{name} must be a scalar numpyro distribution, e.g. {default!r}; "
                    f"got {prior!r}."
                )
        if not np.isfinite(self.x0_mean):
            raise TrustboError(f"Priors.x0_mean must be finite; got {self.x0_mean!r}.")
        if not 0.0 <= self.x0_sd < np.inf:
            raise TrustboError(f"Priors.x0_sd must be finite, not negative; got {self.x0_sd!r}.")

    @classmethod
    def default(cls) -> Self:
        """The default priors."""
        return cls()

    def mean(self, n_features: int) -> dict[str, np.ndarray]:
        """Prior mean of each parameter; 0 for one that has none, as a Cauchy has not."""
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
    names = type(prior).arg_constraints
    numbers = ", ".join(f"{name}={float(getattr(prior, name)):g}" for name in names)
    return f"{type(prior).__name__}({numbers})"
