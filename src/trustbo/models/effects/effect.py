"""Effects: columns that add to the drift of trust, and their weights' prior.

The drift of a bound is u = sum_j U_j c_j, c Gaussian given hyperparameters theta. A chain is one
robot in one mission; a slot is one bound of a chain. A new effect is a class after `Effect`, and
its columns at the slots of some missions one with the members of `Group`.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution
from scipy import sparse

from trustbo.data import is_line_of_sight
from trustbo.errors import TrustboError
from trustbo.models.backend import namespace, own_settings
from trustbo.models.place import Visited
from trustbo.models.priors_numpy import half_normal, log_prob
from trustbo.stacking import MissionBatch

Theta = Mapping[str, np.ndarray]
"""Hyperparameters by name, each (point,): beta0, delta_w, delta_v, those of effects, and `rest`,
the drift by which stationary trust rises by 1: 1 - beta0 where trust itself is carried on."""

MEMORIES = ("level", "deviation")
"""Lasting from one bound to the next: trust, or its deviation from what effects expect."""

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

    @classmethod
    def every(
        cls, batch: MissionBatch, n_missions: int, features: Sequence[str], places: Visited | None
    ) -> Self:
        """All bounds of all robots in the first missions of a batch, as if measured."""
        rates = np.zeros_like(batch.contact_rate)
        return cls.of(batch._replace(contact_rate=rates), n_missions, features, None, places)

    @property
    def line_of_sight(self) -> np.ndarray:
        """Predicted contact (chain, bound), 1 where no feature predicts it."""
        return self.z[:, :, list(self.sight)].mean(2) if self.sight else np.ones(self.y.shape)


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


class Effect(ABC):
    """An effect on the drift, with the settings of its prior.

    Subclasses are frozen dataclasses. Those that a model may have are registered, see `register`,
    and have all members; the evidence takes `names`, `scales`, `hyperpriors` and `group`.
    Hyperparameters are sds with half-normal priors, whose scales are the fields of these names;
    others override `scales` and `hyperpriors`.
    """

    names: ClassVar[tuple[str, ...]] = ()
    """Names of the hyperparameters."""
    noun: ClassVar[str] = ""
    """Plural of what has the effects, also the name of their group in a posterior."""
    variables: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Axes, behind (chain, draw), of each variable of that group."""
    coords: ClassVar[Mapping[str, Sequence[Any]]] = {}
    """Labels of axes other than those of missions, robots and features."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, list):  # of a file; a model's settings are hashed
                object.__setattr__(self, name, tuple(value))

    @abstractmethod
    def group(self, slots: Slots) -> Group:
        """Columns at the slots of some missions; of a model's effect, a `ModelGroup`."""

    def ahead(
        self, values: Mapping[str, np.ndarray], theta: Theta, mission: NextMission
    ) -> tuple[np.ndarray, np.ndarray]:
        """Drift of the next mission: weights (draw, robot, feature), intercept (draw, robot).

        The axis robot is of length 1 where all robots have the same.

        Args:
            values: Variables by name, each (draw, ...).
            theta: Hyperparameters, each (draw,).
            mission: The next mission; a bad day, which it may or may not have, is drawn.
        """
        raise NotImplementedError

    def scales(self, scores: np.ndarray) -> dict[str, np.ndarray]:
        """Hyperparameters by name of normal scores (point, hyperparameter), maybe of JAX."""
        values = half_normal(scores, np.array([getattr(self, name) for name in self.names]))
        return dict(zip(self.names, values.T, strict=True))

    def hyperpriors(self) -> dict[str, Distribution]:
        """Priors of the hyperparameters, by name."""
        return {name: dist.HalfNormal(getattr(self, name)) for name in self.names}

    def draw(self, n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Draws of the hyperparameters from their prior, each (draw,), by name."""
        return self.scales(rng.standard_normal((n, len(self.names))))

    def log_prior(self, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Log prior density of the hyperparameters of draws, by name."""
        with own_settings():
            priors = self.hyperpriors()
        return {name: log_prob(prior, sites[name]) for name, prior in priors.items()}

    def in_short(self) -> str:
        """Text of what the effect is of."""
        return f"of {self.noun}"

    def to_record(self) -> dict[str, Any]:
        """Fields by name, as JSON has them: a tuple is a list."""
        return json.loads(json.dumps(asdict(self)))  # pyright: ignore[reportArgumentType]


class ModelGroup(Group, Protocol):
    """Columns of an effect that a model may have."""

    def coefficients(self, values: Mapping[str, np.ndarray], theta: Theta) -> np.ndarray:
        """Coefficients (draw, column) of effects by name: the inverse of `name`."""
        ...


class Independent(NamedTuple):
    """Columns with independent coefficients of one sd, in units of stationary trust."""

    columns: Columns
    variable: str
    sd: str | float
    """The sd, or the name of the hyperparameter that is it."""
    shape: tuple[int, ...] = ()
    """Shape of the variable behind (draw,), as many numbers as there are columns."""
    joined = ()
    fades = False

    def prior(self, theta: Theta) -> Prior:
        """See `Group.prior`."""
        xp: Any = namespace(theta["rest"])
        sd = theta[self.sd] if isinstance(self.sd, str) else self.sd
        shape = len(theta["rest"]), self.columns.shape[1]
        sds = xp.broadcast_to((xp.abs(theta["rest"]) * sd)[:, None], shape)
        return Prior(np.zeros(shape), sds)

    def name(self, c: np.ndarray, theta: Theta, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """See `Group.name`."""
        return {self.variable: (c / theta["rest"][:, None]).reshape(len(c), *self.shape)}

    def coefficients(self, values: Mapping[str, np.ndarray], theta: Theta) -> np.ndarray:
        """See `ModelGroup.coefficients`."""
        d = values[self.variable]
        return theta["rest"][:, None] * d.reshape(len(d), -1)


EFFECTS: dict[str, type[Effect]] = {}
"""Effects that models may have, by the names of their classes."""


def register[Kind: Effect](cls: type[Kind]) -> type[Kind]:
    """Let models have effects of a class, also those read from files.

    Raises:
        TrustboError: The class lacks a noun or variables, or shares a noun, a hyperparameter or a
            variable with another.
    """
    if not (cls.noun and cls.variables):
        raise TrustboError(f"effect {cls.__name__} needs a noun and variables; got none.")
    names = {cls.noun, *cls.names, *cls.variables}
    for other in (one for one in EFFECTS.values() if one.__name__ != cls.__name__):
        if shared := names & (_TAKEN | {other.noun, *other.names, *other.variables}):
            raise TrustboError(
                f"effect {cls.__name__} has {sorted(shared)[0]!r}, which another has; rename it."
            )
    EFFECTS[cls.__name__] = cls
    return cls


_TAKEN = {
    "posterior", "sample_stats", "prior", "places", "latent", "hazard", "tau_s", "tau_e",
    "length_scale", "place", "place_bound", "beta0", "beta", "b", "delta_w", "delta_v",
}  # fmt: skip


def drift_of(
    effect: Effect, values: Mapping[str, np.ndarray], theta: Theta, slots: Slots
) -> np.ndarray:
    """Drift (draw, mission, bound, robot) of effects by name at some slots."""
    group: Any = effect.group(slots)
    u = (group.columns @ group.coefficients(values, theta).T).T
    drift = np.zeros((len(u), slots.n_missions, slots.n_robots, slots.y.shape[1]))
    drift[:, slots.mission, slots.robot] = u.reshape(len(u), *slots.y.shape)
    return np.swapaxes(drift, 2, 3)


def draw_effects(
    effect: Effect, theta: Theta, slots: Slots, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Effects by name, each (draw, ...), from their prior at theta (draw,)."""
    group = effect.group(slots)
    prior = group.prior(theta)
    e = rng.standard_normal(prior.sd.shape)
    for columns, root in zip(group.joined, prior.roots, strict=True):
        e[:, columns] = np.einsum("nij,nj->ni", dense_root(root), e[:, columns])
    return group.name(prior.mean + prior.sd * e, theta, rng)


def scales_of(effects: Sequence[Effect], scores: Any) -> dict[str, Any]:
    """Hyperparameters of all effects by name, of scores (point, ...) in their order."""
    theta, start = {}, 0
    for effect in effects:
        stop = start + len(effect.names)
        theta |= effect.scales(scores[:, start:stop])
        start = stop
    return theta


def rest_of(beta0: Any, memory: str) -> Any:
    """Drift by which stationary trust rises by 1, of the shape of beta0."""
    return 1.0 - beta0 if memory == "level" else 0.0 * beta0 + 1.0


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
    return xp.where(some, (sd / xp.where(some, whole, 1.0)) ** 2, 0.0)  # squares may underflow


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
