"""Plans, predictions and fits by family of observations, over the worlds.

    python benchmarks/families.py campaigns --data DIR --out out/families
    python benchmarks/families.py loo --data DIR

`campaigns`: the default campaign under each family, with the same seed; after each mission the
regret of the path that it would recommend, and the contact that the path driven lost beyond the
best one's, both by the truth of the world; coverage one mission ahead; processor seconds.
`loo`: every family on the missions of one campaign of
each terrain, along random paths; the log density of a mission left out, in nats of counts of ticks,
less that of the best family. Both go on where they stopped. Differences are paired by
world and course, their 95 % intervals by a bootstrap over these.
"""

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from common import Table, arguments, parsed, records_of

import trustbo as tb
from trustbo.inference import fit
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect
from trustbo.study import worlds
from trustbo.study.world import World

FAMILIES = ("gaussian", "censored")
LOO = ("gaussian", "censored", "beta_binomial")
TERRAINS = ("synthetic-0", "synthetic-1", "synthetic-2", "wellington", "tahoe", "bcts",
            "topography", "synthetic-0-wall", "tahoe-wall")  # fmt: skip
DRIVEN = ("synthetic-0", "synthetic-1", "wellington", "synthetic-0-aged", "synthetic-0-wall",
          "synthetic-0-rain", "synthetic-cedar-dead-detector",
          "synthetic-alder-jammer-appears")  # fmt: skip
"""Kinds of worlds in which no robot fails and nothing changes."""


def main():
    parser = arguments(
        __doc__, names=("campaigns", "loo"), data=True, out="out/families",
        quick="one synthetic world, 3 missions",
    )  # fmt: skip
    parser.add_argument("--worlds", nargs="*")
    parser.add_argument("--courses", nargs="*", default=["sw-ne", "n-s"])
    parser.add_argument("-m", "--missions", type=int, default=12, help="missions, default 12")
    given = parsed(parser)
    if given.quick:
        given.worlds, given.courses, given.missions = ["synthetic-0"], ["sw-ne"], 3
    for name in given.names:
        {"campaigns": campaigns, "loo": loo}[name](given)


def campaigns(given):
    every = worlds(given.data)
    chosen = [every[name] for name in given.worlds or DRIVEN]

    def measure(world: World, course: str, n: int) -> dict[str, Any]:
        found = {family: driven(world, course, n, family, given.out) for family in FAMILIES}
        return {"world": world.name, "course": course, "n": n, **found}

    show(records_of(given.out / "campaigns.jsonl", chosen, given.courses, given.missions, measure))


def driven(world: World, course: str, n: int, family: str, out) -> dict[str, Any]:
    """Regret, contact lost, coverage and seconds of one campaign, which is saved to a folder."""
    workspace, truth, ends = world.workspace(), world.truth(), world.ends(course)
    model = PooledTrust(effects=(PlaceEffect(), RobotEffect()), observation=family)
    campaign = tb.Campaign(workspace, *ends, model=model, seed=0)
    regret, lost, seconds = [], [], []
    run = campaign.run(world.simulator(workspace), n)
    for j in range(n):
        started = time.process_time()
        _, mission = next(run)
        seconds.append(time.process_time() - started)
        now, best = truth.at(j), truth.at(j).best(*ends)
        regret.append(now.regret(campaign.recommend().path))
        lost.append(now.lost(mission.path) - now.lost(best))
    missions = [workspace.fill(mission) for mission in campaign.missions]
    scores = tb.inference.score(campaign.result().posteriors, missions, workspace=workspace)
    far = np.abs(scores["pit"].values - 0.5)
    inside = [float((far[np.isfinite(far)] <= 0.5 * p).mean()) for p in (0.5, 0.9)]
    campaign.save(out / "campaigns" / f"{world.name} {course} {n} {family}", overwrite=True)
    return {"regret": regret, "lost": lost, "seconds": seconds,
            "coverage": inside, "log": float(np.nanmean(scores["log_score"].values))}  # fmt: skip


def show(records: Sequence[dict[str, Any]]) -> None:
    """Print means of each family, and their paired differences."""
    columns: dict[str, Callable[[dict[str, Any]], float]] = {
        "regret after 3 (%)": lambda one: one["regret"][2],
        "after 8": lambda one: one["regret"][min(7, len(one["regret"]) - 1)],
        "at the end": lambda one: one["regret"][-1],
        "lost while driving, bounds a mission": lambda one: float(np.mean(one["lost"])),
        "50 % cover": lambda one: one["coverage"][0],
        "90 % cover": lambda one: one["coverage"][1],
        "log score of a rate": lambda one: one["log"],
        "processor seconds a mission": lambda one: float(np.mean(one["seconds"][1:])),
    }
    values = {
        family: np.array([[f(r[family]) for f in columns.values()] for r in records])
        for family in FAMILIES
    }
    table = Table("family", *columns)
    for family, rows in values.items():
        table.row(family, *(_interval(column) for column in rows.T))
    table.row("difference", *(_interval(c) for c in (values["censored"] - values["gaussian"]).T))
    for name in dict.fromkeys(r["world"] for r in records):
        some = [r for r in records if r["world"] == name]
        lost = [np.mean([np.mean(r[family]["lost"]) for r in some]) for family in FAMILIES]
        print(f"{name}: lost a mission {lost[0]:.3f} gaussian, {lost[1]:.3f} censored")


def _interval(values: np.ndarray) -> str:
    """Mean and its 95 % interval, by a bootstrap."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(len(values), size=(4000, len(values)))].mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return f"{values.mean():.3f} [{low:.3f}, {high:.3f}]"


def loo(given):
    """Leave-one-out densities."""
    total = dict.fromkeys(LOO, 0.0)
    table = Table("world", "0 or 1", *LOO)
    for name in given.worlds or TERRAINS:
        missions = along_random_paths(worlds(given.data)[name])
        rates = np.concatenate([m.contact_rate.ravel() for m in missions])
        piled = np.mean((rates[~np.isnan(rates)] % 1.0) == 0.0)
        outcomes = {family: density(missions, family) for family in LOO}
        best = max(outcomes.values())
        total = {family: total[family] + outcomes[family] - best for family in LOO}
        table.row(name, f"{piled:.0%}", *(f"{outcomes[family] - best:.0f}" for family in LOO))
    table.row("all", "", *(f"{total[family]:.0f}" for family in LOO))


def along_random_paths(world, n=15):
    """Missions along random paths through a world."""
    workspace = world.workspace()
    options = {"policy": "random", "sampler": "importance", "planner": {"max_bounds": "shortest+4"}}
    campaign = tb.Campaign(workspace, *world.ends("sw-ne"), **options)
    run = campaign.run(world.simulator(workspace), n_iterations=n)
    return [workspace.fill(mission) for _, mission in run]


def density(missions, family):
    """Log density of missions left out one by one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Pareto k: 15 missions are few
        return float(tb.inference.loo(fit(missions, PooledTrust(observation=family))).elpd)


if __name__ == "__main__":
    main()
