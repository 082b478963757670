"""Benchmark of campaigns that learn from earlier campaigns; prints the table of docs/worlds.md.

    python benchmarks/earlier.py --data DIR --out out/earlier

In each world, an earlier campaign runs 6 missions from south-west to north-east. A new campaign
runs 5 missions from north-west to south-east, under three conditions: without earlier missions,
after the earlier campaign on the same terrain, and after an earlier campaign on another terrain
whose deviation from the assumed world is of the same kind. The script compares the contact lost in
the new campaigns in pairs.

Results in --out are reused. `--variant` adds variants of the conditions.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from world_set import World, worlds

import trustbo as tb

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
N_RESAMPLES = 10_000
"""Bootstrap resamples of the worlds."""
TARGETS = {"same terrain": 0.85, "other terrain": 0.95}
"""Largest ratio of contact lost with and without earlier missions."""
HURT = 0.05
"""Additional loss per mission, in bounds, that no kind of worlds may have."""


class Restless:
    """Policy that is greedy, but plans with `ucb` if the plan equals the last two."""

    def __init__(self) -> None:
        self.paths: list[Any] = []

    def __call__(self, rng: np.random.Generator, draws: Any, planner: Any) -> Any:
        """Plan a path."""
        policies = tb.planning.policies.POLICIES
        plan = policies["greedy"](rng, draws, planner)
        if len(self.paths) >= 2 and self.paths[-2:] == [plan.path] * 2:
            plan = policies["ucb"](rng, draws, planner)
        self.paths.append(plan.path)
        return plan


def without_places(result: Any) -> Any:
    """Return a result as if its missions were on another map."""
    entries = tuple(
        replace(entry, mission=replace(entry.mission, map="elsewhere"))
        for entry in result.state.entries
    )
    state = replace(result.state, entries=entries)
    return tb.campaign.Result(result.workspace, state, result.learner)


Options = Callable[[Any, Any], dict[str, Any]]
CONDITIONS: dict[str, Options] = {
    "cold": lambda here, there: {},
    "same terrain": lambda here, there: {"earlier": here()},
    "other terrain": lambda here, there: {"earlier": there()},
}
"""Options of the new campaign, given functions that return the earlier results."""
VARIANTS: dict[str, Options] = {
    "same terrain, no places": lambda here, there: {"earlier": without_places(here())},
    "same terrain, ucb": lambda here, there: {"earlier": here(), "policy": "ucb"},
    "cold, restless": lambda here, there: {"policy": Restless()},
    "same terrain, restless": lambda here, there: {"earlier": here(), "policy": Restless()},
    "other terrain, restless": lambda here, there: {"earlier": there(), "policy": Restless()},
    "both": lambda here, there: {"earlier": [there(), here()]},
}


def main():
    parser = arguments(__doc__, data=True, out="out/earlier", quick="two worlds")
    parser.add_argument("--variant", action="append", choices=VARIANTS, default=[])
    parser.add_argument("--world", action="append", choices=PAIRS, help="default all")
    given = parsed(parser)
    known = {
        name: world
        for name, world in worlds(given.data).items()
        if given.data is not None or world.is_packaged
    }
    chosen = [n for n in given.world or PAIRS if n in known and PAIRS[n] in known]
    if given.quick:
        chosen = chosen[:2]

    conditions = CONDITIONS | {name: VARIANTS[name] for name in given.variant}
    rows = []
    for name in chosen:
        here, there = known[name], known[PAIRS[name]]
        for condition, options in conditions.items():
            lost = losses(here, there, condition, options, given.out)
            rows.append({"world": name, "kind": here.kind, "condition": condition, "lost": lost})
            print(name, condition, np.round(lost, 2).tolist(), f"{sum(lost):.2f}", flush=True)
    report(pd.DataFrame(rows))


def losses(here: World, there: World, condition: str, options: Options, out: Path) -> list[float]:
    """Return the contact lost in each mission of a new campaign, in bounds; read if known."""
    file = out / "losses" / f"{here.name}, {condition}.json"
    if file.exists():
        return json.loads(file.read_text())

    given = options(lambda: earlier(here, out), lambda: earlier(there, out))
    campaign = run(here, SECOND, N_NEW, **given)
    lost = campaign.table()["contact_lost"].tolist()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(lost))
    return lost


def earlier(world: World, out: Path) -> Any:
    """Return the result of an earlier campaign, which is saved in a folder."""
    folder = out / "campaigns" / world.name
    if not (folder / "campaign.json").exists():
        run(world, FIRST, N_EARLIER).save(folder)
    return tb.load_result(folder)


def run(world: World, course: str, n: int, **options: Any) -> Any:
    """Run a campaign in a world."""
    workspace = world.workspace()
    return tb.iterate(
        workspace,
        *world.ends(course),
        simulator=world.simulator(workspace),
        n_iterations=n,
        planner={"max_bounds": "shortest+4"},
        progress=False,
        **options,
    )


def report(rows: pd.DataFrame):
    """Print the contact lost by kind, and ratios to a campaign without earlier missions."""
    lost = rows.assign(lost=rows["lost"].map(np.sum)).pivot(
        index=["kind", "world"], columns="condition", values="lost"
    )
    lost = lost[list(dict.fromkeys(rows["condition"]))]

    print("\nContact lost in the first five missions of the new campaign, in bounds\n")
    table = Table("kind (worlds)", *lost.columns)
    for kind, some in lost.groupby("kind", sort=False):
        table.row(f"{kind} ({len(some)})", *(f"{value:.2f}" for value in some.mean()))
    table.row(f"all ({len(lost)})", *(f"{value:.2f}" for value in lost.mean()))

    print("\nCompared with the campaign without earlier missions\n")
    table = Table("condition", "ratio", "target", "better", "worse", "worst kind, per mission")
    for name in lost.columns:
        base = "cold, restless" if name.endswith("restless") else "cold"
        if name.startswith("cold") or base not in lost:
            continue
        change = lost[name] - lost[base]
        low, high = interval(lost[name].to_numpy(), lost[base].to_numpy())
        ratio = lost[name].sum() / lost[base].sum()
        hurt = change.groupby("kind").mean() / N_NEW
        table.row(
            name,
            f"{ratio:.2f} [{low:.2f}, {high:.2f}]",
            TARGETS.get(name, ""),
            int((change < -HURT * N_NEW).sum()),
            int((change > HURT * N_NEW).sum()),
            f"{hurt.max():+.3f} ({hurt.idxmax()})",
        )


def interval(new: np.ndarray, base: np.ndarray) -> tuple[float, float]:
    """Return the 95 % bootstrap interval over worlds of the ratio of sums."""
    rng = np.random.default_rng(0)
    index = rng.integers(len(new), size=(N_RESAMPLES, len(new)))
    low, high = np.quantile(new[index].sum(1) / base[index].sum(1), [0.025, 0.975])
    return float(low), float(high)


if __name__ == "__main__":
    main()
