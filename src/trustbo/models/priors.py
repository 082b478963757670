"""Priors of the trust models' parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from typing import Any

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution, constraints

from trustbo.data import is_line_of_sight
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_positive
from trustbo.models.backend import own_settings
from trustbo.models.families import FAMILIES
from trustbo.models.scores import log_density


def _built(kind: Any, *parameters: float) -> Distribution:
    """Make a distribution in float64 on demand: importing trustbo must create no JAX array."""
    with own_settings():
        return kind(*parameters)


@dataclass(frozen=True, repr=False)
class Priors(Summary):
    """Priors of the parameters, as scalar NumPyro distributions, and of the initial trust.

    The defaults are below; the second argument of a normal is a standard deviation, and the paper
    leaves x_0 ~ N(0.5, 0.5^2) open. A model ignores parameters it does not have. Weights need
    Normal priors, as they are integrated out; beta0 and noise scales need priors with quantiles
    (icdf).

    Attributes:
        beta0: Autoregression; the diagonal of B0 in the coupled model.
        beta: Weight of each feature, independent; the diagonals of B_m in the coupled model. A
            distribution of batch shape (feature,) gives each feature a separate prior.
        b: Intercept.
        delta_w: Standard deviation of the process noise.
        delta_v: Standard deviation of the observation noise, without the noise that is due to the
            resolution of the rates; in the beta-binomial family, the square root of the ratio of
            excess to binomial variance (concentration delta_v^-2).
        delta_s: Standard deviation of the noise that robots share in a bound.
        coupling: Influence of robots on each other: off-diagonals of B0 and B_m.
        tau: Spread of the robots' coefficients in the hierarchical model.
        concentration: Concentration of the LKJ prior of noise correlations, coupled model.
        x0_mean: Mean of trust before the first bound.
        x0_sd: Standard deviation of trust before the first bound; 0 fixes it at `x0_mean`.
        stationary: True if `beta` and `b` are priors of the weights and intercept of stationary
            trust, beta / (1 - beta0) and b / (1 - beta0), the limit under constant features.

    Raises:
        TrustboError: If a prior is not such a distribution, a weight's prior is not Normal or
            beta0's prior not on (0, 1), a noise or tau can be negative, or `x0_sd` is negative.
    """

    beta0: Distribution = field(default_factory=partial(_built, dist.Beta, 2.0, 2.0))
    beta: Distribution = field(default_factory=partial(_built, dist.Normal, 0.0, 1.0))
    b: Distribution = field(default_factory=partial(_built, dist.Normal, 0.0, 0.5))
    delta_w: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.2))
    delta_v: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.2))
    delta_s: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.2))
    coupling: Distribution = field(default_factory=partial(_built, dist.Normal, 0.0, 0.1))
    tau: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.3))
    concentration: float = 2.0
    x0_mean: float = 0.5
    x0_sd: float = 0.5
    stationary: bool = False

    def _rows(self) -> Rows:
        return list(self.describe().items())

    def __post_init__(self) -> None:
        for name in (one.name for one in fields(self) if one.type is Distribution):
            prior = getattr(self, name)
            if wanted := _wanted(name, prior):
                raise TrustboError(f"the prior of Priors.{name} must be {wanted}; got {prior!r}.")
        require_positive("Priors.concentration", self.concentration)
        require_positive("Priors.x0_sd", self.x0_sd, or_zero=True)
        if not np.isfinite(self.x0_mean):
            raise TrustboError(f"Priors.x0_mean must be finite; got {self.x0_mean!r}.")

    @classmethod
    @cache
    def default(cls, observation: str) -> "Priors":
        """Return the default priors of an observation family, as a cached object.

        Counts (`"beta_binomial"`) have wider priors, as trust is a logit: beta_m ~ N(0, 2),
        b ~ N(0, 1), delta_w ~ HalfNormal(0.5), x_0 ~ N(0, 1.5^2).
        """
        return cls(**FAMILIES[observation].priors())

    @classmethod
    def of(cls, features: Sequence[str], observation: str = "gaussian") -> "Priors":
        """Return the default priors for the named features.

        `line_of_sight` is a predicted contact rate: stationary trust has slope 1 in it, or in the
        mean of n of them (`line_of_sight_1`, ...), and little else. beta_los / (1 - beta0) ~
        N(1 / n, 0.3^2 / n), other weights N(0, 0.25^2), and b / (1 - beta0) ~ N(0, 0.15^2), so that
        most rates drawn from the prior lie in [0, 1]. For counts, where trust is a logit, these are
        scaled by five, for rates around one half. Without such a feature, returns `default`.
        """
        is_sight = np.array([is_line_of_sight(name) for name in features])
        default, n = cls.default(observation), max(int(is_sight.sum()), 1)
        if not is_sight.any():
            return default
        unit, centre = FAMILIES[observation].line_of_sight
        with own_settings():
            sd = np.where(is_sight, 0.3 / np.sqrt(n), 0.25)
            return replace(
                default,
                beta=dist.Normal(unit * is_sight / n, unit * sd),
                b=dist.Normal(-unit * centre, unit * 0.15),
                stationary=True,
            )

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and sd of the Normal prior `name`."""
        prior: Any = getattr(self, name)
        return np.asarray(prior.loc, dtype=float), np.asarray(prior.scale, dtype=float)

    def coefficients(self, n_features: int) -> tuple[np.ndarray, np.ndarray]:
        """Return means and sds of the weights and, last, the intercept, each (feature + 1,)."""
        mean, sd = (
            np.append(np.broadcast_to(of_beta, n_features), of_b)
            for of_beta, of_b in zip(self.moments("beta"), self.moments("b"), strict=True)
        )
        return mean, sd

    def log_density(self, name: str, values: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Compute the log density of the prior `name` at each value of the parameter.

        Args:
            name: Name of a field.
            values: Shape (...), or (..., feature) for `beta`.
            rest: Drift by which stationary trust rises by 1, on which priors of stationary trust
                depend; broadcasts to the values.
        """
        prior = getattr(self, name)
        if not self.stationary or name not in ("beta", "b"):
            return log_density(prior, values)
        return log_density(prior, values / rest) - np.log(rest)

    def describe(self) -> dict[str, str]:
        """Write each prior as text, for the record of a posterior."""
        return {one.name: _as_text(getattr(self, one.name)) for one in fields(self)}


def _wanted(name: str, prior: Any) -> str:
    """Return the requirement that a prior violates, or an empty text."""
    if not isinstance(prior, Distribution) or len(prior.shape()) > (name == "beta"):
        return "a scalar numpyro distribution, e.g. Normal(0.0, 1.0)"
    if name in ("beta", "b", "coupling"):
        wanted, good = "Normal, so that it integrates out", isinstance(prior, dist.Normal)
        wanted += " (for another, write a NumPyro model of your own, see models.ContactRate)"
    elif name == "beta0":
        wanted, good = "on (0, 1), e.g. Beta(2.0, 2.0)", prior.support is constraints.unit_interval
    else:
        wanted = "positive, e.g. HalfNormal(0.2), as it is of a standard deviation"
        good = np.all(np.asarray(getattr(prior.support, "lower_bound", -np.inf)) >= 0.0)
    return "" if good else wanted


def _as_text(prior: Distribution | float) -> str:
    """Write a distribution or a number as text."""
    if isinstance(prior, bool):
        return "yes" if prior else "no"
    if not isinstance(prior, Distribution):
        return f"{prior:g}"
    numbers = ", ".join(f"{n}={_numbers(getattr(prior, n))}" for n in type(prior).arg_constraints)
    return f"{type(prior).__name__}({numbers})"


def _numbers(values: object) -> str:
    array = np.asarray(values, dtype=float)
    return f"{array:g}" if not array.ndim else f"[{', '.join(f'{v:g}' for v in array)}]"
