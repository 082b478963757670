"""Contact lost by campaigns that learn from earlier campaigns.

    python benchmarks/earlier.py --data DIR [--quick] [--csv FILE]

In each world, an earlier campaign runs 6 missions from south-west to north-east. A new campaign
runs 5 missions from north-west to south-east, under three conditions: without earlier missions,
after the earlier campaign on the same terrain, and after an earlier campaign on another terrain
whose deviation from the assumed world is of the same kind. All have the defaults of campaigns, and
missions have the same seeds under all conditions. The contact lost in the five missions is in
bounds per mission. Intervals are those of a t test clustered by terrain.

Results in --out are reused.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import interval, over_worlds
from world_set import World, available

import trustbo as tb
from trustbo.files import write_text
from trustbo.study import lost_in

PAIRS = {
    "synthetic-0": "synthetic-1",
    "wellington": "tahoe",
    "synthetic-0-wall": "synthetic-1-wall",
    "tahoe-wall": "synthetic-1-wall",
    "synthetic-2-bare": "wellington-bare",
    "wellington-bare": "bcts-bare",
    "synthetic-0-aged": "synthetic-1-aged",
    "wellington-aged": "tahoe-aged",
    "synthetic-1-dense": "wellington-dense",
    "synthetic-2-thin": "tahoe-thin",
    "synthetic-0-low": "topography-low",
    "topography-low": "synthetic-0-low",
    "synthetic-alder-thin-canopy": "synthetic-cedar-thin-canopy",
    "synthetic-cedar-thin-canopy": "synthetic-alder-thin-canopy",
    "wellington-thin-canopy": "synthetic-alder-thin-canopy",
    "synthetic-1-one-poor": "synthetic-alder-one-poor",
    "synthetic-2-jammer": "synthetic-birch-jammer",
    "synthetic-birch-jammer": "synthetic-2-jammer",
    "synthetic-1-radio": "synthetic-birch-radio",
    "synthetic-birch-radio": "synthetic-1-radio",
}
"""Worlds, and for each the world of the earlier campaign on another terrain."""
FIRST, SECOND = "sw-ne", "nw-se"
"""Courses of the earlier and of the new campaign."""
N_EARLIER = 6
N_NEW = 5
CONDITIONS = ("cold", "same terrain", "other terrain")
"""Conditions of the new campaign; `cold` is without earlier missions."""


def main() -> None:
    parser = arguments(__doc__ or "", data=True, out="out/earlier", quick="two worlds")
    parser.add_argument("--csv", type=Path, help="CSV file for the rows")
    given = parsed(parser)

    known = available(given.data)
    chosen = [name for name in PAIRS if name in known and PAIRS[name] in known]
    rows = []
    for name in chosen[:2] if given.quick else chosen:
        here, there = known[name], known[PAIRS[name]]
        sources: dict[str, Callable[[], Any]] = {
            "cold": tuple,
            "same terrain": partial(earlier, here, given.out),
            "other terrain": partial(earlier, there, given.out),
        }
        for condition in CONDITIONS:
            lost = losses(here, condition, sources[condition], given.out)
            label = {"world": name, "kind": here.kind, "condition": condition}
            rows.append({**label, **{f"lost_{k}": x for k, x in enumerate(lost, start=1)}})
            print(name, condition, f"{np.mean(lost):.2f}", flush=True)

    table = pd.DataFrame(rows)
    if given.csv is not None:
        write_text(given.csv, table.round(4).to_csv(index=False))
    report(table)


def losses(here: World, condition: str, source: Callable[[], Any], out: Path) -> list[float]:
    """Return the contact lost in each mission of a new campaign, in bounds; read if known."""
    file = out / "losses" / f"{here.name}, {condition}.csv"
    if not file.exists():
        campaign = run(here, SECOND, N_NEW, earlier=source())
        lost = pd.Series([lost_in(mission) for mission in campaign.missions], name="lost")
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, lost.to_csv(index=False))
    return pd.read_csv(file)["lost"].tolist()


def earlier(world: World, out: Path) -> Any:
    """Return the result of an earlier campaign, which is saved in a folder."""
    folder = out / "campaigns" / world.name
    if not (folder / "campaign.json").exists():
        run(world, FIRST, N_EARLIER).save(folder)
    return tb.load_result(folder)


def run(world: World, course: str, n: int, **options: Any) -> Any:
    """Run a campaign in a world."""
    workspace = world.campaign_workspace()
    return tb.iterate(
        workspace,
        *world.ends(course),
        simulator=world.simulator(workspace),
        n_iterations=n,
        progress=False,
        **options,
    )


def report(rows: pd.DataFrame) -> None:
    """Print the contact lost by kind, and the differences from new campaigns without others."""
    lost = rows.assign(lost=rows[[f"lost_{k + 1}" for k in range(N_NEW)]].mean(axis=1))
    wide = lost.pivot_table("lost", ["world", "kind"], "condition", sort=False).reset_index()
    differences = [f"{name} minus cold" for name in CONDITIONS[1:]]
    table = Table("kind (worlds)", *CONDITIONS, *differences)
    kinds = {kind: wide[wide["kind"] == kind] for kind in dict.fromkeys(wide["kind"])}
    for name, some in (kinds | {"all": wide}).items():
        texts = []
        for condition in CONDITIONS[1:]:
            *ends, _ = over_worlds((some[condition] - some["cold"]).to_numpy(), some["world"])
            texts.append(interval(*ends))
        means = [f"{some[condition].mean():.3f}" for condition in CONDITIONS]
        table.row(f"{name} ({len(some)})", *means, *texts)


if __name__ == "__main__":
    main()
