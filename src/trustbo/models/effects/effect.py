"""The protocol of effects: columns that add to the drift of trust, and their weights' prior.

The drift of a slot is u = U c, with coefficients c that are Gaussian given hyperparameters theta. A
new effect is a frozen dataclass in a file of its own with the methods of `Effect`; engine,
samplers, posteriors and plans need no more.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.distributions import Distribution

from trustbo.data import Mission, is_line_of_sight
from trustbo.models.backend import namespace
from trustbo.models.slots import Slots
from trustbo.workspace import Workspace

Theta = Mapping[str, Any]
"""Hyperparameters by name, each (point, ...), and `rest`, the drift by which stationary trust rises
by 1: 1 - beta0 where trust itself lasts; (point,), or (point, robot)."""

LEAST = 1e-4
"""Least sd of an effect: precisions stay finite, and a smaller effect is none."""

EFFECTS: dict[str, type["Effect"]] = {}
"""Classes of effects by name, to read models from files."""


class NextMission(NamedTuple):
    """The mission that follows those of a posterior."""

    n_before: int
    """Number of missions of the posterior."""
    features: Sequence[str]
    n_robots: int
    rng: np.random.Generator | None
    """Random numbers to draw effects with; None for expected ones."""

    def by_sight(self, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Drift of slopes (draw, robot) times line of sight, as `Effect.ahead` returns it."""
        weights = np.zeros((*slope.shape, len(self.features)))
        sight = [m for m, name in enumerate(self.features) if is_line_of_sight(name)]
        if not sight:
            return weights, slope
        weights[:, :, sight] = slope[..., None] / len(sight)
        return weights, np.zeros_like(slope)


class Effect:
    """An effect on the drift, with the settings of its prior.

    Hyperparameters are sds with half-normal priors, whose scales are the fields of these names;
    other effects override `hyperpriors`. A class with a noun is known to files by its name.
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

    def named(self, c: np.ndarray, theta: Theta, slots: Slots) -> dict[str, np.ndarray]:
        """Variables by name, each (draw, ...), of coefficients c (draw, column)."""
        raise NotImplementedError

    def coefficients(
        self, values: Mapping[str, np.ndarray], theta: Theta, slots: Slots
    ) -> np.ndarray:
        """Coefficients (draw, column) of variables by name: the inverse of `named`."""
        raise NotImplementedError

    def ahead(
        self, values: Mapping[str, np.ndarray], theta: Theta, mission: NextMission
    ) -> tuple[np.ndarray, np.ndarray]:
        """Drift of the next mission: weights (draw, robot, feature), intercept (draw, robot).

        The axis robot is of length 1 where all robots have the same.

        Args:
            values: Variables by name, each (draw, ...).
            theta: Hyperparameters, each (draw,).
            mission: The next mission; with random numbers, effects of it alone are drawn.
        """
        raise NotImplementedError

    def hyperpriors(self) -> dict[str, Distribution]:
        """Priors of the hyperparameters, by name."""
        return {name: dist.HalfNormal(getattr(self, name)) for name in self.names}

    def slots(
        self, slots: Slots, missions: Sequence[Mission], workspace: Workspace | None
    ) -> Slots:
        """Slots of missions with what the columns need beside rates and features."""
        return slots

    def to_record(self) -> dict[str, Any]:
        """Class and fields by name, as JSON has them: a tuple is a list."""
        return {"kind": type(self).__name__, **json.loads(json.dumps(asdict(self)))}  # pyright: ignore[reportArgumentType]


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
