"""Events that change the simulated world in given missions, with one class per kind of event.

The classes are frozen dataclasses derived from `Event`. Their method `change` returns a world with
the event. Positions are x and y in CRS metres.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.signal import lfilter
from scipy.special import ndtr

from trustbo.arrays import as_array
from trustbo.errors import (
    TrustboError,
    require_choice,
    require_position,
    require_positive,
    require_share,
    require_whole,
)
from trustbo.simulation.world import World
from trustbo.workspace.surface import Surface


@dataclass(frozen=True, kw_only=True)
class Event:
    """Change of the simulated world in given missions.

    Attributes:
        first: First mission with the event; missions are counted from 0.
        last: Last mission with the event; None if the event does not end.

    Example:
        >>> event = tb.simulation.Dust(detection=0.5, first=2, last=4)
        >>> [event.acts_in(mission) for mission in (1, 2, 4, 5)]
        [False, True, True, False]
    """

    SHARES: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that must be in [0, 1]."""

    first: int = 0
    last: int | None = None

    def __post_init__(self) -> None:
        for name in self.SHARES:
            require_share(name, getattr(self, name))
        require_whole("first", self.first, 0)
        if self.last is not None:
            require_whole("last", self.last, self.first)

    def acts_in(self, mission: int) -> bool:
        """Return whether the event acts in a mission."""
        return self.first <= mission and (self.last is None or mission <= self.last)

    def change(self, world: World) -> World:
        """Return the world with the event; raises TrustboError if the event does not fit."""
        raise NotImplementedError


@dataclass(frozen=True)
class Jam(Event):
    """Jammer that lowers the probability that robots in a circle detect others or are detected.

    Attributes:
        center: Centre of the circle.
        radius: Radius of the circle, in metres.
        strength: Strength in [0, 1]; the detection probability is multiplied by 1 - `strength`.

    Example:
        >>> center = workspace.grid.center((4, 4))  # x and y, metres of the CRS
        >>> jam = tb.simulation.Jam(center, radius=40.0, strength=0.8, first=3)
        >>> simulator = tb.simulation.KinematicSimulator(workspace, events=[jam])
    """

    SHARES = ("strength",)

    center: tuple[float, float]
    radius: float
    strength: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_circle(self.center, self.radius)

    def change(self, world: World) -> World:
        """See `Event.change`."""
        inside = _circle(world.surface, self.center, self.radius)
        return world._replace(jams=(*world.jams, (inside, self.strength)))


@dataclass(frozen=True)
class Degradation(Event):
    """Degraded lidar of a robot of T2, which detects the lead with a lower probability.

    Attributes:
        robot: Name of the robot.
        detection: Factor by which the detection probability is multiplied, in [0, 1].

    Example:
        >>> poor = tb.simulation.Degradation("r2", detection=0.5, first=3)
        >>> simulator = tb.simulation.KinematicSimulator(workspace, events=[poor])
    """

    SHARES = ("detection",)

    robot: str
    detection: float

    def change(self, world: World) -> World:
        """See `Event.change`."""
        names = world.team.names
        factors = np.ones(len(names))
        factors[names.index(require_choice("robot", self.robot, names))] = self.detection
        return world._replace(detection=world.detection * factors)


@dataclass(frozen=True)
class Dust(Event):
    """Dust, rain or fog, which reduces the detection probability of all lidars.

    Attributes:
        detection: Factor by which the detection probability is multiplied, in [0, 1].

    Example:
        >>> dust = tb.simulation.Dust(detection=0.5, first=2, last=4)  # in three missions
        >>> simulator = tb.simulation.KinematicSimulator(workspace, events=[dust])
    """

    SHARES = ("detection",)

    detection: float

    def change(self, world: World) -> World:
        """See `Event.change`."""
        t2 = self.detection * world.detection
        lead = self.detection * world.lead_detection
        return world._replace(detection=t2, lead_detection=lead)


@dataclass(frozen=True)
class Trees(Event):
    """Trees felled or grown in a circle; the change affects sight but not motion.

    Attributes:
        height: Height of the canopy above the ground, in metres; 0 if trees were felled.
        center: Centre of the circle.
        radius: Radius of the circle, in metres.

    Example:
        >>> center = workspace.grid.center((4, 4))  # x and y, metres of the CRS
        >>> grown = tb.simulation.Trees(height=12.0, center=center, radius=30.0, first=6)
        >>> simulator = tb.simulation.KinematicSimulator(workspace, events=[grown])
    """

    height: float
    center: tuple[float, float]
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("height", self.height, or_zero=True)
        _require_circle(self.center, self.radius)

    def change(self, world: World) -> World:
        """See `Event.change`."""
        surface = world.surface
        inside = _circle(surface, self.center, self.radius)
        canopy = np.where(inside, surface.ground + self.height, surface.canopy)
        return world._replace(surface=surface._replace(canopy=canopy))


@dataclass(frozen=True)
class Season(Event):
    """Change of season, in which the canopy becomes denser or thinner.

    Attributes:
        extinction: Positive factor on the extinction coefficient of the true model of sight.

    Example:
        >>> leaves = tb.simulation.Season(extinction=3.0, first=6)
        >>> simulator = tb.simulation.KinematicSimulator(workspace, events=[leaves])
    """

    extinction: float

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("extinction", self.extinction)

    def change(self, world: World) -> World:
        """See `Event.change`."""
        extinction = self.extinction * world.sight.extinction
        return world._replace(sight=dataclasses.replace(world.sight, extinction=extinction))


@dataclass(frozen=True)
class Fouling(Event):
    """Fouling of T2's lidars, which changes the detection probability from bound to bound.

    The factor f_t on the detection probability of a robot is ::

        f_t = worst + (1 - worst) Phi(z_t)
        z_t = correlation z_{t-1} + sqrt(1 - correlation^2) e_t,    e_t ~ N(0, 1)

    with the distribution function Phi of the standard normal. The time of bound k = 1, 2, ... in
    mission m = 0, 1, ... is t = m x every + k - 1. The stationary distribution of f is uniform on
    [worst, 1], with mean (1 + worst) / 2.

    Attributes:
        worst: Smallest factor, in [0, 1].
        correlation: Correlation of z between successive bounds, in [0, 1].
        every: Number of bounds between the starts of successive missions. It should be at least the
            number of bounds of a path.
        seed: Seed of the random factors.

    Example:
        >>> fouling = tb.simulation.Fouling(worst=0.1, seed=1)
        >>> simulator = tb.simulation.KinematicSimulator(workspace, events=[fouling])
    """

    SHARES = ("worst", "correlation")

    worst: float
    correlation: float = 0.95
    every: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_whole("every", self.every, 1)
        require_whole("seed", self.seed, 0)

    def change(self, world: World) -> World:
        """See `Event.change`; the long-run mean over missions uses the mean of the factor."""
        if world.mission is None:
            return world._replace(detection=0.5 * (1.0 + self.worst) * world.detection)

        first = world.mission * self.every
        noise = np.stack([
            np.random.default_rng([self.seed, i]).standard_normal(first + self.every)
            for i in range(world.team.n_robots)
        ])  # fmt: skip

        noise[:, 1:] *= np.sqrt(1.0 - self.correlation**2)
        z: Any = lfilter([1.0], [1.0, -self.correlation], noise)

        factors = self.worst + (1.0 - self.worst) * ndtr(z[:, first:].T)  # (bound, robot)
        n_bounds = max(len(factors), len(world.detection))
        before = _up_to(n_bounds, world.detection)
        return world._replace(detection=before * _up_to(n_bounds, factors))


def _up_to(n_bounds: int, detection: np.ndarray) -> np.ndarray:
    """Extend detection (bound, robot) to `n_bounds`; its last row applies to all later bounds."""
    return detection[np.minimum(np.arange(n_bounds), len(detection) - 1)]


def _require_circle(center: object, radius: object) -> None:
    """Check the centre and the radius of an event's circle."""
    require_position("center", center)
    require_positive("radius", radius)


def _circle(surface: Surface, center: tuple[float, float], radius: float) -> np.ndarray:
    """Return a mask (row, col) of the pixels in a circle; raises TrustboError if there are none."""
    rows, cols = surface.ground.shape
    row, col = surface.to_pixel(*as_array("center", center))
    away = np.hypot(
        (np.arange(rows)[:, None] - row) * surface.pixel[0],
        (np.arange(cols) - col) * surface.pixel[1],
    )

    inside = away <= radius
    if not inside.any():
        left, bottom, right, top = surface.extent
        raise TrustboError(
            f"no pixel of the terrain is within {radius:g} m of {center}; the terrain covers x "
            f"from {left:.9g} to {right:.9g} and y from {bottom:.9g} to {top:.9g}. Move the event."
        )
    return inside
