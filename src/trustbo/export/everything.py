"""Export of a result in several formats to one folder."""

from collections.abc import Callable, Collection, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_choice, require_positive
from trustbo.export.checks import (
    LEAD,
    require_crs,
    require_lead_apart,
    require_names_for_sql,
)
from trustbo.export.frame import (
    AT_START,
    Frame,
    PlacedFrame,
    frame_file,
    is_frame,
    placed,
    require_fine,
    save_frame,
)
from trustbo.export.nav2 import stops_of, write_waypoints
from trustbo.export.paths import write_path
from trustbo.export.rasters import write_geotiff
from trustbo.export.ros import occupancy, write_ros_map
from trustbo.export.route_graph import OBJECTIVES, graph_of, summed
from trustbo.export.route_graph_file import write_route_graph
from trustbo.export.tables import write_csv
from trustbo.files import FilePath, require_file, require_folder
from trustbo.planning.problem import mean_of


class _Content(NamedTuple):
    """Result to write."""

    result: Result
    maps: Callable[[], xr.Dataset]
    """Its maps, computed once and only if a format needs them: they are slow."""
    frame: PlacedFrame
    """Frame of all formats for robots."""
    resolution: float | None
    """Side of a pixel of their maps, m."""

    @property
    def placing(self) -> dict[str, Any]:
        """Options of functions that write maps for robots."""
        return {"resolution": self.resolution, "frame": self.frame}


class _Format(NamedTuple):
    text: str
    files: tuple[str, ...]
    write: Callable[[_Content, Path], None]
    """Function of the content and the first of the files."""
    on_earth: bool = False
    """Whether the format needs a CRS."""
    in_frame: bool = False
    """Whether its positions are in the frame of robots."""
    require: Callable[[Result, PlacedFrame], object] | None = None
    """Check that refuses a result, or a frame, that the format cannot hold."""
    on_terrain: tuple[str, ...] = ()
    """Further files, of posts and ways, which need a terrain in memory; `{robot}`: one for each."""

    def files_in(self, folder: Path, result: Result) -> list[Path]:
        more, names = self.on_terrain, (LEAD, *result.workspace.team.names)
        if result.workspace.ground is None:
            more = ()
        by_robot = [name.format(robot=robot) for name in more for robot in names]
        return [folder / name for name in dict.fromkeys((*self.files, *by_robot))]


def export_result(
    result: Result,
    folder: FilePath,
    formats: Sequence[str] = ("geotiff", "geojson"),
    *,
    resolution: float | None = None,
    frame: Frame = AT_START,
) -> list[Path]:
    """Write the maps and the recommended path of a result to a folder.

    Args:
        result: Result of a campaign.
        folder: Folder to write to; files in it are replaced.
        formats: Names of formats, keys of `FORMATS`.
        resolution: Side of a pixel of the maps for ROS, m; by default that of a cell, or a tenth of
            its shorter side if cells are not square.
        frame: Frame of the files for robots.

    Returns:
        Files written. With files for robots, the last is `frame.yaml`, the one frame of them all,
        see `write_frame`.

    Raises:
        TrustboError: A format is unknown, or needs a CRS that the result lacks; the resolution is
            not positive, far too fine, or given without a format for robots; a cost is outside
            [0, 1]; or a file cannot be written. Then nothing is written.
    """
    names = [formats] if isinstance(formats, str) else dict.fromkeys(formats)
    chosen = {name: _FORMATS[require_choice("format", name, _FORMATS)] for name in names}
    target, for_robots = require_folder(folder), any(kind.in_frame for kind in chosen.values())
    if resolution is not None:
        require_positive("resolution", resolution)
    place = placed(frame, result.workspace, result.path[0])
    options, defaults = ("resolution", "origin", "rotation", "frame"), (None, *AT_START)
    for option, value, default in zip(options, (resolution, *frame), defaults, strict=True):
        if not for_robots and value != default:
            shown = f"{value:g}" if isinstance(value, float | int) else repr(value)
            raise TrustboError(
                f"{option}={shown} is of files for robots; leave it out, or ask for one of "
                f"{', '.join(_in_frame())}."
            )
    for name in chosen:
        _require_possible(name, result, target, place)
    if for_robots:
        _require_frame(place, target, chosen)
    content = _Content(result, cache(result.maps), place, resolution)
    if "ros_map" in chosen:
        occupancy(content.maps()["cost"], result.workspace, resolution=resolution)
    for kind in chosen.values():
        kind.write(content, target / kind.files[0])
    written = [file for kind in chosen.values() for file in kind.files_in(target, result)]
    if for_robots:
        written.append(target / _FRAME)
        save_frame(target / _FRAME, place, result.workspace)
        for name in filter(chosen.__contains__, _in_frame()):
            # One of an earlier version would contradict it.
            frame_file(target / _FORMATS[name].files[0]).unlink(missing_ok=True)
    return written


def _require_frame(place: PlacedFrame, target: Path, chosen: Collection[str]) -> None:
    """Refuse another frame than that of files for robots that stay in a folder: TrustboError."""
    others = (file for name in _in_frame() if name not in chosen for file in _FORMATS[name].files)
    staying = [file for file in others if (target / file).exists()]
    if staying and not is_frame(require_file(target / _FRAME), place):
        raise TrustboError(
            f"{str(target)!r} holds {', '.join(staying)} in another frame than that asked for, "
            f"{place.name!r} at x {place.origin[0]:.10g}, y {place.origin[1]:.10g} of the CRS; "
            "write all files for robots at once, or to another folder."
        )


def _in_frame() -> list[str]:
    """Names of the formats for robots."""
    return [name for name, kind in _FORMATS.items() if kind.in_frame]


def left_out(
    result: Result,
    folder: FilePath,
    *,
    frame: Frame = AT_START,
) -> dict[str, str]:
    """Return the formats that cannot be written, and why, in a frame as of `export_result`.

    TrustboError: the folder is a file, or the frame cannot be.
    """
    target, reasons = require_folder(folder), {}
    place = placed(frame, result.workspace, result.path[0])
    for name in _FORMATS:
        try:
            _require_possible(name, result, target, place)
        except TrustboError as error:
            reasons[name] = str(error)
    return reasons


def _require_possible(name: str, result: Result, target: Path, place: PlacedFrame) -> None:
    """Refuse a format that cannot be written: TrustboError.

    It needs a CRS that the result lacks, or cannot hold one of its names, or its frame; or a folder
    has the name of a file.
    """
    kind = _FORMATS[name]
    if kind.on_earth:
        require_crs(result.workspace)
    if any(file.startswith("path") for file in kind.files):
        require_lead_apart(result.workspace.team.names)
    if kind.require is not None:
        kind.require(result, place)
    for file in kind.files_in(target, result):
        require_file(file)


def _write_path(content: _Content, file: Path) -> None:
    write_path(file, content.result)


def _write_map(content: _Content, file: Path) -> None:
    write_ros_map(file, content.maps()["cost"], content.result.workspace, **content.placing)


def _write_nav2(content: _Content, file: Path) -> None:
    result = content.result
    write_route_graph(file, result, objective=_summable(result), frame=content.frame)
    if result.workspace.ground is not None:
        for robot in (LEAD, *result.workspace.team.names):
            target = file.with_name(_WAYPOINTS.format(robot=robot))
            write_waypoints(target, result, robot=robot, frame=content.frame)


def _summable(result: Result) -> str:
    """Objective of the campaign, or lost_contact where its value is no sum."""
    name = result.planner.objective
    return name if name in OBJECTIVES else "lost_contact"


def _require_nav2(result: Result, place: PlacedFrame) -> None:
    require_fine(place, result.workspace, "a route graph")
    graph_of(summed(result.planner, _summable(result)), mean_of(result.posterior), place)
    if result.workspace.ground is not None:
        for robot in (LEAD, *result.workspace.team.names):
            stops_of(result.plan, robot, place)


_WAYPOINTS = "waypoints_{robot}.yaml"
_FRAME = "frame.yaml"
"""File with the frame of all formats for ROS."""
_FORMATS = {
    "geotiff": _Format(
        "all maps as bands of a GeoTIFF",
        ("maps.tif",),
        lambda content, file: write_geotiff(file, content.maps(), content.result.workspace),
        on_earth=True,
    ),
    "geojson": _Format(
        "path, posts and ways in longitude and latitude",
        ("path.geojson",),
        _write_path,
        on_earth=True,
    ),
    "geopackage": _Format(
        "path, cells, posts and ways as layers for GIS",
        ("path.gpkg",),
        _write_path,
        on_earth=True,
        require=lambda result, _: require_names_for_sql(result.workspace.team.names),
    ),
    "csv": _Format(
        "a table of all bounds that were run",
        ("missions.csv",),
        lambda content, file: write_csv(file, content.result),
    ),
    "ros_map": _Format(
        "the cost map for map_server and Nav2",
        ("cost_map.yaml", "cost_map.pgm"),
        _write_map,
        in_frame=True,
    ),
    "nav2": _Format(
        "the graph of all bounds for the route server of Nav2, and each robot's waypoints",
        ("route_graph.geojson", "route_graph_params.yaml"),
        _write_nav2,
        in_frame=True,
        require=_require_nav2,
        on_terrain=(_WAYPOINTS,),
    ),
}
FORMATS = {name: kind.text for name, kind in _FORMATS.items()}
"""Descriptions of the formats of `export_result`, by name."""
