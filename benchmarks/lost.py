"""Compare the contact that campaigns lose on all worlds, with that of another version or method.

    python benchmarks/lost.py --data DIR --csv out/lost.csv
    python benchmarks/lost.py --rows out/lost.csv --compare benchmarks/reference/lost_0.5.csv

Unlike benchmarks/worlds.py, this script needs no truths: the contact lost is that which the
missions measured, in bounds per mission, with bounds that failed or were not reached as fully lost.
Missions have the same seeds in all methods, and each method starts from the same prior. Rows
contain the contact lost in each mission, the share of missions that arrived, and `settled`, the
number of missions after which the planned path did not change again.

With `--rows`, no campaign is run, and the tables are those of the rows of earlier runs. With
`--compare`, the first ten missions are compared with rows of version 0.5, which are means.
"""

import copy
import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from baselines import line_of_sight, residual_process, running_mean
from baselines.paths import PathPolicy
from common import Table, arguments, parsed
from groups import (
    GROUPS,
    KINDS,
    LOST,
    OURS,
    by_group,
    by_kind,
    grounds_of,
    interval,
    print_groups,
    print_kinds,
)
from summary import bootstrap
from world_set import World, worlds

import trustbo as tb
from trustbo.data import POST_SETS

PLANNER = {"max_bounds": "shortest+4"}
METHODS: dict[str, dict[str, Any]] = {
    "trustbo": {},
    "trustbo, failures are free": {"planner": {**PLANNER, "failure_cost": 0.0}},
    "running mean": {"policy": running_mean.greedy(), "model": tb.models.PooledTrust()},
    "residual process": {
        "policy": residual_process.ResidualProcess(),
        "model": tb.models.PooledTrust(),
    },
    "line of sight": {"policy": line_of_sight.LineOfSight(), "model": tb.models.PooledTrust()},
    "one set of posts": {"n_posts": 1},
}
"""Arguments of `trustbo.iterate`, and `n_posts` of the workspace, by default 3, keyed by method."""
USUAL = (OURS, "running mean", "residual process", "line of sight")
"""Methods that are compared if none is given."""
COURSES = ("sw-ne", "nw-se")
MISSIONS = 15
MISSIONS_OF_0_5 = 10
"""Number of missions of the campaigns whose rows are in lost_0.5.csv."""
LABELS = ["world", "kind", "course"]
LEAST = 0.02
"""Contact lost, in bounds, that is added to both sides of a ratio; on some worlds none is lost."""


def main() -> None:
    parser = arguments(__doc__ or "", data=True, quick="three worlds")
    parser.add_argument(
        "--method", action="append", choices=METHODS, help=f"default {', '.join(USUAL)}"
    )
    parser.add_argument("--missions", type=int, default=MISSIONS, help=f"default {MISSIONS}")
    parser.add_argument("--course", action="append", help=f"default {', '.join(COURSES)}")
    parser.add_argument("--csv", type=Path, help="CSV file for the rows")
    parser.add_argument("--rows", type=Path, action="append", help="CSV file with rows")
    parser.add_argument("--compare", type=Path, help="CSV file with rows of version 0.5")
    parser.add_argument("--part", default="0/1", help="K/N: every Nth world, beginning with K")
    given = parsed(parser)

    if given.rows:
        rows = pd.concat([pd.read_csv(file) for file in given.rows])
    else:
        rows = run(given)

    if given.compare is None:
        report(summarised(rows, given.missions))
        settling(rows)
    else:
        before = pd.read_csv(given.compare)
        ours = summarised(rows, MISSIONS_OF_0_5)
        differences(ours[ours["method"] == OURS], before[before["method"] == OURS])


def run(given: Namespace) -> pd.DataFrame:
    """Run the campaigns that the arguments of the command line ask for; return the rows."""
    first, step = map(int, given.part.split("/"))
    every = [w for w in worlds(given.data).values() if given.data or w.is_packaged]
    chosen = every[:3] if given.quick else every[first::step]
    rows = []
    for world in chosen:
        for course in given.course or COURSES:
            rows += rows_of(world, course, given.method or USUAL, given.missions)
            print(f"{world.name}, {course}", file=sys.stderr, flush=True)
            if given.csv is not None:
                given.csv.parent.mkdir(parents=True, exist_ok=True)
                pd.DataFrame(rows).round(5).to_csv(given.csv, index=False)
    return pd.DataFrame(rows)


def rows_of(
    world: World, course: str, methods: Sequence[str], n_missions: int
) -> list[dict[str, object]]:
    """Run one campaign of each method; return the rows."""
    rows = []
    for method in methods:
        campaign = campaign_of(world, course, method, n_missions)
        labels = {"world": world.name, "kind": world.kind, "course": course, "method": method}
        arrived = np.mean([mission.status == "ok" for mission in campaign.missions])
        paths = [
            *(entry.plan.stations for entry in campaign.state.entries),
            campaign.plan().stations,
        ]
        changes = [k for k in range(1, len(paths)) if paths[k] != paths[k - 1]]
        lost = {lost_after(k): lost_in(mission) for k, mission in enumerate(campaign.missions)}
        rows.append(labels | {"settled": max(changes, default=0), "arrive": arrived} | lost)
    return rows


def campaign_of(world: World, course: str, method: str, n_missions: int) -> tb.Campaign:
    """Run a campaign of a method; baselines learn from each mission."""
    options = {"planner": PLANNER, **copy.deepcopy(METHODS[method])}  # policies learn
    workspace = world.workspace(n_posts=options.pop("n_posts", len(POST_SETS)))
    campaign = tb.Campaign(workspace, *world.ends(course), seed=4, progress=False, **options)
    for _, mission in campaign.run(world.simulator(workspace), n_missions, progress=False):
        if isinstance(campaign.policy, PathPolicy):
            campaign.policy.learn(campaign, mission)
    return campaign


def lost_after(n_missions: int) -> str:
    """Return the name of the column of the contact lost after `n_missions` missions."""
    return f"lost_{n_missions + 1}"


def summarised(rows: pd.DataFrame, n_missions: int) -> pd.DataFrame:
    """Add columns with the means over the first `n_missions`, the last four, and the first."""
    lost = rows[[lost_after(k) for k in range(n_missions)]].to_numpy()
    return rows.assign(
        first=lost[:, 0], lost=np.nanmean(lost, 1), lost_last_4=np.nanmean(lost[:, -4:], 1)
    )


def lost_in(mission: tb.Mission) -> float:
    """Return the contact lost in a mission, in bounds; a bound that is not completed counts 1."""
    done = np.array(mission.bound_status) == "ok"
    n_planned = len(mission.path) - 1
    rates = np.nanmean(mission.contact_rate[done], axis=1)
    return float(n_planned - rates.sum())


def report(rows: pd.DataFrame) -> None:
    """Print the means of trustbo and of baselines, and the paired differences of all methods."""
    named = rows.rename(columns={"lost": LOST})
    print_groups(by_group(named))
    print_kinds(by_kind(named))
    print()

    first, *others = rows["method"].unique()
    for name in others:
        print(f"{name} (ours) and {first} (other)")
        differences(rows[rows["method"] == name], rows[rows["method"] == first])


def groups() -> dict[str, Sequence[str]]:
    """Return groups of kinds, and each kind."""
    return {**GROUPS, **{kind: (kind,) for kind in KINDS}}


def differences(ours: pd.DataFrame, other: pd.DataFrame) -> None:
    """Print the difference in contact lost (negative is better), paired by world and course.

    The ratio is that of the geometric means over worlds.
    """
    pairs = ours.merge(other, on=LABELS, suffixes=("", "_other"))
    columns = ["ours minus other [95 % by terrain]", "last four", "ratio", "first missions"]
    if "first_other" not in pairs:  # as in rows of version 0.5
        columns.pop()
    table = Table("worlds", "n", *columns, first=26)
    for group, kinds in groups().items():
        some = pairs[pairs["kind"].isin(kinds)]
        if some.empty:
            continue

        less = pd.DataFrame(
            {name: some[name] - some[f"{name}_other"] for name in ("lost", "lost_last_4")}
        )
        for name in ("lost", "first"):
            if f"{name}_other" in some:
                ratio = (some[name] + LEAST) / (some[f"{name}_other"] + LEAST)
                less[f"ratio {name}"] = np.log(ratio)
        of_worlds = less.groupby(some["world"]).mean()
        means = {name: of_worlds[name].to_numpy() for name in of_worlds}
        found = bootstrap(means, grounds_of(of_worlds.index), np.mean)
        texts = []
        for name in means:
            ends = pd.Series({what: found[name, what] for what in ("value", "low", "high")})
            texts.append(interval(np.exp(ends) if name.startswith("ratio") else ends, 3))
        table.row(group, len(of_worlds), *texts)
    print()


def settling(rows: pd.DataFrame) -> None:
    """Print when the planned path of our method stops changing, by group and kind."""
    ours = rows[rows["method"] == OURS]
    n_missions = ours["settled"].max()
    table = Table("worlds", "campaigns", "median", "90 %", f"not after {n_missions - 1}", first=26)
    for group, kinds in groups().items():
        settled = ours["settled"][ours["kind"].isin(kinds)]
        if len(settled):
            middle, high = settled.quantile([0.5, 0.9])
            late = (settled >= n_missions).mean()
            table.row(group, len(settled), f"{middle:.0f}", f"{high:.0f}", f"{late:.0%}")
    print()


if __name__ == "__main__":
    main()
