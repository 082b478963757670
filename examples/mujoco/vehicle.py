"""MuJoCo model of skid-steer robots on a heightfield, their placement and motion."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from trustbo.team import Robot
from trustbo.workspace.surface import Surface, filled

# Dimensions of a Husky: 1.0 x 0.7 x 0.4 m overall, 50 kg.
MASS, WHEEL_MASS = 50.0, 2.5
WHEEL_RADIUS, WHEEL_WIDTH = 0.165, 0.12
WHEELBASE, TRACK = 0.66, 0.57
"""Distance between the axles, and between the left and right wheels, m."""
STIFFNESS, DAMPING = 5000.0, 400.0
"""Stiffness, N/m, and damping, N s/m, of wheel springs, to keep all wheels on rough ground."""
TORQUE = 80.0
"""Maximum torque of a wheel motor, N m, which can spin the wheel at any grip."""
TIP_MARGIN, GRIP_MARGIN = math.radians(8.0), math.radians(12.0)
"""Angles above `max_slope` at which a robot (with rigid springs) tips over, and slides, rad."""
APART = 1.1
"""Minimum distance between the centres of robots when they are placed, m."""
SETTLING = 1.0
"""Maximum time for robots to come to rest after they were placed, s."""
_BODY, _CLEARANCE = (0.90, 0.45, 0.24), 0.13  # length, width, height; above ground, m
_LOWEST, _HIGHEST = 0.10, 0.40  # limits of the centre of mass, m above ground
_WHEELS = np.array([(x * WHEELBASE, y * TRACK) for x in (0.5, -0.5) for y in (0.5, -0.5)])
_HULL = MASS - len(_WHEELS) * WHEEL_MASS
# Wheels slip sideways in a turn, so a skid-steer robot yaws as if its track were wider. The factor
# follows from the balance of Coulomb friction; with high grip, the track is 40 % wider (measured).
_YAW_TRACK = 1.4 * (TRACK + WHEELBASE**2 / TRACK)


class Ground(NamedTuple):
    """Part of the terrain; x and y are relative to its centre, heights to its lowest point, m."""

    heights: np.ndarray  # (row, col), m, row 0 in the south
    pixel: tuple[float, float]  # height, width of a pixel, m
    center: tuple[float, float]  # x and y of the centre, CRS metres

    @property
    def half_size(self) -> np.ndarray:
        """Half the distance between the centres of the outer pixels along x and y, m."""
        rows, cols = self.heights.shape
        return 0.5 * np.array([(cols - 1) * self.pixel[1], (rows - 1) * self.pixel[0]])

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Interpolate heights (bilinear), m, at positions in metres from the centre."""
        rows, cols = self.heights.shape
        col = np.clip((x + self.half_size[0]) / self.pixel[1], 0.0, cols - 1.001)
        row = np.clip((y + self.half_size[1]) / self.pixel[0], 0.0, rows - 1.001)
        i, j = row.astype(int), col.astype(int)
        s, t = row - i, col - j
        south = (1.0 - t) * self.heights[i, j] + t * self.heights[i, j + 1]
        north = (1.0 - t) * self.heights[i + 1, j] + t * self.heights[i + 1, j + 1]
        return (1.0 - s) * south + s * north


def crop(surface: Surface, window: tuple[int, int, int, int], margin: float) -> Ground:
    """Crop a window (first row, end row, first col, end col) of pixels, and a margin, m.

    Missing heights, and heights beyond the edge of the terrain, are those of the nearest pixel.
    """
    (height, width), (rows, cols) = surface.pixel, surface.ground.shape
    more = [math.ceil(margin / size) for size in surface.pixel]
    row = np.arange(window[0] - more[0], window[1] + more[0])
    col = np.arange(window[2] - more[1], window[3] + more[1])
    cut = np.ix_(np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1))
    heights = filled(surface.ground[cut])[::-1]
    x = surface.origin[0] + 0.5 * float(col[0] + col[-1]) * width
    y = surface.origin[1] - 0.5 * float(row[0] + row[-1]) * height
    return Ground(heights - heights.min(), surface.pixel, (x, y))


def grip_of(robot: Robot) -> float:
    """Return the friction coefficient at which a robot slides `GRIP_MARGIN` above `max_slope`."""
    return math.tan(min(robot.max_slope + GRIP_MARGIN, math.radians(80.0)))


def center_of_mass(robot: Robot) -> float:
    """Return the height of the centre of mass, m, to tip over `TIP_MARGIN` above `max_slope`."""
    angle = min(robot.max_slope + TIP_MARGIN, math.radians(85.0))
    return min(_HIGHEST, max(_LOWEST, 0.5 * TRACK / math.tan(angle)))


class Physics:
    """Physics of robots that are driven by the speeds of their left and right wheels.

    Poses are x, y (CRS metres) and heading (rad from east, counterclockwise).
    """

    def __init__(
        self, ground: Ground, robots: Sequence[Robot], grip: Sequence[float], step: float
    ) -> None:
        """Build the model; the `max_slope` of a robot determines its centre of mass.

        `grip` is the friction coefficient of each robot's wheels, and `step` the time step, s.
        """
        self._ground, self._step = ground, step
        self.model = mujoco.MjModel.from_xml_string(_model(ground, robots, grip, step))
        self.model.hfield_data[:] = (ground.heights / _relief(ground)).ravel()
        self.data = mujoco.MjData(self.model)
        self._bodies = [self.model.body(f"robot{i}").id for i in range(len(robots))]
        # Views of MuJoCo's arrays, one row per robot.
        self._qpos = self.data.qpos.reshape(len(robots), -1)
        self._qvel = self.data.qvel.reshape(len(robots), -1)
        self._brake = self.model.dof_frictionloss.reshape(len(robots), -1)[:, 7::2]

    def place(self, poses: np.ndarray) -> None:
        """Place robots at poses (robot, 3), parallel to the ground, and wait until they rest.

        Robots that would overlap are moved apart.
        """
        local = poses - [*self._ground.center, 0.0]
        local[:, :2] = _spread(local[:, :2])
        for qpos, (x, y, heading) in zip(self._qpos, local, strict=True):
            qpos[:7] = self._standing(x, y, heading)
        self.command(np.zeros((len(poses), 2)))
        for _ in range(round(SETTLING / 0.1)):
            self.advance(round(0.1 / self._step))
            if np.abs(self._qvel[:, :6]).max() < 0.02:
                break

    def command(self, speeds: np.ndarray) -> None:
        """Set the speeds of left and right wheels, (robot, 2), m/s; (0, 0) applies the brake."""
        self.data.ctrl[:] = np.tile(speeds, 2).ravel() / WHEEL_RADIUS
        parked = (speeds == 0.0).all(1)
        self._brake[:] = np.where(parked, TORQUE, 0.0)[:, None]

    def advance(self, n_steps: int) -> None:
        """Advance by a number of physics steps."""
        mujoco.mj_step(self.model, self.data, n_steps)

    @property
    def poses(self) -> np.ndarray:
        """Poses of the robots, shape (robot, 3)."""
        ahead = self._axes[0]
        heading = np.arctan2(ahead[:, 1], ahead[:, 0])
        return np.column_stack([self._qpos[:, :2] + self._ground.center, heading])

    @property
    def rates(self) -> np.ndarray:
        """Forward speed, m/s, and yaw rate, rad/s, of the bodies, shape (robot, 2)."""
        ahead = (self._qvel[:, :3] * self._axes[0]).sum(1)
        return np.column_stack([ahead, self._qvel[:, 5]])

    @property
    def speed(self) -> np.ndarray:
        """Speed of the bodies in any direction, shape (robot,), m/s."""
        return np.linalg.norm(self._qvel[:, :3], axis=1)

    @property
    def up(self) -> np.ndarray:
        """Upward unit vectors of the bodies, shape (robot, 3)."""
        return self._axes[1]

    @property
    def is_finite(self) -> bool:
        """Whether all positions and velocities are finite."""
        return bool(np.isfinite(self._qpos).all() and np.isfinite(self._qvel).all())

    @property
    def off_ground(self) -> np.ndarray:
        """Whether each robot has left the simulated ground, shape (robot,)."""
        inside = (np.abs(self._qpos[:, :2]) < self._ground.half_size).all(1)
        return ~inside | (self._qpos[:, 2] < -1.0)

    @property
    def touching(self) -> np.ndarray:
        """Whether each robot touches another robot, shape (robot,)."""
        bodies = self.model.body_rootid[self.model.geom_bodyid[self.data.contact.geom]]
        return np.isin(self._bodies, bodies[(bodies > 0).all(1)])

    @property
    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Forward and upward axes of the bodies, each (robot, 3), from their quaternions."""
        w, x, y, z = self._qpos[:, 3:7].T
        ahead = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y))
        up = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
        return np.column_stack(ahead), np.column_stack(up)

    def _standing(self, x: float, y: float, heading: float) -> np.ndarray:
        """Return position and quaternion of a robot whose wheels touch the ground, shape (7,)."""
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        wheels = _WHEELS @ turn.T
        z = self._ground.height(x + wheels[:, 0], y + wheels[:, 1])
        # Fit a plane to the ground under the wheels, and raise it above all four contact points.
        slope = np.linalg.lstsq(wheels, z - z.mean(), rcond=None)[0]
        base = float((z - wheels @ slope).max())
        up = np.array([*-slope, 1.0]) / np.sqrt(1.0 + slope @ slope)
        ahead = np.array([*turn[:, 0], slope @ turn[:, 0]])
        ahead /= np.linalg.norm(ahead)
        rotation, quaternion = np.column_stack([ahead, np.cross(up, ahead), up]), np.empty(4)
        mujoco.mju_mat2Quat(quaternion, rotation.ravel())
        return np.array([x, y, base + (WHEEL_RADIUS + 0.005) / up[2], *quaternion])


def wheel_speeds(speed: np.ndarray, yaw_rate: np.ndarray) -> np.ndarray:
    """Return the speeds of the left and right wheels, (robot, 2), m/s, for speed and yaw rate."""
    aside = 0.5 * _YAW_TRACK * yaw_rate
    return np.column_stack([speed - aside, speed + aside])


def _spread(xy: np.ndarray) -> np.ndarray:
    """Return positions (robot, 2), moved apart where robots are too close to each other."""
    xy, turn = xy.copy(), 2.0 * np.pi * np.arange(len(xy)) / len(xy)
    for _ in range(100):
        gap = xy[:, None] - xy
        distance = np.linalg.norm(gap, axis=2) + APART * np.eye(len(xy))
        if (distance >= APART - 1e-3).all():
            break
        # Robots at the same position are pushed in different directions.
        xy += (
            0.01 * (distance.min(1) < 1e-3)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        )
        push = np.maximum(0.0, APART - distance) / np.maximum(distance, 1e-3)
        xy += 0.5 * (push[..., None] * gap).sum(1)
    return xy


def _relief(ground: Ground) -> float:
    """Return the height of the heightfield, m, which must be positive in MuJoCo."""
    return max(float(ground.heights.max()), 1e-3)


def _model(ground: Ground, robots: Sequence[Robot], grip: Sequence[float], step: float) -> str:
    """Return the model in MJCF, the XML format of MuJoCo."""
    (rows, cols), (x, y) = ground.heights.shape, ground.half_size
    bodies = "".join(_body(i, r, g) for i, (r, g) in enumerate(zip(robots, grip, strict=True)))
    motors = "".join(
        f'<velocity joint="axle{i}_{k}" kv="60" forcerange="{-TORQUE} {TORQUE}"/>'
        for i in range(len(robots))
        for k in range(len(_WHEELS))
    )
    return f"""<mujoco>
    <option timestep="{step}" integrator="implicitfast" cone="elliptic" impratio="10">
      <flag autoreset="disable"/>
    </option>
    <asset>
      <hfield name="ground" nrow="{rows}" ncol="{cols}" size="{x} {y} {_relief(ground)} 5"/>
    </asset>
    <worldbody><geom type="hfield" hfield="ground" friction="0.01"/>{bodies}</worldbody>
    <actuator>{motors}</actuator>
    </mujoco>"""


def _body(i: int, robot: Robot, grip: float) -> str:
    """Return the MJCF of one robot, with the origin at axle height between the wheels."""
    length, width, height = _BODY
    # Raise the centre of the hull so that hull and wheels have the required centre of mass.
    raised = (center_of_mass(robot) - WHEEL_RADIUS) * MASS / _HULL
    inertia = [_HULL / 12.0 * (a * a + b * b)
               for a, b in ((width, height), (length, height), (length, width))]  # fmt: skip
    # The springs are in equilibrium under the weight of the hull.
    sag = -0.25 * _HULL * 9.81 / STIFFNESS
    wheels = "".join(
        f'<body pos="{x} {y} 0"><joint type="slide" axis="0 0 1" range="-0.08 0.08" limited="true" '
        f'springref="{sag}" stiffness="{STIFFNESS}" damping="{DAMPING}"/>'
        f'<joint name="axle{i}_{k}" axis="0 1 0" damping="0.05" armature="0.1" '
        f'solimpfriction="0.999 0.999 0.001"/>'
        f'<geom type="ellipsoid" size="{WHEEL_RADIUS} {0.5 * WHEEL_WIDTH} {WHEEL_RADIUS}" '
        f'mass="{WHEEL_MASS}" friction="{grip}"/></body>'
        for k, (x, y) in enumerate(_WHEELS)
    )
    return f"""<body name="robot{i}"><freejoint/>
      <inertial pos="0 0 {raised}" mass="{_HULL}" diaginertia="{" ".join(map(str, inertia))}"/>
      <geom type="box" size="{0.5 * length} {0.5 * width} {0.5 * height}"
            pos="0 0 {_CLEARANCE - WHEEL_RADIUS + 0.5 * height}" friction="0.4" priority="1"/>
      {wheels}</body>"""
