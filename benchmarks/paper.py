"""Test the claims of the paper with the paper's own method; prints docs/evidence/paper.md.

    python benchmarks/paper.py worlds --data DIR
    python benchmarks/paper.py worlds --model coupled --kind right
    python benchmarks/paper.py priors seconds

The paper claims that Bayesian optimisation needs fewer explorations of the workspace and learns the
trust model more efficiently. `worlds` runs campaigns with the settings of `tb.paper` (but with
importance sampling) on simulated worlds. The paths of `greedy` are the best ones under the
posterior mean, for the cost (6) or for the mean trust. The paths of `random` do not depend on what
was learned. `prior only` repeats the first path, which is the best one under a draw of the prior.
Each campaign writes a file to --out and is skipped if its file exists.

`priors` prints the fraction of prior-predictive contact rates in [0, 1]. `seconds` prints the CPU
time of the paper's campaign of eight missions with NUTS.
"""

import time
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import interval, over_worlds
from world_set import COURSES, World, available, drawn

import trustbo as tb
from trustbo.campaign.choose import informed_planner
from trustbo.planning import Planner

OBJECTIVES = {"(6)": "terminal", "mean": "mean"}
"""Objective of paths, keyed by its short name."""
MODELS = {
    "pooled": tb.models.PooledTrust(tb.models.Priors.for_cells()),
    "coupled": tb.models.CoupledTrust(tb.models.Priors.for_cells()),
}
"""Equations (3)-(4) and (1)-(2)."""
NEAR = 5.0
"""Regret in % up to which a path is good enough."""
MISSIONS = 8
MAX_BOUNDS = "shortest+4"
"""Paths among which the best one is looked for, the default of campaigns."""
TERRAIN = {"size": (500.0, 500.0), "resolution": 1.0, "seed": 2}
"""Terrain of the notebook of the paper."""
START, GOAL = (9, 0), (0, 9)
"""Ends of the paths of the notebook."""


def main() -> None:
    names = ("worlds", "priors", "seconds")
    parser = arguments(__doc__, data=True, names=names, out="out/paper")
    parser.add_argument("--model", choices=MODELS, default="pooled", help="default pooled")
    parser.add_argument("--kind", action="append", help="kind of worlds (default all)")
    parser.add_argument("--world", action="append", help="world (default all)")
    parser.add_argument("--course", action="append", choices=COURSES, help="default sw-ne")
    parser.add_argument("--missions", type=int, default=MISSIONS, help=f"default {MISSIONS}")
    parser.add_argument("--csv", type=Path, help="CSV file for the results of each campaign")
    given = parsed(parser)

    if "priors" in given.names:
        print_priors()
    if "seconds" in given.names:
        print_seconds()
    if "worlds" in given.names:
        rows = run_worlds(given)
        numbers = summarised(rows, given.missions)
        if given.csv is not None:
            numbers.round(4).to_csv(given.csv, index=False)
        report(numbers, given.missions)


# --- worlds ---


def run_worlds(given: Any) -> pd.DataFrame:
    """Run or read the campaigns of all chosen worlds and courses; return a row for each mission."""
    chosen = [
        world
        for world in available(given.data).values()
        if (given.kind is None or world.kind in given.kind)
        and (given.world is None or world.name in given.world)
    ]

    tables = []
    for course in given.course or COURSES[:1]:
        for world in chosen:
            for driver in ("greedy, (6)", "greedy, mean", "random"):
                name = f"{given.model}~{world.name}~{course}~{driver}~{given.missions}.csv"
                file = given.out / name.replace(", ", "-")
                if not file.exists():
                    rows = run_campaign(world, course, driver, given)
                    file.parent.mkdir(parents=True, exist_ok=True)
                    pd.DataFrame(rows).to_csv(file, index=False)
                    print(f"{file.name} is done", flush=True)
                tables.append(pd.read_csv(file))
    return pd.concat(tables, ignore_index=True)


def cells_of(world: World) -> tb.Workspace:
    """Return the assumed workspace of a world with the paper's awareness, that of cells."""
    usual = world.workspace()
    return tb.Workspace.from_terrain(
        usual.terrain, world.shape, usual.team, sight=usual.sight, **tb.paper.WORKSPACE
    )


def run_campaign(world: World, course: str, driver: str, given: Any) -> list[dict[str, Any]]:
    """Run a campaign, and return rows that describe it before and after each mission.

    The random paths are the same for both objectives, so one campaign has rows of both.
    """
    policy, _, objective = driver.partition(", ")
    judged = [objective] if objective else list(OBJECTIVES)
    workspace = cells_of(world)
    ends = world.ends(course)
    truth = world.truth(given.out / "truths")
    simulator = world.simulator(workspace)

    # The seed is that of the scene, so all methods share the draw of the prior.
    seed = int(drawn(f"{world.name} {course}", "paper").integers(2**31))
    settings = {
        **tb.paper.CAMPAIGN,
        "model": MODELS[given.model],
        "sampler": "importance",
        "awareness": "map",  # the simulators of the worlds measure no awareness
        "policy": policy,
        "objective": OBJECTIVES[judged[0]],
        "seed": seed,
    }
    campaign = tb.Campaign(workspace, *ends, **settings)
    planners = {name: Planner(workspace, *ends, OBJECTIVES[name]) for name in judged}
    labels = {"world": world.name, "kind": world.kind, "course": course}
    first = {}  # the best path under the draw of the prior
    entered: set[tb.data.Cell] = set()
    rows = []

    def add(number: int, seconds: float, **of_mission: float) -> None:
        """Add the rows after `number` missions; the truth is that of the next mission."""
        now = truth.at(number)
        for name, planner in planners.items():
            path = informed_planner(planner, campaign.risk).plan(campaign.belief.mean()).path
            row = {
                **labels,
                "method": f"{policy}, {name}",
                "mission": number,
                "regret": now.regret(path, MAX_BOUNDS),
                "n_cells": len(entered),
                "sd": sd_of_weights(campaign),
                "seconds": seconds,
            }
            rows.append(row | of_mission)

            first.setdefault(name, path)
            if policy == "greedy":
                same = {"regret": now.regret(first[name], MAX_BOUNDS)}
                if number:
                    before = truth.at(number - 1)
                    same["lost"] = lost_more(before, first[name], before.best(*ends, MAX_BOUNDS))
                    same["n_cells"] = len(set(first[name]))
                rows.append({**labels, "method": f"prior only, {name}", "mission": number, **same})

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        add(0, 0.0)
        began = time.process_time()
        for number, (_, mission) in enumerate(campaign.run(simulator, given.missions), start=1):
            seconds = time.process_time() - began
            entered |= set(mission.path)
            world_then = truth.at(number - 1)
            best = world_then.best(*ends, MAX_BOUNDS)
            arrived = float(mission.status == "ok")
            add(number, seconds, lost=lost_more(world_then, mission.path, best), arrived=arrived)
            began = time.process_time()
    return rows


def lost_more(truth: tb.simulation.Truth, path: Any, best: Any) -> float:
    """Return the contact lost on a path minus that on the best one, in bounds, with failures."""
    return truth.lost_or_failed(path) - truth.lost_or_failed(best)


def sd_of_weights(campaign: tb.Campaign) -> float:
    """Return the mean posterior standard deviation of the weights; NaN before any posterior."""
    tree = campaign.state.posterior
    if tree is None:
        return np.nan

    posterior = tree["posterior"].to_dataset()
    sample = [dim for dim in ("chain", "draw") if dim in posterior.dims]
    if "beta" in posterior:
        return float(posterior["beta"].std(sample).mean())

    # In the coupled model, the effect of awareness that is equal for all robots.
    return float(posterior["B"].sum("robot_").std(sample).mean())


def summarised(rows: pd.DataFrame, n_missions: int) -> pd.DataFrame:
    """Return the numbers of each campaign: one row for each world, course and method."""
    numbers = []
    for key, run in rows.groupby(["world", "kind", "course", "method"], sort=False):
        run = run.sort_values("mission").set_index("mission")
        far = np.flatnonzero(~(run["regret"].to_numpy() <= NEAR))
        number = {
            "lost per mission": run["lost"].mean(),
            "regret before": run["regret"][0],
            "regret after": run["regret"][n_missions],
            f"missions to {NEAR:g} %": float(far[-1] + 1) if len(far) else 0.0,
            "cells entered": run["n_cells"][n_missions],
            "sd after 3": run["sd"].get(3, np.nan),
            "sd of weights": run["sd"][n_missions],
            "seconds": run["seconds"].mean(),
        }
        numbers.append(dict(zip(("world", "kind", "course", "method"), key, strict=True)) | number)
    return pd.DataFrame(numbers)


def report(numbers: pd.DataFrame, n_missions: int = MISSIONS) -> None:
    """Print means by method, and paired differences, with intervals of a t test by terrain."""
    n_worlds = numbers["world"].nunique()
    n_scenes = len(numbers[["world", "course"]].drop_duplicates())
    print(f"\n{n_worlds} worlds, {n_scenes} worlds and courses, {n_missions} missions each\n")

    names = list(numbers.columns[4:])
    table = Table("method", *names)
    for method in ("greedy, (6)", "random, (6)", "prior only, (6)",
                   "greedy, mean", "random, mean", "prior only, mean"):  # fmt: skip
        runs = numbers[numbers["method"] == method]
        table.row(method, *(as_text(runs[name], runs["world"]) for name in names))

    print("\npaired differences\n")
    table = Table("difference", *names)
    for objective in OBJECTIVES:
        for other in ("random", "prior only"):
            differences(numbers, f"greedy, {objective}", f"{other}, {objective}", names, table)
    differences(numbers, "greedy, mean", "greedy, (6)", names, table)


def differences(
    numbers: pd.DataFrame, one: str, other: str, names: list[str], table: Table
) -> None:
    """Print the differences of two methods on the same worlds and courses."""
    index = ["world", "course"]
    runs = [numbers[numbers["method"] == name].set_index(index)[names] for name in (one, other)]
    less = (runs[0] - runs[1]).dropna(how="all")
    of_worlds = less.index.get_level_values("world")
    table.row(f"{one} minus {other}", *(as_text(less[name], of_worlds) for name in names))


def as_text(values: pd.Series, of_worlds: Any) -> str:
    """Write the mean of a measure over worlds, with its interval."""
    *ends, _ = over_worlds(values.to_numpy(), of_worlds)
    return interval(*ends)


# --- priors and seconds ---


def notebook_workspace() -> tb.Workspace:
    """Make the workspace of the notebook of the paper."""
    terrain = tb.terrain.synthetic_terrain(
        TERRAIN["size"], TERRAIN["resolution"], seed=TERRAIN["seed"]
    )
    return tb.Workspace.from_terrain(terrain, (10, 10), tb.Team(n_robots=3), **tb.paper.WORKSPACE)


def print_priors(n_draws: int = 2000, n_paths: int = 40) -> None:
    """Print how many prior-predictive contact rates are in [0, 1], and the first trust map."""
    workspace = notebook_workspace()
    table = Table("prior", "rates in [0, 1]", "5 % to 95 % of rates", "first trust map, 5 draws",
                  name="paper_priors")  # fmt: skip
    for name, model in (("default", tb.models.PooledTrust()), ("for_cells", MODELS["pooled"])):
        rates = []
        maps = []
        for seed in range(n_paths):
            settings = {**tb.paper.CAMPAIGN, "model": model, "seed": seed}
            random = {"policy": "random"}
            campaign = tb.Campaign(workspace, START, GOAL, **settings | random)
            path = campaign.ask().path
            draws = campaign.draw_prior(n_draws // n_paths)
            rates.append(rates_of(draws, workspace.along(path), seed))
            if seed < 5:
                shown = campaign.trust_map.values.copy()
                shown[START] = np.nan
                maps.append(f"{np.nanmin(shown):.2f} to {np.nanmax(shown):.2f}")

        values = np.concatenate([each.ravel() for each in rates])
        low, high = np.quantile(values, [0.05, 0.95])
        inside = np.mean((values >= 0.0) & (values <= 1.0))
        table.row(name, f"{inside:.1%}", f"{low:.2f} to {high:.2f}", "; ".join(maps))


def rates_of(draws: Any, awareness: np.ndarray, seed: int) -> np.ndarray:
    """Draw contact rates by equations (3) and (4), which do not limit them to [0, 1]."""
    rng = np.random.default_rng(seed)
    n_draws = len(draws.beta0)
    n_robots = awareness.shape[1]
    rates = np.empty((n_draws, *awareness.shape[:2]))  # (draw, bound, robot)
    x = rng.normal(draws.x0_mean[:, None], draws.x0_sd[:, None], (n_draws, n_robots))
    for k, z in enumerate(awareness):
        w = draws.delta_w[:, None] * rng.standard_normal(x.shape)
        v = draws.delta_v[:, None] * rng.standard_normal(x.shape)
        x = draws.beta0[:, None] * x + draws.beta @ z.T + draws.b[:, None] + w
        rates[:, k] = x + v
    return rates


def print_seconds(n_missions: int = 8) -> None:
    """Print the CPU time of the campaign of the paper with NUTS, and without compilation.

    Each fit compiles a program of its own. The second campaign is the same as the first one, and
    finds its programs in JAX's cache of compiled programs.
    """
    workspace = notebook_workspace()
    table = Table("campaign of eight missions with NUTS", "CPU time", "wall time",
                  name="paper_seconds")  # fmt: skip
    with TemporaryDirectory() as cache:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        for name in ("with compilation", "compiled programs from the cache"):
            cpu = time.process_time()
            wall = time.perf_counter()
            tb.iterate(
                workspace,
                START,
                GOAL,
                n_iterations=n_missions,
                progress=False,
                **tb.paper.CAMPAIGN,
            )
            seconds = time.process_time() - cpu
            elapsed = time.perf_counter() - wall
            table.row(name, f"{seconds:.1f} s", f"{elapsed:.1f} s")


if __name__ == "__main__":
    main()
