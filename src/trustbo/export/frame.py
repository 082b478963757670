"""Frame of robots: an origin and a direction in the CRS, subtracted in float64.

One frame serves all exports for robots. Its pose in the CRS is a static transform, in a YAML file.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from pyproj import Geod

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_kind
from trustbo.export.checks import find_crs
from trustbo.files import FilePath, read_yaml, require_file, write_text
from trustbo.planning import Plan
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid
from trustbo.workspace.location import Location, crs_name, lonlat_of, position_near

AUTO, CRS = "auto", "crs"
"""Origins at the centre of the first cell of the path, and at that of the CRS."""
_FAR = 1e5
"""Distance of an origin from the grid, m, beyond which float32 is coarser than 8 mm again."""
_AHEAD = 100.0
"""Distance over which the direction of the x axis on Earth is measured, m."""
_COARSE = 0.01
Origin = Location | tuple[float, float]


class Frame(NamedTuple):
    """Frame of the positions in files for robots.

    Attributes:
        origin: Position in the CRS that is (0, 0) of the frame: x and y, m, or with names, such as
            `"lon=174.7,lat=-41.3"`; `"auto"`: the centre of the path's first cell, which a map
            alone has not; `"crs"`: that of the CRS.
        rotation: Angle from east, the CRS's x axis, to that of the frame, rad, anticlockwise.
        name: Name, the `frame_id` of messages.
    """

    origin: Origin = AUTO
    rotation: float = 0.0
    name: str = "map"


AT_START, OF_CRS = Frame(), Frame(CRS)
"""Frames at the start of the path, and of the CRS."""


class PlacedFrame(NamedTuple):
    """Frame of robots, and its pose in the frame of the CRS, its parent.

    Attributes:
        name: Name, the `frame_id` of messages.
        origin: Position of (0, 0) of the frame, x and y in CRS metres.
        rotation: Angle from east, the CRS's x axis, to that of the frame, rad, anticlockwise.
        parent: Name of the frame of the CRS, such as `epsg_2193`; `grid` without a CRS.
    """

    name: str = "map"
    origin: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    parent: str = "grid"

    @property
    def is_default(self) -> bool:
        """Whether positions in the frame are those in the CRS, under the default name."""
        return self == PlacedFrame(parent=self.parent)

    @property
    def turn(self) -> tuple[float, float, float, float]:
        """Rotation as a quaternion x, y, z, w."""
        return 0.0, 0.0, math.sin(self.rotation / 2.0), math.cos(self.rotation / 2.0)

    @property
    def axes(self) -> np.ndarray:
        """Directions of the frame's axes in the CRS, as rows, (2, 2)."""
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return np.array([[c, s], [-s, c]])

    def of_crs(self, positions: np.ndarray) -> np.ndarray:
        """Positions in the frame of those in the CRS, (..., 2), m."""
        moved = np.asarray(positions, dtype=float) - self.origin
        return moved @ self.axes.T if self.rotation else moved

    def to_crs(self, positions: np.ndarray) -> np.ndarray:
        """Positions in the CRS of those in the frame, (..., 2), m."""
        turned = positions @ self.axes if self.rotation else np.asarray(positions)
        return turned + self.origin


def placed(
    frame: Frame | PlacedFrame, workspace: Workspace, start: tuple[int, int] | None = None
) -> PlacedFrame:
    """Place a user's frame, unless it is placed; `start` is the cell of `"auto"`.

    TrustboError: no frame; an origin that is no position, or far from the grid; a rotation that is
    not finite; or a name that ROS has not.
    """
    if isinstance(frame, PlacedFrame):
        return frame
    origin, rotation, name = require_kind("frame", frame, Frame, "give export.Frame(name='odom')")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*(/\w+)*", name):
        raise TrustboError(
            f"the name of a frame is one of ROS such as 'map' or 'r1/odom'; got {name!r}."
        )
    try:
        angle = float(rotation)
    except (TypeError, ValueError):
        angle = math.nan
    if not math.isfinite(angle):
        raise TrustboError(f"rotation must be a finite angle; got {rotation!r}.")
    parent = _parent(workspace.grid)
    if name == parent:
        raise TrustboError(f"frame {name!r} is that of the CRS itself; choose another name.")
    return PlacedFrame(name, _origin(workspace.grid, origin, start), angle, parent)


def write_frame(
    path: FilePath, plan: Plan | Result | Workspace, *, frame: Frame = AT_START
) -> None:
    """Write the pose of a frame in the CRS to a YAML file, as other exports with a frame do.

    The file has the `frame`, its `parent` (the CRS as a frame, such as `epsg_2193`), the `origin`
    and `rotation` of the frame in it, the same as the `transform` of a TransformStamped of ROS,
    the `crs`, and the `longitude` and `latitude` of (0, 0) with `datum`: latitude, longitude
    (degrees) and the angle of the x axis from true east (rad, anticlockwise), as
    navsat_transform_node of robot_localization takes it. Without a CRS, the last four are missing.

    Args:
        path: .yaml or .yml file to write, or to replace.
        plan: Plan or result, at whose start is the origin `"auto"`; or a workspace.
        frame: Frame.

    Raises:
        TrustboError: A frame that cannot be: an origin that is no position, or over 100 km from the
            grid, a rotation that is not finite, or no name of ROS; or the file cannot be written.
    """
    target = require_file(path, ".yaml", ".yml")
    require_kind("plan", plan, Plan | Result | Workspace, "give a Plan, a Result or a Workspace")
    workspace, start = plan, None
    if not isinstance(plan, Workspace):
        workspace, start = plan.workspace, plan.path[0]
    assert isinstance(workspace, Workspace)  # noqa: S101
    save_frame(target, placed(frame, workspace, start), workspace)


def frame_file(path: Path) -> Path:
    """Return the file with the frame of a map, in the same folder."""
    return require_file(path.with_name(f"{path.stem}_frame.yaml"))


def save_beside(
    path: Path, frame: Frame | PlacedFrame, place: PlacedFrame, workspace: Workspace
) -> None:
    """Write the frame of the map at `path` to a file, with its place.

    Nothing for that of the CRS, nor for a frame that was placed before: it has a file.
    """
    if not place.is_default and frame is not place:
        save_frame(frame_file(path), place, workspace)


def save_frame(file: Path, frame: PlacedFrame, workspace: Workspace) -> None:
    """Write a frame to a file; see `write_frame`."""
    (x, y), turn = frame.origin, frame.turn
    record: dict[str, object] = {
        "frame": frame.name,
        "parent": frame.parent,
        "origin": [x, y],
        "rotation": frame.rotation,
        "transform": {
            "translation": {"x": x, "y": y, "z": 0.0},
            "rotation": dict(zip("xyzw", turn, strict=True)),
        },
    }
    about = (
        "# Pose of the frame in its parent, the CRS: x, y of the CRS = origin + [[c, -s], [s, c]]\n"
        "# (x, y of the frame), c and s of rotation (rad). To publish it in ROS 2:\n"
        f"#   ros2 run tf2_ros static_transform_publisher --x {x!r} --y {y!r} "
        f"--yaw {frame.rotation!r} --frame-id {frame.parent} --child-frame-id {frame.name}\n"
    )
    if find_crs(workspace) is not None:
        about += "# datum: latitude, longitude, angle of x from true east (rad), for GPS\n"
        lon, lat = lonlat_of(workspace.grid, frame.origin)
        record |= {
            "crs": crs_name(workspace.grid),
            "longitude": round(lon, 9),
            "latitude": round(lat, 9),
            "datum": [round(lat, 9), round(lon, 9), round(_from_east(workspace.grid, frame), 9)],
        }
    write_text(file, about + yaml.safe_dump(record, sort_keys=False))


def is_frame(file: Path, frame: PlacedFrame) -> bool:
    """Whether a file of `save_frame` has a frame; without a file, whether it is that of the CRS."""
    if not file.exists():
        return frame.is_default
    record = read_yaml(file)
    if not isinstance(record, dict):
        return False
    return (record.get("frame"), record.get("origin"), record.get("rotation")) == (
        frame.name, [*frame.origin], frame.rotation
    )  # fmt: skip


def require_fine(frame: PlacedFrame, workspace: Workspace, what: str) -> None:
    """Refuse a frame so far from the grid that float32, which a reader uses, is coarse there.

    TrustboError: its step is more than a centimetre.
    """
    left, bottom, right, top = workspace.grid.bounds
    corners = np.array([[x, y] for x in (left, right) for y in (bottom, top)])
    far = float(np.abs(frame.of_crs(corners)).max())
    step = float(np.spacing(np.float32(far)))
    if step > _COARSE:
        raise TrustboError(
            f"{what} holds positions in float32, in steps of {step:g} m where coordinates are "
            f"{far:.0f} m; put the origin near the robots: origin='auto' is the start of the path."
        )


def _from_east(grid: Grid, frame: PlacedFrame) -> float:
    """Angle from true east to the x axis of a frame at its origin, rad, anticlockwise."""
    ahead = frame.to_crs(np.array([_AHEAD, 0.0]))
    places = lonlat_of(grid, frame.origin), lonlat_of(grid, (float(ahead[0]), float(ahead[1])))
    azimuth, *_ = Geod(ellps="WGS84").inv(*places[0], *places[1])
    return math.remainder(math.radians(90.0 - azimuth), math.tau)


def _parent(grid: Grid) -> str:
    """Name of the frame of a CRS, of letters, digits and _."""
    if grid.crs is None:
        return "grid"
    return re.sub(r"\W+", "_", crs_name(grid)).strip("_").lower() or "crs"


def _origin(grid: Grid, origin: Origin, start: tuple[int, int] | None) -> tuple[float, float]:
    """Position of an origin in the CRS."""
    if isinstance(origin, str) and origin == CRS:
        return 0.0, 0.0
    if isinstance(origin, str) and origin == AUTO:
        if start is None:
            raise TrustboError('origin="auto" is the start of a path; a map alone has none.')
        return grid.center(start)
    given = origin.split(",") if isinstance(origin, str) and "=" not in origin else origin
    if not isinstance(given, Mapping | str):  # a bare pair is of metres here
        try:
            x, y = (float(value) for value in given)
        except (TypeError, ValueError):
            x = y = math.nan
        if not math.isfinite(x + y):
            raise TrustboError(
                f"origin must be two finite numbers (x, y); got {origin!r}. In degrees, it is "
                "lon=174.7,lat=-41.3; the start of the path is 'auto'."
            )
        given = {"x": x, "y": y}
    return position_near("origin", given, grid, _FAR)
