"""Maps as GridMap messages of grid_map, all layers in one, written to bags and read from them."""

import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rioxarray  # noqa: F401  (registers the .rio accessor)
import xarray as xr

from trustbo.errors import TrustboError, require_choice
from trustbo.export.checks import Maps, require_maps
from trustbo.export.frame import OF_CRS, Frame, PlacedFrame, frame_file, placed, save_beside
from trustbo.export.lattice import sampled
from trustbo.export.ros import static_transform
from trustbo.files import FilePath
from trustbo.logs.bagfile import STORAGES, Record, opened, require_new_bag, write_messages
from trustbo.logs.messages import GRID_MAP, TRANSFORMS, Messages
from trustbo.workspace import Workspace

TOPIC = "/trustbo/maps"
_STATIC = "/tf_static"
_LEVEL = 1e-9
"""Rotation below which a frame is that of a raster, rad."""


def write_grid_map(
    path: FilePath,
    maps: Maps,
    workspace: Workspace,
    *,
    storage: str = "mcap",
    resolution: float | None = None,
    frame: Frame | PlacedFrame = OF_CRS,
) -> None:
    """Write maps as the layers of one grid_map_msgs/GridMap in a ROS bag.

    Layers on `/trustbo/maps` are float32, named after their variables, NaN where unknown; the bag
    has the pose of the frame on `/tf_static`. Both are latched (transient local).

    Args:
        path: New `.bag` file for ROS 1, or new folder for ROS 2.
        maps: Maps (row, col), e.g. `Result.maps()`.
        workspace: Workspace of the cells.
        storage: Storage of ROS 2, "mcap" or "sqlite3".
        resolution: Side of a pixel, m, see `write_ros_map`.
        frame: Frame, see `write_ros_map`.

    Raises:
        ShapeError: The dims or the number of cells differ.
        TrustboError: rosbags is not installed; the path exists; or an argument is
            refused by `write_ros_map`.
    """
    target = Path(path)
    require_choice("storage", storage, STORAGES)
    version = require_new_bag(target)
    place = placed(frame, workspace)
    frame_file(target)
    bands = require_maps(maps, workspace)
    cells = np.stack([band.values for band in bands.data_vars.values()]).astype(np.float32)
    raster = sampled(cells, np.nan, workspace, resolution, place)
    layers = dict(zip(map(str, bands.data_vars), raster.values, strict=True))

    def records(make: Messages) -> list[Record]:
        now = time.time_ns()
        message = make.grid_map(now, layers, raster.resolution, raster.corner)
        return [static_transform(make, now, place), Record(now, TOPIC, GRID_MAP, message)]

    write_messages(target, version, storage, records, latched=True, frame=place.name)
    save_beside(target, frame, place, workspace)


def read_grid_map(path: FilePath, topic: str | None = None) -> xr.Dataset:
    """Read the last grid_map_msgs/GridMap on a topic of a ROS bag, such as heights for a terrain.

    `read_terrain(read_grid_map("mapping")["elevation"])` reads a DEM; where its frame has no known
    pose in a CRS, with `crs=`.

    Args:
        path: A `.bag` file of ROS 1, the folder of a bag of ROS 2, or its .mcap file.
        topic: Topic of the map; by default the only one of this type.

    Returns:
        Dataset of the layers over (y, x), float32, north at the top. Where the bag has a static
        transform from the frame of a CRS, such as `epsg_2193`, without a rotation, as exports write
        it, y and x are metres of this CRS, which `rio` has; else of the frame. Attributes are
        `frame`, its name, and `time`, s since 1970.

    Raises:
        TrustboError: No rosbags; not a bag; no such topic, or several; or a map whose layers do not
            agree with its size.
    """
    with opened(Path(path)) as bag:
        topics = [name for name, kind in bag.types.items() if kind == GRID_MAP]
        if topic is not None:
            bag.require([topic])
        elif len(topics) != 1:
            there = ", ".join(topics) or "none"
            raise TrustboError(
                f"{str(path)!r} must have one topic of {GRID_MAP}, or give topic=; it has {there}."
            )
        name = topic or topics[0]
        wanted = {name: (GRID_MAP,)}
        if bag.types.get(_STATIC) == TRANSFORMS:
            wanted[_STATIC] = (TRANSFORMS,)
        found, poses = None, []
        for on, _, message in bag.messages(wanted):
            if on == _STATIC:  # of any publisher
                poses += message.transforms
            else:
                found = message
    if found is None:
        raise TrustboError(f"{str(path)!r} has no message on {name}.")
    return _georeferenced(_maps_of(found, name), poses)


def _maps_of(message: Any, topic: str) -> xr.Dataset:
    """Layers of a message over (y, x) of its frame."""
    header = message.header if hasattr(message, "header") else message.info.header
    info, start = message.info, (message.outer_start_index, message.inner_start_index)
    shape = tuple(
        round(length / info.resolution) for length in (info.length_x, info.length_y)
    )  # rows run along -x, columns along -y
    if len(message.layers) != len(message.data):
        raise TrustboError(
            f"{topic} has {len(message.layers)} names of layers and {len(message.data)} layers."
        )
    layers = {}
    for layer, array in zip(message.layers, message.data, strict=True):
        sizes = {axis.label: axis.size for axis in array.layout.dim}
        if [*sizes] != ["column_index", "row_index"]:
            raise TrustboError(
                f"{topic}: axes of the layer {layer!r} are {[*sizes]}; they must be column_index "
                "and row_index, in this order."
            )
        found = sizes["row_index"], sizes["column_index"]
        if found != shape or array.data.size != shape[0] * shape[1]:
            raise TrustboError(
                f"{topic}: the layer {layer!r} has {array.data.size} values of {found[0]} x "
                f"{found[1]} cells, and the map {shape[0]} x {shape[1]}."
            )
        cells = np.reshape(array.data, shape, order="F")
        # The map is a circular buffer, whose first row and column are these.
        cells = np.roll(cells, (-start[0], -start[1]), axis=(0, 1))
        layers[layer] = (("y", "x"), np.rot90(cells, -1))
    place, side = info.pose.position, info.resolution
    # From the centre of the map: x rises with the column, y falls with the row.
    x, y = (
        place.x + (np.arange(shape[0]) - 0.5 * (shape[0] - 1)) * side,
        place.y - (np.arange(shape[1]) - 0.5 * (shape[1] - 1)) * side,
    )
    about = {"frame": header.frame_id, "time": header.stamp.sec + 1e-9 * header.stamp.nanosec}
    return xr.Dataset(layers, {"y": y, "x": x}, about)


def _georeferenced(maps: xr.Dataset, poses: Sequence[Any]) -> xr.Dataset:
    """Maps in the CRS whose frame is the parent of theirs; unchanged where that is not known."""
    for one in poses:
        code = re.fullmatch(r"(epsg|esri)_(\d+)", one.header.frame_id)
        turn, shift = one.transform.rotation, one.transform.translation
        level = max(abs(turn.x), abs(turn.y), abs(turn.z)) < _LEVEL
        if code is not None and level and one.child_frame_id == maps.attrs["frame"]:
            moved = maps.assign_coords(y=maps["y"] + shift.y, x=maps["x"] + shift.x)
            return moved.rio.write_crs(f"{code[1].upper()}:{code[2]}")
    return maps
