"""Contact by lidar: scans detect robots, and tracks persist over a few misses.

At each tick, each standing robot scans each moving robot once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trustbo.kernels import kernel
from trustbo.simulation.world import World
from trustbo.team import Robot
from trustbo.workspace.sight import detection_probability, optics


class Drive(NamedTuple):
    """Movements of the robots in one bound."""

    poses: np.ndarray
    """Position and heading of each robot, the lead first, shape (tick, 1 + robot, 3)."""
    lead_moves: np.ndarray
    """Whether the lead (rather than T2) moves in each tick, shape (tick,)."""
    status: str
    """Outcome of the bound."""
    stops: np.ndarray
    """Planned positions of the robots after the bound, shape (1 + robot, 2)."""


def detections(world: World, drives: Sequence[Drive], k: int) -> list[np.ndarray]:
    """Compute the probability, for each drive, that each scan detects its target, (tick, robot).

    The drives are alternatives for the k-th bound of a mission, counted from 1.
    """
    team = world.team
    poses = np.concatenate([drive.poses[..., :2] for drive in drives])
    t2_scans = np.concatenate([drive.lead_moves for drive in drives])[:, None]  # else the lead
    lead = np.repeat(poses[:, :1], team.n_robots, axis=1)
    t2 = poses[:, 1:]

    by_t2 = np.stack([optics(robot, team.lead) for robot in team.robots])
    by_lead = np.stack([optics(team.lead, robot) for robot in team.robots])

    # One row for each tick and robot: who scans, and whom.
    by_robot = t2_scans[..., None]
    sensor = np.where(by_robot, t2, lead).reshape(-1, 2)
    target = np.where(by_robot, lead, t2).reshape(-1, 2)
    scanners = np.where(by_robot, by_t2, by_lead).reshape(-1, by_t2.shape[-1])

    probability = detection_probability(world.surface, world.sight, sensor, target, scanners)
    for mask, strength in world.jams:
        inside = mask[world.surface.nearest(sensor[:, 0], sensor[:, 1])]
        inside |= mask[world.surface.nearest(target[:, 0], target[:, 1])]
        probability[inside] *= 1.0 - strength

    probability = probability.reshape(-1, team.n_robots)
    detection = world.detection[min(k, len(world.detection)) - 1]
    probability *= np.where(t2_scans, detection, world.lead_detection)

    ends = np.cumsum([len(drive.poses) for drive in drives])
    return np.split(probability, ends[:-1])


def new_tracks(n_robots: int) -> np.ndarray:
    """Return tracks (phase, robot, 2): tracked or not, and number of successive contrary scans."""
    return np.zeros((2, n_robots, 2), np.int64)


def contact_of(detected: np.ndarray, watchers: Sequence[Robot], tracks: np.ndarray) -> np.ndarray:
    """Compute the contact from scans, shape (tick, robot), bool.

    `detected` (tick, robot) contains the outcome of each scan. A track begins after `acquire`
    successive detections and ends after `drop` successive misses; both numbers are properties of
    the watcher. The state of the tracks, shape (robot, 2), is updated in place.
    """
    limits = np.array([[robot.acquire, robot.drop] for robot in watchers])
    contact = np.empty(detected.shape, bool)
    _track(detected, limits, tracks, contact)
    return contact


@kernel()
def _track(detected, limits, tracks, contact):
    """Write the contact after each scan, and update the tracks."""
    for k in range(detected.shape[0]):
        for i in range(detected.shape[1]):
            tracked = tracks[i, 0]
            if detected[k, i] != (tracked == 1):
                tracks[i, 1] += 1
                if tracks[i, 1] >= limits[i, tracked]:
                    tracks[i, 0] = 1 - tracked
                    tracks[i, 1] = 0
            else:
                tracks[i, 1] = 0
            contact[k, i] = tracks[i, 0] == 1
