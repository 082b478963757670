"""Measurements of a robot as it drives: state of motion and sensing, and awareness."""

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import xarray as xr

from trustbo.data import Bound
from trustbo.errors import require_choice
from trustbo.logs.netcdf import STATES
from trustbo.team import Team
from trustbo.terrain import CompositeIndex, fan
from trustbo.workspace import Workspace
from trustbo.workspace.sight import Sight
from trustbo.workspace.surface import Surface

REALTIME: Mapping[str, Mapping[str, int]] = {
    "traversability": {"offline": +1, "speed_ratio": +1, "pitch": -1, "roll": -1},
    "visibility": {"offline": +1, "return_range": +1, "visible_share": +1},
}
"""Inputs and signs of the real-time indices: the map's value, and motion or sensing state."""
_SHARES, _N_RAYS = (0.25, 0.5, 0.75, 1.0), 12
_OPAQUE = 1e6
"""Extinction of an opaque canopy, 1/m."""


class Measure:
    """Awareness and states that robots measure along their tracks."""

    def __init__(
        self,
        workspace: Workspace,
        team: Team,
        surface: Surface,
        sight: Sight,
        tick: float,
        realtime: Mapping[str, CompositeIndex],
    ) -> None:
        """Prepare the maps of pixels, for poses `tick` s apart; real-time indices are by feature.

        TrustboError: a real-time index of an unknown feature.
        """
        self._team, self._surface, self._sight, self._tick = team, surface, sight, tick
        pixels, planned = workspace.pixels, workspace.surface
        assert pixels is not None and planned is not None  # noqa: S101, PT018  # refused before
        self._planned = planned
        # Lines of sight are of bounds, and not measured.
        self._names = [name for name in workspace.features if name in pixels]
        for feature in realtime:
            require_choice("awareness feature", feature, self._names)
        self._realtime = realtime
        self._maps = np.stack([pixels[name].values for name in self._names], axis=-1)
        self._columns = [workspace.features.index(name) for name in self._names]
        self._n_features = len(workspace.features)

    def __call__(self, ways: Sequence[np.ndarray], states: Sequence[np.ndarray]) -> np.ndarray:
        """Mean awareness along tracks, shape (track, robot, feature).

        NaN for a feature that is no map of pixels. From the poses of each track, shape (tick,
        robot, 3), and for real-time indices the states of each, shape (tick, robot, state), else
        empty.
        """
        poses = np.concatenate(ways)
        starts = np.cumsum([0, *(len(way) for way in ways[:-1])])
        values = self._maps[self._planned.nearest(poses[..., 0], poses[..., 1])]
        for m, name in enumerate(self._names):
            index = self._realtime.get(name)
            if index is not None and states:
                recorded = np.concatenate(states)
                columns = {n: recorded[..., i].ravel() for i, n in enumerate(STATES)}
                columns["offline"] = values[..., m].ravel()
                fused = index.transform({n: columns[n] for n in index.signs})
                values[..., m] = fused.reshape(values.shape[:-1])
        # A robot that has arrived waits for the others: those ticks do not measure its track.
        moved = np.any(np.diff(poses[..., :2], axis=0, prepend=poses[:1, :, :2]) != 0.0, axis=-1)
        moved[starts] = True
        weight = moved[..., None] & np.isfinite(values)
        total = np.add.reduceat(np.where(weight, values, 0.0), starts, axis=0)
        awareness = np.full((*total.shape[:-1], self._n_features), np.nan)
        with np.errstate(invalid="ignore"):
            awareness[..., self._columns] = total / np.add.reduceat(
                weight, starts, 0, dtype=np.int64
            )
        return awareness

    def states(self, poses: np.ndarray) -> np.ndarray:
        """Values of `STATES` of each robot at each tick, shape (tick, robot, state)."""
        row, col = self._surface.nearest(poses[..., 0], poses[..., 1])
        gx, gy = self._surface.gradient[:, row, col]
        ahead, left = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        way = np.diff(poses[..., :2], axis=0, prepend=poses[:1, :, :2])
        speed = np.hypot(way[..., 0], way[..., 1]) / self._tick
        motion = [
            np.minimum(speed / np.array([robot.speed for robot in self._team.robots]), 1.0),
            np.abs(np.arctan(gx * ahead + gy * left)),
            np.abs(np.arctan(gy * ahead - gx * left)),
        ]
        return np.concatenate([np.stack(motion, axis=-1), self._lidar[row, col]], axis=-1)

    def samples(self, bounds: Sequence[Bound]) -> dict[str, xr.Dataset]:
        """Map's value and mean states by feature, one sample per robot and bound, (sample)."""
        rows = [
            np.concatenate(
                [self([b.poses[:, 1:]], [])[0][:, self._columns], b.states.mean(0)], axis=1
            )
            for b in bounds
            if b.poses is not None and b.states is not None
        ]
        table, n = np.concatenate(rows), len(self._names)
        states = {name: ("sample", table[:, n + i]) for i, name in enumerate(STATES)}
        return {
            name: xr.Dataset({"offline": ("sample", table[:, m]), **states})
            for m, name in enumerate(self._names)
        }

    @cached_property
    def _lidar(self) -> np.ndarray:
        """Mean range of a lidar's returns, m, and share of clear beams, by pixel: (row, col, 2).

        By rays all around. The mean range of returns is the integral over range of the share of
        beams that reach it. Beams are blocked by what blocks sight: for "wall", a canopy opaque
        from the ground up.
        """
        team, surface, sight = self._team, self._surface, self._sight
        sides = [n * step for n, step in zip(surface.ground.shape, surface.pixel, strict=True)]
        reach = min(max(robot.lidar_range for robot in team.robots), 0.5 * min(sides))
        heights = team.robots[0].sensor_height, team.lead.target_height
        canopy = {"bare": (0.0, sight.crown_base), "wall": (_OPAQUE, 0.0)}
        opacity = canopy.get(sight.mode, (sight.extinction, sight.crown_base))
        rasters = surface.ground, surface.canopy, surface.pixel
        seen = [np.ones(surface.ground.shape)]
        for share in _SHARES:
            clear = fan.openness(*rasters, share * reach, *heights, _N_RAYS, *opacity, slice(None))
            seen.append(np.nan_to_num(clear))
        return_range = reach * np.trapezoid(seen, [0.0, *_SHARES], axis=0)
        return np.stack([return_range, seen[-1]], axis=-1)
