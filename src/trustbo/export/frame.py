"""Frame of a robot's map: an origin and a direction in the CRS, subtracted in float64."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from trustbo.errors import TrustboError
from trustbo.export.checks import find_crs
from trustbo.files import require_file, write_text
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid
from trustbo.workspace.location import Location, crs_name, lonlat_of, position_near

AUTO = "auto"
"""Origin at the centre of the first cell of the path."""
_FAR = 1e5
"""Distance of an origin from the grid, m, beyond which float32 is coarser than 8 mm again."""
Origin = Location | tuple[float, float] | None


class Frame(NamedTuple):
    """Frame of a map.

    Attributes:
        name: Name, the `frame_id` of messages.
        origin: Position of (0, 0) of the frame, x and y in CRS metres.
        rotation: Angle from east, the CRS's x axis, to that of the frame, rad, anticlockwise.
    """

    name: str = "map"
    origin: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0

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


def frame_of(
    workspace: Workspace,
    origin: Origin,
    rotation: float,
    name: str,
    start: tuple[int, int] | None = None,
) -> Frame:
    """Frame of a user's arguments; `start` is the cell of `"auto"`.

    TrustboError: an origin that is no position, or far from the grid; a rotation that is not
    finite; or a name that ROS has not.
    """
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*(/\w+)*", name):
        raise TrustboError(f"frame must be a name of ROS such as 'map' or 'r1/odom'; got {name!r}.")
    try:
        angle = float(rotation)
    except (TypeError, ValueError):
        angle = math.nan
    if not math.isfinite(angle):
        raise TrustboError(f"rotation must be a finite angle; got {rotation!r}.")
    return Frame(name, _origin(workspace.grid, origin, start), angle)


def frame_file(path: Path) -> Path:
    """Return the file with the frame of a map or a bag, in the same folder."""
    return require_file(path.with_name(f"{path.stem}_frame.yaml"))


def write_frame(path: Path, frame: Frame, workspace: Workspace) -> None:
    """Write the frame of the map or bag at `path` to a file; nothing for that of the CRS."""
    if frame == Frame():
        return
    record: dict[str, object] = {
        "frame": frame.name,
        "origin": list(frame.origin),
        "rotation": frame.rotation,
    }
    about = "# x, y of the CRS = origin + [[c, -s], [s, c]] (x, y of the frame), c, s of rotation\n"
    if find_crs(workspace) is not None:
        lon, lat = lonlat_of(workspace.grid, frame.origin)
        record |= {
            "crs": crs_name(workspace.grid),
            "longitude": round(lon, 9),
            "latitude": round(lat, 9),
        }
    write_text(frame_file(path), about + yaml.safe_dump(record, sort_keys=False))


def _origin(grid: Grid, origin: Origin, start: tuple[int, int] | None) -> tuple[float, float]:
    """Position of an origin in the CRS."""
    if origin is None:
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
