"""The protocol of effects: columns added to the drift of trust, and the prior of their weights.

The drift of a slot is u = U c, with coefficients c that are Gaussian given hyperparameters theta.
To add an effect, write a frozen dataclass with the methods of `Effect`; inference and planning need
no change.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpy.random import Generator
from numpyro.distributions import Distribution

from trustbo.data import Mission
from trustbo.errors import require_positive
from trustbo.models.backend import namespace
from trustbo.models.slots import Slots
from trustbo.workspace import Workspace

Theta = Mapping[str, Any]
"""Hyperparameters by name, each (point, ...), and `rest`, the drift by which stationary trust rises
by 1: 1 - beta0 where trust itself lasts; (point,), or (point, robot)."""

Values = Mapping[str, np.ndarray]
"""Variables of an effect by name, each (draw, ...)."""

LEAST = 1e-4
"""Smallest sd of an effect, which keeps precisions finite."""

EFFECTS: dict[str, type["Effect"]] = {}
"""Classes of effects by name, to read models from files."""


class Effect:
    """An effect on the drift, with the settings of its prior.

    By default, hyperparameters are sds with half-normal priors, whose scales are the fields of the
    same names; otherwise override `hyperpriors`. Classes with a `noun` can be read from files.

    Raises:
        TrustboError: If the scale of a hyperparameter is not positive.
    """

    names: ClassVar[tuple[str, ...]] = ()
    """Names of the hyperparameters."""
    noun: ClassVar[str] = ""
    """Plural noun for the effect, also the name of its group in a posterior."""
    variables: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Axes after (chain, draw) of each variable of this group."""
    coords: ClassVar[Mapping[str, Sequence[Any]]] = {}
    """Labels of axes other than missions, robots and features."""

    def __init_subclass__(cls) -> None:
        if cls.noun:
            EFFECTS[cls.__name__] = cls

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in self.names:
                require_positive(f"{type(self).__name__}.{name}", value)

    def columns(self, slots: Slots) -> Any:
        """Return a sparse matrix (slot, column); slots are (mission, bound, robot), raveled."""
        raise NotImplementedError

    def prior(self, theta: Theta, slots: Slots) -> tuple[Any, list[Any]]:
        """Return the prior of the coefficients at each theta, in NumPy or JAX.

        Returns:
            Mean (point, column), None for 0, and precisions of consecutive columns, (point, k, k),
            or (point, k) if independent.
        """
        raise NotImplementedError

    def named(self, c: np.ndarray, theta: Theta, slots: Slots) -> Values:
        """Convert coefficients c (draw, column) to variables by name."""
        raise NotImplementedError

    def coefficients(self, values: Values, theta: Theta, slots: Slots) -> np.ndarray:
        """Convert variables to coefficients (draw, column), the inverse of `named`."""
        raise NotImplementedError

    def ahead(self, values: Values, theta: Theta, n: int, rng: Generator | None) -> np.ndarray:
        """Return the slope (draw, robot) of drift in line of sight after mission n; 0 by default.

        With `rng`, effects specific to that mission are drawn; otherwise they are expectations.
        """
        return np.zeros((len(theta["rest"]), 1))

    def hyperpriors(self) -> dict[str, Distribution]:
        """Return the priors of the hyperparameters, by name."""
        return {name: dist.HalfNormal(getattr(self, name)) for name in self.names}

    def slots(self, slots: Slots, missions: Sequence[Mission], on: Workspace | None) -> Slots:
        """Add the data that the columns need to slots of missions, on a workspace if given."""
        return slots


def sample_columns(effects: Sequence[Effect], theta: Theta, slots: Slots) -> Any:
    """Sample all coefficients (column,) in a NumPyro program; theta has one point."""
    columns = []
    for effect in effects:
        mean, parts = effect.prior(theta, slots)
        label = effect.noun or "weights"
        start = 0
        for i, part in enumerate(parts):
            Q = part[0] if part.ndim == 3 else namespace(part).diag(part[0])
            white = dist.MultivariateNormal(np.zeros(len(Q)), precision_matrix=Q)
            c: Any = numpyro.sample(f"{label}_{i}", white)
            columns.append(c if mean is None else c + mean[0, start : start + len(Q)])
            start += len(Q)
    return jnp.concatenate(columns)
