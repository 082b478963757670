"""`trustbo live`: a campaign in the field, with a page."""

import sys
from functools import partial
from pathlib import Path

from trustbo.cli.options import choices_of
from trustbo.cli.terrains import pair, reader_of, team_of, workspace_with
from trustbo.errors import TrustboError, require_choice


def live(
    folder: Path,
    dem: Path | None = None,
    dsm: Path | None = None,
    start: str | None = None,
    goal: str | None = None,
    shape: str = "10,10",
    crs: str | None = None,
    robots: int = 3,
    max_slope: float = 45.0,
    lidar_range: float = 100.0,
    bounding: str = "successive",
    port: int = 8737,
    listen: str = "127.0.0.1",
    udp: int | None = None,
    stdin: bool = False,
    bag: Path | None = None,
    rate: float = 1.0,
    foxglove: int | None = None,
    keep_path: bool = False,
) -> None:
    """Follow a campaign in the field: contact tick by tick, a page, a plan for each next bound.

    Example: trustbo live out/field --udp 8738
    A new one: trustbo live out/field --dem dem.tif --start 9,0 --goal 0,9 --udp 8738
    A bag, ten times as fast: trustbo live out/field --bag log.bag --rate 10

    The page shows the map, the trust of each robot and what to do next, and has
    buttons for the outcome of each bound. Messages are lines of JSON, such as
    {"contact": {"r1": true, "r2": false}}; see docs/live.md. Nobody else reaches
    it without --listen and the token that is printed; TRUSTBO_TOKEN sets a token of
    yours. After Ctrl-C, a crash or a power cut, the same command goes on where it was.
    """
    from trustbo.campaign.replacing import STATE, current

    begun = (current(folder) / STATE).exists()
    if not begun:
        if dem is None or start is None or goal is None:
            raise TrustboError(
                f"{str(folder)!r} holds no campaign; to begin one, give --dem, --start and --goal, "
                "or make it in Python: trustbo.Campaign(workspace, start, goal, directory=folder)."
            )
        require_choice("bounding", bounding, choices_of("bounding"))
        cells, team = pair("shape", shape), team_of(max_slope, robots, lidar_range)
        from trustbo.campaign import Campaign

        read = reader_of(dem, dsm, crs, None, None)
        made = workspace_with(start, goal, read, cells, team, progress=True, bounding=bounding)
        with Campaign(made[0], *made[1], directory=folder):
            print(f"a campaign was begun in {folder}.")
    from trustbo.live import serve

    serve(
        folder, port=port, listen=listen, udp=udp, lines=sys.stdin.buffer if stdin else None,
        bag=bag, rate=rate, foxglove=foxglove, replan=not keep_path,
        ready=partial(print, flush=True),
    )  # fmt: skip
    print(f"stopped; trustbo live {folder} goes on.")
