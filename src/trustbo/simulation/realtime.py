"""Real-time awareness of the paper, which combines the map with measurements of moving robots.

Each feature is the first principal component of its value on the map and the robot's measurements.
The robot estimates traversability from its motion, and visibility from the returns of its lidar.
The inputs are means over the ticks of a bound in which the robot moves.
"""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Bound, Mission
from trustbo.errors import TrustboError
from trustbo.simulation.kinematic import KinematicSimulator
from trustbo.simulation.world import World
from trustbo.terrain import CompositeIndex
from trustbo.workspace.sight import detection_between, optics

SIGNS = {
    "traversability": {"map": +1, "speed_ratio": +1, "pitch": -1, "roll": -1},
    "visibility": {"map": +1, "return_range": +1, "visible_share": +1},
}
"""Inputs of each feature, with the signs of their effects; pitch is in rad, range in m."""
MIN_SAMPLES = 200
"""Smallest number of samples (robots x bounds); loadings from fewer samples are unstable."""
_SHARES = np.array([0.25, 0.5, 0.75, 1.0])
"""Points along a beam, as shares of its reach, up to which sight is computed."""
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
"""Directions of the twelve beams of a lidar, rad from east, anticlockwise."""


class RealtimeAwareness:
    """Awareness measured by the robots during a bound.

    Attributes:
        indices: Fitted `CompositeIndex` of each feature.
    """

    def __init__(self, simulator: KinematicSimulator, missions: Sequence[Mission]) -> None:
        """Fit the indices to calibration missions; raises TrustboError if there are too few."""
        self._workspace = simulator.workspace
        self._world = simulator.world()
        self._tick = simulator.tick
        samples = [self.inputs(bound) for mission in missions for bound in mission.bounds]
        n = len(samples) * self._world.team.n_robots
        if n < MIN_SAMPLES:
            raise TrustboError(
                f"real-time awareness needs {MIN_SAMPLES} samples (robots x bounds); got {n}. Give "
                "more missions."
            )

        self.indices = {}
        for feature, signs in SIGNS.items():
            inputs = {
                name: np.concatenate([sample[feature][name] for sample in samples])
                for name in signs
            }
            self.indices[feature] = CompositeIndex(signs).fit(inputs)

    def inputs(self, bound: Bound) -> dict[str, dict[str, np.ndarray]]:
        """Compute the inputs of each feature (see `SIGNS`), each of shape (robot,)."""
        world = self._world
        workspace = self._workspace
        poses = bound.poses[:, 1:]  # pyright: ignore[reportOptionalSubscript]

        way = np.diff(poses[..., :2], axis=0, prepend=poses[:1, :, :2])
        speed = np.hypot(way[..., 0], way[..., 1]) / self._tick
        gx, gy = world.surface.gradient[:, *world.surface.nearest(poses[..., 0], poses[..., 1])]

        ahead = np.cos(poses[..., 2])
        left = np.sin(poses[..., 2])
        state = lidar_state(world, poses) | {
            "speed_ratio": np.minimum(speed / [robot.speed for robot in world.team.robots], 1.0),
            "pitch": np.abs(np.arctan(gx * ahead + gy * left)),
            "roll": np.abs(np.arctan(gy * ahead - gx * left)),
        }

        place = workspace.surface.nearest(poses[..., 0], poses[..., 1])  # pyright: ignore[reportOptionalMemberAccess]
        moved = speed > 0.0
        moved[0] |= ~moved.any(0)  # the first tick represents a robot that never moves

        found = {}
        for feature, signs in SIGNS.items():
            ticks = state | {"map": workspace.pixels[feature].values[place]}  # pyright: ignore[reportOptionalSubscript]
            found[feature] = {n: (ticks[n] * moved).sum(0) / moved.sum(0) for n in signs}
        return found

    def measured(self, mission: Mission) -> Mission:
        """Return the mission with the features of `SIGNS` as measured by the robots."""
        z = mission.awareness.copy()
        for k, bound in enumerate(mission.bounds):
            for feature, inputs in self.inputs(bound).items():
                column = mission.features.index(feature)
                z[k, :, column] = self.indices[feature].transform(inputs)
        return mission.with_awareness(z)


def lidar_state(world: World, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the mean range of returns (m) and the fraction of clear beams, (tick, robot).

    The mean range is the integral over the range of the fraction of beams that reach it.
    """
    robot = world.team.robots[0]
    low, high = np.reshape(world.surface.extent, (2, 2))
    reach = min(robot.lidar_range, 0.5 * float((high - low).min()))
    beams = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
    eye = poses[..., None, None, :2]
    target = np.clip(eye + reach * _SHARES[:, None, None] * beams, low, high)

    lidar = optics(robot, world.team.lead)
    clear = detection_between(world.surface, world.sight, eye, target, lidar).mean(-1)

    seen = np.insert(clear, 0, 1.0, axis=-1)  # (tick, robot, 1 + share)
    reached = np.asarray(np.trapezoid(seen, [0.0, *_SHARES], axis=-1))
    return {"return_range": reach * reached, "visible_share": seen[..., -1]}
