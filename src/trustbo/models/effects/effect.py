"""The protocol of effects: columns that add to the drift of trust, and their weights' prior.

The drift of a slot is u = U c, with coefficients c that are Gaussian given hyperparameters theta. A
new effect is a frozen dataclass in a file of its own with the methods of `Effect`; engine,
samplers, posteriors and plans need no more.
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
"""Least sd of an effect: precisions stay finite, and a smaller effect is none."""

EFFECTS: dict[str, type["Effect"]] = {}
"""Classes of effects by name, to read models from files."""


class Effect:
    """An effect on the drift, with the settings of its prior.

    Hyperparameters are sds with half-normal priors, whose scales are the fields of these names;
    other effects override `hyperpriors`. A class with a noun is known to files by its name.

    Raises:
        TrustboError: A field of the name of a hyperparameter is not positive.
    """

    names: ClassVar[tuple[str, ...]] = ()
    """Names of the hyperparameters."""
    noun: ClassVar[str] = ""
    """Plural of what has the effects, also the name of their group in a posterior."""
    variables: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Axes, behind (chain, draw), of each variable of that group."""
    coords: ClassVar[Mapping[str, Sequence[Any]]] = {}
    """Labels of axes other than those of missions, robots and features."""

    def __init_subclass__(cls) -> None:
        if cls.noun:
            EFFECTS[cls.__name__] = cls

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in self.names:
                require_positive(f"{type(self).__name__}.{name}", value)

    def columns(self, slots: Slots) -> Any:
        """Sparse matrix (slot, column); slots are (mission, bound, robot), raveled."""
        raise NotImplementedError

    def prior(self, theta: Theta, slots: Slots) -> tuple[Any, list[Any]]:
        """Prior of the coefficients at each theta, in NumPy or JAX.

        Returns:
            Mean (point, column), None for 0, and precisions of consecutive columns, (point, k, k)
            or (point, k) of independent ones.
        """
        raise NotImplementedError

    def named(self, c: np.ndarray, theta: Theta, slots: Slots) -> Values:
        """Variables of coefficients c (draw, column)."""
        raise NotImplementedError

    def coefficients(self, values: Values, theta: Theta, slots: Slots) -> np.ndarray:
        """Coefficients (draw, column) of variables: the inverse of `named`."""
        raise NotImplementedError

    def ahead(self, values: Values, theta: Theta, n: int, rng: Generator | None) -> np.ndarray:
        """Slope (draw, robot) in line of sight of the drift of the mission after n, by default 0.

        With random numbers, effects of that mission alone are drawn; else they are the expected.
        """
        return np.zeros((len(theta["rest"]), 1))

    def hyperpriors(self) -> dict[str, Distribution]:
        """Priors of the hyperparameters, by name."""
        return {name: dist.HalfNormal(getattr(self, name)) for name in self.names}

    def slots(self, slots: Slots, missions: Sequence[Mission], on: Workspace | None) -> Slots:
        """Slots of missions, on a workspace if known, with all that the columns need."""
        return slots


def sample_columns(effects: Sequence[Effect], theta: Theta, slots: Slots) -> Any:
    """Sample statements of all coefficients (column,); theta has one point."""
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
