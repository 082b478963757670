"""Geometry between the robots of a log, tick by tick: what a sensor's success depends on."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError, require_kind, require_positive
from trustbo.logs.log import Log
from trustbo.terrain.read import require_terrain
from trustbo.workspace.sight import Sight, detection_probability, sights_of
from trustbo.workspace.surface import surface_of

_NEAR = 0.1  # m: nothing hides this close to either end
_REACH = 1e9  # m: the terrain alone limits sight here
_PAIRS = ("watcher", "seen", "time")


def geometry(
    log: Log,
    *,
    tick: float = 1.0,
    terrain: xr.Dataset | None = None,
    sight: Sight | str = "transmittance",
    sensor_height: float = 1.0,
    target_height: float = 1.0,
) -> xr.Dataset:
    """Geometry of every pair of robots at every tick, and whether one detected the other.

    Args:
        log: Log of poses and detections.
        tick: Length of a tick, s; poses are those of its middle.
        terrain: DEM and DSM in the coordinates of the poses, which may hide robots.
        sight: Model of sight through the terrain.
        sensor_height: Height of the sensors above ground, m.
        target_height: Height of the point of a robot that they aim at, m.

    Returns:
        Dataset over (watcher, seen, time), NaN where a pose is not known, or of a robot with
        itself: `range` (m); `bearing`, rad from the watcher's heading, in [-pi, pi]; `hidden`,
        1 where a landmark or another robot stands between, else 0; `turning`, the watcher's rate
        of turn (rad/s); `speed` of the robot seen (m/s); `contact`, 1 where it was detected in the
        tick, else 0; with a terrain `passes`, the share of a beam that passes it.

    Raises:
        TrustboError: A tick that is not positive or longer than the log, or no log.
    """
    require_kind("log", log, Log, "give a trustbo.logs.Log, such as of read_log")
    require_positive("tick", tick)
    start, end = log.span
    n = int(np.floor((end - start) / tick + 1e-9))
    if n < 1:
        raise TrustboError(f"a tick of {tick:g} s is longer than the log, {end - start:g} s.")
    time = start + (np.arange(n) + 0.5) * tick
    poses = log.at(time)
    xy, heading = poses[..., :2], poses[..., 2]
    across = xy[None] - xy[:, None]  # (watcher, seen, time, 2)
    away = np.hypot(across[..., 0], across[..., 1])
    angle = np.arctan2(across[..., 1], across[..., 0]) - heading[:, None]
    itself = np.eye(len(poses), dtype=bool)
    away[itself] = np.nan
    known = np.isfinite(away)
    before, after = (log.at(np.clip(time + s * 0.5 * tick, start, end)) for s in (-1.0, 1.0))
    turning = np.abs(after[..., 2] - before[..., 2]) / tick
    speed = np.hypot(*np.moveaxis(after[..., :2] - before[..., :2], -1, 0)) / tick
    columns: dict[str, np.ndarray] = {
        "range": away,
        "bearing": np.where(known, (angle + np.pi) % (2.0 * np.pi) - np.pi, np.nan),
        "hidden": hidden_by(xy, log.landmarks, log.robot_radius).astype(float),
        "turning": np.broadcast_to(np.nan_to_num(turning)[:, None], away.shape),
        "speed": np.broadcast_to(np.nan_to_num(speed)[None], away.shape),
        "contact": _contacts(log, time, tick),
    }
    if terrain is not None:
        heights = sensor_height, target_height
        columns["passes"] = _passing(terrain, sights_of(sight)[0], heights, xy)
    variables: dict[str, Any] = {
        name: (_PAIRS, np.where(known, values, np.nan)) for name, values in columns.items()
    }
    names = list(log.robots)
    coords = {"watcher": names, "seen": names, "time": time}
    return xr.Dataset(variables, coords, {"tick": float(tick)})


def hidden_by(xy: np.ndarray, landmarks: Iterable[np.ndarray], robot_radius: float) -> np.ndarray:
    """Whether a landmark or another robot is in the line between two, (watcher, seen, time).

    Robots are at xy (robot, time, 2), landmarks x, y and radius, all in m; a radius of 0 hides
    nothing.
    """
    across = xy[None] - xy[:, None]
    away = np.hypot(across[..., 0], across[..., 1])
    hidden = np.zeros(away.shape, dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = across / away[..., None]
    cylinders = [(x, y, r, -1) for x, y, r in landmarks if r > 0.0]
    bodies = [(*xy[k].T, robot_radius, k) for k in range(len(xy)) if robot_radius > 0.0]
    for x, y, radius, k in (*cylinders, *bodies):
        to = np.stack(np.broadcast_arrays(x - xy[..., 0], y - xy[..., 1]), axis=-1)[:, None]
        along = (to * unit).sum(-1)
        beside = np.abs(to[..., 0] * unit[..., 1] - to[..., 1] * unit[..., 0])
        with np.errstate(invalid="ignore"):
            between = (along > _NEAR) & (along < away - _NEAR) & (beside < radius)
        if k >= 0:  # a robot hides neither itself nor from itself
            between[k], between[:, k] = False, False
        hidden |= between
    return hidden


def _contacts(log: Log, time: np.ndarray, tick: float) -> np.ndarray:
    """Whether each robot detected each other one in a tick, (watcher, seen, time)."""
    n = len(log.robots)
    contact = np.zeros((n, n, len(time)))
    t, watcher, seen = log.detections.T
    k = np.floor((t - (time[0] - 0.5 * tick)) / tick + 1e-9).astype(int)
    there = (k >= 0) & (k < len(time))
    contact[watcher[there].astype(int), seen[there].astype(int), k[there]] = 1.0
    return contact


def _passing(
    terrain: xr.Dataset, sight: Sight, heights: tuple[float, float], xy: np.ndarray
) -> np.ndarray:
    """Share of a beam between robots that the terrain lets pass, (watcher, seen, time)."""
    terrain = require_terrain(terrain)
    surface = surface_of(terrain, np.ones(terrain["dem"].shape, dtype=bool))
    n, _, m = len(xy), *xy.shape[:2]
    ends = np.broadcast_arrays(xy[:, None], xy[None])
    eye, target = (np.ascontiguousarray(e).reshape(-1, 2) for e in ends)
    optics = np.array([*heights, _REACH, 1.0])
    return detection_probability(surface, sight, eye, target, optics).reshape(n, n, m)
