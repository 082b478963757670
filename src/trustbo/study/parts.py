"""Parts of a study as plain settings: their base, trust models and simulators."""

import importlib
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Protocol, Self

import numpy as np

from trustbo import models, simulation
from trustbo.errors import TrustboError, require_choice
from trustbo.models.model import require_model
from trustbo.models.record import model_to_record
from trustbo.workspace import Workspace


@dataclass(frozen=True, kw_only=True)
class Part:
    """Settings of one part of a run; JSON can hold them."""

    kind: ClassVar[str]
    REQUIRED: ClassVar[tuple[str, ...]] = ()
    """Settings without a default."""

    @classmethod
    def of(cls, what: str, settings: Mapping[str, Any]) -> Self:
        """Part with these settings; TrustboError if one is unknown, missing or impossible."""
        known = {f.name: f for f in fields(cls)}
        for name in settings:
            require_choice(f"setting of {what} ({cls.kind})", name, known)
        try:
            return cls(**{name: _frozen(value) for name, value in settings.items()})
        except TypeError as error:
            missing = [name for name in cls.REQUIRED if name not in settings]
            reason = f"needs {', '.join(missing)}" if missing else str(error)
            raise TrustboError(f"{what} ({cls.kind}): {reason}; got {dict(settings)}.") from None

    def settings(self) -> dict[str, Any]:
        """All settings, defaults included."""
        return {"kind": self.kind, **asdict(self)}

    def identity(self) -> dict[str, Any]:
        """Settings that the numbers depend on; by default all."""
        return self.settings()


def parts_of[P: Part](what: str, given: object, kinds: Iterable[type[P]]) -> dict[str, P]:
    """Make parts of these kinds, by their names in the study; `what` is the noun for messages.

    Given are names of kinds, or a mapping of names to settings, whose `kind` may be left out where
    the name is that of a kind. TrustboError: another type, or an unknown kind or setting.
    """
    by_kind = {kind.kind: kind for kind in kinds}
    if isinstance(given, str):
        given = (given,)
    if not isinstance(given, Mapping):
        names = given if isinstance(given, list | tuple) else ()
        given = {name: {} for name in names if isinstance(name, str)}
        if not given or len(given) != len(names):
            raise TrustboError(
                f"{what}s must be distinct names of kinds ({', '.join(by_kind)}), or a mapping of "
                f"your own names to settings; got {names or given!r}."
            )
    if not given:
        raise TrustboError(f"a study needs at least one {what}; got none.")
    parts = {}
    for name, settings in given.items():
        if isinstance(settings, Part):
            settings = settings.settings()
        if not isinstance(settings, Mapping | None):
            raise TrustboError(f"{what} {name!r} must be a mapping of settings; got {settings!r}.")
        own = dict(settings or {})
        kind = by_kind[require_choice(f"kind of {what}", own.pop("kind", str(name)), by_kind)]
        try:
            parts[str(name)] = kind.of(f"{what} {name!r}", own)
        except TrustboError as error:
            message = str(error)
            prefix = "" if repr(str(name)) in message else f"{what} {name!r}: "
            raise TrustboError(prefix + message) from None
    return parts


def imported(what: str, source: str) -> Any:
    """Object of a `"module:name"`; TrustboError: there is no such module or name."""
    module, _, name = source.partition(":")
    if os.getcwd() not in sys.path:  # where a program runs, there are the user's modules
        sys.path.append(os.getcwd())
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise TrustboError(f"{what} {source!r} cannot be imported: {error}.") from None


def _frozen(value: Any) -> Any:
    """Lists as tuples, so that parts can be hashed."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return tuple(_frozen(v) for v in value) if isinstance(value, list | tuple) else value


@dataclass(frozen=True, kw_only=True)
class Model(Part):
    """Trust model with its default priors, or those of `"zheng2023"`."""

    observation: str = "gaussian"
    response: str = "level"
    priors: str = "default"
    make: ClassVar[Callable[..., models.TrustModel]]

    def __post_init__(self) -> None:
        require_choice("priors", self.priors, ("default", "zheng2023"))
        self.model()

    def model(self) -> models.TrustModel:
        """Make the model."""
        own = asdict(self)
        vague = own.pop("priors") == "zheng2023"
        return self.make(models.Priors.zheng2023() if vague else None, **own)  # pyright: ignore


@dataclass(frozen=True, kw_only=True)
class Pooled(Model):
    """Settings of `models.PooledTrust`."""

    kind, make = "pooled", models.PooledTrust


@dataclass(frozen=True, kw_only=True)
class Places(Model):
    """Settings of `models.PooledTrust` with effects of places."""

    kind = "places"
    cells: bool = True
    bounds: bool = True

    @staticmethod
    def make(priors: models.Priors | None, **options: Any) -> models.TrustModel:
        """Make the model."""
        place = models.PlaceEffect(cells=options.pop("cells"), bounds=options.pop("bounds"))
        return models.PooledTrust(priors, place=place, **options)  # pyright: ignore


@dataclass(frozen=True, kw_only=True)
class Hierarchical(Model):
    """Settings of `models.HierarchicalTrust`."""

    kind, make = "hierarchical", models.HierarchicalTrust


@dataclass(frozen=True, kw_only=True)
class Coupled(Model):
    """Settings of `models.CoupledTrust`."""

    kind, make = "coupled", models.CoupledTrust
    inter_robot: str = "full"


@dataclass(frozen=True, kw_only=True)
class Own(Part):
    """Trust model of your own: itself, or the `"module:name"` of it or of what makes it."""

    kind, REQUIRED = "own", ("source",)
    source: Any

    def __post_init__(self) -> None:
        self.model()

    def model(self) -> models.TrustModel:
        """Give the model."""
        given = self.source
        found = imported("model", given) if isinstance(given, str) else given
        made: Any = found
        if callable(found) and not isinstance(found, models.TrustModel):
            made = found()
        require_model(made)
        return made

    def identity(self) -> dict[str, Any]:
        """Settings that the numbers depend on."""
        return {"kind": self.kind, "model": model_to_record(self.model())}


NAMED_MODELS = (Pooled, Places, Hierarchical, Coupled)
"""Models that a name alone tells."""
MODELS = (*NAMED_MODELS, Own)


class Place(Protocol):
    """Terrain of a run, as far as a simulator needs to know it."""

    def workspace(self) -> Workspace:
        """Workspace of the paths."""
        ...


@dataclass(frozen=True, kw_only=True)
class Simulating(Part, ABC):
    """Simulator that runs the paths."""

    @abstractmethod
    def simulator(self, place: Place) -> simulation.Simulator:
        """Make the simulator."""

    def truth(self, place: Place) -> simulation.Truth | None:
        """Find its truth; None where nobody asked for it."""
        return simulation.Truth.of(self.simulator(place))


@dataclass(frozen=True, kw_only=True)
class Kinematic(Simulating):
    """Settings of `simulation.KinematicSimulator`, which needs a terrain.

    By default sight is the workspace's; `known_truth` asks for true regret, see `simulation.Truth`.
    """

    kind = "kinematic"
    sight: str | None = None
    tick: float = 0.5
    bound_timeout: float = 600.0
    bounding: str = "successive"
    known_truth: bool = False

    def simulator(self, place: Place) -> simulation.Simulator:
        """Make the simulator."""
        own = asdict(self)
        del own["known_truth"]
        return simulation.KinematicSimulator(place.workspace(), **own)

    def truth(self, place: Place) -> simulation.Truth | None:
        """Find its truth; None where nobody asked for it."""
        return super().truth(place) if self.known_truth else None


@dataclass(frozen=True, kw_only=True)
class FromModel(Simulating):
    """Settings of `simulation.ModelSimulator`: the pooled model with these true parameters."""

    kind = "model"
    REQUIRED = ("beta0", "beta", "b", "delta_w", "delta_v")
    beta0: float
    beta: tuple[float, ...]
    b: float
    delta_w: float
    delta_v: float
    x0_mean: float = 0.5
    x0_sd: float = 0.5
    observation: str = "gaussian"
    n_ticks: int | None = None

    def simulator(self, place: Place) -> simulation.Simulator:
        """Make the simulator."""
        own = asdict(self)
        n_ticks = own.pop("n_ticks")
        model = models.PooledTrust(observation=own.pop("observation"))
        truth = models.TrustParams(**own | {"beta": np.array(self.beta, dtype=float)})
        return simulation.ModelSimulator(place.workspace(), truth, model, n_ticks=n_ticks)


SIMULATORS = (Kinematic, FromModel)
