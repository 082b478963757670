"""What goes in and out of a mission: robots, teams, bounds, missions, and missions stacked."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from trustbo.errors import ShapeError, TrustboError, require_choice

Cell = tuple[int, int]
Status = Literal["ok", "stuck", "tipped", "timeout", "collision", "lost_contact", "aborted"]
STATUSES: tuple[str, ...] = get_args(Status)
FEATURES = ("traversability", "visibility")
"""The paper's z1 and z2, the names of the first two features."""


@dataclass(frozen=True)
class Robot:
    """One ground robot with a lidar. The defaults describe a Husky-sized skid-steer vehicle.

    Attributes:
        speed: Speed on level ground, m/s.
        turn_rate: Largest yaw rate, rad/s.
        lidar_range: Distance up to which the lidar tracks another robot, m.
        vertical_fov: Half the vertical field of view, rad, measured from the plane of the body.
        sensor_height: Height of the lidar above ground, m.
        target_height: Height of the point others aim at, m above ground; by default the lidar.
        max_slope: Steepest pitch or roll the robot stands, rad.

    Raises:
        TrustboError: A value is not positive, or an angle is beyond a quarter turn.
    """

    speed: float = 2.0
    turn_rate: float = 1.0
    lidar_range: float = 100.0
    vertical_fov: float = np.pi / 8
    sensor_height: float = 1.0
    target_height: float = 1.0
    max_slope: float = np.pi / 4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise TrustboError(f"Robot.{name} must be positive and finite; got {value!r}.")
        for name in ("vertical_fov", "max_slope"):
            if getattr(self, name) >= np.pi / 2:
                raise TrustboError(
                    f"Robot.{name} is an angle in radians below pi/2; got {getattr(self, name):g} "
                    "(degrees? use numpy.deg2rad)."
                )


@dataclass(frozen=True)
class Team:
    """The lead T1 and the overwatching subteam T2.

    Attributes:
        n_robots: Number of robots in T2; taken from `robots` where these are given.
        robots: The members of T2; by default `n_robots` equal ones.
        lead: T1.
        names: One name per member of T2; by default r1, r2, ...

    Raises:
        TrustboError: No robots, or names that are not one distinct name per robot.
    """

    n_robots: int = 3
    robots: tuple[Robot, ...] = ()
    lead: Robot = field(default_factory=Robot)
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        robots = tuple(self.robots) or (Robot(),) * self.n_robots
        if not robots:
            raise TrustboError(
                f"a team needs at least one overwatching robot; got {self.n_robots}."
            )
        names = tuple(self.names) or tuple(f"r{i + 1}" for i in range(len(robots)))
        if len(set(names)) != len(robots):
            raise TrustboError(f"names must be {len(robots)} distinct names; got {names}.")
        for name, value in (("n_robots", len(robots)), ("robots", robots), ("names", names)):
            object.__setattr__(self, name, value)

    @property
    def max_slope(self) -> float:
        """Steepest slope every member stands, rad."""
        return min(robot.max_slope for robot in (self.lead, *self.robots))


@dataclass(frozen=True, eq=False)
class Bound:
    """What one bound measured, one row per overwatching robot.

    Attributes:
        cell: Planning cell entered, (row, col).
        awareness: Situational awareness, shape (robot, feature), in [0, 1]; NaN where not measured.
        contact_rate: Share of the running time in contact, shape (robot,); NaN where not measured.
        duration: Running time of the bound, shape (robot,), s; NaN where not recorded.
        status: How the bound ended.
        t0: Start of the bound, s since the mission's start.
        poses: Shape (tick, 1 + robot, 3), the lead first: x and y in CRS metres, heading in rad
            from east, anticlockwise. None where not recorded.
        contact: Shape (tick, robot), whether each robot had contact. None where not recorded.

    Raises:
        ShapeError: The arrays disagree on the number of robots.
        TrustboError: A value outside [0, 1], a duration that is not positive, an unknown status.
    """

    cell: Cell
    awareness: np.ndarray
    contact_rate: np.ndarray
    duration: np.ndarray
    status: str = "ok"
    t0: float = 0.0
    poses: np.ndarray | None = None
    contact: np.ndarray | None = None

    def __post_init__(self) -> None:
        lengths = [len(self.awareness), len(self.contact_rate), len(self.duration)]
        if len(set(lengths)) != 1:
            raise ShapeError(
                "awareness, contact_rate and duration must have one row per robot; "
                f"got {lengths[0]}, {lengths[1]}, {lengths[2]}."
            )
        require_choice("status", self.status, STATUSES)
        for name, values in (("awareness", self.awareness), ("contact_rate", self.contact_rate)):
            _require_unit_interval(f"{name} of the bound into cell {self.cell}", values)
        if (self.duration <= 0).any():
            robot = int(np.argmax(self.duration <= 0))
            raise TrustboError(f"duration[{robot}] = {self.duration[robot]:g} s must be positive.")

    @property
    def contact_time(self) -> np.ndarray:
        """Time in contact with the lead, shape (robot,), s."""
        return self.contact_rate * self.duration

    @property
    def t1(self) -> float:
        """End of the bound, s since the mission's start."""
        return self.t0 + float(np.nanmax(self.duration, initial=0.0))


@dataclass(frozen=True, eq=False)
class Mission:
    """One traversal of a path: its bounds, as far as they were run, and how it ended.

    Attributes:
        path: The planned cells, start first, each (row, col).
        bounds: The bounds run; bound k enters `path[k]`. Fewer than planned if the mission ended
            early; the last one then carries the same status as the mission.
        status: `"ok"` if the goal was reached.
        features: Names of the features, in the order of the awareness' last axis.
        robots: Names of the overwatching robots.

    Raises:
        ShapeError: Bounds that do not fit the path, or disagree on robots or features.
        TrustboError: An unknown status.
    """

    path: tuple[Cell, ...]
    bounds: tuple[Bound, ...]
    status: str = "ok"
    features: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_choice("status", self.status, STATUSES)
        if not self.bounds or len(self.bounds) > len(self.path) - 1:
            raise ShapeError(
                f"a path of {len(self.path)} cells has {len(self.path) - 1} bounds, and a mission "
                f"at least one; got {len(self.bounds)}."
            )
        if self.status == "ok" and len(self.bounds) < len(self.path) - 1:
            raise ShapeError(
                f'status "ok" says the goal was reached, but only {len(self.bounds)} of '
                f"{len(self.path) - 1} bounds were run; give the status it ended with."
            )
        shapes = {bound.awareness.shape for bound in self.bounds}
        if len(shapes) != 1:
            raise ShapeError(f"bounds disagree on (robot, feature): {sorted(shapes)}.")
        n_robots, n_features = shapes.pop()
        names = {
            "features": tuple(self.features) or default_features(n_features),
            "robots": tuple(self.robots) or tuple(f"r{i + 1}" for i in range(n_robots)),
        }
        for (name, labels), size in zip(names.items(), (n_features, n_robots), strict=True):
            if len(labels) != size:
                raise ShapeError(f"{name} must be {size} names; got {labels}.")
            object.__setattr__(self, name, labels)

    @classmethod
    def from_arrays(
        cls,
        path: Sequence[Cell],
        awareness: ArrayLike,
        contact_rate: ArrayLike,
        duration: ArrayLike | None = None,
        status: str = "ok",
        *,
        features: Sequence[str] = (),
        robots: Sequence[str] = (),
    ) -> Self:
        """Make a mission of a user's own log.

        Args:
            path: Planned cells, start first.
            awareness: Shape (bound, robot, feature), in [0, 1].
            contact_rate: Shape (bound, robot), in [0, 1].
            duration: Shape (bound, robot) or (bound,), s; None where not recorded.
            status: How the mission ended.
            features: Names; by default traversability, visibility, z3, ...
            robots: Names; by default r1, r2, ...

        Raises:
            ShapeError: Axes that do not fit together.
            TrustboError: A value outside [0, 1], or an unknown status.
        """
        z, y = np.asarray(awareness, dtype=float), np.asarray(contact_rate, dtype=float)
        if z.ndim != 3 or y.shape != z.shape[:2]:
            raise ShapeError(
                "awareness must be (bound, robot, feature) and contact_rate (bound, robot); "
                f"got {z.shape} and {y.shape}."
            )
        seconds = np.asarray(np.nan if duration is None else duration, dtype=float)
        if seconds.ndim == 1:
            seconds = seconds[:, None]
        try:
            seconds = np.broadcast_to(seconds, y.shape)
        except ValueError:
            raise ShapeError(f"duration must be {y.shape}; got {seconds.shape}.") from None
        cells = tuple((int(row), int(col)) for row, col in path)
        if len(y) > len(cells) - 1:
            raise ShapeError(f"{len(y)} bounds need {len(y) + 1} cells; the path has {len(cells)}.")
        last, starts = len(y) - 1, np.concatenate([[0.0], np.cumsum(np.nan_to_num(seconds.max(1)))])
        bounds = tuple(
            Bound(
                cells[k + 1],
                z[k],
                y[k],
                seconds[k],
                status if k == last else "ok",
                float(starts[k]),
            )
            for k in range(len(y))
        )
        return cls(cells, bounds, status, tuple(features), tuple(robots))

    @property
    def awareness(self) -> np.ndarray:
        """Measured awareness, shape (bound, robot, feature)."""
        return np.stack([bound.awareness for bound in self.bounds])

    @property
    def contact_rate(self) -> np.ndarray:
        """Contact rates, shape (bound, robot)."""
        return np.stack([bound.contact_rate for bound in self.bounds])

    @property
    def duration(self) -> np.ndarray:
        """Running times, shape (bound, robot), s."""
        return np.stack([bound.duration for bound in self.bounds])


class MissionBatch(NamedTuple):
    """Missions stacked and padded with NaN, ready for compiled code.

    Both leading axes are padded to a bucket, so that compiled code is reused from one mission to
    the next; a padded bound has NaN contact rates, which the models read as "not measured".
    """

    awareness: np.ndarray
    """Shape (mission, bound, robot, feature); 0 in the padding."""
    contact_rate: np.ndarray
    """Shape (mission, bound, robot); NaN in the padding."""


def stack_missions(missions: Sequence[Mission], *, pad: bool = True) -> MissionBatch:
    """Stack missions of any length into one batch.

    Args:
        missions: At least one mission; all with the same robots and features.
        pad: Grow the axes to their buckets: bounds to a multiple of 8, missions to a power of two
            from 8 on. Without it, bounds are padded to the longest mission only.

    Raises:
        ShapeError: No missions, or missions that disagree on robots or features.
        TrustboError: An awareness value is NaN (contact rates may be missing, awareness may not).
    """
    if not missions:
        raise ShapeError("no missions to learn from; give at least one.")
    first = missions[0]
    for j, mission in enumerate(missions):
        if (mission.robots, mission.features) != (first.robots, first.features):
            raise ShapeError(
                f"mission {j} has robots {mission.robots} and features {mission.features}, mission "
                f"0 has {first.robots} and {first.features}; all must agree."
            )
        if np.isnan(mission.awareness).any():
            k, i, m = np.argwhere(np.isnan(mission.awareness))[0]
            raise TrustboError(
                f"awareness of mission {j}, bound {k + 1}, robot {first.robots[i]}, feature "
                f"{first.features[m]} is NaN; fill it from the awareness map or drop the bound."
            )
    n_missions, n_bounds = len(missions), max(len(mission.bounds) for mission in missions)
    if pad:
        n_missions, n_bounds = max(8, 1 << (n_missions - 1).bit_length()), -(-n_bounds // 8) * 8
    shape = (n_missions, n_bounds, len(first.robots), len(first.features))
    batch = MissionBatch(np.zeros(shape), np.full(shape[:-1], np.nan))
    for j, mission in enumerate(missions):
        batch.awareness[j, : len(mission.bounds)] = mission.awareness
        batch.contact_rate[j, : len(mission.bounds)] = mission.contact_rate
    return batch


def fill_awareness(mission: Mission, awareness: np.ndarray) -> Mission:
    """Replace awareness that a mission did not measure (NaN) by that of a map.

    Args:
        mission: The mission.
        awareness: Shape (robot, row, col, feature), such as `Workspace.awareness`.
    """
    if not np.isnan(mission.awareness).any():
        return mission
    bounds = tuple(
        replace(b, awareness=np.where(np.isnan(b.awareness), awareness[:, *b.cell], b.awareness))
        for b in mission.bounds
    )
    return replace(mission, bounds=bounds)


def default_features(n_features: int) -> tuple[str, ...]:
    """Names of the first features: traversability, visibility, z3, z4, ..."""
    return (*FEATURES, *(f"z{m + 1}" for m in range(2, n_features)))[:n_features]


def _require_unit_interval(what: str, values: np.ndarray) -> None:
    bad = (values < 0.0) | (values > 1.0)
    if bad.any():
        index = ", ".join(str(i) for i in np.argwhere(bad)[0])
        raise TrustboError(f"{what}: [{index}] = {values[bad][0]:g} is outside [0, 1].")
