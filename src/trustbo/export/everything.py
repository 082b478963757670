"""Export of a result in several formats to one folder."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_choice, require_positive
from trustbo.export.checks import (
    require_crs,
    require_lead_apart,
    require_names_for_netcdf,
    require_names_for_sql,
)
from trustbo.export.frame import Frame, Origin, frame_file, frame_of
from trustbo.export.overwatch import require_overwatch, write_overwatch
from trustbo.export.paths import tables_beside, write_path
from trustbo.export.rasters import write_geotiff, write_netcdf
from trustbo.export.ros import occupancy, require_robots, write_ros_bag, write_ros_map
from trustbo.export.style import write_style
from trustbo.export.tables import write_csv
from trustbo.files import FilePath, require_file, require_folder
from trustbo.logs.bagfile import require_new_bag


class _Content(NamedTuple):
    """Result to write."""

    result: Result
    maps: Callable[[], xr.Dataset]
    """Its maps, computed once and only if a format needs them: they are slow."""
    for_ros: dict[str, Any]
    """Arguments of the maps and bags for ROS."""


class _Format(NamedTuple):
    text: str
    files: tuple[str, ...]
    write: Callable[[_Content, Path], None]
    """Function of the content and the first of the files."""
    on_earth: bool = False
    """Whether the format needs a CRS."""
    require: Callable[[Result], None] | None = None
    """Check that refuses a result the format cannot hold."""
    on_terrain: tuple[str, ...] = ()
    """Further files, of posts and ways, which need a terrain in memory."""

    def files_in(self, folder: Path, result: Result) -> list[Path]:
        more = () if result.workspace.ground is None else self.on_terrain
        return [folder / name for name in (*self.files, *more)]


def export_result(
    result: Result,
    folder: FilePath,
    formats: Sequence[str] = ("geotiff", "geojson"),
    *,
    resolution: float | None = None,
    origin: Origin = None,
    rotation: float = 0.0,
    frame: str = "map",
) -> list[Path]:
    """Write the maps and the recommended path of a result to a folder.

    Args:
        result: Result of a campaign.
        folder: Folder to write to; files in it are replaced, bags are not.
        formats: Names of formats, keys of `FORMATS`.
        resolution: Side of a pixel of the maps for ROS, m; by default that of a cell, or a tenth of
            its shorter side if cells are not square.
        origin: Position in the CRS that is (0, 0) of the maps and bags for ROS, x and y, m, or with
            names; `"auto"`: the centre of the path's first cell. By default that of the CRS.
        rotation: Angle from east to the x axis of their frame, rad, anticlockwise.
        frame: Name of their frame; see `write_ros_map`.

    Returns:
        Files written; the folder of a ROS 2 bag.

    Raises:
        TrustboError: A format is unknown, or needs a CRS that the result lacks; a bag exists, or
            rosbags is not installed; the resolution is not positive, far too fine, or given
            without a format for ROS; a cost is outside [0, 1]; or a file cannot be written. Then
            nothing is written.
    """
    names = [formats] if isinstance(formats, str) else dict.fromkeys(formats)
    chosen = {name: _FORMATS[require_choice("format", name, _FORMATS)] for name in names}
    target, for_ros = require_folder(folder), not chosen.keys().isdisjoint(_ROS)
    if resolution is not None:
        require_positive("resolution", resolution)
    place = frame_of(result.workspace, origin, rotation, frame, result.path[0])
    given = {"resolution": resolution, "origin": origin, "rotation": rotation, "frame": frame}
    for option, default in _FOR_ROS.items():
        if not for_ros and (value := given[option]) != default:
            shown = f"{value:g}" if isinstance(value, float | int) else repr(value)
            raise TrustboError(
                f"{option}={shown} is of maps for ROS; leave it out, or ask for one of "
                f"{', '.join(_ROS)}."
            )
    for name in chosen:
        _require_possible(name, result, target)
    origin_xy = None if origin is None else place.origin  # "auto" is not known to a map alone
    content = _Content(result, cache(result.maps), given | {"origin": origin_xy})
    if for_ros:
        occupancy(content.maps()["cost"], result.workspace, resolution=resolution)
    for kind in chosen.values():
        kind.write(content, target / kind.files[0])
    written = [file for kind in chosen.values() for file in kind.files_in(target, result)]
    if place != Frame():
        written += [frame_file(target / kind.files[0]) for n, kind in chosen.items() if n in _ROS]
    return written


def left_out(result: Result, folder: FilePath) -> dict[str, str]:
    """Return the formats that cannot be written, and why; TrustboError: the folder is a file."""
    target, reasons = require_folder(folder), {}
    for name in _FORMATS:
        try:
            _require_possible(name, result, target)
        except TrustboError as error:
            reasons[name] = str(error)
    return reasons


def _require_possible(name: str, result: Result, target: Path) -> None:
    """Refuse a format that cannot be written: TrustboError.

    It needs a CRS that the result lacks, or cannot hold one of its names; a bag exists, or rosbags
    is not installed; or a folder has the name of a file.
    """
    kind = _FORMATS[name]
    if kind.on_earth:
        require_crs(result.workspace)
    if any(file.startswith("path") for file in kind.files):
        require_lead_apart(result.workspace.team.names)
    if kind.require is not None:
        kind.require(result)
    for file in kind.files_in(target, result):
        if name in _BAGS:
            require_new_bag(file, None)
        else:
            require_file(file)


def _write_maps(content: _Content, file: Path) -> None:
    maps = content.maps()
    write_geotiff(file, maps, content.result.workspace, style=False)
    row, col = content.result.path[0]
    # The trust of the start cell is assumed; it must not set the limits of the colours.
    learned = maps.where((maps["y"] != maps["y"][row]) | (maps["x"] != maps["x"][col]))
    write_style(file.with_suffix(".qml"), learned)


def _write_tables(content: _Content, file: Path) -> None:
    write_csv(file, content.result)
    write_path(file.with_name("path.csv"), content.result)


def _write_bag(content: _Content, file: Path) -> None:
    result, cost = content.result, content.maps()["cost"]
    write_ros_bag(file, result, cost, result.workspace, **content.for_ros)


def _write_path(content: _Content, file: Path) -> None:
    write_path(file, content.result)


def _require_topics(result: Result) -> None:
    require_robots(result.workspace)


_BAGS = ("ros1_bag", "ros2_bag")
_ROS = ("ros_map", *_BAGS)
_FOR_ROS = {"resolution": None, "origin": None, "rotation": 0.0, "frame": "map"}
"""Options of the formats for ROS, with their defaults."""
_FORMATS = {
    "geotiff": _Format(
        "all maps as bands of a GeoTIFF, with a style for QGIS",
        ("maps.tif", "maps.qml"),
        _write_maps,
        on_earth=True,
    ),
    "cog": _Format(
        "all maps as a Cloud Optimized GeoTIFF",
        ("maps_cog.tif",),
        lambda content, file: write_geotiff(
            file, content.maps(), content.result.workspace, cog=True, style=False
        ),
        on_earth=True,
    ),
    "netcdf": _Format(
        "all maps as netCDF by the CF conventions",
        ("maps.nc",),
        lambda content, file: write_netcdf(file, content.maps(), content.result.workspace),
        # Result.maps renames features that have the name of a coordinate.
        require=lambda result: require_names_for_netcdf(
            name for name in result.workspace.features if "/" in name
        ),
    ),
    "geojson": _Format(
        "path, posts and ways in longitude and latitude",
        ("path.geojson",),
        _write_path,
        on_earth=True,
    ),
    "gpx": _Format(
        "the path, and each robot's way, as routes for GPS receivers",
        ("path.gpx",),
        _write_path,
        on_earth=True,
    ),
    "geopackage": _Format(
        "path, cells, posts and ways as layers for GIS",
        ("path.gpkg",),
        _write_path,
        on_earth=True,
        require=lambda result: require_names_for_sql(result.workspace.team.names),
    ),
    "overwatch": _Format(
        "how much of each bound of the path one would see from each point, as GeoTIFF",
        ("overwatch.tif",),
        lambda content, file: write_overwatch(file, content.result.plan),
        on_earth=True,
        require=lambda result: require_overwatch(result.workspace),
    ),
    "csv": _Format(
        "tables of all bounds, of the path, its posts and its ways",
        ("missions.csv", "path.csv"),
        _write_tables,
        on_terrain=tuple(file.name for file in tables_beside(Path("path.csv"))),
    ),
    "ros_map": _Format(
        "the cost map for map_server and Nav2",
        ("cost_map.yaml", "cost_map.pgm"),
        lambda content, file: write_ros_map(
            file, content.maps()["cost"], content.result.workspace, **content.for_ros
        ),
    ),
    "ros1_bag": _Format(
        "cost map, path, posts and ways as a bag of ROS 1",
        ("path.bag",),
        _write_bag,
        require=_require_topics,
    ),
    "ros2_bag": _Format(
        "cost map, path, posts and ways as a bag of ROS 2 (mcap)",
        ("path_ros2",),
        _write_bag,
        require=_require_topics,
    ),
}
FORMATS = {name: kind.text for name, kind in _FORMATS.items()}
"""Descriptions of the formats of `export_result`, by name."""
