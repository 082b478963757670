"""Server for Foxglove: map of the team's trust, path, and state of the robots."""

import asyncio
import json
import logging
from functools import partial
from types import TracebackType
from typing import Any, Self

import numpy as np

from trustbo.errors import TrustboError
from trustbo.live.hub import Hub

_log = logging.getLogger(__name__)
_FRAME, _SECONDS = "map", 1.0
_FLOAT32 = 4  # bytes
_STATE = {"type": "object", "additionalProperties": True}


class Scene:
    """Server for Foxglove on this machine alone, as it has no token; each second all is sent anew.

    Topics: `/trust` (Grid), `/path` (SceneUpdate) and `/state` (JSON, as of `Live.state`), in CRS
    metres.

    Attributes:
        port: Port of the server.
    """

    def __init__(self, hub: Hub, port: int) -> None:
        """Start a server; TrustboError: the port is taken."""
        import foxglove
        from foxglove import channels

        self._hub, self._context = hub, foxglove.Context()
        try:
            self._server: Any = foxglove.start_server(
                name="trustbo live", host="127.0.0.1", port=port, context=self._context
            )
        except (OSError, RuntimeError) as error:
            raise TrustboError(
                f"cannot serve Foxglove at port {port}: {error}; give another."
            ) from error
        self.port: int = self._server.port
        self._grid = channels.GridChannel("/trust", context=self._context)
        self._scene = channels.SceneUpdateChannel("/path", context=self._context)
        self._state = foxglove.Channel("/state", schema=_STATE, context=self._context)

    def __enter__(self) -> Self:
        self._task = asyncio.get_running_loop().create_task(self._run())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._task.cancel()
        self._server.stop()

    async def _run(self) -> None:
        while True:
            try:
                await self.send()
            except Exception as error:  # a view that fails must not end the mission
                _log.warning("Foxglove: %s: %s", type(error).__name__, error)
            await asyncio.sleep(_SECONDS)

    async def send(self) -> None:
        """Send the map, the path and the state of now."""
        live = self._hub.live
        values = np.array(
            (await self._hub.compute(partial(live.map, "trust")))["values"], dtype=float
        )
        self._grid.log(grid_of(values, live.campaign.workspace.grid))
        self._scene.log(path_of(self._hub))
        self._state.log(json.loads(self._hub.text()))


def grid_of(values: np.ndarray, grid: Any) -> Any:
    """Grid of the cells; its first row is the southern one."""
    from foxglove import messages as fg

    left, bottom = grid.corner
    data = np.flipud(values).astype("<f4")
    return fg.Grid(
        frame_id=_FRAME,
        pose=fg.Pose(
            position=fg.Vector3(x=left, y=bottom, z=0.0),
            orientation=fg.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
        ),
        column_count=data.shape[1],
        cell_size=fg.Vector2(x=grid.cell_width, y=grid.cell_height),
        row_stride=_FLOAT32 * data.shape[1],
        cell_stride=_FLOAT32,
        fields=[
            fg.PackedElementField(
                name="trust", offset=0, type=fg.PackedElementFieldNumericType.Float32
            )
        ],
        data=data.tobytes(),
    )


def path_of(hub: Hub) -> Any:
    """Lines of the cells entered and planned, the poses that were reported, and what to do."""
    from foxglove import messages as fg

    live = hub.live
    mission, grid, state = live.mission, live.campaign.workspace.grid, live.state()
    centres = [grid.center(cell) for cell in mission.path]
    points = [fg.Point3(x=x, y=y, z=0.2) for x, y in centres]
    n = len(mission.bounds)
    here = centres[n]

    def line(some: list[Any], colour: Any) -> Any:
        return fg.LinePrimitive(
            type=fg.LinePrimitiveLineType.LineStrip, thickness=4.0, scale_invariant=True,
            points=some, color=colour,
        )  # fmt: skip

    white, grey = fg.Color(r=1.0, g=1.0, b=1.0, a=1.0), fg.Color(r=0.7, g=0.7, b=0.7, a=0.8)
    lines = [line(points[n:], grey)] + ([line(points[: n + 1], white)] if n else [])
    spheres = [
        fg.SpherePrimitive(
            pose=fg.Pose(position=fg.Vector3(x=x, y=y, z=0.5)),
            size=fg.Vector3(x=2.0, y=2.0, z=2.0),
            color=fg.Color(r=0.0, g=0.45, b=0.7, a=1.0),
        )
        for x, y in live.poses.values()
    ]
    text = fg.TextPrimitive(
        pose=fg.Pose(position=fg.Vector3(x=here[0], y=here[1], z=2.0)), billboard=True,
        font_size=14.0, scale_invariant=True, color=white, text=state["to_do"],
    )  # fmt: skip
    entity = fg.SceneEntity(
        frame_id=_FRAME, id="mission", lines=lines, spheres=spheres, texts=[text]
    )
    return fg.SceneUpdate(entities=[entity])
