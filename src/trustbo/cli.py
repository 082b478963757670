"""Command-line interface: `trustbo demo`, `run`, ...; see `parser` for all commands.

Simulated campaigns are run by `demo`, `run` and `resume`. Those of real robots are begun by `new`,
asked for paths and told their logs; see `field_commands`.

Commands import heavy modules only when they run, so that `--help` takes a tenth of a second.
"""

import argparse
import io
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from trustbo import field_commands as field
from trustbo.errors import TrustboError, require_docstrings

if TYPE_CHECKING:
    from trustbo.campaign.result import Result
    from trustbo.workspace import Workspace

# Repeated from the modules that define them, which are slow to import; a test compares them.
POLICIES = ("explore", "greedy", "optimistic", "thompson", "ucb", "random")
OBJECTIVES = ("lost_contact", "terminal", "mean")
FORMATS = ("geotiff", "geojson", "csv", "nav2")
LIMITS = ("measured", "data sheet", "guessed")
BAD_INPUT = 1
"""Exit code for input that trustbo refuses; argparse exits with 2 if the words are wrong."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as in a shell."""
LOCATION = (
    "ROW,COL with row 0 in the north, x=...,y=... in CRS metres, lon=...,lat=... (degrees), or the "
    "name of a place"
)
_COLUMNS = ["status", "contact_rate", "objective", "k_hat", "r_hat", "path_changed"]
"""Columns of the table of missions to print."""


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command and exit; errors are printed as one line on standard error.

    Args:
        arguments: Words after `trustbo`; by default those of this process.
    """
    args = parser().parse_args(arguments)
    warnings.showwarning = lambda message, *_, **__: _say(f"warning: {message}")
    for stream in (sys.stdout, sys.stderr):  # a terminal may not support all characters
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        require_docstrings()
        args.run(args)
    except KeyboardInterrupt:
        folder = getattr(args, "folder", None) or getattr(args, "out", ".")
        can_resume = args.run in (demo, run, resume) and Path(folder, "campaign.json").is_file()
        remedy = f"; continue with: trustbo resume {folder}" if can_resume else ""
        _exit(f"interrupted{remedy}", INTERRUPTED)
    except (TrustboError, OSError) as error:
        _exit(f"error: {error}", BAD_INPUT)
    sys.exit(0)


def _exit(message: str, code: int) -> NoReturn:
    _say(message)
    sys.exit(code)


def _say(message: str) -> None:
    """Print a line to stderr; nothing without a stderr, as `print` would use stdout."""
    if sys.stderr is not None:
        print(message, file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    """Build the parser for all commands; the parsed argument `run` is the function to call."""
    top = argparse.ArgumentParser(
        prog="trustbo",
        description="Learn where robots are trustworthy on a terrain, and plan the best path.",
        epilog="exit codes: 0 success, 1 bad input, 2 wrong words, 130 interrupted",
    )
    top.add_argument("--version", action="version", version=f"trustbo {version('trustbo')}")
    top.set_defaults(run=lambda _: top.print_help())
    commands = top.add_subparsers(metavar="COMMAND")

    def command(run: Callable[..., None], text: str, example: str) -> Any:
        example = f"example: trustbo {run.__name__} {example}"
        made = commands.add_parser(run.__name__, help=text, description=text, epilog=example)
        made.set_defaults(run=run)
        return made.add_argument

    add = command(demo, "Run a campaign on the example hillside.", "--missions 4")
    _add_campaign(add, "out/demo")

    add = command(info, "Describe and plot the planning grid of a terrain.", "dem.tif")
    add("dem", type=Path, metavar="DEM", help="raster of ground heights, such as a GeoTIFF")
    add("dsm", type=Path, nargs="?", metavar="DSM", help="raster of surface heights")
    _add_workspace(add)
    add("--out", type=Path, default=Path("grid.png"), metavar="FILE", help="image file to write")

    example = "--dem dem.tif --dsm dsm.tif --start 9,0 --goal 0,9"
    add = command(run, "Run a simulated campaign on a given terrain.", example)
    add("--dem", type=Path, required=True, metavar="FILE", help="raster of ground heights")
    add("--dsm", type=Path, metavar="FILE", help="raster of surface heights")
    add("--start", type=place, required=True, metavar="LOCATION", help=LOCATION)
    text = "in the same format as --start"
    add("--goal", type=place, required=True, metavar="LOCATION", help=text)
    _add_workspace(add)
    add("--policy", choices=POLICIES, help="policy that chooses the paths (default explore)")
    add("--objective", choices=OBJECTIVES, help="objective of the paths (default lost_contact)")
    add("--paper", action="store_true", help="use the settings of the paper, with NUTS")
    _add_stop(add)
    _add_campaign(add, "out")

    add = command(resume, "Continue a campaign, or add missions to it.", "out --missions 12")
    add("folder", type=Path, metavar="DIR", help="folder of the campaign")
    add("--missions", type=_count, metavar="N", help="total number of missions")
    _add_stop(add)
    add("--quiet", "-q", action="store_true", help="hide the progress bar and the table")

    add = command(export, "Write a result to files for GIS, Nav2 or tables.", "out --format nav2")
    add("folder", type=Path, metavar="DIR", help="folder of the campaign")
    add("--format", choices=FORMATS, nargs="+", default=FORMATS[:2], help="default geotiff geojson")
    add("--out", type=Path, metavar="DIR", help="output folder (default: campaign folder)")
    _add_field_commands(command)
    return top


def _add_field_commands(command: Callable[..., Any]) -> None:
    """Add the commands for campaigns of real robots."""

    def on_folder(run: Callable[..., None], text: str, example: str) -> Any:
        add = command(run, text, f"week {example}".rstrip())
        add("folder", type=Path, metavar="FOLDER", help="folder of the campaign")
        return add

    def add_course(add: Any) -> None:
        add("start", type=place, metavar="START", help=LOCATION)
        add("goal", type=place, metavar="GOAL", help="in the same format as START")
        text = "robots that go, such as alpha,bravo"
        add("--robots", type=_names, metavar="NAMES", help=text)

    def add_log(add: Any) -> None:
        add("log", type=Path, metavar="LOG", help="table (CSV), ROS bag, or poses for --detections")
        add("--detections", type=Path, metavar="FILE", help="detections, if LOG contains poses")
        add("--tick", type=float, default=1.0, metavar="S", help="seconds of a detector reading")
        text = "why tracks end early, such as stuck"
        add("--status", default="aborted", metavar="TEXT", help=text)
        text = "why a bound failed, if it says nothing about other bounds, such as mud"
        add("--cause", default="", metavar="TEXT", help=text)

    example = "--dem dem.tif --dsm dsm.tif --shape 12,10 --max-slope 18 --place camp=9,1"
    _add_ground(on_folder(new, "Begin a campaign of real robots on a ground.", example))

    add = on_folder(field.ask, "Plan the next mission.", "camp hill --nav2 nav2")
    add_course(add)
    add("--way", type=int, metavar="K", help="take way K of `trustbo ways` instead of the best")
    add("--nav2", type=Path, metavar="DIR", help="folder for the waypoints of Nav2")
    add("--geojson", type=Path, metavar="FILE", help="file for the path")

    add = on_folder(field.ways, "Compare ways by contact, arrival and metres.", "camp hill")
    add_course(add)
    add("--picture", type=Path, metavar="FILE", help="image file for a map of the ways")

    add = on_folder(field.tell, "Record the log of a mission, and learn from it.", "log.csv")
    add_log(add)

    add = on_folder(field.fail, "Report a mission in which nothing was measured.", "stuck")
    add("reason", metavar="REASON", help="such as stuck, tipped, or rain")
    add("--where", type=shape, metavar="ROW,COL", help="cell that was not reached")

    add = on_folder(field.correct, "Replace a mission whose log was wrong.", "5 right.csv ...")
    add("mission", type=_count, metavar="N", help="number of the wrong mission")
    add_log(add)
    add("--reason", required=True, metavar="TEXT", help="why the log was wrong")

    _add_closings(on_folder)

    add = on_folder(field.status, "Show the ground and all missions.", "")

    add = on_folder(field.report, "Write a report as an HTML page.", "--out report.html")
    add("--out", type=Path, default=Path("report.html"), metavar="FILE", help="file to write")


def _add_closings(on_folder: Callable[..., Any]) -> None:
    """Add the commands that close and reopen cells and bounds."""
    example = "3,6 2,1/1,1 --reason wreck --until 2026-12-03T08:00"
    add = on_folder(field.close, "Close cells and bounds for plans.", example)
    text = f"cell, or bound as CELL/CELL; a cell is {LOCATION}"
    add("where", type=_closed, nargs="+", metavar="WHERE", help=text)
    add("--reason", required=True, metavar="TEXT", help="such as wreck, or mud")
    text = "time or number of a mission from which it is open again (default: for ever)"
    add("--until", type=_until, metavar="TIME", help=text)
    add("--by", default="", metavar="NAME", help="who reported it")

    example = "1 --reason 'towed away'"
    add = on_folder(field.reopen, "Reopen what was closed.", example)
    add("closing", type=_count, metavar="N", help="number of the closing, as in status")
    add("--reason", required=True, metavar="TEXT", help="why it is open again")


def _add_ground(add: Any) -> None:
    """Add the flags of a campaign of real robots."""
    add("--dem", type=Path, required=True, metavar="FILE", help="raster of ground heights")
    add("--dsm", type=Path, metavar="FILE", help="raster of surface heights")
    _add_workspace(add)
    add("--names", type=_names, metavar="NAMES", help="names of the robots, such as alpha,bravo")
    text = f"name of a location, such as camp=9,1; repeat it. {LOCATION}"
    add("--place", type=_named_place, action="append", metavar="NAME=LOCATION", help=text)
    text = "how the slope limit is known (default data sheet)"
    add("--limit", choices=LIMITS, default="data sheet", help=text)
    text = "sets of posts of each cell (default 3)"
    add("--posts", type=int, choices=(1, 3), default=3, help=text)
    text = "TOML file with the names and units of the columns of logs; it is copied"
    add("--columns", type=Path, metavar="FILE", help=text)
    add("--seed", type=int, default=0, metavar="N", help="random seed (default 0)")


def _add_campaign(add: Any, folder: str) -> None:
    """Add the flags of commands that start a campaign."""
    add("--missions", type=_count, default=8, metavar="N", help="number of missions (default 8)")
    add("--seed", type=int, default=0, metavar="N", help="random seed (default 0)")
    add("--out", type=Path, default=Path(folder), metavar="DIR", help=f"folder (default {folder})")
    add("--overwrite", action="store_true", help="replace an existing campaign in that folder")
    add("--quiet", "-q", action="store_true", help="hide the progress bar and the table")


def _add_workspace(add: Any) -> None:
    """Add the flags of the planning grid and of the team."""
    add("--shape", type=shape, default=(10, 10), metavar="ROWS,COLS", help="cells (default 10,10)")
    add("--resolution", type=float, metavar="M", help="average the rasters to M-metre pixels")
    add("--robots", type=_count, default=3, metavar="N", help="overwatching robots (default 3)")
    add(
        "--max-slope",
        type=slope,
        default=45.0,
        metavar="DEG",
        help="slope limit (default 45); if in doubt, 2 to 3 degrees less than the robots withstand",
    )


def _add_stop(add: Any) -> None:
    """Add the flag of the stopping rule."""
    text = "stop when the relative regret of the path is at most this, with probability 0.9"
    add("--stop-regret", type=float, metavar="FRACTION", help=text)


def _count(text: str) -> int:
    """Parse a whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1; got {text!r}")
    return int(text)


def shape(text: str) -> tuple[int, int]:
    """Parse two whole numbers, such as "10,12"."""
    rows, cols = map(int, text.split(","))
    return rows, cols


def slope(text: str) -> float:
    """Parse a slope limit in degrees, above 0 and below 90."""
    degrees = float(text)
    if not 0.0 < degrees < 90.0:
        raise argparse.ArgumentTypeError(f"must be above 0 and below 90 degrees; got {text!r}")
    return degrees


def place(text: str) -> tuple[int, int] | dict[str, float] | str:
    """Parse a cell, such as "9,0", a position, such as "x=1748000,y=5427000", or a name."""
    if "=" in text:
        pairs = (part.split("=") for part in text.split(","))
        return {name.strip(): float(value) for name, value in pairs}
    return shape(text) if "," in text else text


def _closed(text: str) -> Any:
    """Parse a location, or a bound, such as "2,1/1,1"."""
    ends = [place(end) for end in text.split("/")]
    return ends[0] if len(ends) == 1 else ends


def _until(text: str) -> str | int:
    """Parse the number of a mission, or a time, which is returned as it is."""
    return int(text) if text.isdecimal() else text


def _named_place(text: str) -> tuple[str, Any]:
    """Parse a place with its name, such as "camp=9,1" or "camp=x=1748000,y=5427000"."""
    name, _, where = text.partition("=")
    return name, place(where)


def _names(text: str) -> tuple[str, ...]:
    """Parse names, such as "alpha,bravo"."""
    return tuple(name.strip() for name in text.split(","))


def demo(args: argparse.Namespace) -> None:
    """Run a campaign on the example terrain."""
    import trustbo as tb

    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10))
    _run(args, workspace, start=(9, 0), goal=(0, 9))


def info(args: argparse.Namespace) -> None:
    """Print a summary of the workspace of a terrain, and plot the grid."""
    import matplotlib.pyplot as plt

    import trustbo as tb
    from trustbo.plots.style import save_figure

    workspace = _workspace(args)
    print(workspace)
    print(_passable(workspace))
    plt.switch_backend("agg")
    save_figure(args.out, tb.plots.grid_map(workspace))
    print(f"the figure of the grid is in {args.out}")


def run(args: argparse.Namespace) -> None:
    """Run a simulated campaign on the user's terrain."""
    import trustbo as tb

    features = {}
    options = {}
    if args.paper:
        features = dict(tb.paper.WORKSPACE)
        options = dict(tb.paper.CAMPAIGN)
    given = {"policy": args.policy, "objective": args.objective}
    options |= {name: value for name, value in given.items() if value is not None}
    workspace = _workspace(args, {"start": args.start, "goal": args.goal}, **features)
    if not args.quiet:
        print(_passable(workspace))
    _run(args, workspace, start=args.start, goal=args.goal, **options, stop=_stop(args))


def _workspace(
    args: argparse.Namespace, ends: Mapping[str, Any] | None = None, **features: Any
) -> "Workspace":
    """Make the workspace from the flags of `_add_workspace`, after a check of the ends of paths.

    Args:
        args: Parsed flags.
        ends: Start and goal of the paths by their names, if there are any.
        features: Further arguments of `Workspace.from_terrain`.
    """
    from math import radians

    import trustbo as tb
    from trustbo.workspace.grid import Grid

    terrain = tb.terrain.read_terrain(args.dem, args.dsm, resolution=args.resolution)
    for name, end in (ends or {}).items():  # before the slow computation of awareness
        Grid.over(terrain, args.shape).locate(end, name)
    robot = tb.Robot(max_slope=radians(args.max_slope))
    names = getattr(args, "names", None) or ()
    team = tb.Team(robots=(robot,) * (len(names) or args.robots), lead=robot, names=names)
    return tb.Workspace.from_terrain(terrain, args.shape, team, **features)


def _passable(workspace: "Workspace") -> str:
    """Return, as text, the robots' slope limit and how many cells are passable with it."""
    from math import degrees

    limit = degrees(workspace.team.max_slope)
    n_passable = int(workspace.passable.sum())
    return (
        f"slope limit of the robots: {limit:.3g} degrees; {n_passable} of "
        f"{workspace.passable.size} cells are passable"
    )


def _run(args: argparse.Namespace, workspace: "Workspace", **options: Any) -> None:
    """Run a campaign in a folder, and write the report."""
    import trustbo as tb

    result = tb.iterate(
        workspace,
        n_iterations=args.missions,
        directory=args.out,
        overwrite=args.overwrite,
        seed=args.seed,
        progress=not args.quiet,
        **options,
    )
    _finish(result, args.out, args.quiet)


def _stop(args: argparse.Namespace) -> Any:
    """Make the stopping rule from the flag `--stop-regret`; None without the flag."""
    from trustbo import RegretBound

    return None if args.stop_regret is None else RegretBound(eps=args.stop_regret)


def new(args: argparse.Namespace) -> None:
    """Begin a campaign of real robots, and print the ground."""
    import trustbo as tb
    from trustbo.files import read_file, write_file

    workspace = _workspace(args, n_posts=args.posts).with_places(dict(args.place or ()))
    hazard = tb.hazard.Hazard(limit=args.limit)
    if args.columns is not None:
        tb.logs.read_columns(args.columns)  # before anything is written
    campaign = tb.Campaign(workspace, hazard=hazard, seed=args.seed, directory=args.folder)
    campaign.close()
    if args.columns is not None:
        write_file(args.folder / field.COLUMNS_FILE, read_file(args.columns))
    print(workspace)
    print(_passable(workspace))
    print(f"the campaign is in {args.folder}; ask it for a course: trustbo ask {args.folder} ...")


def resume(args: argparse.Namespace) -> None:
    """Continue the campaign in a folder, and write the report again."""
    import trustbo as tb

    result = tb.resume(
        args.folder, n_iterations=args.missions, stop=_stop(args), progress=not args.quiet
    )
    _finish(result, args.folder, args.quiet)


def _finish(result: "Result", folder: Path, quiet: bool) -> None:
    """Write the report and, with a terrain, the maps and the path for GIS; print a summary."""
    import matplotlib as mpl

    from trustbo.data import path_text
    from trustbo.export import export_result
    from trustbo.report import write_report

    mpl.use("agg")
    write_report(folder / "report.html", result)
    if result.workspace.terrain is not None:
        export_result(result, folder, ("geotiff", "geojson"))
    if not quiet:
        print(result.table().filter(_COLUMNS).to_string(float_format="%.3f"))
    done = "all missions were run; for more, use trustbo resume with --missions"
    print(f"stopped: {done if result.stop_reason == 'n_iterations' else result.stop_reason}")
    print(f"recommended path: {path_text(result.path)}")
    print(f"results are in {folder}; open {folder / 'report.html'}")


def export(args: argparse.Namespace) -> None:
    """Write a result to files, and print their names."""
    import trustbo as tb

    result = tb.load_result(args.folder)
    for file in tb.export.export_result(result, args.out or args.folder, args.format):
        print(file)
