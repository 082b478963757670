"""The open benchmark: the tables of docs/worlds.md, in Markdown.

    python benchmarks/worlds.py --data DIR --out out/worlds
    python benchmarks/worlds.py --kind aged --kind wall --method trustbo --method "running mean"

All worlds x 4 courses x methods, 15 missions each; called again, it goes on where it stopped, with
other parts too: the tables are those of the chosen parts. BoTorch and Ax are left out where they
are not installed.
`--targets` runs the objective and path class of the targets instead, mean contact on shortest+2.
"""

from importlib.util import find_spec
from typing import Any

import numpy as np
import xarray as xr
from baselines import (
    ax_default,
    botorch,
    line_of_sight,
    oracle,
    residual_process,
    running_mean,
    standard_design,
)
from common import arguments, parsed

from trustbo.study import run_worlds, worlds, worlds_table
from trustbo.study.methods import BASELINE_ROWS
from trustbo.study.table import as_text, differences, worse_than

OURS = "trustbo"
METHODS: dict[str, Any] = {
    OURS: {"model": "robots", "policy": "optimistic"},
    "trustbo, places": {"model": "places", "policy": "optimistic"},
    "trustbo, no places": {"model": "pooled", "policy": "greedy"},
    "running mean": running_mean.greedy,
    "running mean, optimistic": running_mean.optimistic,
    "residual process": residual_process.ResidualProcess,
    "BoTorch EI": botorch.expected_improvement,
    "BoTorch Thompson": botorch.thompson,
    "Ax": ax_default.AxDefault,
    "line of sight": line_of_sight.LineOfSight,
    "standard design": standard_design.StandardDesign,
    "oracle": oracle.Oracle,
    **dict(BASELINE_ROWS.values()),
}
"""Methods by the names of their rows."""
PACKAGES = {"BoTorch EI": "botorch", "BoTorch Thompson": "botorch", "Ax": "ax"}
"""Packages that methods need."""


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
    given = parsed(parser)
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
    methods = {
        name: METHODS[name]
        for name in given.method or METHODS
        if name not in PACKAGES or find_spec(PACKAGES[name])
    }
    courses = {} if given.course is None else {"courses": given.course}
    results = run_worlds(
        given.out, data=given.data, only=names, methods=methods, baselines=(), policies=(),
        seeds=given.seeds, n_iterations=given.missions, objective=objective,
        max_bounds=max_bounds, quick=given.quick, executor="serial" if given.serial else "loky",
        **courses,
    )  # fmt: skip
    report(results, f"{objective}, {max_bounds}")


def report(results: xr.Dataset, title: str):
    """Print tables of all worlds, of each kind, and of the differences."""
    kinds = results["kind"].values
    for kind in ("all", *np.unique(kinds)):
        runs = results if kind == "all" else results.isel(run=kinds == kind)
        n = len(np.unique(runs["world"].values))
        print(f"\n{kind} (worlds: {n}), {title}\n\n{as_text(worlds_table(runs))}")
    methods = set(results["method"].values.tolist())
    if OURS not in methods or len(methods) < 2:
        return
    for by in ((), ("kind",)):
        table = differences(results, OURS, by)
        print(f"\n{OURS} less each other method, same world, course and seed\n\n{as_text(table)}\n")
        print("\n".join(worse_than(table)))


if __name__ == "__main__":
    main()
