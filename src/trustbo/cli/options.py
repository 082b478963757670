"""Flags of the commands, and their help."""

import inspect
import re
from collections.abc import Callable
from copy import copy
from functools import wraps
from typing import Annotated, Any

import typer

from trustbo.cli.errors import one_line_errors

_HELP = """
Terrain and grid
  dem FILE: Heights of the ground (DEM), e.g. a GeoTIFF.
  dsm FILE: Heights of the canopy (DSM) of the same place; without one, none is assumed.
  start PLACE: First cell, as row,col with row 0 in the north; or a position in it, as
    x=1748000,y=5427000 in metres of the terrain's CRS, or lon=174.7,lat=-41.3.
  goal PLACE: Last cell, or a position in it.
  shape ROWS,COLS: Planning grid.
  crs CRS: CRS of rasters that carry none, e.g. EPSG:32633.
  resolution M: Pixel size of rasters that carry none; others are averaged to about it. Rasters of
    over 9 million pixels are averaged to fewer without it.
  nodata VALUE: Stored height that means missing, where no tag declares it.
Robots and sight
  robots N: Number of robots that overwatch the lead.
  max_slope DEG: Steepest slope that robots can drive.
  lidar_range M: Range within which robots track each other.
  sight MODE: Obstacles to sight: bare (the ground), wall (canopy too), transmittance (canopy dims
    it).
Paths
  objective NAME: Objective of a path: lost_contact (on the way), terminal (trust at the goal, as in
    the paper), mean (on the way), success (of every bound), bottleneck (the least on the way),
    stationary.
Learning
  policy NAME: Choice of the next path: greedy, optimistic, thompson, ucb, random.
  model NAME: Trust model: robots (places differ, and a robot from mission to mission: damage, bad
    days), places (robots are alike), pooled (places are too, as in the paper), hierarchical
    (robots are similar), coupled (they influence each other).
  observation NAME: Family of contact rates: gaussian (as in the paper), censored,
    beta_binomial.
  sampler NAME: Sampler of the posterior: auto (exact where it applies, else nuts); exact
    (importance sampling, which need not compile); nuts.
Benchmark
  data FOLDER: Folder of the real terrains, tahoe/dem.tif and so on; without it, synthetic ones and
    wellington.
  world NAME: World, may be repeated; by default all.
  kind NAME: Kind of worlds, may be repeated, such as right, aged, days, change or physics; by
    default all.
  worlds.policy NAME: Policy, may be repeated: a name as for [b]trustbo run[/b], or module:name;
    by default greedy.
  worlds.model NAME: Model, may be repeated: robots (the default), places, pooled,
    hierarchical, coupled, or module:name.
  simulator NAME: Simulator of a world, module:name.
  baseline NAME: Baseline, may be repeated: random, shortest, paper, none, or module:name; by
    default the first three.
  max_bounds NAME: Admissible paths: shortest, shortest+4, or the most bounds allowed.
  by NAME: Rows of the table: method, kind, case, world or course.
  quick: Run five small worlds, one course and three missions only.
  seeds N: Number of campaigns for each course.
Missions
  iterations N: Number of missions to run and learn from.
  resume.iterations N: Number of missions in all; by default as many as it was begun for.
  stop_regret SHARE: Stop when the path is within this share of the best with probability 0.9, e.g.
    0.05.
  seed N: Seed of everything random.
Program
  out FOLDER: Folder for the results, made if need be; not one that holds a campaign.
  worlds.out FOLDER: Folder for the results, made if need be.
  export.out FOLDER: Folder for the files; by default the result's.
  info.out FILE: Picture of the grid, a .png.
  overwrite: Remove the campaign that the folder holds first; other files in it are kept.
  quiet: Show no progress bar and no table.
  debug: Show the whole traceback of an error.
Options
  formats NAME: Format, may be repeated: geotiff (maps); geojson, geopackage (the path);
    csv (missions); ros_map, nav2 (route graph and waypoints); or all that can be written.
  export.resolution M: Pixel size of maps for ROS; by default a cell, or a tenth of its shorter side
    where cells are not square.
  origin PLACE: Position in the terrain's CRS that is 0,0 of files for robots, as x,y in metres
    or lon=174.7,lat=-41.3; or auto, the start of the path; or crs, that of the CRS. It is kept in
    frame.yaml.
  rotation DEG: Angle from east to the x axis of their frame, anticlockwise.
  frame NAME: Name of their frame.
  executor NAME: Executor of the runs: serial, loky, dask, or a scheduler's address,
    tcp://host:8786; by default loky, or serial without the extra study.
  workers N: Number of processes of loky or dask; by default one for each core.
Arguments
  folder FOLDER: Folder of the campaign's results.
  info.dem DEM: Heights of the ground (DEM), e.g. a GeoTIFF.
  info.dsm DSM: Heights of the canopy (DSM) of the same place.
"""
"""Flags by panel: name, placeholder and help; `command.name` where it differs by command."""
_NAMES = {
    "overwrite": ("--overwrite",),  # without --no-overwrite
    "quick": ("--quick",),
    "quiet": ("--quiet", "-q"),
    "debug": ("--debug",),
    "formats": ("--format",),
}
_ALONE = inspect.Parameter.KEYWORD_ONLY


def _flags() -> dict[str, Any]:
    """Flags of `_HELP` by name."""
    flags, panel = {}, ""
    for line in re.sub(r"\n {4}", " ", _HELP.strip()).splitlines():
        if not line.startswith(" "):
            panel = line
            continue
        name, metavar, text = re.findall(r"  ([\w.]+) ?(\S*): (.+)", line)[0]
        about = {"help": text, "metavar": metavar or None}
        if panel == "Arguments":
            flags[name] = typer.Argument(**about)
        else:
            if metavar in ("NAME", "MODE"):
                about["autocompletion"] = _beginning(text)
            flags[name] = typer.Option(*_NAMES.get(name, ()), rich_help_panel=panel, **about)
    return flags


def _beginning(text: str) -> Callable[[str], list[str]]:
    """Names in a list of the help, remarks in brackets apart, that begin with some letters."""
    listed = re.split(r"[;,] ?", re.sub(r" \(.*?\)", "", text.partition(": ")[2].rstrip(".")))

    def names(incomplete: str) -> list[str]:
        return [name for name in listed if name.startswith(incomplete) and " " not in name]

    return names


_FLAGS = _flags()


def choices_of(flag: str) -> list[str]:
    """Names that the help of a flag lists, which are all that it takes; nothing is imported."""
    return _FLAGS[flag].autocompletion("")


def with_flags(command: Callable[..., None], campaign: str = "") -> Callable[..., None]:
    """Give a command's parameters their flags, and --debug.

    `campaign` is the parameter with the folder of the campaign at work, see `one_line_errors`.
    """
    signature = inspect.signature(command, eval_str=True)
    debug = inspect.Parameter("debug", _ALONE, default=False, annotation=bool)
    parameters = []
    for p in (*signature.parameters.values(), debug):
        flag = _FLAGS.get(f"{command.__name__}.{p.name}") or _FLAGS[p.name]
        if p.annotation in _PARSERS:
            flag = copy(flag)
            flag.parser = _PARSERS[p.annotation]
        parameters.append(p.replace(annotation=Annotated[p.annotation, flag], kind=_ALONE))

    @wraps(command)
    def run(*, debug: bool, **given: Any) -> None:
        with one_line_errors(debug, campaign=given.get(campaign)):
            command(**given)

    run.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore
    return run


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"must be a number{_share(text)}; got {text!r}.") from None


def _share(text: str) -> str:
    """Remedy of a percentage."""
    try:
        return f", such as {float(text.removesuffix('%')) / 100.0:g}" if "%" in text else ""
    except ValueError:
        return ""


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"must be a whole number; got {text!r}.") from None


_PARSERS: dict[Any, Callable[[str], Any]] = {
    float: _number, float | None: _number, int: _whole, int | None: _whole
}  # fmt: skip
"""Parsers of numbers, by the annotations of commands; Typer's own speak of its insides."""
