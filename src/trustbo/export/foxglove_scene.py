"""A plan as a scene for Foxglove: maps, ways, posts, and sight bound by bound, in an MCAP."""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.campaign.result import Result
from trustbo.errors import require_package
from trustbo.export.checks import Maps, require_maps
from trustbo.export.colours import Colour, of_robot, of_values
from trustbo.export.frame import AT_START, Frame, PlacedFrame, frame_file, placed, save_beside
from trustbo.export.lattice import Raster, sampled
from trustbo.export.layers import plan_of
from trustbo.export.schedule import Schedule, schedule_of
from trustbo.files import FilePath, require_file, write_file
from trustbo.planning import Plan

_THICK, _SIZE, _LETTERS = 3.0, 4.0, 14.0
_NS = 1_000_000_000


def write_foxglove(
    path: FilePath,
    plan: Plan | Result,
    maps: Maps | None = None,
    *,
    resolution: float | None = None,
    frame: Frame | PlacedFrame = AT_START,
) -> None:
    """Write a plan as a scene that Foxglove plays in the 3D panel.

    ================ ========================= ===================================================
    /trustbo/maps    foxglove.Grid             maps, a field for each
    /trustbo/scene   foxglove.SceneUpdate      `<robot>/way`, `<robot>/<place>` with its name; from
                                               the begin of each bound on `bound`: the lead's way,
                                               and lines from T2's posts to its end, from dark where
                                               no contact is expected to light
    /tf              foxglove.FrameTransforms  pose of the frame in that of the CRS
    ================ ========================= ===================================================

    The times of messages are those of the plan, from now on. A file of the frame is written as by
    `write_ros_map`.

    Args:
        path: .mcap file to write, or to replace.
        plan: Plan, or result whose recommended path is meant, on a terrain in memory.
        maps: Maps (row, col), e.g. `Result.maps()`.
        resolution: Side of a pixel of the maps, m, see `write_ros_map`.
        frame: Frame, by default at the start of the path.

    Raises:
        ShapeError: The maps have other dims or another number of cells.
        TrustboError: foxglove-sdk is not installed; no terrain in memory; a robot that has no way
            in a bound; or an argument is refused by `write_ros_map`.
    """
    require_foxglove()
    target = require_file(path, ".mcap")
    frame_file(target)
    plan = plan_of(plan)
    place = placed(frame, plan.workspace, plan.path[0])
    schedule, raster, names = schedule_of(plan), None, []
    if maps is not None:
        bands = require_maps(maps, plan.workspace)
        names = [str(name) for name in bands.data_vars]
        cells = np.stack([band.values for band in bands.data_vars.values()]).astype(np.float32)
        raster = sampled(cells, np.nan, plan.workspace, resolution, place)
    import foxglove
    from foxglove import channels

    now = time.time_ns()
    scene = _Scene(place, now)
    with tempfile.TemporaryDirectory() as folder:
        file, context = Path(folder) / "scene.mcap", foxglove.Context()
        with foxglove.open_mcap(file, context=context):
            transforms = channels.FrameTransformsChannel("/tf", context=context)
            transforms.log(scene.transforms(), log_time=now)
            if raster is not None:
                grids = channels.GridChannel("/trustbo/maps", context=context)
                grids.log(scene.grid(raster, names), log_time=now)
            updates = channels.SceneUpdateChannel("/trustbo/scene", context=context)
            updates.log(scene.everything(schedule), log_time=now)
            for k, begin in enumerate(schedule.begins[:-1].tolist()):
                at = now + round(begin * _NS)
                updates.log(scene.bound(plan, k, at), log_time=at)
        content = file.read_bytes()
    write_file(target, lambda temporary: temporary.write_bytes(content))
    save_beside(target, frame, place, plan.workspace)


def require_foxglove() -> None:
    """Refuse to go on without foxglove-sdk: TrustboError."""
    require_package("scenes need", "foxglove-sdk", "foxglove")


class _Scene:
    """Messages of Foxglove in a frame."""

    def __init__(self, place: PlacedFrame, now: int) -> None:
        from foxglove import messages

        self._m, self._place, self._now = messages, place, now

    def transforms(self) -> Any:
        """Pose of the frame in that of the CRS."""
        m, (x, y), turn = self._m, self._place.origin, self._place.turn
        one = m.FrameTransform(
            timestamp=self._stamp(self._now), parent_frame_id=self._place.parent,
            child_frame_id=self._place.name, translation=m.Vector3(x=x, y=y, z=0.0),
            rotation=m.Quaternion(x=turn[0], y=turn[1], z=turn[2], w=turn[3]),
        )  # fmt: skip
        return m.FrameTransforms(transforms=[one])

    def grid(self, raster: Raster, names: list[str]) -> Any:
        """Maps as fields of one grid, row by row from the south."""
        m, n_x = self._m, raster.values.shape[-1]
        kind, size = m.PackedElementFieldNumericType.Float32, 4 * len(names)
        fields = [
            m.PackedElementField(name=name, offset=4 * i, type=kind) for i, name in enumerate(names)
        ]
        data = np.ascontiguousarray(np.moveaxis(raster.values, 0, -1), "<f4").tobytes()
        side, (x, y) = raster.resolution, raster.corner
        return m.Grid(
            timestamp=self._stamp(self._now), frame_id=self._place.name,
            pose=self._pose(np.array([x, y])), column_count=n_x,
            cell_size=m.Vector2(x=side, y=side), row_stride=n_x * size, cell_stride=size,
            fields=fields, data=data,
        )  # fmt: skip

    def everything(self, schedule: Schedule) -> Any:
        """Ways and places of all robots."""
        entities = []
        for i, (robot, stands) in enumerate(schedule.robots.items()):
            colour = self._colour(of_robot(i))
            points = np.concatenate([stand.way for stand in stands])
            entities.append(self._entity(f"{robot}/way", lines=[self._line(points, colour)]))
            for stand in stands:
                pose = self._pose(self._place.of_crs(stand.place))
                size = self._m.Vector3(x=_SIZE, y=_SIZE, z=_SIZE)
                sphere = self._m.SpherePrimitive(pose=pose, size=size, color=colour)
                text = self._m.TextPrimitive(
                    pose=pose, billboard=True, font_size=_LETTERS, scale_invariant=True,
                    color=colour, text=f"{robot} {stand.name}",
                )  # fmt: skip
                about = {"arrives, s": stand.arrives, "until, s": stand.until}
                entities.append(
                    self._entity(
                        f"{robot}/{stand.name}", about, spheres=[sphere], texts=[text]
                    )
                )  # fmt: skip
        return self._m.SceneUpdate(entities=entities)

    def bound(self, plan: Plan, k: int, now: int) -> Any:
        """Bound k, from 0: the lead's way, and sight of it by the contact expected."""
        assert plan.posts is not None and plan.ways is not None  # noqa: S101, PT018
        way = plan.ways[k][0]
        assert way is not None  # noqa: S101
        trust = np.clip(plan.trust[k], 0.0, 1.0)
        lines = [self._line(way, self._colour(of_robot(0)), 2.0 * _THICK)]
        for post, colour in zip(plan.posts[k], of_values(trust).tolist(), strict=True):
            lines.append(self._line(np.stack([post, way[-1]]), self._colour(tuple(colour))))
        about = {"bound": k + 1}
        about |= dict(zip(plan.workspace.team.names, trust.tolist(), strict=True))
        shown = ", ".join(
            f"{name} {x:.2f}" for name, x in zip(plan.workspace.team.names, trust, strict=True)
        )
        text = self._m.TextPrimitive(
            pose=self._pose(self._place.of_crs(way[-1]), 2.0 * _SIZE), billboard=True,
            font_size=_LETTERS, scale_invariant=True, color=self._colour(of_robot(0)),
            text=f"bound {k + 1}: contact {shown}",
        )  # fmt: skip
        entity = self._entity("bound", about, now, lines=lines, texts=[text])
        return self._m.SceneUpdate(entities=[entity])

    def _entity(
        self, name: str, about: dict[str, Any] | None = None, now: int | None = None, **what: Any
    ) -> Any:
        pairs = [
            self._m.KeyValuePair(key=key, value=f"{value:g}")
            for key, value in (about or {}).items()
        ]
        stamp = self._stamp(self._now if now is None else now)
        return self._m.SceneEntity(
            timestamp=stamp, frame_id=self._place.name, id=name, frame_locked=True, metadata=pairs,
            **what,
        )  # fmt: skip

    def _line(self, points: np.ndarray, colour: Any, thick: float = _THICK) -> Any:
        m = self._m
        places = [m.Point3(x=x, y=y, z=0.0) for x, y in self._place.of_crs(points).tolist()]
        return m.LinePrimitive(
            type=m.LinePrimitiveLineType.LineStrip, pose=self._pose(np.zeros(2)), thickness=thick,
            scale_invariant=True, points=places, color=colour,
        )  # fmt: skip

    def _pose(self, place: np.ndarray, z: float = 0.0) -> Any:
        x, y = place.tolist()
        turn = self._m.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
        return self._m.Pose(position=self._m.Vector3(x=x, y=y, z=z), orientation=turn)

    def _colour(self, colour: Colour) -> Any:
        red, green, blue = (channel / 255.0 for channel in colour)
        return self._m.Color(r=red, g=green, b=blue, a=1.0)

    def _stamp(self, now: int) -> Any:
        return self._m.Timestamp(sec=now // _NS, nsec=now % _NS)
