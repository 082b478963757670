"""Maps for map_server of ROS and of Nav2.

Coordinates are in a frame, by default `map` with x east and y north in metres of the terrain's CRS.
RViz draws in float32, which is coarse so far from 0: `origin` puts (0, 0) near the robots.
"""

import numpy as np
import xarray as xr
import yaml

from trustbo.errors import TrustboError
from trustbo.export.checks import require_maps
from trustbo.export.frame import OF_CRS, Frame, PlacedFrame, frame_file, placed, save_beside
from trustbo.export.lattice import Raster, sampled
from trustbo.files import FilePath, require_file, write_file, write_text
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
