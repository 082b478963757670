"""Custom simulator with MuJoCo, in which robots slip, get stuck, tip over and collide.

    pip install mujoco
    python examples/mujoco/simulator.py

`MujocoSimulator` inherits bounds, posts and contacts from `KinematicSimulator` and replaces the
motion. To import the class, add this folder to `sys.path`. Example:

    result = tb.iterate(workspace, start, goal, simulator=MujocoSimulator(workspace))
"""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from vehicle import Physics, crop, grip_of, wheel_speeds

import trustbo as tb
from trustbo.errors import require_positive
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.motion import ARRIVED, LOOKAHEAD
from trustbo.simulation.world import World
from trustbo.team import Robot
from trustbo.workspace import Workspace
from trustbo.workspace.routes import SLOWEST
from trustbo.workspace.surface import Surface

MARGIN = 5.0
"""Width of the simulated margin around the pixels that a route may use, m."""
CONTROL = 0.05
"""Maximum time between two commands to the wheels, s."""
TIPPED, ON_ITS_SIDE = math.radians(75.0), math.radians(60.0)
"""Angles to the vertical, and to the ground's normal, from which a robot has tipped over, rad."""
PROGRESS = 0.25
"""Distance along the route that counts as progress; without progress a robot is stuck, m."""
CLEARANCE, AVOIDANCE_RANGE = 1.3, 4.0
"""Distance kept between the centres of two robots, and range at which they avoid, m."""
COLLISION_TIME = 3.0
"""Maximum time from a contact of two robots to a failure that counts as a collision, s."""
STILL = 0.05
"""Minimum displacement per tick of a robot at its goal that counts as motion, m."""
SLOW = 1.5
"""Maximum speed at which a robot that reaches its goal counts as arrived, m/s."""
GRIP_SD, SLIP_SD = 0.1, 0.05
"""Log standard deviations of the grip per robot and drive, and of wheel speeds per tick."""


class MujocoSimulator(KinematicSimulator):
    """Physics simulator of skid-steer robots on the DEM as a heightfield.

    Bounds, posts, routes and contacts are computed as in `KinematicSimulator`; MuJoCo simulates the
    motion. All robots have the size of a Husky (1.0 x 0.7 x 0.4 m, 50 kg). The `max_slope` of a
    `Robot` determines its centre of mass and its grip, so that the robot tips over or slides a few
    degrees above `max_slope`. Robots steer towards a point ahead, slow down on slopes as in
    `KinematicSimulator`, and avoid each other.

    The mission ends as `"tipped"` if a robot leans by 75 degrees, or by 60 degrees to the ground.
    The status is `"stuck"` if a robot makes no progress for `stuck_after` seconds, has no route, or
    slides off the simulated ground. In both cases, the status is `"collision"` if the robot touched
    another robot shortly before. The status is `"timeout"` after `bound_timeout` seconds, and
    `"aborted"` if the physics diverges.

    Robots that watch and vegetation are not part of the physics, so they are no obstacles. The same
    seed gives the same mission on the same machine and version of MuJoCo.
    """

    def __init__(
        self,
        workspace: Workspace,
        *,
        friction: float | None = None,
        stuck_after: float = 15.0,
        step: float = 0.01,
        **options: Any,
    ) -> None:
        """Prepare a terrain for simulation.

        Args:
            workspace: Workspace made from a terrain.
            friction: Mean friction coefficient of the wheels on the ground; by default, the minimum
                that each robot needs for its `max_slope`.
            stuck_after: Time without progress after which a robot is stuck, s.
            step: Maximum physics step, s.
            **options: Options of `KinematicSimulator`, such as `sight` and `tick`.

        Raises:
            TrustboError: A value is not positive, or `KinematicSimulator` raises the error.
        """
        super().__init__(workspace, **options)
        self.friction = None if friction is None else require_positive("friction", friction)
        self.stuck_after = require_positive("stuck_after", stuck_after)
        self.step = require_positive("step", step)

    def describe(self) -> dict[str, object]:
        """Return the settings that affect the measurements."""
        return {
            **super().describe(),
            "friction": self.friction,
            "stuck_after": self.stuck_after,
            "step": self.step,
            "mujoco": mujoco.__version__,
        }

    def drive(
        self,
        world: World,
        poses: np.ndarray,
        robots: Sequence[Robot],
        routes: Sequence[np.ndarray | None],
        window: tuple[int, int, int, int],
        max_ticks: int,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, str]:
        """See `KinematicSimulator.drive`."""
        legs: list[_Leg] = []
        for robot, route in zip(robots, routes, strict=True):
            if route is None:
                return poses[None].copy(), "stuck"
            legs.append(_Leg(route, robot))
        n_commands = math.ceil(self.tick / CONTROL)
        n_steps = math.ceil(self.tick / n_commands / self.step)
        grip = np.array([self.friction or grip_of(robot) for robot in robots])
        grip *= np.exp(GRIP_SD * rng.standard_normal(len(robots)))
        slip = np.exp(SLIP_SD * rng.standard_normal((max(1, max_ticks), len(robots), 2)))
        physics = Physics(
            crop(world.surface, self._true_window(world.surface, window), MARGIN),
            robots,
            grip.tolist(),
            self.tick / n_commands / n_steps,
        )
        convoy = _Convoy(physics, legs, world.surface, self.stuck_after)
        physics.place(poses)
        track, status = [poses], "underway"
        for slip_now in slip:
            for _ in range(n_commands):
                status = convoy.advance(slip_now, self.tick / n_commands, n_steps)
                if status != "underway":
                    break
            track.append(convoy.record(track[-1]))
            if status != "underway":
                break
        return np.stack(track[1:]), "timeout" if status == "underway" else status

    def _true_window(
        self, true: Surface, window: tuple[int, int, int, int]
    ) -> tuple[int, int, int, int]:
        """Return the window in pixels of the true surface, whose raster may differ."""
        planned = self.workspace.surface
        if planned.pixel == true.pixel and planned.origin == true.origin:
            return window
        y, x = planned.axes
        row, col = true.nearest(x[[window[2], window[3] - 1]], y[[window[0], window[1] - 1]])
        return int(row[0]), int(row[1]) + 1, int(col[0]), int(col[1]) + 1


class _Convoy:
    """Robots that drive at the same time, each along its route."""

    def __init__(
        self, physics: Physics, legs: "list[_Leg]", surface: Surface, stuck_after: float
    ) -> None:
        """Prepare a drive; the gradient of the surface determines which robots have tipped over."""
        self._physics, self._legs = physics, legs
        self._surface, self._stuck_after = surface, stuck_after
        self._untouched = np.full(len(legs), np.inf)  # s

    def advance(self, slip: np.ndarray, seconds: float, n_steps: int) -> str:
        """Command the wheels, advance by `n_steps`, and return the status or "underway".

        The commanded wheel speeds are multiplied by `slip`, shape (robot, side).
        """
        physics, legs, poses = self._physics, self._legs, self._physics.poses
        tilt = np.arccos(np.clip(physics.up[:, 2], -1.0, 1.0))
        asked = np.zeros((len(legs), 2))
        for i, leg in enumerate(legs):
            if not leg.arrived:
                others = np.delete(poses[:, :2], i, axis=0)
                asked[i] = leg.steer(poses[i], tilt[i], others)
        # Slipping wheels are commanded to turn faster; robots that have arrived brake.
        short = np.clip(asked - physics.rates, -1.0, 1.0)
        short[[leg.arrived for leg in legs]] = 0.0
        physics.command(wheel_speeds(*(asked + short).T) * slip)
        physics.advance(n_steps)
        if not physics.is_finite:
            return "aborted"
        poses, speed = physics.poses, physics.speed
        self._untouched = np.where(physics.touching, 0.0, self._untouched + seconds)
        hit = self._untouched < COLLISION_TIME
        tipped = self._has_tipped(poses)
        if tipped.any():
            return "collision" if hit[tipped].any() else "tipped"
        for leg, pose, v in zip(legs, poses, speed, strict=True):
            leg.update(pose[:2], v, seconds)
        stuck = physics.off_ground | [leg.idle >= self._stuck_after for leg in legs]
        if stuck.any():
            return "collision" if hit[stuck].any() else "stuck"
        return "ok" if all(leg.arrived for leg in legs) else "underway"

    def record(self, last: np.ndarray) -> np.ndarray:
        """Return the poses to record after the `last` ones, shape (robot, 3).

        A robot that creeps slightly at its goal keeps its last pose.
        """
        if not self._physics.is_finite:
            return last
        poses = self._physics.poses
        still = np.linalg.norm(poses[:, :2] - last[:, :2], axis=1) < STILL
        still &= [leg.arrived for leg in self._legs]
        return np.where(still[:, None], last, poses)

    def _has_tipped(self, poses: np.ndarray) -> np.ndarray:
        up = self._physics.up
        dz_dx, dz_dy = self._surface.gradient[:, *self._surface.nearest(poses[:, 0], poses[:, 1])]
        along_normal = up[:, 2] - dz_dx * up[:, 0] - dz_dy * up[:, 1]
        along_normal /= np.sqrt(1.0 + dz_dx**2 + dz_dy**2)
        return (up[:, 2] < math.cos(TIPPED)) | (along_normal < math.cos(ON_ITS_SIDE))


class _Leg:
    """Route of one robot, with its progress and steering."""

    def __init__(self, route: np.ndarray, robot: Robot) -> None:
        """Start at the beginning of a route, shape (point, 2), CRS metres."""
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1)))
        self._along = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / 0.25) + 1))
        self._points = np.column_stack([np.interp(self._along, along, xy) for xy in route.T])
        self._robot, self._reach = robot, LOOKAHEAD + 0.25 * robot.speed
        self._position, self._best = 0, 0.0
        self.idle, self.arrived = 0.0, False

    def update(self, position: np.ndarray, speed: float, seconds: float) -> None:
        """Update the progress; `seconds` is the time since the last update.

        A robot that slides past its goal too fast has not arrived.
        """
        near = self._points[self._position : self._position + 12]
        self._position += int(np.argmin(((near - position) ** 2).sum(1)))
        there = math.dist(position, self._points[-1]) < ARRIVED
        self.arrived |= there and speed < SLOW
        if self.arrived or self._along[self._position] >= self._best + PROGRESS:
            self._best, self.idle = float(self._along[self._position]), 0.0
        else:
            self.idle += seconds

    def steer(self, pose: np.ndarray, tilt: float, others: np.ndarray) -> tuple[float, float]:
        """Return the speed, m/s, and yaw rate, rad/s, towards a point ahead, around other robots.

        `pose` is (x, y, heading), `tilt` is the angle of the body to the vertical, rad, and
        `others` are positions of the other robots, shape (robot, 2), CRS metres.
        """
        robot, left = self._robot, math.dist(pose[:2], self._points[-1])
        ahead = np.searchsorted(self._along, self._along[self._position] + self._reach)
        dx, dy = self._points[min(int(ahead), len(self._points) - 1)] - pose[:2]
        bearing = _around(math.atan2(dy, dx), left, others - pose[:2])
        error = _wrapped(bearing - pose[2])
        share = max(SLOWEST, 1.0 - (1.0 - SLOWEST) * tilt / robot.max_slope)
        # Slow down before the goal, and turn on the spot until the robot faces its route.
        speed = min(robot.speed * share, 2.0 * left) * max(0.0, math.cos(error))
        return speed, min(robot.turn_rate, max(-robot.turn_rate, 2.0 * error))


def _around(bearing: float, left: float, others: np.ndarray) -> float:
    """Return the bearing, rad, corrected to pass other robots with clearance.

    `left` is the distance to the goal, m; `others` are positions relative to this robot, shape
    (robot, 2), m.
    """
    for x, y in others:
        gap = math.hypot(x, y)
        if gap > min(left + 0.5, AVOIDANCE_RANGE):
            continue
        off = _wrapped(bearing - math.atan2(y, x))
        least = math.asin(min(1.0, CLEARANCE / max(gap, 1e-6)))
        if abs(off) < least:
            # Pass on the nearer side, or on the right if the other robot is straight ahead.
            bearing += (least if off > 1e-3 else -least) - off
    return _wrapped(bearing)


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


if __name__ == "__main__":
    hills = tb.terrain.synthetic_terrain(size=(150.0, 150.0), resolution=1.0, seed=3)
    workspace = tb.Workspace.from_terrain(hills, (3, 3))
    mission = MujocoSimulator(workspace).run([(2, 0), (1, 1)], seed=0)
    print(mission.status, mission.contact_rate)
