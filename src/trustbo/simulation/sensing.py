"""Who looks at whom, and what a lidar makes of its looks: tracks."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numba import njit

from trustbo.data import Robot, Team
from trustbo.simulation.bounding import Drive
from trustbo.simulation.sight import optics


class Looks(NamedTuple):
    """Looks between the lead and each robot of T2: by those who stand, at those who move."""

    sensor: np.ndarray  # (tick * robot, 2), CRS metres
    target: np.ndarray  # likewise
    glass: np.ndarray  # (tick * robot, 4), see `sight.optics`
    t2_looks: np.ndarray  # (tick, 1), else the lead does

    @classmethod
    def of(cls, team: Team, drives: Sequence[Drive]) -> Self:
        """The looks of some bounds, one after the other."""
        poses = np.concatenate([drive.poses[..., :2] for drive in drives])
        t2_looks = np.concatenate([drive.lead_moves for drive in drives])[:, None]
        lead = np.repeat(poses[:, :1], len(team.robots), axis=1)
        by_t2 = np.stack([optics(robot, team.lead) for robot in team.robots])
        by_lead = np.stack([optics(team.lead, robot) for robot in team.robots])
        return cls(
            np.where(t2_looks[..., None], poses[:, 1:], lead).reshape(-1, 2),
            np.where(t2_looks[..., None], lead, poses[:, 1:]).reshape(-1, 2),
            np.where(t2_looks[..., None], by_t2, by_lead).reshape(-1, 4),
            t2_looks,
        )


def new_tracks(n_robots: int) -> np.ndarray:
    """Nobody tracked yet: (phase, robot, (tracked, run of contrary looks))."""
    return np.zeros((2, n_robots, 2), np.int64)


def contact_of(found: np.ndarray, watchers: Sequence[Robot], tracks: np.ndarray) -> np.ndarray:
    """Contact from looks: a track begins after some finds in a row, and ends after some misses.

    Args:
        found: Whether each look found its target, shape (tick, robot).
        watchers: Whose lidar looks, one per robot: they say how many finds and misses.
        tracks: State of the tracks, shape (robot, 2); it is moved on.

    Returns:
        Shape (tick, robot), bool.
    """
    limits = np.array([[robot.acquire, robot.drop] for robot in watchers])
    contact = np.empty(found.shape, bool)
    _track(found, limits, tracks, contact)
    return contact


@njit(cache=True)
def _track(found, limits, tracks, contact):
    for k in range(found.shape[0]):
        for i in range(found.shape[1]):
            tracked = tracks[i, 0]
            if found[k, i] != (tracked == 1):
                tracks[i, 1] += 1
                if tracks[i, 1] >= limits[i, tracked]:
                    tracks[i, 0], tracks[i, 1] = 1 - tracked, 0
            else:
                tracks[i, 1] = 0
            contact[k, i] = tracks[i, 0] == 1


def cut_at_lost_contact(contact: np.ndarray, patience: int, status: str) -> tuple[int, str]:
    """How many ticks a bound has that ends when nobody has had contact for `patience` ticks."""
    alone = 0
    for k, any_contact in enumerate(contact.any(1)):
        alone = 0 if any_contact else alone + 1
        if alone >= patience:
            return k + 1, "lost_contact"
    return len(contact), status
