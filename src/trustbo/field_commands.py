"""Commands for campaigns of real robots: `ask`, `ways`, `tell`, `fail`, `close`, and others.

Each command loads the campaign from its folder, which is locked meanwhile, and does one thing.
`trustbo new` begins the campaign. An error has recorded nothing.
"""

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trustbo.errors import TrustboError

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign
    from trustbo.data import Mission
    from trustbo.planning import Plan
    from trustbo.workspace import Workspace

_BAG = (".bag", ".mcap", ".db3")
"""Endings of the files of a ROS bag; that of ROS 2 may also be a folder."""
COLUMNS_FILE = "columns.toml"
"""File in the folder of a campaign with the columns of its logs; see `logs.read_columns`."""
_STATUS = (
    "began",
    "start",
    "goal",
    "robots",
    "status",
    "state",
    "contact_lost",
    "n_bounds",
    "reason",
)
"""Columns of the table that `status` prints."""
_WAYS = ["name", "bounds", "metres", "contact_lost", "p_arrive", "price", "path"]
"""Columns of the table that `ways` prints."""


def loaded(folder: Path) -> "Campaign":
    """Load the campaign of a folder, to be closed at the end of a `with` block."""
    import trustbo as tb

    return tb.Campaign.load(folder, progress=False)


def ask(args: Namespace) -> None:
    """Plan the next mission, print the plan, and write its files."""
    from trustbo.export import write_geojson, write_nav2

    with loaded(args.folder) as campaign:
        if args.way is None:
            plan = campaign.ask(args.start, args.goal, robots=args.robots)
        else:
            ways = campaign.ways(args.start, args.goal, robots=args.robots)
            if not 0 <= args.way < len(ways):
                raise TrustboError(
                    f"there is no way {args.way}; there are ways 0 to {len(ways) - 1}."
                )
            plan = campaign.suggest(ways[args.way].stations, robots=args.robots)

        workspace = campaign.workspace
        robots = ", ".join(plan.robots)
        print(f"{workspace.name_of(plan.start)} to {workspace.name_of(plan.goal)}, with {robots}")
        print(plan)
        if args.nav2 is not None:
            write_nav2(args.nav2, plan)
            print(f"waypoints for Nav2 are in {args.nav2}")
        if args.geojson is not None:
            write_geojson(args.geojson, plan)
            print(f"the path is in {args.geojson}")


def ways(args: Namespace) -> None:
    """Print the ways of a course, and what the slope limit costs; none is recorded."""
    import matplotlib.pyplot as plt

    from trustbo import plots
    from trustbo.plots.style import save_figure

    with loaded(args.folder) as campaign:
        found = campaign.ways(args.start, args.goal, robots=args.robots)
        print(_text(found.to_frame()[_WAYS]))
        print("to drive way K: trustbo ask FOLDER START GOAL --way K")
        if campaign.workspace.terrain is not None:
            print("the recommended way, if the robots withstood other slopes:")
            print(_text(campaign.limits(args.start, args.goal, robots=args.robots)))
        if args.picture is not None:
            plt.switch_backend("agg")
            save_figure(args.picture, plots.ways_map(found))
            print(f"the map of the ways is in {args.picture}")


def _text(ways: Any) -> str:
    """Return a table of ways as text."""
    metres = ways["metres"].round().astype(int)
    return ways.assign(metres=metres).to_string(float_format="%.3f")


def tell(args: Namespace) -> None:
    """Record the missions of a log, and print what they measured."""
    with loaded(args.folder) as campaign:
        for mission in _missions_in(args, campaign.workspace, campaign.state.asked):
            campaign.tell(mission, cause=args.cause)
            _print_last(campaign)


def fail(args: Namespace) -> None:
    """Report that nothing was measured in the planned mission."""
    with loaded(args.folder) as campaign:
        campaign.fail(args.reason, where=args.where)
        print(f"recorded: {args.reason}, without a measured mission")


def correct(args: Namespace) -> None:
    """Replace a mission by that of another log."""
    with loaded(args.folder) as campaign:
        entries = campaign.state.entries
        planned = entries[args.mission - 1].plan if args.mission <= len(entries) else None
        missions = _missions_in(args, campaign.workspace, planned)
        if len(missions) != 1:
            raise TrustboError(
                f"the log has {len(missions)} missions; give that of mission {args.mission} alone."
            )
        campaign.correct(args.mission, missions[0], args.reason, cause=args.cause)
        print(f"mission {args.mission} is excluded; the correction is the next mission:")
        _print_last(campaign)


def close(args: Namespace) -> None:
    """Close cells and bounds, and print the number of the closing."""
    from trustbo.workspace.closed import closed_along, closed_text

    with loaded(args.folder) as campaign:
        n = campaign.close_off(args.where, args.reason, until=args.until, by=args.by)
        closing = campaign.state.closings[n - 1]
        what = closed_text(closing.closed, campaign.workspace.name_of)
        print(f"closing {n}: {what}, {closing.until_text}")
        asked = campaign.state.asked
        if asked is not None and closed_along(closing.closed, asked.path):
            print("the mission that is asked for uses it; call trustbo ask again")


def reopen(args: Namespace) -> None:
    """Reopen what a closing has closed."""
    with loaded(args.folder) as campaign:
        campaign.reopen(args.closing, args.reason)
        print(f"closing {args.closing} no longer counts: {args.reason}")


def status(args: Namespace) -> None:
    """Print the ground, the campaign and a table of its missions."""
    with loaded(args.folder) as campaign:
        print(campaign.workspace)
        print(campaign)
        table = campaign.table().filter(_STATUS)
        if len(table):
            print(table.to_string(float_format="%.2f", na_rep=""))
        closings = campaign.closings()
        if len(closings):
            print(closings.to_string())
        asked = campaign.state.asked
        if asked is not None:
            name_of = campaign.workspace.name_of
            print(f"asked for: {name_of(asked.start)} to {name_of(asked.goal)}; tell or fail it")


def report(args: Namespace) -> None:
    """Write the report of a campaign."""
    import matplotlib as mpl

    from trustbo.report import write_report

    mpl.use("agg")
    with loaded(args.folder) as campaign:
        write_report(args.out, campaign)
    print(f"the report is in {args.out}")


def _missions_in(args: Namespace, workspace: "Workspace", plan: "Plan | None") -> "list[Mission]":
    """Read the missions of the log that the arguments name; tracks need the plan of the mission."""
    from trustbo import logs

    file = args.folder / COLUMNS_FILE
    columns = logs.read_columns(file) if file.exists() else None
    if args.detections is not None:
        if plan is None:
            raise TrustboError(
                "tracks need the plan of their mission, but no mission is asked for; call "
                "`trustbo ask` first."
            )
        options: dict[str, Any] = {"path": plan.path, "tick": args.tick, "status": args.status}
        options["columns"] = columns
        return logs.read_tracks(args.log, args.detections, workspace, **options)
    if args.log.suffix in _BAG or args.log.is_dir():
        return logs.read_bag(args.log, workspace)
    path = None if plan is None else plan.path
    return logs.read_table(args.log, columns=columns, workspace=workspace, path=path)


def _print_last(campaign: "Campaign") -> None:
    """Print what the last mission measured."""
    from trustbo.campaign.state import bounds_planned

    row = campaign.table().iloc[-1]
    last = campaign.state.entries[-1]
    n_planned = bounds_planned(last.measured, last.plan.path)
    print(
        f"mission {len(campaign.missions)}: {row['start']} to {row['goal']}, {row['status']}, "
        f"{row['contact_lost']:.2f} of {n_planned} bounds of contact lost ({row['state']})"
    )
