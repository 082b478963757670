"""How good the paths are at which `tb.RegretBound` stops campaigns, by the truth of worlds.

    python benchmarks/stopping.py --data DIR [--csv FILE] [--jobs N]

In each world and on both diagonal courses, a campaign runs at most 15 missions, or until
`RegretBound(eps=0.05, delta=0.1)` stops it. The true regret is that of the recommended path: how
much more contact it loses than the best path, as a share of the contact on the best path. The rule
promises a regret of at most 5 % with a probability of 0.9, if the model is right. Campaigns have
one set of posts, since truths of three sets take eight times as long.

Before the first mission, the 90 % band of the first plan is compared with the truth.

Each world has a file in --out, so a run that was stopped continues where it was.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from common import Table, arguments, parsed
from contact import SETTINGS
from groups import groups_in, kinds_in
from world_set import World, available
from worlds_in_parallel import rows_of_worlds

import trustbo as tb
from trustbo.files import write_text

MISSIONS = 15
EPS, DELTA = 0.05, 0.1
RULE = tb.RegretBound(eps=EPS, delta=DELTA)


def rows_of(world: World) -> Iterator[dict[str, Any]]:
    """Yield the row of each campaign of a world."""
    for course in SETTINGS["one"]:
        yield stopped_campaign(world, course)


def stopped_campaign(world: World, course: str) -> dict[str, Any]:
    """Run a campaign until the rule stops it, and compute the true regret."""
    workspace = world.workspace()
    simulator = world.simulator(workspace)
    truth = tb.simulation.Truth.from_simulator(simulator)
    campaign = tb.Campaign(workspace, *world.ends(course), seed=0, progress=False)

    first = campaign.ask()
    low, high = first.value_band
    lost = truth.at(0).lost(first.path)
    for _ in campaign.run(simulator, MISSIONS, stop=RULE):
        pass
    n = len(campaign.missions)
    return {
        "world": world.name, "kind": world.kind, "case": world.case, "course": course,
        "band_low": -high, "band_high": -low, "first_lost": lost,
        "stopped": int((campaign.state.stop_reason or "").startswith("regret_bound")),
        "missions": n,
        "regret": truth.at(n).regret(campaign.path),
    }  # fmt: skip


def report(rows: pd.DataFrame) -> None:
    """Print the regret of stopped campaigns, and the coverage of bands, by group and kind."""
    table = Table(
        "worlds (campaigns)", "stopped", "regret at most 5 %", "median regret, %",
        "missions, mean", "band of the first plan holds the truth", "width of the band, bounds",
    )  # fmt: skip
    for name, some in [*groups_in(rows), *kinds_in(rows)]:
        stopped = some[some["stopped"] == 1]
        inside = some["first_lost"].between(some["band_low"], some["band_high"])
        table.row(
            f"{name} ({len(some)})", len(stopped),
            f"{(stopped['regret'] <= 100.0 * EPS).mean():.0%}", f"{stopped['regret'].median():.2f}",
            f"{stopped['missions'].mean():.1f}", f"{inside.mean():.0%}",
            f"{(some['band_high'] - some['band_low']).mean():.1f}",
        )  # fmt: skip


def main() -> None:
    parser = arguments(__doc__ or "", data=True, out="out/stopping", quick="two worlds")
    parser.add_argument("--jobs", type=int, default=-1, help="processes, default one per core")
    parser.add_argument("--csv", type=Path, help="CSV file for the rows")
    given = parsed(parser)
    some = list(available(given.data).values())[: 2 if given.quick else None]
    rows = rows_of_worlds(rows_of, some, given.jobs, given.out)
    if given.csv is not None:
        write_text(given.csv, rows.to_csv(index=False))
    report(rows)


if __name__ == "__main__":
    main()
