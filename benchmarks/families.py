"""Regret and leave-one-out density by family of observations, over the worlds.

    python benchmarks/families.py regret --data DIR --out out/families
    python benchmarks/families.py loo --data DIR

`regret`: campaigns of 15 missions with effects of places under each family, and the seconds of
their fits; `auto` looks at the rates of each fit. `loo`: every family on the missions of one
campaign of each terrain, along random paths; the log density of a mission left out, in nats of
counts of ticks, less that of the best family. Both go on where they stopped.
"""

import warnings

import numpy as np
from common import Table, arguments, parsed

import trustbo as tb
from trustbo.inference import fit
from trustbo.models import PlaceEffect, PooledTrust
from trustbo.study import run_worlds, worlds, worlds_table
from trustbo.study.table import as_text

REGRET = ("gaussian", "auto", "censored")
LOO = ("gaussian", "censored", "beta_binomial", "student_t")
TERRAINS = ("synthetic-0", "synthetic-1", "synthetic-2", "wellington", "tahoe", "bcts",
            "topography", "synthetic-0-wall", "tahoe-wall")  # fmt: skip
HARDER = ("wellington", "tahoe-aged", "synthetic-0-aged", "bcts-low", "tahoe-wall",
          "synthetic-1")  # fmt: skip


def main():
    parser = arguments(
        __doc__, names=("regret", "loo"), data=True, out="out/families", quick="one synthetic world"
    )
    parser.add_argument("--families", nargs="*")
    parser.add_argument("--worlds", nargs="*")
    parser.add_argument("--courses", nargs="*", default=["sw-ne", "n-s"])
    parser.add_argument("--executor", default="loky")
    given = parsed(parser)
    if given.quick:
        given.worlds, given.courses = ["synthetic-0"], ["sw-ne"]
    for name in given.names:
        {"regret": regret, "loo": loo}[name](given)


def regret(given):
    models = [
        PooledTrust(observation=family, place=PlaceEffect()) for family in given.families or REGRET
    ]
    results = run_worlds(
        given.out, data=given.data, only=given.worlds or HARDER, courses=given.courses,
        models=models, baselines=(), sampler="auto", executor=given.executor,
    )  # fmt: skip
    print(as_text(worlds_table(results)))
    seconds = results["seconds_fit"].groupby("method").median(...)
    print("\nmedian seconds of a fit\n")
    for name, value in zip(seconds["method"].values, seconds.values, strict=True):
        print(f"{name}: {value:.2f}")


def loo(given):
    families = given.families or LOO
    total = dict.fromkeys(families, 0.0)
    table = Table("world", "0 or 1", *families)
    for name in given.worlds or TERRAINS:
        missions = driven(worlds(given.data)[name])
        rates = np.concatenate([m.contact_rate.ravel() for m in missions])
        piled = np.mean((rates[~np.isnan(rates)] % 1.0) == 0.0)
        outcomes = {family: density(missions, family) for family in families}
        best = max(outcomes.values())
        total = {family: total[family] + outcomes[family] - best for family in families}
        table.row(name, f"{piled:.0%}", *(f"{outcomes[family] - best:.0f}" for family in families))
    table.row("all", "", *(f"{total[family]:.0f}" for family in families))


def driven(world, n=15):
    """Missions along random paths through a world."""
    workspace = world.workspace()
    options = {"policy": "random", "max_bounds": "shortest+4", "sampler": "exact"}
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
