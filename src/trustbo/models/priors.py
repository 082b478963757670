"""Priors on the parameters of the trust models."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from typing import Any, Self

import jax
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution

from trustbo.data import THREAT, is_line_of_sight
from trustbo.display import Rows, Summary
from trustbo.errors import (
    TrustboError,
    require_choice,
    require_finite,
    require_list,
    require_order,
    require_positive,
    require_switch,
    see,
)
from trustbo.models.backend import own_flags, own_settings
from trustbo.models.families import FAMILIES
from trustbo.models.scores import log_density

# Prior sds of the coefficients of stationary trust, with line of sight (see
# `Priors.from_features`).
_SIGHT_SD = 0.3
_FEATURE_SD = 0.25
_LOST_TO_THREAT = 0.5  # expected loss of stationary trust per unit of the feature `threat`
_INTERCEPT_SD = 0.15
_MEMORY = (2.0, 6.0)
"""Parameters of the Beta prior on beta0 with line of sight. With more weight near 1, constant
contact in a first mission would be explained by trust that never changes."""
_FLOOR = (1.0, 2.0)
"""Parameters of the Beta prior on the floor of the scale of noise."""
_MIDDLE = 0.5
"""Contact rate that `Priors.for_cells` expects in every cell, the middle of [0, 1]."""


def _built(kind: Any, *parameters: float) -> Distribution:
    """Make a float64 distribution on demand, as importing trustbo must not create JAX arrays."""
    with own_settings():  # the Beta distribution computes
        return kind(*parameters)


@dataclass(frozen=True, repr=False)
class Priors(Summary):
    """Priors on the parameters, as scalar NumPyro distributions, and on initial trust.

    The paper does not specify the prior on initial trust; the default is x_0 ~ N(0.5, 0.5^2).
    Models ignore the priors on parameters that they do not have. Weights need Normal priors,
    because they are integrated out; beta0 and the noise scales need priors with quantiles (icdf).

    Attributes:
        beta0: Autoregression coefficient, or the diagonal of B0 in the coupled model.
        beta: Independent feature weights, or the diagonals of B_m in the coupled model. A
            distribution with batch shape (feature,) gives each feature a separate prior.
        b: Intercept.
        delta_w: Standard deviation of the process noise.
        delta_v: Standard deviation of the observation noise, excluding the noise that is due to the
            resolution of the rates. In the beta-binomial family, the concentration is delta_v^-2.
        f_v: Floor of the scale of the observation noise, in (0, 1). Where the mean over robots of
            the predicted line of sight is m, the noise has the standard deviation g delta_v with
            g^2 = f_v^2 + (1 - f_v^2) 4 m (1 - m). None for a floor of 1, with which noise is the
            same in all bounds. It applies to Gaussian rates in models without shared noise.
        delta_s: Standard deviation of the noise that all robots share in a bound.
        coupling: Off-diagonal entries of B0 and B_m, through which robots influence each other.
        tau: Standard deviation of coefficients between robots in the hierarchical model.
        concentration: Concentration of the LKJ prior on noise correlations in the coupled model.
        x0_mean: Mean of trust before the first bound.
        x0_sd: Standard deviation of trust before the first bound; 0 fixes trust at `x0_mean`.
        stationary: Whether `beta` and `b` are priors on beta / (1 - beta0) and b / (1 - beta0).
            These are the coefficients of stationary trust, the limit under constant features.
        features: Names of the features of `beta`. Data with the same features in another order use
            the priors by name, and data with other features are refused. If it is None, the priors
            are in the order of the features of the data.
        by_feature: Whether a model uses the priors of `from_features` instead, as with `default`.

    Raises:
        TrustboError: If a prior has the wrong shape or support, the prior on a weight is not
            Normal, `concentration`, `x0_mean` or `x0_sd` is invalid, or the number of `features`
            is not that of the priors `beta`.

    Example:
        >>> priors = tb.models.Priors(beta0=dist.Beta(2.0, 4.0), beta=dist.Normal(0.0, 0.5))
        >>> model = tb.models.default_model(priors=priors)
    """

    beta0: Distribution = field(default_factory=partial(_built, dist.Beta, 2.0, 2.0))
    beta: Distribution = field(default_factory=partial(_built, dist.Normal, 0.0, 1.0))
    b: Distribution = field(default_factory=partial(_built, dist.Normal, 0.0, 0.5))
    delta_w: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.2))
    delta_v: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.2))
    f_v: Distribution | None = None
    delta_s: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.2))
    coupling: Distribution = field(default_factory=partial(_built, dist.Normal, 0.0, 0.1))
    tau: Distribution = field(default_factory=partial(_built, dist.HalfNormal, 0.3))
    concentration: float = 2.0
    x0_mean: float = 0.5
    x0_sd: float = 0.5
    stationary: bool = False
    features: Sequence[str] | None = None
    by_feature: bool = field(default=False, init=False)  # not copied to changed priors

    def _rows(self) -> Rows:
        return list(self.describe().items())

    def __post_init__(self) -> None:
        object.__setattr__(self, "stationary", require_switch("stationary", self.stationary))
        given = (one.name for one in fields(self) if one.type is Distribution)
        for name in (*given, *(["f_v"] if self.f_v is not None else [])):
            prior = getattr(self, name)
            if wanted := _wanted(name, prior):
                raise TrustboError(
                    f"the prior Priors.{name} must be {wanted}; got {as_text(prior)}."
                )

        numbers = {
            "concentration": require_positive("Priors.concentration", self.concentration),
            "x0_mean": require_finite("Priors.x0_mean", self.x0_mean),
            "x0_sd": require_positive("Priors.x0_sd", self.x0_sd, or_zero=True),
        }
        for name, number in numbers.items():
            object.__setattr__(self, name, number)

        if self.features is not None:
            features = require_order("Priors.features", self.features)
            features = require_list("Priors.features", features, str, "give a list of names")
            object.__setattr__(self, "features", tuple(features))
            self.coefficients(len(features))

    @staticmethod
    def default(family: str) -> "Priors":
        """Return the default priors for an observation family.

        A model with these priors uses those of `from_features` for the features of its data.

        The family `"beta_binomial"` has wider priors because trust is a logit: beta_m ~ N(0, 2^2),
        b ~ N(0, 1), delta_w ~ HalfNormal(0.5) and x_0 ~ N(0, 1.5^2).
        """
        return _default(family)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Rebuild priors from their `record`.

        Raises TrustboError if the class of a prior is not one of NumPyro's.
        """
        with own_settings():
            priors = cls(**{name: _from_plain(value) for name, value in record.items()})
        return priors

    def record(self) -> dict[str, Any]:
        """Return the priors as plain values, such as {"beta": {"Normal": {"loc": 0.0, ...}}}."""
        return {one.name: as_plain(getattr(self, one.name)) for one in fields(self) if one.init}

    @classmethod
    def from_features(cls, features: Sequence[str], family: str = "gaussian") -> "Priors":
        """Return the default priors for features with the given names.

        The feature `line_of_sight` predicts the contact rate. Stationary trust therefore has prior
        slope 1 in this feature, or in the mean of n such features (`line_of_sight_1`, ...). Divided
        by 1 - beta0, the weights of these features have the prior N(1 / n, 0.3^2 / n), other
        weights have N(0, 0.25^2), or N(-0.5, 0.25^2) for `threat`, and the intercept has N(0,
        0.15^2). Line of sight explains trust without much memory, so beta0 ~ Beta(2, 6). Most rates
        drawn from these priors are in [0, 1]. The floor of the noise has the prior f_v ~ Beta(1, 2)
        for Gaussian rates. For tick counts, the priors are scaled by 5, and a line of sight of 0.5
        predicts a rate of 0.5. If there is no such feature, the priors are those of `default`.
        """
        features = require_order("features", features)
        features = require_list("features", features, str, "give the names of the features")
        require_choice("family", family, FAMILIES)

        default = cls.default(family)
        is_sight = np.array([is_line_of_sight(name) for name in features])
        if not is_sight.any():
            return replace(default)

        n = int(is_sight.sum())
        slope, zero = FAMILIES[family].line_of_sight
        with own_flags():
            is_threat = np.array([name == THREAT for name in features])
            sd = np.where(is_sight, _SIGHT_SD / np.sqrt(n), _FEATURE_SD)
            return replace(
                default,
                beta0=_built(dist.Beta, *_MEMORY),
                beta=dist.Normal(slope * (is_sight / n - _LOST_TO_THREAT * is_threat), slope * sd),
                b=dist.Normal(-slope * zero, slope * _INTERCEPT_SD),
                f_v=_built(dist.Beta, *_FLOOR) if FAMILIES[family].gaussian else None,
                stationary=True,
                features=features,
            )

    @classmethod
    def for_cells(cls, family: str = "gaussian") -> "Priors":
        """Return priors for awareness of cells without line of sight, on the scale of contact.

        No feature predicts the contact rate, so the prior mean of stationary trust is 0.5 for any
        awareness. Divided by 1 - beta0, the weights have the prior N(0, 0.25^2), which allows
        either sign, and the intercept has N(0.5, 0.15^2). These are the standard deviations that
        `from_features` uses for features other than line of sight. For tick counts, the priors are
        scaled by 5, and a trust of 0 corresponds to a rate of 0.5.

        On the terrain of the paper's notebook, 81 % of the contact rates drawn from these priors
        are in [0, 1], compared with 24 % of those drawn from `default`.
        """
        require_choice("family", family, FAMILIES)
        slope, zero = FAMILIES[family].line_of_sight
        with own_flags():
            return replace(
                cls.default(family),
                beta=dist.Normal(0.0, slope * _FEATURE_SD),
                b=dist.Normal(slope * (_MIDDLE - zero), slope * _INTERCEPT_SD),
                stationary=True,
            )

    def in_order_of(self, features: Sequence[str]) -> "Priors":
        """Return the same priors for data with these features in this order.

        Raises TrustboError if the priors are for other features.
        """
        own = self.features
        if own is None:
            return self
        if sorted(own) != sorted(features):
            raise TrustboError(
                f"the priors are for the features {', '.join(own)}, but the data have "
                f"{', '.join(features)}; use Priors.from_features(features)."
            )

        beta = self.beta
        if beta.batch_shape:
            at = np.array([list(own).index(name) for name in features])
            mean, sd = self.moments("beta")
            with own_flags():
                beta = dist.Normal(mean[at], sd[at])
        return replace(self, beta=beta, features=None)

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and standard deviation of the Normal prior `name`."""
        prior: Any = getattr(self, name)
        return np.asarray(prior.loc, dtype=float), np.asarray(prior.scale, dtype=float)

    def coefficients(self, n_features: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the prior means and sds (feature + 1,) of the weights and, last, the intercept.

        Raises TrustboError if `beta` has priors for another number of features.
        """
        shape = self.beta.batch_shape
        if shape not in ((), (n_features,)):
            raise TrustboError(
                f"Priors.beta has priors for {shape[0]} features, but there are {n_features}."
            )

        pairs = zip(self.moments("beta"), self.moments("b"), strict=True)
        mean, sd = (np.append(np.broadcast_to(beta, n_features), b) for beta, b in pairs)
        return mean, sd

    def log_density(self, name: str, values: np.ndarray, inverse_gain: np.ndarray) -> np.ndarray:
        """Compute the log density of the prior `name` at each value of the parameter.

        Args:
            name: Name of a field.
            values: Parameter values with shape (...), or (..., feature) for `beta`.
            inverse_gain: Drift that raises stationary trust by 1, with a shape that broadcasts to
                that of the values; used only if `stationary` is true.
        """
        prior = getattr(self, name)
        if not self.stationary or name not in ("beta", "b"):
            return log_density(prior, values)

        # The density of `values` is the density of the stationary coefficients times the Jacobian.
        return log_density(prior, values / inverse_gain) - np.log(inverse_gain)

    def describe(self) -> dict[str, str]:
        """Describe each prior as text."""
        return {name: as_text(v) for name, v in self.record().items() if v is not None}


@cache
def _default(family: str) -> Priors:
    """See `Priors.default`; it takes JAX some time to make the distributions."""
    priors = Priors(**FAMILIES[family].priors())
    object.__setattr__(priors, "by_feature", True)
    return priors


def _wanted(name: str, prior: Any) -> str:
    """Return the requirement that a prior violates, or an empty string."""
    if not isinstance(prior, Distribution) or len(prior.shape()) > (name == "beta"):
        return "a scalar NumPyro distribution, e.g. Normal(0.0, 1.0)"

    if name in ("beta", "b", "coupling"):
        good = isinstance(prior, dist.Normal)
        wanted = (
            f"Normal, because the model integrates {name} out (for other priors, write a NumPyro "
            f"model; {see('howto/your-own-model')})"
        )
    elif name in ("beta0", "f_v"):
        low, high = (getattr(prior.support, f"{end}_bound", np.nan) for end in ("lower", "upper"))
        good = bool(np.all(low >= 0.0) and np.all(high <= 1.0))
        wanted = "on (0, 1), e.g. Beta(2.0, 2.0)"
    else:
        good = np.all(np.asarray(getattr(prior.support, "lower_bound", -np.inf)) >= 0.0)
        wanted = "on positive numbers, e.g. HalfNormal(0.2)"

    return "" if good else wanted


def as_plain(value: Any) -> Any:
    """Return a distribution as {class: arguments}, and anything else as plain values.

    The name of a class that `_from_plain` cannot rebuild includes that of its module.
    """
    if not isinstance(value, Distribution):
        return np.asarray(value).tolist()

    kind = type(value)
    name = kind.__name__
    arguments = {}
    for argument in inspect.signature(kind).parameters:
        given = getattr(value, argument, None)
        if argument != "validate_args" and given is not None:
            arguments[argument] = as_plain(given)
    if getattr(dist, name, None) is not kind or "transforms" in arguments:
        name = f"{kind.__module__}.{name}"
        arguments = {"values": [np.asarray(v).tolist() for v in jax.tree.leaves(value)]}
    return {name: arguments}


def _from_plain(value: Any) -> Any:
    """Return the distribution or the values of `as_plain`."""
    if not isinstance(value, Mapping):
        return value

    [(name, arguments)] = value.items()
    kind = getattr(dist, name, None)
    if not (isinstance(kind, type) and issubclass(kind, Distribution)):
        raise TrustboError(
            f"the prior {name} is not one of NumPyro's, and cannot be rebuilt from its arguments; "
            "give the model with model=."
        )
    given = {
        n: np.asarray(v) if isinstance(v, list) else _from_plain(v) for n, v in arguments.items()
    }
    return kind(**given)


def as_text(value: Any) -> str:
    """Format a distribution, its `as_plain` or a number as text."""
    if isinstance(value, Distribution):
        value = as_plain(value)
    if isinstance(value, Mapping):
        [(name, arguments)] = value.items()
        return f"{name}({', '.join(f'{n}={as_text(v)}' for n, v in arguments.items())})"
    if isinstance(value, list):
        return f"[{', '.join(as_text(v) for v in value)}]"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float | int) else repr(value)
