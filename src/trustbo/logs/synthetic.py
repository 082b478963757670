"""Logs made up by a simulation of robots with cameras, to try models on without data."""

import math

import numpy as np
from scipy.special import expit

from trustbo.errors import require_positive, require_whole
from trustbo.logs.geometry import hidden_by
from trustbo.logs.log import Log

_HALL = np.array([15.0, 8.0])  # m
_SPEED, _TURN = 0.15, 0.6  # m/s, rad/s
_HALF_VIEW, _REACH = 0.55, 5.5  # rad, m
_RADIUS = 0.17  # m
_STEP = 0.5  # s between poses
_LASTING = 0.95  # share of a deviation that lasts for a second


def synthetic_log(n_robots: int = 5, minutes: float = 10.0, *, seed: int = 0) -> Log:
    """Make up a log of robots that wander in a hall and detect each other with a camera.

    A camera sees 31 degrees to each side, some 5 m far, and not through robots. A robot has a
    quality of its camera, N(0, .7^2) of log odds, which stays; and each pair a deviation from
    what geometry expects, of sd 1, of which .95 lasts from each second to the next.

    Args:
        n_robots: Number of robots, r1, r2, ..., from 2.
        minutes: Length, min.
        seed: Seed.

    Raises:
        TrustboError: Fewer than two robots, or a length that is not positive.
    """
    n, rng = require_whole("n_robots", n_robots, 2), np.random.default_rng(seed)
    m = int(require_positive("minutes", minutes) * 60.0 / _STEP) + 1
    names = [f"r{i + 1}" for i in range(n)]
    tracks = np.stack([_wander(m, rng) for _ in names])  # (robot, time, 3)
    time = np.arange(m) * _STEP
    seconds = tracks[:, 1::2]
    quality, deviation = 0.7 * rng.standard_normal(n), rng.standard_normal((n, n))
    seen: dict[str, list] = {"t": [], "watcher": [], "seen": []}
    by_geometry = _log_odds(seconds)
    for k in range(seconds.shape[1]):
        noise = rng.standard_normal((n, n))
        deviation = _LASTING * deviation + np.sqrt(1.0 - _LASTING**2) * noise
        odds = by_geometry[..., k] + quality[:, None] + deviation
        for i, j in np.argwhere(rng.random((n, n)) < expit(odds)):
            for name, value in zip(seen, (k + 0.5, names[i], names[j]), strict=True):
                seen[name].append(value)
    poses = {"t": np.tile(time, n), "robot": np.repeat(names, m)}
    poses |= dict(zip(("x", "y", "heading"), tracks.reshape(-1, 3).T, strict=True))
    return Log(poses, seen, robot_radius=_RADIUS)


def _wander(n: int, rng: np.random.Generator) -> np.ndarray:
    """Poses of a robot that drives from one random place to the next, (time, 3)."""
    (x, y), heading = rng.random(2) * _HALL, float(rng.uniform(-np.pi, np.pi))
    goal, poses = rng.random(2) * _HALL, np.empty((n, 3))
    for k in range(n):
        poses[k] = x, y, heading
        if math.hypot(goal[0] - x, goal[1] - y) < 0.3:
            goal = rng.random(2) * _HALL
        off = math.remainder(math.atan2(goal[1] - y, goal[0] - x) - heading, 2.0 * math.pi)
        heading += min(max(off, -_TURN * _STEP), _TURN * _STEP)
        if abs(off) < 0.5:
            x, y = x + _SPEED * _STEP * math.cos(heading), y + _SPEED * _STEP * math.sin(heading)
    return poses


def _log_odds(poses: np.ndarray) -> np.ndarray:
    """Log odds of a detection in a second by the geometry alone, (watcher, seen, second)."""
    across = poses[None, ..., :2] - poses[:, None, :, :2]
    away = np.hypot(across[..., 0], across[..., 1])
    bearing = np.arctan2(across[..., 1], across[..., 0]) - poses[:, None, :, 2]
    bearing = np.abs((bearing + np.pi) % (2.0 * np.pi) - np.pi)
    hidden = hidden_by(poses[..., :2], (), _RADIUS)
    odds = 1.5 - 12.0 * np.maximum(bearing - _HALF_VIEW, 0.0) - 1.5 * np.maximum(away - _REACH, 0.0)
    odds = np.maximum(odds - 0.15 * away - 3.0 * hidden, -9.0)
    odds[np.eye(len(poses), dtype=bool)] = -np.inf
    return odds
