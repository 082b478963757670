"""Nav2 files: a map for map_server, stops for FollowWaypoints, and a graph for the route server.

Positions are given in a frame with its origin near the robots. RViz and Nav2 store positions as
float32, which is too coarse for CRS coordinates. `frame.yaml` contains the pose of the frame in the
CRS. YAML files are written as JSON, which is valid YAML.
"""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.arrays import as_array, without_rounding
from trustbo.campaign.result import Result
from trustbo.errors import (
    TrustboError,
    require_choice,
    require_finite,
    require_kind,
    require_position,
    require_positive,
)
from trustbo.files import FilePath, read_file, to_path, write_file
from trustbo.planning import Plan
from trustbo.planning.given import mean_of
from trustbo.team import LEAD
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES

IMPASSABLE = 100
"""Pixel value of impassable cells."""
UNKNOWN = 255
"""Pixel value of unknown cells."""
WORST = 98
"""Pixel value of the highest cost, because Nav2 treats 99 and 100 as obstacles."""
_MAX_PIXELS = 1e8  # of a map: 100 MB
_MAX_ID = 65_535
"""Largest id in Nav2 messages (uint16)."""
_MIN_COST = 1e-9
"""Minimum cost of an edge, since the route server rejects 0."""
_FARTHEST = 10_000.0
"""Largest distance of a frame's origin from the map, in metres; float32 then resolves 1 mm."""
_PICTURE = ".pgm"
"""Suffix of the pixels of a cost map."""
_NO_WAYPOINTS = "waypoints need a workspace made with Workspace.from_terrain."
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that Windows reserves, with any suffix."""


@dataclass(frozen=True)
class Frame:
    """Coordinate frame of the robots, defined by the pose of its origin in the CRS.

    Attributes:
        origin: Position of the frame's origin, x and y in CRS metres.
        rotation: Angle from the x axis of the CRS (east) to the x axis of the frame, in rad,
            counterclockwise.
        name: Name of the frame, used as the `frame_id` of messages.

    Raises:
        TrustboError: The origin is not two finite numbers, the rotation is beyond a full turn, or
            the name is empty.

    Example:
        >>> frame = tb.export.Frame(origin=(380_000.0, 5_224_800.0), rotation=np.pi / 2.0)
        >>> frame.of_crs([380_000.0, 5_224_810.0]).round(6)  # 10 m north of the origin
        array([10., 0.])
    """

    origin: tuple[float, float]
    rotation: float = 0.0
    name: str = "map"

    def __post_init__(self) -> None:
        # NumPy numbers, such as those from an array, become floats, because JSON knows no others.
        origin = require_position("the frame's origin", self.origin)

        rotation = require_finite("the frame's rotation", self.rotation)
        if abs(rotation) > 2.0 * math.pi:
            raise TrustboError(
                f"the frame's rotation must be in radians, within 2 pi; got {rotation:g} (degrees? "
                "use numpy.deg2rad)."
            )

        remedy = "give the frame_id, such as 'map'"
        if not require_kind("the frame's name", self.name, str, remedy).strip():
            raise TrustboError(f"the frame's name is empty; {remedy}.")

        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "rotation", rotation)

    def of_crs(self, xy: Any) -> np.ndarray:
        """Convert positions (..., 2) from CRS metres to this frame, in metres."""
        return (_positions(xy) - self.origin) @ self._turn

    def to_crs(self, xy: Any) -> np.ndarray:
        """Convert positions (..., 2) in this frame to CRS coordinates, both in metres."""
        return _positions(xy) @ self._turn.T + self.origin

    @property
    def _turn(self) -> np.ndarray:
        """Matrix that turns row vectors from the axes of the CRS to those of the frame."""
        c = math.cos(self.rotation)
        s = math.sin(self.rotation)
        return np.array([[c, -s], [s, c]])


def _positions(xy: Any) -> np.ndarray:
    """Return positions (..., 2) as floats; raises TrustboError for another shape."""
    values = as_array("positions", xy)
    if values.shape[-1:] != (2,):
        raise TrustboError(f"positions must have shape (..., 2), x and y; got {values.shape}.")
    return values


def write_nav2(
    folder: FilePath,
    result: Result | Plan,
    *,
    frame: Frame | None = None,
    pixel: float | None = None,
) -> None:
    """Write the cost map, each robot's waypoints, the route graph and the frame to a folder.

    For a result or a campaign, all files are written, with the waypoints of the *recommended* path.
    Before the first mission, the costs are those of the prior. The next path of a campaign may
    differ from the recommended path.

    For a plan, such as `campaign.ask()`, only its waypoints and the frame are written, because a
    plan has no costs of other bounds. A cost map and a route graph that are already in the folder
    are kept. The waypoints of a plan from `Campaign.replan` begin in the cell in which the
    team is, `plan.path[plan.n_driven]`, and leave out the bounds that were driven.

    Args:
        folder: Folder for `cost_map.yaml` and `.pgm`, `waypoints_<robot>.yaml` (on a terrain),
            `route_graph.geojson` and `frame.yaml`.
        result: Result of a campaign, or the campaign; or a plan from `Campaign.ask`,
            `Campaign.replan` or `Follower.replan`.
        frame: Frame of all files; by default, the frame's origin is the lower left corner of the
            planning grid, so that all courses on a ground share a frame.
        pixel: Side length of a map pixel, in metres; by default a tenth of a cell's shorter side.

    Raises:
        TrustboError: The frame is not a `Frame` or its origin is far off the map, a robot's name
            cannot be part of a file name, a robot has no route in a bound, the grid has too many
            cells for Nav2's ids, the map has too many pixels, or a file cannot be written. The same
            error is raised if a plan has no terrain, or if the folder has files in a frame other
            than that of the plan.

    Example:
        >>> frame = tb.export.Frame(origin=(380_000.0, 5_224_800.0))
        >>> tb.export.write_nav2("nav2", campaign, frame=frame)
        >>> tb.export.write_nav2("nav2", campaign.ask(), frame=frame)  # the next path's waypoints
    """
    require_kind(
        "result", result, (Result, Plan), "give a result, a campaign, or a plan such as ask()"
    )
    if frame is not None:
        require_kind("frame", frame, Frame, "give a trustbo.export.Frame")
    folder = to_path(folder)
    plan = result.plan() if isinstance(result, Result) else result
    workspace = result.workspace
    place = Frame(workspace.grid.corner) if frame is None else frame

    # All contents are made before the first file is written, so that an error leaves no incomplete
    # set of files.
    waypoints = {} if plan.stops is None else _waypoints(plan, place)
    files = {folder / f"waypoints_{robot}.yaml": text for robot, text in waypoints.items()}
    parent = "grid" if workspace.grid.crs is None else workspace.grid.crs_name
    about = _yaml(
        {
            "frame": place.name,
            "parent": parent,
            "origin": [*place.origin],
            "rotation": place.rotation,
        }
    )

    if isinstance(result, Result):
        cost = result.maps()["cost"]
        files |= _ros_map(folder / "cost_map.yaml", cost, workspace, place, pixel)
        files[folder / "route_graph.geojson"] = _graph(result, place).encode()
    else:
        if not waypoints:
            raise TrustboError(_NO_WAYPOINTS)
        _require_near(place, workspace.grid.bounds)
        _require_same_frame(folder / "frame.yaml", about)

    files[folder / "frame.yaml"] = about
    for path, content in files.items():
        write_file(path, content, is_raster=path.suffix == _PICTURE)


def _waypoints(plan: Plan, frame: Frame) -> dict[str, bytes]:
    """Return the content of each robot's file of waypoints."""
    team = plan.workspace.team
    _require_file_names(team.names)

    contents = {}
    for robot in team.members:
        poses = [
            {
                "header": {"frame_id": frame.name},
                "pose": {
                    "position": {"x": x, "y": y, "z": 0.0},
                    "orientation": {
                        "x": 0.0,
                        "y": 0.0,
                        "z": math.sin(turn / 2.0),
                        "w": math.cos(turn / 2.0),
                    },
                },
            }
            for x, y, turn in stops_of(plan, robot, frame).tolist()
        ]
        contents[robot] = _yaml({"poses": poses}, indent=1)
    return contents


def _yaml(content: dict[str, Any], **options: Any) -> bytes:
    """Return the content of a YAML file."""
    return json.dumps(content, **options).encode()


def _require_same_frame(file: Path, content: bytes) -> None:
    """Check that the files that stay in a folder are in the frame of the waypoints."""
    if file.exists() and read_file(file) != content:
        raise TrustboError(
            f"the files in {str(file.parent)!r} are in another frame; pass their frame, which is "
            f"in {file.name}, or use another folder."
        )


def _require_file_names(robots: Sequence[str]) -> None:
    """Check that robots' names can be parts of file names and differ, on Windows too."""
    seen = {LEAD: LEAD}
    for name in robots:
        if not re.fullmatch(r"\w([\w .-]*[\w-])?", name) or _DEVICES.fullmatch(name):
            raise TrustboError(
                f"the robot's name {name!r} cannot be part of a file name; use letters, digits, "
                "'_' and '-', and begin with a letter or a digit."
            )
        other = seen.setdefault(name.casefold(), name)
        if other != name:
            raise TrustboError(
                f"the files of the robots {other!r} and {name!r} would have one name; rename a "
                "robot."
            )


def _ros_map(
    target: Path, cost: xr.DataArray, workspace: Workspace, frame: Frame, pixel: float | None
) -> dict[Path, bytes]:
    """Return a cost map for the map_server of Nav2: a .yaml and a .pgm file with their contents."""
    values, corner, side = occupancy(cost.values, workspace, frame, pixel)
    picture = target.with_suffix(_PICTURE)
    # The first row of an image is in the north. In raw mode, map_server reads bytes as costs.
    pixels = f"P5\n{values.shape[1]} {values.shape[0]}\n255\n".encode() + values[::-1].tobytes()

    about = {"image": picture.name, "mode": "raw", "resolution": side, "origin": [*corner, 0.0],
             "negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196}  # fmt: skip

    return {picture: pixels, target: _yaml(about)}


def occupancy(
    cost: np.ndarray, workspace: Workspace, frame: Frame, pixel: float | None = None
) -> tuple[np.ndarray, list[float], float]:
    """Return pixels (row, col), southern row first, the lower left corner and the pixel size.

    Args:
        cost: Cost of each cell (row, col), in [0, 1]; NaN if unknown. A pixel has the value 100
            times the cost, at most 98; 100 means impassable and 255 means unknown.
        workspace: Workspace of the cells.
        frame: Frame of the pixels. Each pixel has the cost of the cell at the pixel's centre.
        pixel: Side length of a pixel, in metres; by default a tenth of a cell's shorter side.

    Raises:
        TrustboError: A cost is outside [0, 1], the frame is not a `Frame` or its origin is far off
            the map, or the map has too many pixels.
    """
    cost = without_rounding(cost)
    if ((cost < 0.0) | (cost > 1.0)).any():
        raise TrustboError(
            f"cost must be in [0, 1]; got values from {np.nanmin(cost):g} to {np.nanmax(cost):g}."
        )

    grid = workspace.grid
    _require_near(frame, grid.bounds)

    shorter = min(grid.cell_height, grid.cell_width)
    side = float(f"{shorter / 10.0:.2g}") if pixel is None else require_positive("pixel", pixel)

    left, bottom, right, top = grid.bounds
    corners = frame.of_crs([*product((left, right), (bottom, top))])
    corner = corners.min(0)

    # The quotient may be a whole number plus a rounding error.
    n_x, n_y = np.ceil(np.ptp(corners, axis=0) / side - 1e-6).astype(int)
    if float(n_x) * float(n_y) > _MAX_PIXELS:
        raise TrustboError(f"pixel={side:g} m gives {n_x} x {n_y} pixels; use a larger pixel.")

    percent = np.where(np.isnan(cost), UNKNOWN, np.fmin(np.rint(100.0 * cost), WORST))
    percent = np.where(workspace.passable.values, percent, IMPASSABLE)

    values = np.full((n_y, n_x), UNKNOWN, dtype=np.uint8)
    for i in range(n_y):  # row by row, because maps may be large
        x = (np.arange(n_x) + 0.5) * side
        places = frame.to_crs(np.column_stack([x, np.full(n_x, (i + 0.5) * side)]) + corner)
        row, col, inside = grid.cells_at(*places.T)
        values[i, inside] = percent[row[inside], col[inside]]
    return values, corner.tolist(), side


def _require_near(frame: Frame, bounds: tuple[float, float, float, float]) -> None:
    """Check that a frame's origin is near the map with these edges: left, bottom, right, top."""
    require_kind("frame", frame, Frame, "give an export.Frame, such as Frame((x, y), rotation)")
    x, y = frame.origin
    left, bottom, right, top = bounds
    away = math.dist(frame.origin, np.clip(frame.origin, (left, bottom), (right, top)))

    if away > _FARTHEST:
        raise TrustboError(
            f"the frame's origin ({x:.10g}, {y:.10g}) is {away / 1000.0:.4g} km off the map, which "
            f"covers x {left:.10g} to {right:.10g} and y {bottom:.10g} to {top:.10g}; give it in "
            "metres of the map's CRS, not in degrees."
        )


def stops_of(plan: Plan, robot: str, frame: Frame) -> np.ndarray:
    """Return the poses (x, y, heading) of a robot's stops ahead in a frame, shape (stop, 3).

    Stops of bounds that were driven are left out. The lead faces its next stop. At each post, the
    other robots face the lead's next stop; at the goal, they face the lead. Waypoints do not make
    robots wait for each other. Raises TrustboError if there is no terrain or no route.
    """
    require_choice("robot", robot, plan.workspace.team.members)
    if plan.stops is None or plan.posts is None or plan.routes is None:
        raise TrustboError(_NO_WAYPOINTS)

    n = plan.n_driven
    lead = frame.of_crs(plan.stops[n:])
    if robot == LEAD:
        places = lead
        steps = np.diff(lead, axis=0)
        steps = np.vstack([steps, steps[-1:]])
    else:
        i = plan.workspace.team.names.index(robot)
        routes = [of_bound[i + 1] for of_bound in plan.routes[n:]]
        if any(route is None for route in routes) or routes[-1] is None:
            raise TrustboError(f"robot {robot!r} has no route in a bound; plan another path.")
        places = frame.of_crs(np.vstack([plan.posts[n:, i], routes[-1][-1:]]))
        steps = np.vstack([lead[1:], lead[-1:]]) - places
    return np.column_stack([places, np.arctan2(steps[:, 1], steps[:, 0])])


def _graph(result: Result, frame: Frame) -> str:
    """Return all bounds with their expected costs, as GeoJSON for Nav2's route server.

    The cost of a bound is the contact lost in it plus its failure probability times the cost of a
    failure. Nodes are stops, with the id row * columns + column. Edges are straight lines, with the
    id (1 + move) * cells + id of the stop entered. Nav2's PenaltyScorer reads `penalty`.
    """
    workspace = result.workspace
    cols = workspace.grid.shape[1]
    n_cells = math.prod(workspace.grid.shape)
    if (1 + len(MOVES)) * n_cells - 1 > _MAX_ID:
        raise TrustboError(
            f"a route graph of {n_cells} cells needs ids above {_MAX_ID}, the limit of Nav2; "
            "use larger cells."
        )

    posts = workspace.posts
    draws = result.belief if result.state.posterior is None else result.posterior
    graph = result.planner.graph(mean_of(draws, result.workspace))
    place = workspace.grid.center if posts is None else posts.stop
    where = {cell: frame.of_crs(place(cell)).tolist() for cell in graph.nodes}
    ids = {(row, col): row * cols + col for row, col in where}

    features = []
    for (row, col), xy in where.items():
        about = {"id": ids[row, col], "frame": frame.name, "metadata": {"row": row, "col": col}}
        features.append(_feature("Point", xy, about))

    failure_cost = result.planner.problem.cost_of_failure
    least: dict[Any, tuple[float, float]] = {}  # of parallel edges, the one with the best posts
    for a, c, edge in graph.edges(data=True):
        p_fail = -math.expm1(-edge.get("risk", 0.0))
        cost = max(edge["lost"] + failure_cost * p_fail, _MIN_COST)
        least[a, c] = min(least.get((a, c), (math.inf, 0.0)), (cost, p_fail))

    for (a, c), (cost, p_fail) in least.items():
        move = MOVES.index((c[0] - a[0], c[1] - a[1]))
        about = {"id": (1 + move) * n_cells + ids[c], "startid": ids[a], "endid": ids[c]}
        about |= {"cost": cost, "overridable": True}
        about |= {"metadata": {"penalty": cost, "p_fail": p_fail}}
        features.append(_feature("MultiLineString", [[where[a], where[c]]], about))
    return '{"type": "FeatureCollection", "features": [\n' + ",\n".join(features) + "\n]}\n"


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> str:
    """Return a GeoJSON feature; Nav2 reads numbers without a decimal point as integers."""
    geometry = {"type": kind, "coordinates": coordinates}
    return json.dumps({"type": "Feature", "properties": properties, "geometry": geometry})
