"""The open benchmark: the tables of docs/worlds.md, in Markdown.

    python benchmarks/worlds.py --data DIR --out out/worlds
    python benchmarks/worlds.py --kind aged --kind wall --method trustbo --method "running mean"

All worlds x 4 courses x methods, 15 missions each; called again, it goes on where it stopped, with
other parts too: the tables are those of the chosen parts.
`--targets` runs the objective and path class of the targets instead, mean contact on shortest+2.
`--report` runs nothing, and prints the tables of what is in `--out`, for the worlds and courses
that the default campaign has run. `--csv` writes a row for each world, course and method.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from baselines import line_of_sight, oracle, residual_process, running_mean
from common import arguments, parsed
from groups import KINDS, OURS, report_groups, rows_of

from trustbo.files import to_json
from trustbo.study import run_worlds, worlds, worlds_table
from trustbo.study.methods import BASELINE_ROWS
from trustbo.study.store import Store
from trustbo.study.table import as_text, differences, to_dataset, worse_than

METHODS: dict[str, Any] = {
    OURS: {"model": "robots", "policy": "greedy"},
    "trustbo, optimistic": {"model": "robots", "policy": "optimistic"},
    "trustbo, places": {"model": "places", "policy": "greedy"},
    "trustbo, no places": {"model": "pooled", "policy": "greedy"},
    "running mean": running_mean.greedy,
    "running mean, optimistic": running_mean.optimistic,
    "residual process": residual_process.ResidualProcess,
    "line of sight": line_of_sight.LineOfSight,
    "oracle": oracle.Oracle,
    **dict(BASELINE_ROWS.values()),
}
"""Methods by the names of their rows."""
CASES = ("canopy", "robots", "days", "change", "jammer", "limit")
"""Kinds of which each case has a table."""
COLUMNS = ["regret after 0", "regret after 3", "regret after 8", "regret after 15", "regret now",
           "lost while learning", "lost with failures", "missions to 1 %", "arrive",
           "seconds"]  # fmt: skip
OF_CASES = ["regret after 3", "regret after 8", "regret after 15", "regret now",
            "lost while learning", "lost with failures"]  # fmt: skip
OF_DIFFERENCES = ["pairs", "regret after 15", "regret now", "lost while learning",
                  "lost with failures", "missions to 1 %", "seconds"]  # fmt: skip


def main():
    parser = arguments(
        __doc__, data=True, seeds=1, out="out/worlds", quick="three small worlds, 3 missions"
    )
    parser.add_argument("--kind", action="append", help="a kind of worlds; by default all")
    parser.add_argument("--world", action="append", help="a world; by default all of the kinds")
    parser.add_argument("--course", action="append", help="a course; by default all")
    parser.add_argument("--method", action="append", choices=METHODS, help="by default all")
    parser.add_argument("--missions", type=int, default=15, help="of a campaign; default 15")
    parser.add_argument("--objective", default="lost_contact")
    parser.add_argument("--max-bounds", default="shortest+4")
    parser.add_argument("--targets", action="store_true")
    parser.add_argument("--serial", action="store_true", help="one campaign after the other")
    parser.add_argument("--report", action="store_true", help="tables alone, of --out")
    parser.add_argument("--csv", type=Path, help="file of the rows of all campaigns")
    given = parsed(parser)
    if given.report:
        report(kept(given.out), given.csv)
        return
    objective, max_bounds = given.objective, given.max_bounds
    if given.targets:
        objective, max_bounds = "mean", "shortest+2"
    names = [
        world.name
        for world in worlds(given.data).values()
        if (given.data or world.is_packaged)
        and (given.kind is None or world.kind in given.kind)
        and (given.world is None or world.name in given.world)
    ]
    methods = {name: METHODS[name] for name in given.method or METHODS}
    courses = {} if given.course is None else {"courses": given.course}
    results = run_worlds(
        given.out, data=given.data, only=names, methods=methods, baselines=(), policies=(),
        seeds=given.seeds, n_iterations=given.missions, objective=objective,
        max_bounds=max_bounds, quick=given.quick, executor="serial" if given.serial else "loky",
        **courses,
    )  # fmt: skip
    report(results, given.csv)


def kept(folder: Path) -> xr.Dataset:
    """Results of all runs that a folder holds, of whatever parts; of equal labels the newest."""
    store = Store(folder)
    files = sorted((folder / "runs").glob("*.json"), key=lambda file: file.stat().st_mtime)
    newest = {to_json(store.read(file.stem)["labels"]): file.stem for file in files}
    records = {key: store.read(key) for key in newest.values()}
    return to_dataset(records, {key: record["labels"] for key, record in records.items()})


def report(results: xr.Dataset, csv: Path | None = None):
    """Print tables of all worlds, kinds and cases, of the differences, and of the groups."""
    rows = results[["world", "course", "method", "seed"]].to_dataframe()
    if OURS in set(rows["method"]):
        ours = rows[rows["method"] == OURS].set_index(["world", "course", "seed"]).index
        rows = rows[rows.set_index(["world", "course", "seed"]).index.isin(ours)]
    order = [name for name in METHODS if name in set(rows["method"])]
    rows = rows.assign(rank=rows["method"].map(order.index)).sort_values("rank", kind="stable")
    results = results.isel(run=rows.index.to_numpy())
    if csv is not None:
        rows_of(results).round(4).to_csv(csv, index=False)
    kinds = results["kind"].values
    for kind in ("all worlds", *KINDS):
        runs = results if kind == "all worlds" else results.isel(run=kinds == kind)
        if runs.sizes["run"]:
            n = len(np.unique(runs["world"].values))
            print(f"\n**{kind}** ({n} worlds)\n\n{text(worlds_table(runs), COLUMNS)}")
    runs = results.isel(run=np.isin(kinds, CASES))
    for case in np.unique(runs["case"].values):
        one = runs.isel(run=runs["case"].values == case)
        print(f"\n**{case}**: {', '.join(np.unique(one['world'].values))}\n")
        print(text(worlds_table(one), OF_CASES))
    if len(order) < 2 or order[0] != OURS:
        return
    for by in ((), ("kind",)):
        table = differences(results, OURS, by)
        print(f"\n{OURS} less each other method, same world, course and seed\n")
        print(f"{text(table, OF_DIFFERENCES)}\n\n" + "\n".join(worse_than(table)))
    report_groups(rows_of(results))


def text(table: pd.DataFrame, columns: list[str]) -> str:
    """Some columns of a table in Markdown; campaigns may be too short for all."""
    return as_text(table[[name for name in columns if name in table.columns.levels[0]]])


if __name__ == "__main__":
    main()
