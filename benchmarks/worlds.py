"""Benchmark of methods on simulated worlds; prints the tables of docs/worlds.md in Markdown.

    python benchmarks/worlds.py --data DIR --out out/worlds
    python benchmarks/worlds.py --kind aged --kind wall --method trustbo --method "running mean"

The following smaller set of 17 worlds and 2 courses is used to evaluate changes of the defaults:

    python benchmarks/worlds.py --set --out out/set --csv out/set.csv

By default, the benchmark runs all worlds, 4 courses and all methods, with 15 missions each. If you
run it again, even with other options, existing results in --out are reused. The tables contain the
selected results. `--csv` writes a row for each world, course and method.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from baselines import line_of_sight, oracle, residual_process, running_mean, unlearned
from common import arguments, parsed
from groups import KINDS, OURS, interval, report_groups, rows_of
from joblib import Parallel, delayed
from summary import differences, numbers_of, summary
from world_set import COURSES, World, worlds

import trustbo as tb
from trustbo.study import run_grid

SET = (
    "synthetic-0", "synthetic-1", "synthetic-2", "wellington", "synthetic-0-aged",
    "synthetic-1-aged", "synthetic-0-slopes", "synthetic-0-low", "synthetic-alder-thin-canopy",
    "synthetic-1-dense", "synthetic-1-one-poor", "synthetic-alder-one-poor", "synthetic-2-dust",
    "synthetic-0-rain", "synthetic-2-jammer", "synthetic-birch-jammer", "synthetic-1-radio",
)  # fmt: skip
SET_COURSES = ("sw-ne", "nw-se")


def beside_pooled(make: Any, scene: tb.study.Scene) -> dict[str, Any]:
    """Add the fast pooled model to the options of a method that does not use a posterior."""
    return {"model": tb.models.PooledTrust(), **make(scene)}


METHODS: dict[str, Any] = {
    OURS: {},
    "trustbo, greedy": {"policy": "greedy"},
    "trustbo, optimistic": {"policy": "optimistic"},
    "trustbo, places": {"model": tb.models.PooledTrust(effects=(tb.models.PlaceEffect(),))},
    "trustbo, no places": {"model": tb.models.PooledTrust(), "policy": "greedy"},
    "running mean": lambda scene: {"policy": running_mean.greedy()},
    "running mean, optimistic": lambda scene: {"policy": running_mean.optimistic()},
    "residual process": lambda scene: {"policy": residual_process.ResidualProcess()},
    "line of sight": lambda scene: {"policy": line_of_sight.LineOfSight()},
    "oracle": lambda scene: {"policy": oracle.Oracle(scene.truth)},
    "random path": lambda scene: {"policy": unlearned.RandomPath()},
    "shortest path": lambda scene: {"policy": unlearned.shortest()},
    "paper": {**tb.paper.CAMPAIGN, "sampler": "importance"},
}
"""Options of each method, keyed by its name; "paper" uses the awareness of cells."""
for _name, _make in METHODS.items():
    if callable(_make):
        METHODS[_name] = partial(beside_pooled, _make)
CASES = ("canopy", "robots", "days", "change", "jammer", "limit")
"""Kinds of worlds for which each case has its own table."""
COLUMNS = ["regret after 0", "regret after 3", "regret after 8", "regret after 15", "regret now",
           "lost while learning", "lost with failures", "missions to 1 %", "arrive",
           "seconds"]  # fmt: skip
OF_CASES = ["regret after 3", "regret after 8", "regret after 15", "regret now",
            "lost while learning", "lost with failures"]  # fmt: skip
ABOUT = {
    "seconds": "seconds (CPU time per mission)",
    "arrive": "arrive (fraction of missions that reach the goal)",
    "lost while learning": "lost while learning (bounds per mission)",
    "lost with failures": "lost with failures (bounds per mission; failed bounds count as lost)",
    "missions to 1 %": "missions to 1 % (missions until the regret stays within 1 %)",
}
"""Longer descriptions of quantities, keyed by the column names of `numbers_of`."""
OF_DIFFERENCES = ["pairs", "regret after 15", "regret now", "lost while learning",
                  "lost with failures", "missions to 1 %", "seconds"]  # fmt: skip


def main():
    parser = arguments(
        __doc__, data=True, seeds=1, out="out/worlds", quick="three small worlds, 3 missions"
    )
    parser.add_argument("--kind", action="append", help="kind of worlds (default all)")
    parser.add_argument("--world", action="append", help="world (default all)")
    parser.add_argument("--course", action="append", help="course (default all)")
    parser.add_argument("--set", action="store_true", help="smaller set: 17 worlds x 2 courses")
    parser.add_argument("--method", action="append", choices=METHODS, help="default all")
    parser.add_argument("--missions", type=int, default=15, help="per campaign (default 15)")
    parser.add_argument("--max-bounds", default="shortest+4")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (default one per core)")
    parser.add_argument("--csv", type=Path, help="CSV file for the rows")
    given = parsed(parser)
    names = SET if given.set else given.world
    courses = given.course or (SET_COURSES if given.set else COURSES)
    chosen = [
        world
        for world in worlds(given.data).values()
        if (given.data or world.is_packaged)
        and (given.kind is None or world.kind in given.kind)
        and (names is None or world.name in names)
    ]
    if given.quick:
        chosen, courses, given.missions = small(chosen), courses[:1], 3
    kept = given.out / "truths"
    Parallel(given.jobs)(delayed(find_truths)(world, kept, given.missions) for world in chosen)
    scenes = {
        f"{world.name}, {course}": partial(world.scene, course, kept, given.max_bounds)
        for world in chosen
        for course in courses
    }
    methods = {name: METHODS[name] for name in given.method or METHODS}
    settings = {"seeds": range(given.seeds), "n_missions": given.missions, "n_jobs": given.jobs}
    tables = []
    if printed := {"paper": methods.pop("paper")} if "paper" in methods else {}:
        cells = {name: partial(scene, bounds=tb.paper.WORKSPACE["bounds"])
                 for name, scene in scenes.items()}  # fmt: skip
        tables.append(run_grid(printed, cells, given.out, **settings))
    if methods:
        tables.append(run_grid(methods, scenes, given.out, **settings))
    report(numbers_of(pd.concat(tables)), given.csv)


def small(chosen: list[World]) -> list[World]:
    """Make a small synthetic world of each of three kinds."""
    made = {world.kind: world for world in reversed(chosen) if world.is_made}
    return [
        replace(made[kind], name=f"{made[kind].name}-small", shape=(5, 5), cell=40.0)
        for kind in ("right", "days", "physics")
        if kind in made
    ]


def find_truths(world: World, folder: Path, n_missions: int) -> None:
    """Compute the truths of all missions of a world, which campaigns then read from `folder`."""
    truth = world.truth(folder)
    for mission in range(n_missions + 1):
        truth.at(mission)


def report(numbers: pd.DataFrame, csv: Path | None = None):
    """Print tables of all worlds, kinds and cases, of differences, and of groups."""
    order = [name for name in METHODS if name in set(numbers["case"])]
    rank = numbers["case"].map(order.index)
    numbers = numbers.iloc[np.argsort(rank, kind="stable")]
    if csv is not None:
        rows_of(numbers).round(4).to_csv(csv, index=False)
    for kind in ("all worlds", *KINDS):
        some = numbers if kind == "all worlds" else numbers[numbers["kind"] == kind]
        if len(some):
            n = some["world"].nunique()
            print(f"\n**{kind}** ({n} worlds)\n\n{as_text(summary(some), COLUMNS)}")
    of_cases = numbers[numbers["kind"].isin(CASES)]
    for case, some in of_cases.groupby("of"):
        print(f"\n**{case}**: {', '.join(some['world'].unique())}\n")
        print(as_text(summary(some), OF_CASES))
    if len(order) < 2 or order[0] != OURS:
        return
    for by in ((), ("kind",)):
        table = differences(numbers, OURS, by)
        print(f"\n{OURS} minus each other method, same world, course and seed\n")
        print(f"{as_text(table, OF_DIFFERENCES)}\n")
        print(f"Where {OURS} is significantly worse, by the 95 % interval of the difference:\n")
        print("\n".join(worse_than(table)))
    report_groups(rows_of(numbers))


def worse_than(table: pd.DataFrame) -> list[str]:
    """List the quantities and methods of `differences` for which ours is significantly worse.

    The 95 % interval of the difference is then above 0 or, for `arrive`, below 0.
    """
    lines = []
    for name in dict.fromkeys(str(name) for name, _ in table.columns):
        if name == "pairs":
            continue
        good = name.startswith("arrive")
        worse = table[name, "high"] < 0.0 if good else table[name, "low"] > 0.0
        rows = [label(key) for key in table.index[worse.to_numpy()]]
        if rows:
            what = ABOUT.get(name, name)
            lines.append(f"- {what}: worse than {'; '.join(rows)}")
    return lines or ["- nowhere"]


def as_text(table: pd.DataFrame, columns: list[str]) -> str:
    """Format columns of `summary` or `differences` in Markdown, each value with its interval."""
    names = [name for name in columns if name in table.columns.levels[0]]
    head = [" and ".join(table.index.names)]
    head += [f"{name} (%)" if "regret" in name else name for name in names]
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for key, row in table.iterrows():
        cells = []
        for name in names:
            if name == "pairs":
                cells.append(f"{row[name, 'value']:.0f}")
                continue
            places = 1 if "regret" in name or "missions" in name else 2
            cells.append(interval(row[name], places))
        lines.append(" | ".join([label(key), *cells]))
    return "\n".join(f"| {line} |" for line in lines)


def label(key: Any) -> str:
    return ", ".join(map(str, key)) if isinstance(key, tuple) else str(key)


if __name__ == "__main__":
    main()
