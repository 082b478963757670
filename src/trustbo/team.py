"""Robots and teams."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from trustbo.arrays import as_names, default_robots, some_of
from trustbo.display import Rows, Summary
from trustbo.errors import (
    TrustboError,
    require_count,
    require_kind,
    require_positive,
    require_whole,
)

LEAD = "lead"
"""Name of the lead T1 in tables and files."""


@dataclass(frozen=True)
class Robot:
    """One ground robot with a lidar. The defaults describe a Husky-sized skid-steer vehicle.

    Attributes:
        speed: Speed on level ground, m/s.
        turn_rate: Largest yaw rate, rad/s.
        lidar_range: Distance up to which the lidar tracks another robot, m.
        vertical_fov: Half the vertical field of view, rad, measured from the plane of the body.
        sensor_height: Height of the lidar above ground, m.
        target_height: Height above ground of the point on this robot that the lidars of other
            robots aim at, m.
        max_slope: Steepest pitch or roll that the robot withstands, rad. If you are not sure, enter
            a limit that is 2 to 3 degrees lower: too low a limit makes paths a little longer, and
            too high a limit makes missions fail.
        detection: Quality of the lidar: fraction of unobstructed scans that detect their target, in
            (0, 1].
        acquire: Number of successive scans that must detect a target before contact begins.
        drop: Number of successive scans that must miss a target before contact ends.
        lookahead: Distance to the point of its route that the robot steers towards, m. With a
            longer distance, the robot cuts corners more and drives over ground off its route.

    Raises:
        TrustboError: A value is not positive, an angle exceeds 90 degrees, a fraction exceeds 1, or
            a number of scans is not a whole number.

    Example:
        >>> tb.Team(robots=[tb.Robot(lidar_range=60.0, max_slope=np.radians(20.0))] * 3)
    """

    speed: float = 2.0
    turn_rate: float = 1.0
    lidar_range: float = 100.0
    vertical_fov: float = np.pi / 8
    sensor_height: float = 1.0
    target_height: float = 1.0
    max_slope: float = np.pi / 4
    detection: float = 1.0
    acquire: int = 1
    drop: int = 1
    lookahead: float = 1.5

    def __post_init__(self) -> None:
        for name, value in list(vars(self).items()):
            number = require_positive(f"Robot.{name}", value)
            if name in ("acquire", "drop"):
                number = require_whole(f"Robot.{name}", value, 1)
            object.__setattr__(self, name, number)  # a number of NumPy becomes Python's

        if self.detection > 1.0:
            raise TrustboError(f"Robot.detection must be in (0, 1]; got {self.detection:g}.")
        for name in ("vertical_fov", "max_slope"):
            if getattr(self, name) >= np.pi / 2:
                raise TrustboError(
                    f"Robot.{name} must be in radians, below pi/2; got {getattr(self, name):g} "
                    "(degrees? use numpy.deg2rad)."
                )


@dataclass(frozen=True, repr=False)
class Team(Summary):
    """The lead T1 and the overwatching subteam T2.

    Attributes:
        n_robots: Number of robots in T2; taken from `robots` if these are given.
        robots: Members of T2; by default `n_robots` identical robots.
        lead: Lead robot T1.
        names: Names of the members of T2; by default r1, r2, ...

    Raises:
        TrustboError: There are no robots, the lead is not a `Robot`, or `names` does not hold one
            distinct name per robot other than `"lead"`.

    Example:
        >>> tb.Team(robots=(tb.Robot(lidar_range=60.0), tb.Robot()), names=("spot", "husky"))
    """

    n_robots: int = 3
    robots: tuple[Robot, ...] = ()
    lead: Robot = field(default_factory=Robot)
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_kind("Team.lead", self.lead, Robot, "give a Robot")
        remedy = "give a sequence of Robot, or n_robots= for identical robots"
        for robot in require_kind("Team.robots", self.robots, Sequence, remedy):
            require_kind("Team.robots", robot, Robot, remedy)
        robots = tuple(self.robots) or (Robot(),) * require_count("n_robots", self.n_robots)
        n = len(robots)
        names = as_names("names", self.names, n) or default_robots(n)
        if LEAD in names:
            raise TrustboError(f"names: {LEAD!r} is the name of the lead T1; choose another name.")

        object.__setattr__(self, "n_robots", n)
        object.__setattr__(self, "robots", robots)
        object.__setattr__(self, "names", names)

    @property
    def members(self) -> dict[str, Robot]:
        """The lead and then the members of T2, by name."""
        return {LEAD: self.lead} | dict(zip(self.names, self.robots, strict=True))

    @property
    def max_slope(self) -> float:
        """Steepest slope that every member withstands, rad."""
        return min(robot.max_slope for robot in self.members.values())

    @classmethod
    def of(cls, team: Self | None) -> Self:
        """Return the team, by default three identical robots; raises TrustboError if not a Team."""
        return cls() if team is None else require_kind("team", team, Team, "give Team(n_robots=3)")

    def of_robots(self, names: Iterable[str]) -> Self:
        """Return the team with the same lead and some robots of T2, in the order of this team.

        Raises TrustboError if a name is unknown or repeated, or if there are no names.
        """
        members = some_of("robots", names, self.names)
        if len(members) == self.n_robots:
            return self
        robots = tuple(self.robots[i] for i in members)
        known = tuple(self.names[i] for i in members)
        return replace(self, n_robots=len(members), robots=robots, names=known)

    def _rows(self) -> Rows:
        limit = f"{np.rad2deg(self.max_slope):.3g} degrees"
        alike = "all alike" if len(set(self.members.values())) == 1 else "not all alike"
        return [("robots", f"{', '.join(self.names)} ({alike})"), ("slope limit", limit)]
