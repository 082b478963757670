"""The protocol of an effect: columns that add to the drift of trust, and their weights' prior.

The drift of a bound is u = sum_j U_j c_j, c Gaussian given hyperparameters theta. A chain is one
robot in one mission; a slot is one bound of a chain. A new effect is a class with the methods of
`Effect`, and its columns at the slots of some missions one with those of `Group`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpyro.distributions import Distribution
from scipy import sparse

from trustbo.data import is_line_of_sight
from trustbo.models.backend import namespace
from trustbo.models.place import Visited
from trustbo.stacking import MissionBatch

Theta = Mapping[str, np.ndarray]
"""Hyperparameters by name, each (point,): beta0, delta_w, delta_v, those of effects, and `rest`,
the drift by which stationary trust rises by 1: 1 - beta0 where trust itself is carried on."""

Columns = Any
"""A `scipy.sparse.csr_array`, whose stubs have neither shape nor products."""


class Slots(NamedTuple):
    """Rates and features of chains with a measured rate and a positive weight."""

    y: np.ndarray  # (chain, bound), NaN where not measured
    z: np.ndarray  # (chain, bound, feature)
    mission: np.ndarray  # (chain,)
    robot: np.ndarray  # (chain,)
    weight: np.ndarray  # (chain,), of the mission
    n_missions: int
    n_robots: int
    sight: tuple[int, ...] = ()
    """Features that are predicted contact rates."""
    places: Visited | None = None
    n_ticks: np.ndarray | None = None  # (chain, bound), NaN where not known

    @classmethod
    def of(
        cls,
        batch: MissionBatch,
        n_missions: int,
        features: Sequence[str] = (),
        weight: np.ndarray | None = None,
        places: Visited | None = None,
    ) -> Self:
        """Chains of the first missions of a batch; each counts by the weight of its mission."""
        y = np.swapaxes(batch.contact_rate[:n_missions], 1, 2)
        z = np.swapaxes(batch.awareness[:n_missions], 1, 2)
        longest = int(np.flatnonzero(~np.isnan(y).all((0, 1)))[-1]) + 1
        y, z = y[:, :, :longest], z[:, :, :longest]
        weight = np.ones(n_missions) if weight is None else weight[:n_missions]
        mission, robot = np.nonzero(~np.isnan(y).all(2) & (weight[:, None] > 0.0))
        sight = tuple(m for m, name in enumerate(features) if is_line_of_sight(name))
        y, z = y[mission, robot], z[mission, robot]
        sizes = n_missions, batch.contact_rate.shape[2]
        rates = batch.contact_rate[:n_missions]
        n_ticks = np.swapaxes(np.broadcast_to(batch.n_ticks[:n_missions], rates.shape), 1, 2)
        n_ticks = n_ticks[mission, robot, :longest]
        return cls(y, z, mission, robot, weight[mission], *sizes, sight, places, n_ticks)


class Fading(NamedTuple):
    """Correlation share rho^|i - j| + (1 - share) [i = j] of columns i and j."""

    share: np.ndarray  # (point,)
    rho: float
    size: int

    def correlation(self) -> np.ndarray:
        """Correlations (point, column, column)."""
        i = np.arange(self.size)
        eye = np.eye(self.size)
        return self.share[:, None, None] * (self.rho ** np.abs(i[:, None] - i) - eye) + eye


class Prior(NamedTuple):
    """Gaussian prior of a group's coefficients at some theta."""

    mean: np.ndarray  # (point, column)
    sd: np.ndarray  # (point, column), may be 0
    roots: Sequence[np.ndarray | Fading] = ()
    """Cholesky factors (point, column, column) of the correlations of the columns joined, or the
    correlations themselves where they fade."""


class Group(Protocol):
    """Columns of an effect at the slots of some missions."""

    @property
    def columns(self) -> Columns:
        """Matrix (slot, column), slots being chains by bounds."""
        ...

    @property
    def joined(self) -> Sequence[slice]:
        """Columns that depend on each other a priori; all others are independent."""
        ...

    @property
    def fades(self) -> bool:
        """Whether the correlations of the columns joined are `Fading`."""
        ...

    def prior(self, theta: Theta) -> Prior:
        """Prior of the coefficients at each theta, which may be arrays of JAX."""
        ...

    def name(self, c: np.ndarray, theta: Theta, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Effects by name, each (draw, ...), of coefficients c (draw, column) and theta (draw,)."""
        ...


class Effect(Protocol):
    """An effect in a model."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the hyperparameters."""
        ...

    def scales(self, scores: np.ndarray) -> dict[str, np.ndarray]:
        """Hyperparameters by name of normal scores (point, hyperparameter), maybe of JAX."""
        ...

    def hyperpriors(self) -> dict[str, Distribution]:
        """Priors of the hyperparameters, by name."""
        ...

    def group(self, slots: Slots) -> Group:
        """Columns at the slots of some missions."""
        ...


def dense_root(root: Any) -> Any:
    """Cholesky factor (point, column, column) of a correlation, in NumPy or JAX."""
    if not isinstance(root, Fading):
        return root
    xp: Any = namespace(root.share)
    return xp.linalg.cholesky(root.correlation())


def share_of(sd: Any, whole: Any) -> Any:
    """Share of a variance (sd / whole)^2, 0 where the whole is 0; in NumPy or JAX."""
    xp: Any = namespace(whole)
    some = whole > 0.0
    return xp.where(some, sd**2 / xp.where(some, whole, 1.0) ** 2, 0.0)


def hypot(a: Any, b: Any) -> Any:
    """Sd of a sum of independent variables of two sds, in NumPy or JAX; slope 0 where both are."""
    xp: Any = namespace(a)
    if xp is np:
        return np.hypot(a, b)
    square = a**2 + b**2
    some = square > 0.0
    return xp.where(some, xp.sqrt(xp.where(some, square, 1.0)), 0.0)


def dense_columns(values: np.ndarray) -> Columns:
    """Sparse matrix (slot, column) of values (chain, bound, column)."""
    return sparse.csr_array(values.reshape(-1, values.shape[2]))
