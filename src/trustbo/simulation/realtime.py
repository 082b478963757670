"""Real-time awareness of the paper, which combines the map with measurements of moving robots.

Each feature is the first principal component of its value on the map and the robot's measurements.
The robot estimates traversability from its motion, and visibility from the returns of its lidar.
The inputs are means over the ticks of a bound in which the robot moves.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError, require_kind, require_whole
from trustbo.identity import fingerprint
from trustbo.simulation.kinematic import KinematicSimulator
from trustbo.simulation.protocol import DescribedSimulator
from trustbo.simulation.world import World
from trustbo.stacking import list_of_missions
from trustbo.team import Robot
from trustbo.terrain import CompositeIndex
from trustbo.workspace.moves import cells_ahead
from trustbo.workspace.sight import detection_between, optics

SIGNS = {
    "traversability": {"map": +1, "speed_ratio": +1, "pitch": -1, "roll": -1},
    "visibility": {"map": +1, "return_range": +1, "visible_share": +1},
}
"""Inputs of each feature, with the signs of their effects; pitch is in rad, range in m."""
MIN_SAMPLES = 200
"""Smallest number of samples (robots x bounds); loadings from fewer samples are unstable."""
_MOST_BOUNDS = 10
"""Largest number of bounds of a random walk."""
_MOST_WALKS = 1000
"""Largest number of random walks for calibration."""
_SHARES = np.array([0.25, 0.5, 0.75, 1.0])
"""Points along a beam, as shares of its reach, up to which sight is computed."""
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
"""Directions of the twelve beams of a lidar, rad from east, anticlockwise."""


class RealtimeAwareness(DescribedSimulator):
    """Simulator whose missions contain the awareness that the robots measured in each bound.

    Missions are run in a `KinematicSimulator`. Traversability is replaced with the first principal
    component of the map and of the measured speed, pitch and roll. Visibility is replaced with the
    first principal component of the map and of a lidar's range and share of clear beams. Other
    features remain those of the map. A campaign learns from measured awareness if it is given
    `awareness="measured"`.

    Attributes:
        simulator: Simulator of the missions; use this one for `Truth.from_simulator`.
        workspace: Workspace of the simulator.
        indices: Fitted `CompositeIndex` of each feature, keyed by its name.

    Example:
        >>> robots = tb.simulation.RealtimeAwareness(tb.simulation.KinematicSimulator(workspace))
        >>> robots.run(path, seed=0).awareness  # (bound, robot, feature)
    """

    def __init__(
        self,
        simulator: KinematicSimulator,
        missions: Iterable[Mission] | None = None,
        *,
        seed: int = 0,
    ) -> None:
        """Fit the indices to calibration missions.

        Args:
            simulator: Simulator of the missions.
            missions: Missions of this simulator, with poses, in the world of mission 0; by default,
                missions on random paths.
            seed: Seed of the random paths.

        Raises:
            TrustboError: The workspace lacks a feature of `SIGNS`, or there are fewer than 200
                samples (robots x bounds), or a bound has no poses.
        """
        remedy = "give a trustbo.simulation.KinematicSimulator"
        self.simulator = require_kind("simulator", simulator, KinematicSimulator, remedy)
        self.workspace = simulator.workspace
        missing = [feature for feature in SIGNS if feature not in self.workspace.features]
        if missing or self.workspace.pixels is None:
            raise TrustboError(
                f"real-time awareness needs the features {', '.join(SIGNS)} of a terrain; the "
                f"workspace has {', '.join(self.workspace.features)}."
            )

        if missions is None:
            missions = _random_missions(simulator, require_whole("seed", seed, 0))
        else:
            missions = list_of_missions(missions)

        samples = [self.inputs(bound) for mission in missions for bound in mission.bounds]
        n = len(samples) * self.workspace.team.n_robots
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

    def describe(self) -> dict[str, object]:
        """Return the settings that affect the measurements of a mission."""
        fitted = [self.indices[feature].fitted for feature in SIGNS]
        numbers = [one[name].values for one in fitted for name in ("loading", "low", "high")]
        return {**self.simulator.describe(), "realtime_awareness": fingerprint(numbers)}

    def describe_world(self, mission: int) -> dict[str, object]:
        """Return the settings of a mission's world, which are equal for equal worlds."""
        return self.simulator.describe_world(mission)

    def run(
        self,
        path: Sequence[Cell],
        *,
        seed: int,
        mission: int = 0,
        post_sets: Sequence[str] = (),
    ) -> Mission:
        """Run a path and measure awareness; see `KinematicSimulator.run`."""
        run = self.simulator.run(path, seed=seed, mission=mission, post_sets=post_sets)
        return self.measured(run, number=mission)

    def inputs(self, bound: Bound, *, number: int = 0) -> dict[str, dict[str, np.ndarray]]:
        """Compute the inputs of each feature (see `SIGNS`), each of shape (robot,).

        Args:
            bound: Bound with poses.
            number: Number of the mission, from 0, which determines the active events.

        Raises:
            TrustboError: The bound has no poses.
        """
        if bound.poses is None:
            raise TrustboError(
                f"the bound into {bound.cell} has no poses, from which awareness is measured."
            )

        world = self.simulator.world(number)
        workspace = self.workspace
        poses = bound.poses[:, 1:]

        way = np.diff(poses[..., :2], axis=0, prepend=poses[:1, :, :2])
        speed = np.hypot(way[..., 0], way[..., 1]) / self.simulator.tick
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

    def measured(self, mission: Mission, *, number: int = 0) -> Mission:
        """Return a mission with the features of `SIGNS` as measured by the robots.

        Args:
            mission: Mission of the simulator, with poses.
            number: Number of the mission, from 0, which determines the active events.

        Raises:
            TrustboError: A bound has no poses.
        """
        z = mission.awareness.copy()
        for k, bound in enumerate(mission.bounds):
            for feature, inputs in self.inputs(bound, number=number).items():
                column = mission.features.index(feature)
                z[k, :, column] = self.indices[feature].transform(inputs)
        return mission.with_awareness(z)


def _random_missions(simulator: KinematicSimulator, seed: int) -> list[Mission]:
    """Run missions on random paths without loops, until there are enough samples."""
    rng = np.random.default_rng(seed)
    bounds = simulator.workspace.passable_bounds.values
    n_needed = -(-MIN_SAMPLES // simulator.team.n_robots)

    onward = cells_ahead(bounds)
    starts = sorted(onward)

    missions = []
    n_bounds = 0
    for n in range(_MOST_WALKS if starts else 0):
        path = [starts[rng.integers(len(starts))]]
        while len(path) <= _MOST_BOUNDS:
            new = [cell for cell in onward[path[-1]] if cell not in path and cell in onward]
            if not new:
                break
            path.append(new[rng.integers(len(new))])

        if len(path) > 1:
            missions.append(simulator.run(path, seed=seed + n))
            n_bounds += len(missions[-1].bounds)
        if n_bounds >= n_needed:
            break
    return missions


def lidar_state(world: World, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the mean range of returns (m) and the fraction of clear beams, (tick, robot).

    The mean range is the integral over the range of the fraction of beams that reach it. The poses
    have shape (tick, robot, 3).
    """
    states = [_lidar_state(world, robot, poses[:, i]) for i, robot in enumerate(world.team.robots)]
    ranges, shares = zip(*states, strict=True)
    return {"return_range": np.stack(ranges, axis=1), "visible_share": np.stack(shares, axis=1)}


def _lidar_state(world: World, robot: Robot, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean range of returns (m) and the fraction of clear beams of a robot, (tick,)."""
    low, high = np.reshape(world.surface.extent, (2, 2))
    reach = min(robot.lidar_range, 0.5 * float((high - low).min()))
    beams = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
    eye = poses[..., None, None, :2]
    target = np.clip(eye + reach * _SHARES[:, None, None] * beams, low, high)

    lidar = optics(robot, world.team.lead)
    clear = detection_between(world.surface, world.sight, eye, target, lidar).mean(-1)

    seen = np.insert(clear, 0, 1.0, axis=-1)  # (tick, 1 + share)
    reached = np.asarray(np.trapezoid(seen, [0.0, *_SHARES], axis=-1))
    return reach * reached, seen[..., -1]
