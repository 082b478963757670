"""Maps and paths for ROS: files of map_server and Nav2, and bags.

All is in the frame `map`, x east and y north, in metres. By default that is the terrain's CRS; as
RViz draws in float32, which is coarse that far out, `origin=(0.0, 0.0)` puts the lower left corner
of the grid there instead.
"""

import math
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
import yaml

from trustbo.errors import TrustboError, require_choice, require_positive
from trustbo.export.checks import require_file, require_maps
from trustbo.export.paths import plan_of
from trustbo.files import write_file, write_text
from trustbo.planning import Plan
from trustbo.result import Result
from trustbo.simulation.bagfile import STORAGES, Record, require_new_bag, write_messages
from trustbo.simulation.messages import GRID, PATH, Messages
from trustbo.terrain import Workspace

IMPASSABLE, UNKNOWN = 100, -1
# 99 and 100 are what a costmap publishes for "inscribed" and "lethal": no robot may go there.
WORST_PASSABLE = 98
_MOST_PIXELS = 100_000_000
_TIME = 1_000_000_000  # of the messages, ns; not 0, which means "unknown" in ROS


class _Raster(NamedTuple):
    """A map as ROS has it."""

    values: np.ndarray  # (row, col), int8, the southern row first
    resolution: float  # m
    corner: tuple[float, float]  # lower left, x and y in the frame `map`, m
    shift: np.ndarray  # from the grid's metres into the frame, (2,)


def occupancy(
    cost: xr.DataArray, workspace: Workspace, *, resolution: float | None = None
) -> np.ndarray:
    """A cost map as ROS has it.

    Args:
        cost: Dims (row, col), in [0, 1]; NaN where it is not known, e.g. `Result.maps()["cost"]`.
        workspace: Whose cells they are.
        resolution: Side of a pixel, m, each as the cell at its centre; by default that of a cell,
            or a tenth of its shorter side where cells are not square.

    Returns:
        Shape (height, width), int8, the southern row first: 100 times the cost, but at most 98,
        100 where no robot can go, -1 where the cost is not known. Pixels begin at the grid's lower
        left corner; those whose centres are beyond its other edges are -1.

    Raises:
        ShapeError: Other dims, or another number of cells.
        TrustboError: A cost outside [0, 1]; or a resolution that is not positive, or far too fine.
    """
    (values,) = require_maps(cost.rename("cost"), workspace).data_vars.values()
    known = values.values
    if (bad := (known < 0.0) | (known > 1.0)).any():
        cell = tuple(int(i) for i in np.argwhere(bad)[0])
        raise TrustboError(f"cost{list(cell)} = {known[cell]:g} is outside [0, 1].")
    cells = np.where(np.isnan(known), UNKNOWN, np.fmin(np.rint(100.0 * known), WORST_PASSABLE))
    cells = np.where(workspace.passable.values, cells, IMPASSABLE).astype(np.int8)
    grid, side = workspace.grid, _resolution(workspace, resolution)
    rows, cols = grid.shape
    height, width = rows * grid.cell_height / side, cols * grid.cell_width / side
    if height * width > _MOST_PIXELS:
        raise TrustboError(
            f"resolution={side:g} m gives {height * width:.1e} pixels; take a coarser one."
        )
    # Sizes are whole but for rounding, and so may the quotient be.
    y, x = ((np.arange(math.ceil(n - 1e-6)) + 0.5) * side for n in (height, width))
    row, col = rows - 1 - (y // grid.cell_height).astype(int), (x // grid.cell_width).astype(int)
    within = (row >= 0)[:, None] & (col < cols)
    return np.where(within, cells[np.ix_(row.clip(0), col.clip(None, cols - 1))], UNKNOWN).astype(
        np.int8
    )


def write_ros_map(
    path: str | PathLike[str],
    cost: xr.DataArray,
    workspace: Workspace,
    *,
    resolution: float | None = None,
    origin: tuple[float, float] | None = None,
) -> None:
    """Write a cost map for map_server of ROS 1 and of Nav2: a .yaml file, and a .pgm beside it.

    Args:
        path: The .yaml (or .yml) file.
        cost: See `occupancy`.
        workspace: Whose cells they are.
        resolution: See `occupancy`.
        origin: Where the grid's lower left corner is to be in the frame `map`, m; by default where
            it is in the CRS.

    Raises:
        ShapeError: Other dims, or another number of cells.
        TrustboError: What `occupancy` refuses; an origin that is no position; or a path that is no
            such file.
    """
    target = require_file(path, ".yaml", ".yml")
    picture = require_file(target.with_suffix(".pgm"))
    raster = _raster(cost, workspace, resolution, origin)
    height, width = raster.values.shape
    # Pictures begin in the north. In raw mode, map_server takes a pixel's byte as the value, where
    # 255 is -1 as int8; Nav2 does if it is at most 100, and takes any other as unknown.
    pixels = raster.values[::-1].astype(np.uint8).tobytes()
    head = f"P5\n{width} {height}\n255\n".encode("ascii")
    record = {
        "image": picture.name,
        "mode": "raw",
        "resolution": raster.resolution,
        "origin": [*raster.corner, 0.0],
        "negate": 0,
        # Both loaders ask for these, but raw mode has no use for them: the values are their own.
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    write_file(picture, lambda file: file.write_bytes(head + pixels))
    # Last: it speaks of the picture.
    write_text(target, yaml.safe_dump(record, sort_keys=False, default_flow_style=None))


def write_ros_bag(
    path: str | PathLike[str],
    plan: Plan | Result,
    cost: xr.DataArray,
    workspace: Workspace,
    *,
    version: int | None = None,
    storage: str = "mcap",
    resolution: float | None = None,
    origin: tuple[float, float] | None = None,
) -> None:
    """Write a cost map and a path as a ROS bag, for RViz and Foxglove.

    `/trustbo/cost` has one nav_msgs/OccupancyGrid, `/trustbo/path` one nav_msgs/Path from centre to
    centre, each pose heading for the next; both are latched (transient local).

    Args:
        path: A `.bag` file for ROS 1, or a folder for ROS 2; written whole or not at all.
        plan: The path, or a result for the one it recommends.
        cost: See `occupancy`.
        workspace: Where they are.
        version: Of ROS, 1 or 2; by default as the path says.
        storage: Of ROS 2, "mcap" or "sqlite3".
        resolution: See `occupancy`.
        origin: See `write_ros_map`.

    Raises:
        ShapeError: Other dims, or another number of cells or robots.
        TrustboError: No rosbags; a path that exists, or is of the other version; or what
            `write_ros_map` refuses.
    """
    target = Path(path)
    require_choice("storage", storage, STORAGES)
    of_path = require_new_bag(target, version)
    plan, workspace = plan_of(plan, workspace)
    raster = _raster(cost, workspace, resolution, origin)
    poses = _poses(plan, workspace, raster.shift)

    def records(make: Messages) -> list[Record]:
        corner = np.array([*raster.corner, 0.0])
        grid = make.grid(_TIME, raster.values, raster.resolution, corner)
        return [
            Record(_TIME, "/trustbo/cost", GRID, grid),
            Record(_TIME, "/trustbo/path", PATH, make.path(_TIME, poses)),
        ]

    write_messages(target, of_path, storage, records, latched=True)


def _raster(
    cost: xr.DataArray,
    workspace: Workspace,
    resolution: float | None,
    origin: tuple[float, float] | None,
) -> _Raster:
    grid = workspace.grid
    own = np.array(grid.corner)
    corner = own if origin is None else _position(origin)
    values = occupancy(cost, workspace, resolution=resolution)
    x, y = corner.tolist()
    return _Raster(values, _resolution(workspace, resolution), (x, y), corner - own)


def _resolution(workspace: Workspace, resolution: float | None) -> float:
    """Side of a pixel, m."""
    if resolution is not None:
        return require_positive("resolution", resolution)
    height, width = workspace.grid.cell_height, workspace.grid.cell_width
    # Pixels of ROS are square; with ten to a cell, its edges are off by a twentieth at most.
    return width if math.isclose(height, width, rel_tol=1e-6) else min(height, width) / 10.0


def _position(origin: tuple[float, float]) -> np.ndarray:
    try:
        position = np.array(origin, dtype=float)
    except (TypeError, ValueError):
        position = np.array(np.nan)
    if position.shape != (2,) or not np.isfinite(position).all():
        raise TrustboError(f"origin must be two finite numbers (x, y); got {origin!r}.")
    return position


def _poses(plan: Plan, workspace: Workspace, shift: np.ndarray) -> np.ndarray:
    """Centres of the cells, each heading for the next, the last as the one before; (cell, 3)."""
    centers = np.array([workspace.grid.center(cell) for cell in plan.path]) + shift
    steps = np.diff(centers, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    return np.column_stack([centers, [*heading, heading[-1] if len(heading) else 0.0]])
