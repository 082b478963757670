"""Base class of effects, which add columns with Gaussian coefficients to the drift of trust.

The drift of all rates is u = U c, where the coefficients c are Gaussian given the hyperparameters
theta. To add an effect, write a frozen dataclass with the methods of `Effect`. Inference and
planning need no change, unless `design` needs data that `Observations` does not have.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpy.random import Generator
from numpyro.distributions import Distribution

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_positive, require_switch
from trustbo.models.observations import Observations
from trustbo.models.scores import Pair
from trustbo.statespace.matrices import namespace
from trustbo.workspace import Workspace

Theta = Mapping[str, Any]
"""Hyperparameters (point, ...) by name. `inverse_gain`, with shape (point,) or (point, robot), is
the drift that raises stationary trust by 1. It equals 1 - beta0 if `memory` is "level"."""

Values = Mapping[str, np.ndarray]
"""Variables (draw, ...) of an effect by name."""

LEAST = 1e-4
"""Smallest standard deviation of an effect, so that precisions stay finite."""

EFFECTS: dict[str, type["Effect"]] = {}
"""Effect classes by name, to read models from files."""


class SampledEffect(NamedTuple):
    """An effect within a NumPyro function, whose hyperparameters are variables of the function."""

    effect: "Effect"
    values: dict[str, Any]
    """Hyperparameters by name."""


class Effect:
    """Base class of an effect on the drift, with the settings of its prior.

    By default, hyperparameters are standard deviations with half-normal priors. The fields of the
    same names are the scales of these priors. Override `hyperpriors` for other priors. Classes with
    a `group` can be read from files.

    Raises:
        TrustboError: If a prior scale is not positive.

    Example:
        >>> [effect.group for effect in tb.models.default_model().effects]
        ['places', 'robots']
        >>> isinstance(tb.models.PlaceEffect(), tb.models.Effect)
        True
    """

    names: ClassVar[tuple[str, ...]] = ()
    """Names of the hyperparameters that are always positive numbers."""
    group: ClassVar[str] = ""
    """Plural name of the objects with the effect; also the name of the group in a posterior."""
    variables: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Axes of each variable of the effect by name, after (chain, draw)."""
    coords: ClassVar[Mapping[str, Sequence[Any]]] = {}
    """Labels along the axes of the variables other than mission, bound, robot and feature."""

    def __init_subclass__(cls) -> None:
        if cls.group:
            EFFECTS[cls.__name__] = cls

    def __post_init__(self) -> None:
        for name, value in list(vars(self).items()):
            if name in self.names:
                number = require_positive(f"{type(self).__name__}.{name}", value)
                object.__setattr__(self, name, number)

    def design(self, observations: Observations) -> Any:
        """Return the design matrix (observation, column), which is sparse.

        An observation is a (mission, bound, robot), flattened.
        """
        raise NotImplementedError

    def prior(self, theta: Theta, observations: Observations) -> tuple[Any, list[Any]]:
        """Return the prior on the coefficients at each theta, in NumPy or JAX.

        Returns:
            The mean (point, column), or None if it is 0, and a list of precisions for consecutive
            groups of columns. Each has shape (point, k, k), or (point, k) for independent columns.
        """
        raise NotImplementedError

    def to_variables(self, c: np.ndarray, theta: Theta, observations: Observations) -> Values:
        """Convert coefficients c (draw, column) to variables by name."""
        raise NotImplementedError

    def coefficients(self, values: Values, theta: Theta, observations: Observations) -> np.ndarray:
        """Convert variables back to coefficients (draw, column); the inverse of `to_variables`."""
        raise NotImplementedError

    def predict_next(
        self, values: Values, theta: Theta, n: int, rng: Generator | None
    ) -> np.ndarray:
        """Return the effect (draw, robot) on drift per unit of line of sight after n missions.

        If `rng` is given, the effect is drawn at random; otherwise, its expected value is returned.
        By default, the effect is 0.
        """
        return np.zeros((len(theta["inverse_gain"]), 1))

    def hyperpriors(self) -> dict[str, Distribution]:
        """Return the priors on the hyperparameters by name."""
        return {name: dist.HalfNormal(getattr(self, name)) for name in self.names}

    def sample(self) -> SampledEffect:
        """Sample the hyperparameters within a NumPyro function, for `ContactRate(effects=)`.

        Raises:
            TrustboError: Within a `numpyro.plate`, in which each member would have its own values.

        Example:
            >>> places = tb.models.PlaceEffect().sample()
            >>> robots = tb.models.RobotEffect().sample()
            >>> rates = tb.models.ContactRate(
            ...     drift, beta0, delta_w, delta_v, n_ticks=n_ticks, effects=[places, robots]
            ... )
        """
        values = {name: numpyro.sample(name, prior) for name, prior in self.hyperpriors().items()}
        if any(np.ndim(value) for value in values.values()):
            name = type(self).__name__
            raise TrustboError(
                f"{name}.sample() was called within a numpyro.plate; call it before the plate, "
                "because its standard deviations are the same for all missions, bounds and robots."
            )
        return SampledEffect(self, values)

    def for_features(self, features: Sequence[str], *, of_rates: bool) -> Self:
        """Return the effect for these features; `of_rates` is false if trust is a logit."""
        require_switch("of_rates", of_rates)
        return self

    def pairs(self, observations: Observations) -> list[Pair]:
        """Return the pair of standard deviations that add up to one variance, if any, in a list.

        Samplers then use their common size as a coordinate; see `scores`.
        """
        priors = self.hyperpriors()
        sds = [name for name in self.names if isinstance(priors[name], dist.HalfNormal)]
        if len(sds) != 2:
            return []
        return [Pair(sds[0], sds[1])]

    def add_data(
        self, observations: Observations, missions: Sequence[Mission], on: Workspace | None
    ) -> Observations:
        """Add the data that `design` needs; `on` is the workspace, if known."""
        return observations


def sample_coefficients(effects: Sequence[Effect], theta: Theta, observations: Observations) -> Any:
    """Sample all coefficients (column,) at one point theta within a NumPyro program."""
    coefficients = []
    for effect in effects:
        mean, parts = effect.prior(theta, observations)
        label = effect.group or "weights"
        start = 0
        for i, part in enumerate(parts):
            Q = part[0] if part.ndim == 3 else namespace(part).diag(part[0])
            white = dist.MultivariateNormal(np.zeros(len(Q)), precision_matrix=Q)
            c: Any = numpyro.sample(f"{label}_{i}", white)
            coefficients.append(c if mean is None else c + mean[0, start : start + len(Q)])
            start += len(Q)

    return jnp.concatenate(coefficients)
