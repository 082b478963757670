"""Events: changes of the world in some missions, one class for each kind."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
from rasterio.features import geometry_mask
from rasterio.transform import Affine
from scipy.signal import lfilter
from scipy.special import ndtr

from trustbo.errors import TrustboError, require_choice, require_positive, require_whole
from trustbo.team import Team
from trustbo.workspace.surface import Surface

if TYPE_CHECKING:
    from trustbo.simulation.world import World

KINDS = ("jam", "forbid")


class Event:
    """Change of the world from a first mission to a last one; missions count from 0.

    A kind of event is a frozen dataclass with the fields `first_mission` and `last_mission`, and
    the method `change`.
    """

    first_mission: int
    last_mission: int | None

    def acts_in(self, mission: int) -> bool:
        """Whether the event acts in a mission."""
        last = self.last_mission
        return self.first_mission <= mission and (last is None or mission <= last)

    @property
    def settings(self) -> dict[str, Any]:
        """Kind and settings, as JSON can hold them."""
        return {"event": type(self).__name__, **dataclasses.asdict(self)}  # pyright: ignore[reportArgumentType]

    @property
    def effect(self) -> dict[str, Any]:
        """Settings without the missions: events of one effect make the same world."""
        numbers = ("first_mission", "last_mission")
        return {name: value for name, value in self.settings.items() if name not in numbers}

    def check(self, team: Team, surface: Surface) -> None:
        """Refuse a team or a terrain that the event cannot act on: TrustboError."""

    def change(self, world: "World") -> "World":
        """Return the world with the event."""
        raise NotImplementedError


class _Regional(Event):
    """Event in a circle or a polygon of the terrain, in CRS metres."""

    center: tuple[float, float] | None
    radius: float | None
    polygon: Sequence[tuple[float, float]] | None

    def mask(self, surface: Surface) -> np.ndarray:
        """Pixels with centres inside, shape (row, col)."""
        rows, cols = surface.ground.shape
        if self.polygon is not None:
            height, width = surface.pixel
            corner = Affine.translation(
                surface.origin[0] - width / 2, surface.origin[1] + height / 2
            )
            shape = {"type": "Polygon", "coordinates": [[*self.polygon, self.polygon[0]]]}
            transform = corner @ Affine.scale(width, -height)
            return geometry_mask([shape], (rows, cols), transform, invert=True)
        x, y = self.center or (0.0, 0.0)
        row, col = surface.to_pixel(np.asarray(x), np.asarray(y))
        away = np.hypot(
            (np.arange(rows)[:, None] - row) * surface.pixel[0],
            (np.arange(cols) - col) * surface.pixel[1],
        )
        return away <= (self.radius or 0.0)

    def check(self, team: Team, surface: Surface) -> None:
        """See `Event.check`."""
        if not self.mask(surface).any():
            left, bottom, right, top = surface.extent
            raise TrustboError(
                f"{self} has no pixel of the terrain, which is x from {left:.9g} to "
                f"{right:.9g} and y from {bottom:.9g} to {top:.9g}; give CRS metres, and a "
                "region of a pixel at least."
            )

    def _require_region(self, noun: str) -> None:
        given = [value is not None for value in (self.center, self.radius, self.polygon)]
        if given not in ([True, True, False], [False, False, True]):
            raise TrustboError(f"a {noun} is either a circle, center and radius, or a polygon.")
        if self.polygon is None:
            require_positive("radius", self.radius)
            if not _are_positions(self.center, 1):
                raise TrustboError(f"center must be x and y in CRS metres; got {self.center!r}.")
        elif not _are_positions(self.polygon, 2) or len(self.polygon) < 3:
            raise TrustboError(
                f"a polygon needs three corners (x, y) in CRS metres; got {self.polygon!r}."
            )


@dataclass(frozen=True)
class Threat(_Regional):
    """Region that jams sight, or that no robot may enter, in some missions.

    Attributes:
        kind: `"jam"`: detection from or of a robot inside is 1 - `strength` times as probable;
            `"forbid"`: no route leads through.
        center: x and y of a circle, CRS metres.
        radius: Radius of the circle, m.
        polygon: Corners (x, y) of a region instead of a circle.
        strength: Strength of a jam, in (0, 1].
        first_mission: First mission with the threat; missions count from 0.
        last_mission: Last mission with the threat; None: no last.

    Raises:
        TrustboError: Neither a circle nor a polygon, an unknown kind, or a value out of range.
    """

    kind: str
    center: tuple[float, float] | None = None
    radius: float | None = None
    polygon: Sequence[tuple[float, float]] | None = None
    strength: float = 1.0
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        require_choice("threat", self.kind, KINDS)
        _require_missions(self)
        self._require_region("threat")
        if not isinstance(self.strength, Real) or not 0.0 < self.strength <= 1.0:
            raise TrustboError(f"strength must be in (0, 1]; got {self.strength!r}.")

    def change(self, world: "World") -> "World":
        """See `Event.change`."""
        if self.kind == "forbid":
            return world._replace(closed=(*world.closed, self))
        return world._replace(jams=(*world.jams, (self.mask(world.surface), self.strength)))


@dataclass(frozen=True)
class Degradation(Event):
    """Lidar of a robot of T2 that is worse in some missions.

    Attributes:
        robot: Name of the robot.
        detection: Factor on the probability of detection, in [0, 1].
        first_mission, last_mission: Missions with the worse lidar, see `Threat`.

    Raises:
        TrustboError: A value out of range.
    """

    robot: str
    detection: float
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        _require_missions(self)
        _require_share("detection", self.detection)

    def check(self, team: Team, surface: Surface) -> None:
        """See `Event.check`."""
        require_choice("robot", self.robot, team.names)

    def change(self, world: "World") -> "World":
        """See `Event.change`."""
        detection = world.detection.copy()
        detection[world.robots.index(self.robot)] *= self.detection
        return world._replace(detection=detection)


@dataclass(frozen=True)
class Dust(Event):
    """Dust, rain or fog: all lidars, the lead's too, are worse in some missions.

    Attributes:
        detection: Factor on the probability of detection, in [0, 1].
        first_mission, last_mission: Missions with the dust, see `Threat`.

    Raises:
        TrustboError: A value out of range.
    """

    detection: float
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        _require_missions(self)
        _require_share("detection", self.detection)

    def change(self, world: "World") -> "World":
        """See `Event.change`."""
        lead = self.detection * world.lead_detection
        return world._replace(detection=self.detection * world.detection, lead_detection=lead)


@dataclass(frozen=True)
class Fouling(Event):
    """Lidars of T2 that foul and clear from bound to bound, also from one mission to the next.

    The factor on the probability of detection of a robot is f_t = worst + (1 - worst) Phi(z_t),
    with z_t = correlation z_{t-1} + sqrt(1 - correlation^2) e_t, e_t standard normal, over bounds
    t, for each robot its z. In the long run f is uniform in [worst, 1], with mean (1 + worst) / 2,
    which is what `Truth` takes. Bound k of mission m, counted from 1 and 0, is t = m x every + k -
    1: time between missions is counted in bounds, and the seed alone decides all f, not the runs.

    Attributes:
        worst: Least factor, in [0, 1].
        correlation: Correlation of z in successive bounds, in [0, 1).
        every: Bounds from the start of a mission to that of the next; as many as the longest path
            has, or more.
        seed: Seed of the robots' z.
        first_mission, last_mission: Missions with the fouling, see `Threat`.

    Raises:
        TrustboError: A value out of range.
    """

    worst: float
    correlation: float = 0.95
    every: int = 16
    seed: int = 0
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        _require_missions(self)
        _require_share("worst", self.worst)
        if not isinstance(self.correlation, Real) or not 0.0 <= self.correlation < 1.0:
            raise TrustboError(f"correlation must be in [0, 1); got {self.correlation!r}.")
        require_whole("every", self.every, 1)
        require_whole("seed", self.seed, 0)

    @property
    def mean(self) -> float:
        """Mean factor in the long run."""
        return 0.5 * (1.0 + self.worst)

    def factors(self, mission: int, k: int, n_robots: int) -> np.ndarray:
        """Factor of each robot in bound k (1 for the first) of a mission, shape (robot,)."""
        t = mission * self.every + k - 1
        noise = np.stack([
            np.random.default_rng([self.seed, i]).standard_normal(t + 1) for i in range(n_robots)
        ])  # fmt: skip
        noise[:, 1:] *= np.sqrt(1.0 - self.correlation**2)
        z: Any = lfilter([1.0], [1.0, -self.correlation], noise)
        return self._factor(ndtr(z[:, -1]))

    def draw(self, rng: np.random.Generator, n_robots: int) -> np.ndarray:
        """Draw the factor of each robot from the long run, shape (robot,)."""
        return self._factor(rng.random(n_robots))

    def change(self, world: "World") -> "World":
        """See `Event.change`."""
        return world._replace(fouling=(*world.fouling, self))

    def _factor(self, share: np.ndarray) -> np.ndarray:
        return self.worst + (1.0 - self.worst) * share


@dataclass(frozen=True)
class Vegetation(_Regional):
    """Region where trees have been felled, or have grown, in some missions.

    Only sight is concerned: robots drive through as before.

    Attributes:
        height: Height of the canopy above the ground, m; 0 where trees have been felled.
        center: x and y of a circle, CRS metres.
        radius: Radius of the circle, m.
        polygon: Corners (x, y) of a region instead of a circle.
        first_mission, last_mission: Missions with this vegetation, see `Threat`.

    Raises:
        TrustboError: Neither a circle nor a polygon, or a value out of range.
    """

    height: float
    center: tuple[float, float] | None = None
    radius: float | None = None
    polygon: Sequence[tuple[float, float]] | None = None
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        _require_missions(self)
        self._require_region("vegetation")
        if not isinstance(self.height, Real) or not 0.0 <= self.height < np.inf:
            raise TrustboError(f"height must be 0 or positive, m; got {self.height!r}.")

    def change(self, world: "World") -> "World":
        """See `Event.change`."""
        surface = world.surface
        canopy = np.where(self.mask(surface), surface.ground + self.height, surface.canopy)
        return world._replace(surface=surface._replace(canopy=canopy))


@dataclass(frozen=True)
class Season(Event):
    """Canopy that is denser or thinner in some missions.

    Attributes:
        extinction: Factor on the extinction of the true sight, positive.
        first_mission, last_mission: Missions of the season, see `Threat`.

    Raises:
        TrustboError: A value out of range.
    """

    extinction: float
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        _require_missions(self)
        require_positive("extinction", self.extinction)

    def change(self, world: "World") -> "World":
        """See `Event.change`."""
        extinction = self.extinction * world.sight.extinction
        return world._replace(sight=dataclasses.replace(world.sight, extinction=extinction))


def require_events(what: str, events: object, kind: type) -> None:
    """Check that `events` is a list of one kind of event: TrustboError if not."""
    if not isinstance(events, Sequence) or not all(isinstance(event, kind) for event in events):
        raise TrustboError(f"{what} must be a list, [{kind.__name__}(...)]; got {events!r}.")


def _are_positions(value: object, ndim: int) -> bool:
    """Whether it is one position (x, y), or with 2 dimensions many."""
    try:
        xy = np.asarray(value)
    except ValueError:  # unequal numbers of coordinates
        return False
    right = xy.ndim == ndim and xy.shape[-1] == 2 and xy.dtype.kind in "iuf"
    return right and bool(np.isfinite(xy).all())


def _require_missions(event: Event) -> None:
    """Check that the missions of an event are a range: TrustboError if not."""
    require_whole("first_mission", event.first_mission, 0)
    if event.last_mission is not None:
        require_whole("last_mission", event.last_mission, event.first_mission)


def _require_share(name: str, value: object) -> None:
    if not isinstance(value, Real) or not 0.0 <= value <= 1.0:  # pyright: ignore[reportOperatorIssue]
        raise TrustboError(f"{name} must be in [0, 1]; got {value!r}.")
