"""A simulator of one's own: robots slip, get stuck, tip over and collide in MuJoCo.

    pip install mujoco
    python examples/mujoco/simulator.py

It inherits bounds, posts and contacts from `KinematicSimulator` and replaces the motion.
Import it with this folder on the path, for example

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
"""Width of the ground simulated around the pixels that a route may use, m."""
CONTROL = 0.05
"""Longest time between two commands to the wheels, s."""
TIPPED, ON_ITS_SIDE = math.radians(75.0), math.radians(60.0)
"""Angle of a body with the vertical, and with the ground's normal, beyond which it has tipped."""
PROGRESS = 0.25
"""Distance along its route that a robot must gain not to be stuck, m."""
CLEARANCE, AVOIDANCE_RANGE = 1.3, 4.0
"""Distance that a robot keeps from another, centre to centre, and range of avoidance, m."""
COLLISION_TIME = 3.0
"""Upper limit of the time from a touch to a failure that counts as a collision, s."""
STILL = 0.05
"""Least displacement of a robot at its goal that counts as motion, m."""
SLOW = 1.5
"""Highest speed at which a robot that reaches its goal stops there, m/s."""
GRIP_SD, SLIP_SD = 0.1, 0.05
"""Log standard deviations of a robot's grip per drive, and of a side's wheel speed per tick."""


class MujocoSimulator(KinematicSimulator):
    """Simulator of skid-steer robots with weight, grip and torque on the DEM as a heightfield.

    Bounds, posts, routes and contacts are those of `KinematicSimulator`; motion along the
    routes is physics. All robots are of the size of a Husky (1.0 x 0.7 x 0.4 m, 50 kg); the
    `max_slope` of a `Robot` sets the height of its centre of mass and the grip of its wheels: it
    tips over and slides some degrees beyond it. Robots steer for a point ahead, slow down on slopes
    as kinematic ones do, and go round each other.

    A mission ends as `"tipped"` if a body leans 75 degrees, or 60 degrees from the ground under it;
    as `"stuck"` if a robot comes no farther along its route for `stuck_after` seconds, has no
    route, or slides off the ground around the two cells; as `"collision"` instead if it touched
    another one just before; as `"timeout"` after `bound_timeout`; as `"aborted"` if the physics
    breaks down.

    Only robots that move are in the physics: those that watch are no obstacles, nor is vegetation.
    Same seed, same mission, on one machine with one version of MuJoCo.
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
            workspace: A workspace made from a terrain.
            friction: Mean friction coefficient of the wheels on the ground; None: the least that
                each robot needs for its `max_slope`.
            stuck_after: Time without progress after which a robot is stuck, s.
            step: Longest physics step, s.
            **options: Options of `KinematicSimulator`, such as `sight` and `tick`.

        Raises:
            TrustboError: A value that is not positive, or what `KinematicSimulator` refuses.
        """
        super().__init__(workspace, **options)
        self.friction = None if friction is None else require_positive("friction", friction)
        self.stuck_after = require_positive("stuck_after", stuck_after)
        self.step = require_positive("step", step)

    def describe(self) -> dict[str, object]:
        """Return the settings that decide what a mission measures."""
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
        """The window's pixels on the true surface, whose raster may be another."""
        planned = self.workspace.surface
        if planned.pixel == true.pixel and planned.origin == true.origin:
            return window
        y, x = planned.axes
        row, col = true.nearest(x[[window[2], window[3] - 1]], y[[window[0], window[1] - 1]])
        return int(row[0]), int(row[1]) + 1, int(col[0]), int(col[1]) + 1


class _Convoy:
    """Group of robots that drive at the same time, each along one route."""

    def __init__(
        self, physics: Physics, legs: "list[_Leg]", surface: Surface, stuck_after: float
    ) -> None:
        """Begin; the surface's gradient determines which robots lie on their side."""
        self._physics, self._legs = physics, legs
        self._surface, self._stuck_after = surface, stuck_after
        self._untouched = np.full(len(legs), np.inf)  # s

    def advance(self, slip: np.ndarray, seconds: float, n_steps: int) -> str:
        """Command the wheels, let the physics run `n_steps`, and return "underway" or the status.

        `slip` are factors on the wheels' speeds, shape (robot, side).
        """
        physics, legs, poses = self._physics, self._legs, self._physics.poses
        tilt = np.arccos(np.clip(physics.up[:, 2], -1.0, 1.0))
        asked = np.zeros((len(legs), 2))
        for i, leg in enumerate(legs):
            if not leg.arrived:
                others = np.delete(poses[:, :2], i, axis=0)
                asked[i] = leg.steer(poses[i], tilt[i], others)
        # Wheels that slip are asked for the missing speed on top; robots that have arrived brake.
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
        """Poses to record after the last ones, shape (robot, 3).

        A robot that only creeps at its goal has not moved: it measures nothing more.
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
    """Route of one robot to its goal, its progress, and its steering."""

    def __init__(self, route: np.ndarray, robot: Robot) -> None:
        """Begin a route, shape (point, 2), CRS metres."""
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1)))
        self._along = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / 0.25) + 1))
        self._points = np.column_stack([np.interp(self._along, along, xy) for xy in route.T])
        self._robot, self._reach = robot, LOOKAHEAD + 0.25 * robot.speed
        self._position, self._best = 0, 0.0
        self.idle, self.arrived = 0.0, False

    def update(self, position: np.ndarray, speed: float, seconds: float) -> None:
        """Update the progress of the robot, some seconds after the last update.

        A robot that slides past its goal has not arrived.
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
        """Speed, m/s, and yaw rate, rad/s, towards a point ahead, round other robots.

        From the pose (x, y, heading), the body's angle with the vertical, rad, and the positions of
        the other robots, shape (robot, 2), CRS metres.
        """
        robot, left = self._robot, math.dist(pose[:2], self._points[-1])
        ahead = np.searchsorted(self._along, self._along[self._position] + self._reach)
        dx, dy = self._points[min(int(ahead), len(self._points) - 1)] - pose[:2]
        bearing = _around(math.atan2(dy, dx), left, others - pose[:2])
        error = _wrapped(bearing - pose[2])
        share = max(SLOWEST, 1.0 - (1.0 - SLOWEST) * tilt / robot.max_slope)
        # Slow enough to stop at the goal; turns on the spot until it faces its route.
        speed = min(robot.speed * share, 2.0 * left) * max(0.0, math.cos(error))
        return speed, min(robot.turn_rate, max(-robot.turn_rate, 2.0 * error))


def _around(bearing: float, left: float, others: np.ndarray) -> float:
    """Bearing to steer for, rad, corrected to pass other robots with clearance.

    `left` is the distance to the goal, m; others' positions are relative to this one, (robot, 2),
    m.
    """
    for x, y in others:
        gap = math.hypot(x, y)
        if gap > min(left + 0.5, AVOIDANCE_RANGE):
            continue
        off = _wrapped(bearing - math.atan2(y, x))
        least = math.asin(min(1.0, CLEARANCE / max(gap, 1e-6)))
        if abs(off) < least:
            # Pass on the nearer side; head on, to the right.
            bearing += (least if off > 1e-3 else -least) - off
    return _wrapped(bearing)


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


if __name__ == "__main__":
    hills = tb.terrain.synthetic_terrain(size=(150.0, 150.0), resolution=1.0, seed=3)
    workspace = tb.Workspace.from_terrain(hills, (3, 3))
    mission = MujocoSimulator(workspace).run([(2, 0), (1, 1)], seed=0)
    print(mission.status, mission.contact_rate)
