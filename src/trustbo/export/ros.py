"""Maps and paths for ROS: files of map_server and Nav2, and bags.

Coordinates are in a frame, by default `map` with x east and y north in metres of the terrain's CRS.
RViz draws in float32, which is coarse so far from 0: `origin` puts (0, 0) near the robots.
"""

import time
from pathlib import Path

import numpy as np
import xarray as xr
import yaml

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_choice
from trustbo.export.checks import LEAD, require_maps
from trustbo.export.frame import OF_CRS, Frame, PlacedFrame, frame_file, placed, save_beside
from trustbo.export.lattice import Raster, sampled
from trustbo.export.layers import plan_of, routes_of
from trustbo.export.poses import onward, towards
from trustbo.files import FilePath, require_file, write_file, write_text
from trustbo.logs.bagfile import STORAGES, Record, require_new_bag, write_messages
from trustbo.logs.messages import (
    GRID,
    PATH,
    POSES,
    TRANSFORMS,
    Messages,
    require_topic_names,
)
from trustbo.planning import Plan
from trustbo.workspace import Workspace

IMPASSABLE, UNKNOWN = 100, -1
# Costmaps publish 99 and 100 for "inscribed" and "lethal", where no robot may go.
WORST_PASSABLE = 98


def occupancy(
    cost: xr.DataArray, workspace: Workspace, *, resolution: float | None = None
) -> np.ndarray:
    """Return the occupancy grid of a cost map (row, col) in [0, 1], NaN where unknown.

    Shape (height, width), int8, the southern row first: 100 times the cost, but at most 98, 100 in
    impassable cells, -1 where the cost is unknown. A pixel has the cost of the cell at its centre;
    its side, `resolution` m, is by default that of a cell, or a tenth of its shorter side if cells
    are not square. Pixels begin at the lower left corner of the grid; those with centres beyond its
    other edges are -1.

    ShapeError: other dims or another number of cells. TrustboError: a cost outside [0, 1], or a
    resolution that is not positive, or far too fine.
    """
    return _raster(cost, workspace, resolution, PlacedFrame()).values


def _raster(
    cost: xr.DataArray, workspace: Workspace, resolution: float | None, frame: PlacedFrame
) -> Raster:
    """Occupancy, see `occupancy`, whose pixels lie along the axes of a frame."""
    (values,) = require_maps(cost.rename("cost"), workspace).data_vars.values()
    costs = values.values
    if (bad := (costs < 0.0) | (costs > 1.0)).any():
        cell = tuple(int(i) for i in np.argwhere(bad)[0])
        raise TrustboError(f"cost{list(cell)} = {costs[cell]:g} is outside [0, 1].")
    cells = np.where(np.isnan(costs), UNKNOWN, np.fmin(np.rint(100.0 * costs), WORST_PASSABLE))
    cells = np.where(workspace.passable.values, cells, IMPASSABLE).astype(np.int8)
    return sampled(cells, UNKNOWN, workspace, resolution, frame)


def write_ros_map(
    path: FilePath,
    cost: xr.DataArray,
    workspace: Workspace,
    *,
    resolution: float | None = None,
    frame: Frame | PlacedFrame = OF_CRS,
) -> None:
    """Write a cost map for map_server of ROS 1 and of Nav2: a .yaml and a .pgm file.

    Args:
        path: .yaml or .yml file to write, or to replace.
        cost: Cost map (row, col), in [0, 1], NaN where unknown, e.g. `Result.maps()["cost"]`. It is
            written as 100 times the cost, at most 98; 100 is impassable, -1 unknown.
        workspace: Workspace of the cells.
        resolution: Side of a pixel, m, by default that of a cell, or a tenth of its shorter side if
            cells are not square.
        frame: Frame, by default that of the CRS; another is defined by a file with the suffix
            _frame.yaml in the map's folder. Pixels lie along its axes: they take the cost of the
            cell at their centre.

    Raises:
        ShapeError: The dims or the number of cells differ.
        TrustboError: A cost is outside [0, 1]; the resolution is not positive, or far too fine; the
            origin is no position, or over 100 km from the grid; a rotation or a name of a frame
            that cannot be; or the file cannot be written.
    """
    target = require_file(path, ".yaml", ".yml")
    picture = require_file(target.with_suffix(".pgm"))
    place = placed(frame, workspace)
    frame_file(target)
    raster = _raster(cost, workspace, resolution, place)
    height, width = raster.values.shape
    # Pictures begin in the north. In raw mode, map_server takes the byte of a pixel as its value,
    # 255 as -1; Nav2 does so up to 100, and takes larger bytes as unknown.
    pixels = raster.values[::-1].astype(np.uint8).tobytes()
    head = f"P5\n{width} {height}\n255\n".encode("ascii")
    record = {
        "image": picture.name,
        "mode": "raw",
        "resolution": raster.resolution,
        "origin": [*raster.corner, 0.0],
        "negate": 0,
        # Both loaders require these, although raw mode does not use them.
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    write_file(picture, lambda file: file.write_bytes(head + pixels))
    # Last, as it names the picture.
    write_text(target, yaml.safe_dump(record, sort_keys=False, default_flow_style=None))
    save_beside(target, frame, place, workspace)


def write_ros_bag(
    path: FilePath,
    plan: Plan | Result,
    cost: xr.DataArray,
    *,
    storage: str = "mcap",
    resolution: float | None = None,
    frame: Frame | PlacedFrame = OF_CRS,
) -> None:
    """Write a cost map, a path, and all robots' posts and ways as a ROS bag.

    All messages are latched (transient local), for RViz, Foxglove and drivers:

    ======================= ======================= ==========================================
    /tf_static              tf2_msgs/TFMessage      pose of the frame in that of the CRS
    /trustbo/cost           nav_msgs/OccupancyGrid  cost map
    /trustbo/path           nav_msgs/Path           centres of the cells, each towards the next
    /trustbo/<robot>/way    nav_msgs/Path           ways of all bounds, also of the `lead`
    /trustbo/<robot>/posts  geometry_msgs/PoseArray where it stands while the lead runs each bound
    /trustbo/lead/waypoints geometry_msgs/PoseArray stops of the lead, each towards the next
    ======================= ======================= ==========================================

    Ways, posts and stops need a terrain in memory; the way of a robot ends where it has none.

    Args:
        path: New `.bag` file for ROS 1, or new folder for ROS 2.
        plan: Plan, or result whose recommended path is meant.
        cost: Cost map, see `write_ros_map`.
        storage: Storage of ROS 2, "mcap" or "sqlite3".
        resolution: Side of a pixel, m, see `write_ros_map`.
        frame: Frame of all messages, see `write_ros_map`.

    Raises:
        ShapeError: The dims or the number of cells differ.
        TrustboError: rosbags is not installed; the path exists; a name
            of a robot is none of ROS, or "lead"; or an argument is refused by `write_ros_map`.
    """
    target = Path(path)
    require_choice("storage", storage, STORAGES)
    version = require_new_bag(target)
    plan = plan_of(plan)
    workspace = plan.workspace
    require_robots(workspace)
    place = placed(frame, workspace, plan.path[0])
    frame_file(target)
    raster, topics = _raster(cost, workspace, resolution, place), _topics(plan, place)
    of_kind = {PATH: Messages.path, POSES: Messages.poses}

    def records(make: Messages) -> list[Record]:
        corner = np.array([*raster.corner, 0.0])
        now = time.time_ns()
        return [
            static_transform(make, now, place),
            Record(
                now, "/trustbo/cost", GRID, make.grid(now, raster.values, raster.resolution, corner)
            ),
            *(
                Record(now, f"/trustbo/{name}", kind, of_kind[kind](make, now, poses))
                for name, (kind, poses) in topics.items()
            ),
        ]

    write_messages(target, version, storage, records, latched=True, frame=place.name)
    save_beside(target, frame, place, workspace)


def static_transform(make: Messages, now: int, place: PlacedFrame) -> Record:
    """Pose of a frame in that of the CRS, for `/tf_static`; time in ns."""
    message = make.transform(now, place.parent, place.origin, place.turn)
    return Record(now, "/tf_static", TRANSFORMS, message)


def require_robots(workspace: Workspace) -> None:
    """Refuse names of robots that cannot be in topics, where they are: TrustboError."""
    if workspace.ground is not None:
        require_topic_names(LEAD, workspace.team.names)


def _topics(plan: Plan, frame: PlacedFrame) -> dict[str, tuple[str, np.ndarray]]:
    """Return the type and the poses (pose, 3) of each topic, in the frame."""
    centers = np.array([plan.workspace.grid.center(cell) for cell in plan.path])
    topics = {"path": (PATH, onward(frame.of_crs(centers)))}
    if plan.stops is None or plan.posts is None:
        return topics
    stops = frame.of_crs(plan.stops)
    topics[f"{LEAD}/waypoints"] = POSES, onward(stops)
    for i, robot in enumerate(plan.workspace.team.names):
        posts = frame.of_crs(plan.posts[:, i])
        topics[f"{robot}/posts"] = POSES, towards(posts, stops[1:] - posts)
    for robot, ways in routes_of(plan).items():
        if ways:
            # The end of a way is the start of the next.
            points = np.concatenate([ways[0][:1], *(way[1:] for way in ways)])
            topics[f"{robot}/way"] = PATH, onward(frame.of_crs(points))
    return topics
