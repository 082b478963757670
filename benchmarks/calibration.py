"""Measure how certain fitted models are, and how certain they should be.

    python benchmarks/calibration.py --data DIR --csv out/calibration.csv
    python benchmarks/calibration.py --paths --data DIR               # drive the paths anew

The data do not depend on the model. In each world and on two courses, ten missions follow the paths
that a default campaign took. These paths, with the sets of posts, and the seeds of their simulation
are stored in reference/calibration_paths.csv. Each model is fitted to the ten missions. Its trust
in each robot, with the robots' effects in the next mission drawn, and its predicted rates are
compared with simulated rates of the next mission:

- driven: 24 replicates of the path of the last mission.
- undriven: 8 replicates of each of six random paths, only bounds that are on none of the ten paths,
  watched from any set of posts.

A true rate is the mean over the replicates that complete the bound, at least half of them. It has a
Monte Carlo error of its own, which is not removed. `trust50` and `trust90` are the shares of true
rates in central intervals of trust, which is limited to [0, 1]. `rate50` and `rate90` are the
shares of single rates in intervals of predicted rates, rounded to ticks. `score` is the mean log
probability of the ticks of single rates, in nats. `error`, `bias` (median of trust minus truth) and
`width` (of the 90 % interval) are of trust. `poor_bias` is the bias in the robot that is worse than
assumed. Strata are by true rate. The mean of a world is over all its rates on both courses, and the
other means are over worlds; worlds with fewer than ten rates in a stratum are left out.

Before any mission, `prior_in_range` is the share of prior predictive rates along the first planned
path that lie in [0, 1]. `plan90` states whether the 90 % band of the first plan's value holds the
contact lost in replicates of its path, and `plan_width` is the width of the band, in bounds.

Intervals of differences between models are those of a t test clustered by terrain.

Simulated missions are kept in --out, so later runs only fit. Delete this folder if a simulator, a
workspace or the stored paths have changed.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import ALIKE, interval, over_worlds
from scipy.special import ndtr
from world_set import World, available

import trustbo as tb
from trustbo.data import Station
from trustbo.files import write_text
from trustbo.models.draws import Draws
from trustbo.planning.recursion import trust_recursion
from trustbo.workspace.moves import MOVE_NAMES, MOVES, bounds_along, moves_along

MODELS: dict[str, Callable[[], Any]] = {
    "default": tb.models.default_model,
    "without effects": tb.models.PooledTrust,
}
"""Makes the models that are compared; the second one has the features of the first alone."""
WORLDS = (
    "synthetic-1", "wellington", "topography", "synthetic-0-wall", "bcts-bare",
    "synthetic-0-aged", "bcts-aged", "tahoe-aged",
    "wellington-dense", "synthetic-2-thin", "topography-low", "synthetic-alder-thin-canopy",
    "tahoe-slopes", "wellington-one-poor", "synthetic-1-one-poor", "synthetic-alder-one-poor",
    "tahoe-unlike", "synthetic-0-rain", "synthetic-2-dust", "synthetic-2-foul",
    "bcts-dead-detector", "synthetic-1-felled", "wellington-leaf-fall",
    "synthetic-birch-jammer", "wellington-jammer-appears", "synthetic-1-radio",
    "tahoe-12x7", "synthetic-cedar-20x20", "synthetic-2-team-of-2", "synthetic-cedar-team-of-5",
    "tahoe-limit-4",
)  # fmt: skip
SMALL = ("synthetic-1", "wellington-one-poor")
"""Worlds of --quick, which need no data."""
COURSES = ("sw-ne", "nw-se")
MISSIONS = 10
"""Number of missions to which models are fitted; those of held-out data have this number."""
PATHS = Path(__file__).parent / "reference" / "calibration_paths.csv"
N_RANDOM = 6
N_OF_RANDOM = 8
"""Number of replicates of each random path."""
N_OF_PLANNED = 24
"""Number of replicates of the path of the last mission, and of the first plan."""
SEEDS = {"driven": 1_000, "first": 2_000, "random": 3_000}
"""Seeds of the first replicate of each kind of held-out data."""
N_TICKS = 60.0
"""Number of ticks of a rate in worlds that do not count them."""
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles at the ends of the 90 and 50 % intervals, and the median."""
STRATA = ("all", "exactly 1", ".97 to 1", "below .97")
LEAST = 10
"""Smallest number of rates of a world in a stratum."""
LABELS = ["world", "kind", "course", "model", "set", "stratum"]
OF_TRUST = ["trust50", "trust90", "rate50", "rate90", "score", "error", "bias", "width",
            "poor_bias"]  # fmt: skip
OF_PRIOR = ["prior_in_range", "plan90", "plan_width"]
MEASURES = [*OF_TRUST, *OF_PRIOR]
NOWHERE = np.full((1, 3), -1)
"""Bounds of a model whose noise does not depend on where they are."""
FIRST = "first plan"
"""Name of the set of measures before any mission."""


class HeldOut(NamedTuple):
    """Replicates of paths in the next mission.

    Attributes:
        bounds: Moves, rows and columns, shape (bound, 3).
        rates: Contact rates, shape (replicate, bound, robot); NaN where a bound is not completed.
        n_ticks: Number of ticks of each rate, with the same shape.
    """

    bounds: np.ndarray
    rates: np.ndarray
    n_ticks: np.ndarray


class Data(NamedTuple):
    """Missions of a world and course to which models are fitted, and held-out data by set."""

    missions: list[tb.Mission]
    sets: dict[str, HeldOut]


def main() -> None:
    parser = arguments(
        __doc__ or "", data=True, out="out/calibration", quick="two small worlds, one course"
    )
    parser.add_argument("--csv", type=Path, help="CSV file for the rows")
    parser.add_argument("--paths", action="store_true", help="compute the stored paths anew")
    given = parsed(parser)

    courses = COURSES[:1] if given.quick else COURSES
    every = available(given.data)
    chosen = [every[name] for name in (SMALL if given.quick else WORLDS) if name in every]
    if given.paths:
        store_paths(chosen, courses)
        return

    rows = measure(chosen, courses, MODELS, given.out)
    if given.csv is not None:
        write_text(given.csv, rows.round(4).to_csv(index=False))
    report(rows)


def rows_in(file: Path) -> pd.DataFrame:
    """Return stored rows."""
    return pd.read_csv(file, dtype={"stratum": str})


# --- paths ---


def store_paths(chosen: Sequence[World], courses: Sequence[str]) -> None:
    """Run the campaigns, and write the paths and seeds of their missions and of random paths."""
    rows = []
    for world in chosen:
        for course in courses:
            show(f"{world.name}, {course}")
            rows += paths_of(world, course)
    pd.DataFrame(rows).to_csv(PATHS, index=False)


def paths_of(world: World, course: str) -> list[dict[str, Any]]:
    """Run the default campaign of a world and course; return the rows of its paths."""
    workspace = world.campaign_workspace()
    simulator = world.simulator(workspace)
    campaign = tb.Campaign(workspace, *world.ends(course), seed=0)
    rng = np.random.default_rng(0)
    random = [
        tb.planning.policies.random(rng, campaign.belief, campaign.planner).stations
        for _ in range(N_RANDOM)
    ]

    for _ in campaign.run(simulator, MISSIONS):
        pass
    driven = [
        (str(j), campaign.state.seed_of("mission", j), mission.stations)
        for j, mission in enumerate(campaign.missions)
    ]
    others = [(f"random-{k}", SEEDS["random"] + 100 * k, path) for k, path in enumerate(random)]

    labels = {"world": world.name, "course": course}
    return [
        {**labels, "mission": name, "seed": seed, "path": text_of(path)}
        for name, seed, path in (*driven, *others)
    ]


def text_of(path: Sequence[Station]) -> str:
    """Write a path as its first cell, directions, and sets of posts, such as "9,0 n ne@far".

    The first set of posts has no name.
    """
    row, col = path[0][:2]
    names = [MOVE_NAMES[move] for move in moves_along(path)]
    sets = ["".join(f"@{name}" for name in station[2:]) for station in path[:-1]]
    return " ".join([f"{row},{col}", *map(str.__add__, names, sets)])


def path_of(text: str) -> list[Station]:
    """Read a path that `text_of` wrote."""
    first, *steps = text.split()
    row, col = map(int, first.split(","))
    found: list[Station] = []
    for step in steps:
        name, _, posts = step.partition("@")
        found.append((row, col, posts) if posts else (row, col))
        down, right = MOVES[MOVE_NAMES.index(name)]
        row, col = row + down, col + right
    return [*found, (row, col)]


# --- simulated data ---


def data_of(world: World, course: str, folder: Path) -> Data:
    """Simulate the missions and the held-out data of a world and course, or read them."""
    file = folder / f"{world.name}~{course}.pkl"
    if file.exists():
        missions, sets = joblib.load(file)
        return Data(missions, {name: HeldOut(*arrays) for name, arrays in sets.items()})

    stored = pd.read_csv(PATHS)
    stored = stored[(stored["world"] == world.name) & (stored["course"] == course)]
    paths = {
        name: path_of(text) for name, text in zip(stored["mission"], stored["path"], strict=True)
    }
    seeds = dict(zip(stored["mission"], stored["seed"], strict=True))

    simulator = world.simulator(world.campaign_workspace())
    missions = [
        without_ticks(simulator.run(paths[f"{j}"], seed=int(seeds[f"{j}"]), mission=j))
        for j in range(MISSIONS)
    ]
    driven = {tuple(b) for m in missions for b in bounds_along(m.driven_stations)}
    planned = {bound for mission in missions for bound in moves_of(bounds_along(mission.path))}

    last = replicates(simulator, missions[-1].stations, N_OF_PLANNED, SEEDS["driven"], MISSIONS)
    random = [
        replicates(simulator, path, N_OF_RANDOM, int(seeds[name]), MISSIONS)
        for name, path in paths.items()
        if name.startswith("random")
    ]
    undriven = HeldOut(
        np.concatenate([one.bounds for one in random]),
        np.concatenate([one.rates for one in random], axis=1),
        np.concatenate([one.n_ticks for one in random], axis=1),
    )
    sets = {
        "driven": selected(last, [tuple(bound) in driven for bound in last.bounds]),
        "undriven": selected(
            undriven, [bound not in planned for bound in moves_of(undriven.bounds)]
        ),
    }
    folder.mkdir(parents=True, exist_ok=True)
    # Plain tuples can be read by any process; classes of a script belong to `__main__`.
    joblib.dump((missions, {name: tuple(arrays) for name, arrays in sets.items()}), file)
    return Data(missions, sets)


def moves_of(bounds: np.ndarray) -> list[tuple[int, ...]]:
    """Return the moves, rows and columns of bounds, from whichever set of posts."""
    return [(int(way) % len(MOVES), int(row), int(col)) for way, row, col in bounds]


def without_ticks(mission: tb.Mission) -> tb.Mission:
    """Leave out what no model is fitted to, which would need most of the disk space."""
    return replace(mission, poses=(), contact=())


def replicates(simulator: Any, path: Sequence[Station], n: int, seed: int, mission: int) -> HeldOut:
    """Simulate a path n times."""
    bounds = bounds_along(path)
    shape = (n, len(bounds), len(simulator.workspace.team.names))
    rates = np.full(shape, np.nan)
    n_ticks = np.full(shape, N_TICKS)
    for i in range(n):
        run = simulator.run(path, seed=seed + i, mission=mission)
        done = np.flatnonzero(np.array(run.bound_status) == "ok")
        rates[i, done] = run.contact_rate[done]
        n_ticks[i, done] = np.where(np.isnan(run.n_ticks[done]), N_TICKS, run.n_ticks[done])
    return HeldOut(bounds, rates, n_ticks)


def selected(data: HeldOut, where: Sequence[bool]) -> HeldOut:
    """Select the bounds where a mask is true, of those that at least half of the runs complete."""
    n_done = np.isfinite(data.rates).all(2).sum(0)
    kept = np.array(where, bool) & (n_done >= len(data.rates) / 2)
    return HeldOut(data.bounds[kept], data.rates[:, kept], data.n_ticks[:, kept])


def lost_on(world: World, course: str, path: Sequence[Station], folder: Path) -> float:
    """Return the mean contact lost on a path in the first mission, in bounds, if no bound fails."""
    file = folder / f"{world.name}~{course}~first.pkl"
    known = joblib.load(file) if file.exists() else {}
    text = text_of(path)
    if text not in known:
        simulator = world.simulator(world.campaign_workspace())
        runs = replicates(simulator, path, N_OF_PLANNED, SEEDS["first"], 0)
        n_done = np.isfinite(runs.rates).sum(0)
        mean = np.nansum(runs.rates, axis=0) / np.where(n_done, n_done, np.nan)
        known[text] = float((1.0 - mean.mean(1)).sum())
        joblib.dump(known, file)
    return known[text]


# --- models ---


def measure(
    chosen: Sequence[World], courses: Sequence[str], models: Mapping[str, Any], folder: Path
) -> pd.DataFrame:
    """Return the rows of all worlds, courses, models, sets and strata."""
    rows = []
    seconds = 0.0
    for world in chosen:
        for course in courses:
            data = data_of(world, course, folder)
            world.campaign_workspace()  # is kept, and not part of the time of fits
            for name, make in models.items():
                model = make()
                started = time.process_time()
                found = [
                    *rows_of_fit(world, data, model),
                    *rows_before(world, course, model, folder),
                ]
                seconds += time.process_time() - started

                labels = {"world": world.name, "kind": world.kind, "course": course, "model": name}
                rows += [labels | row for row in found]
            show(f"{world.name}, {course}: {seconds:.0f} s of CPU time for fits so far")
    return pd.DataFrame(rows).reindex(columns=[*LABELS, "n", *MEASURES])


def rows_of_fit(world: World, data: Data, model: Any) -> list[dict[str, Any]]:
    """Fit a model, and return its rows for each set and stratum."""
    workspace = world.campaign_workspace()
    posterior = tb.fit(
        data.missions, model, workspace=workspace, seed=1, latent=False, progress=False
    )
    draws = tb.inference.params_of(posterior, workspace, next_mission=True)

    rows = []
    for name, held_out in data.sets.items():
        if not len(held_out.bounds):
            continue
        awareness = workspace.awareness.values[:, *held_out.bounds.T]
        trust = trust_of(draws, awareness, held_out.bounds)
        truth, measures = compare(trust, noise_of(draws, awareness), held_out)

        is_poor = np.zeros(truth.shape, bool)
        is_poor[:, poor_robots(world)] = name == "driven"
        measures["poor_bias"] = np.where(is_poor, measures["bias"], np.nan)
        rows += [{"set": name} | row for row in in_strata(truth, measures)]
    return rows


def trust_of(draws: Draws, awareness: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return stationary trust (draw, robot, bound), as `Planner.trust` does for all cells."""
    return trust_recursion(draws, awareness, bounds=bounds, by_robot=True).steady_states()


def noise_of(draws: Draws, awareness: np.ndarray) -> np.ndarray:
    """Return the sd of a rate given expected trust, shape (draw, robot or 1, bound or 1)."""
    space = draws.state_space(len(awareness))
    process = np.diagonal(space.process_cov, axis1=-2, axis2=-1)
    n = draws.n_draws
    own = space.rate_sd.reshape(n, -1, 1) * draws.noise_scale(awareness, NOWHERE)
    return np.sqrt(own**2 + process.reshape(n, -1, 1))


def poor_robots(world: World) -> list[int]:
    """Return the indices of the robots that are worse than assumed in a world with one of them."""
    if world.case != "one-poor" or world.assumed_team is None:
        return []
    pairs = zip(world.team.robots, world.assumed_team.robots, strict=True)
    return [i for i, (true, assumed) in enumerate(pairs) if true != assumed]


def rows_before(world: World, course: str, model: Any, folder: Path) -> list[dict[str, Any]]:
    """Return the row of measures before any mission."""
    workspace = world.campaign_workspace()
    campaign = tb.Campaign(workspace, *world.ends(course), model=model, seed=0)
    plan = campaign.ask()
    lost = lost_on(world, course, plan.stations, folder)
    low, high = plan.value_band or (np.nan, np.nan)

    awareness = workspace.along(plan.stations)
    trust = tb.planning.expected_trust(campaign.forecast, awareness, path=plan.stations)
    trust = np.swapaxes(trust, 1, 2)  # (draw, robot, bound)
    sd = noise_of(campaign.forecast, np.swapaxes(awareness, 0, 1))
    rates = trust + sd * np.random.default_rng(0).standard_normal(trust.shape)
    row = {
        "prior_in_range": float(np.mean((rates >= 0.0) & (rates <= 1.0))),
        "plan90": np.nan if np.isnan(lost) else float(low <= -lost <= high),
        "plan_width": high - low,
    }
    return [{"set": FIRST, "stratum": "all", "n": trust[0].size} | row]


# --- measures ---


def compare(
    trust: np.ndarray, sd: np.ndarray, data: HeldOut
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Compare trust (draw, robot, bound) and the noise sd of rates with held-out data.

    Returns:
        True rates (bound, robot), and the measures by name, with the same shape.
    """
    trust = np.swapaxes(trust, 1, 2)
    sd = np.swapaxes(np.broadcast_to(sd, (len(trust), *sd.shape[1:])), 1, 2)
    y = data.rates
    n = data.n_ticks
    truth = np.nanmean(y, axis=0)

    noise = np.random.default_rng(1).standard_normal(trust.shape)
    low90, low50, middle, high50, high90 = np.quantile(np.clip(trust, 0.0, 1.0), LEVELS, axis=0)
    ends = np.quantile(np.clip(trust + sd * noise, 0.0, 1.0), LEVELS, axis=0)
    score = tick_score(trust, sd, y, n)
    measures = {
        "trust50": is_between(truth, low50, high50),
        "trust90": is_between(truth, low90, high90),
        # The interval of the ticks is that of continuous rates, with its ends rounded.
        "rate50": held(y, np.round(ends[1] * n) / n, np.round(ends[3] * n) / n),
        "rate90": held(y, np.round(ends[0] * n) / n, np.round(ends[4] * n) / n),
        "score": np.nanmean(score, axis=0),
        "error": np.abs(middle - truth),
        "bias": middle - truth,
        "width": high90 - low90,
    }
    return truth, measures


def is_between(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return whether values are in an interval, with its ends and what differs by rounding."""
    return (values >= low - 1e-9) & (values <= high + 1e-9)


def held(y: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the share of the replicates (replicate, bound, robot) that are in an interval."""
    inside = np.where(np.isnan(y), np.nan, is_between(y, low, high))
    return np.nanmean(inside, axis=0)


def tick_score(trust: np.ndarray, sd: np.ndarray, y: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the log probability of rates y of n ticks, shape (replicate, bound, robot).

    The rate is rounded to ticks, and limited to [0, 1]. Its distribution is a mixture of normals
    over draws. Probabilities below 1e-12 count as 1e-12.

    Args:
        trust: Expected trust, shape (draw, bound, robot).
        sd: Noise sd of a rate, shape (draw, bound or 1, robot or 1).
        y: Contact rates, shape (replicate, bound, robot); NaN where there is none.
        n: Number of ticks, with the same shape.
    """
    sd = np.maximum(sd, 1e-6)
    low = np.where(y - 0.5 / n <= 0.0, -np.inf, y - 0.5 / n)
    high = np.where(y + 0.5 / n >= 1.0, np.inf, y + 0.5 / n)
    p = [
        (ndtr((one_high - trust) / sd) - ndtr((one_low - trust) / sd)).mean(0)
        for one_low, one_high in zip(low, high, strict=True)
    ]
    return np.log(np.maximum(p, 1e-12))


def in_strata(truth: np.ndarray, measures: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Average measures (bound, robot) over the rates of each stratum."""
    masks = (
        np.full(truth.shape, True),
        truth == 1.0,
        (truth >= 0.97) & (truth < 1.0),
        truth < 0.97,
    )
    rows = []
    for stratum, mask in zip(STRATA, masks, strict=True):
        if not mask.any():
            continue
        means = {}
        for name, values in measures.items():
            known = values[mask & np.isfinite(values)]
            means[name] = float(known.mean()) if known.size else np.nan
        rows.append({"stratum": stratum, "n": int(mask.sum()), **means})
    return rows


# --- tables ---


def by_world(rows: pd.DataFrame) -> pd.DataFrame:
    """Average over courses, weighted by the number of rates.

    Worlds with few rates in a stratum are left out of it.
    """
    group_of = {kind: group for group, kinds in ALIKE.items() for kind in kinds}
    keys = ["model", "set", "stratum", "group", "world"]
    rows = rows.assign(group=rows["kind"].map(group_of))
    values = rows[MEASURES].astype(float)
    weights = values.notna().mul(rows["n"], axis=0)

    labels = [rows[key] for key in keys]
    totals = weights.groupby(labels, sort=False).sum()
    means = (values * weights).groupby(labels, sort=False).sum() / totals.where(totals > 0)
    means = means.assign(n=rows.groupby(keys, sort=False)["n"].sum()).reset_index()
    return means[(means["stratum"] == "all") | (means["n"] >= LEAST)]


def report(rows: pd.DataFrame) -> None:
    """Print Markdown tables of means over worlds, and of paired differences between models."""
    found = by_world(rows)
    models = list(dict.fromkeys(rows["model"]))
    learned = found[found["set"] != FIRST]

    print("\n**After ten missions**, by true rate\n")
    rank = learned["stratum"].map(STRATA.index)
    in_order = learned.assign(rank=rank).sort_values(["set", "rank"], kind="stable")
    print_means(in_order, ["set", "stratum"], models)
    for name, some in learned[learned["stratum"] == "all"].groupby("set", sort=False):
        print(f"\n**{name}**, by group of kinds\n")
        print_means(some, ["group"], models)

    before = found[found["set"] == FIRST]
    print("\n**Before any mission**: prior predictive rates, and the first plan's band\n")
    table = Table("group", "model", "worlds", *OF_PRIOR)
    for group in ("all", *ALIKE):
        for model in models:
            some = before[
                (before["model"] == model) & ((before["group"] == group) | (group == "all"))
            ]
            if len(some):
                means = some[OF_PRIOR].mean()
                table.row(group, model, len(some), *(f"{mean:.3f}" for mean in means))

    first, *others = models
    for model in others:
        print(f"\n**{first} minus {model}**, same worlds\n")
        print_differences(learned, first, model)


def print_means(found: pd.DataFrame, by: list[str], models: Sequence[str]) -> None:
    """Print the means over worlds of each model by the given columns."""
    table = Table(*by, "model", "worlds", "rates", *OF_TRUST)
    for key, of_key in found.groupby(by, sort=False):
        for model in models:
            some = of_key[of_key["model"] == model]
            if len(some):
                cells = [number(name, some[name].mean()) for name in OF_TRUST]
                table.row(*key, model, len(some), some["n"].sum(), *cells)


def print_differences(found: pd.DataFrame, first: str, second: str) -> None:
    """Print the means over worlds of one model minus another, by set and by stratum or group."""
    names = [name for name in OF_TRUST if name != "poor_bias"]
    table = Table("set", "rates", "worlds", *names)
    keys = ["set", "stratum", "group", "world"]
    pair = [found[found["model"] == model].set_index(keys)[names] for model in (first, second)]
    less = (pair[0] - pair[1]).dropna().reset_index()

    parts = {stratum: less[less["stratum"] == stratum] for stratum in STRATA}
    whole = parts["all"]
    parts |= {group: whole[whole["group"] == group] for group in ALIKE}
    for name in dict.fromkeys(less["set"]):
        for part, every in parts.items():
            some = every[every["set"] == name]
            if some.empty:
                continue
            cells = []
            for measure in names:
                *ends, _ = over_worlds(some[measure].to_numpy(), some["world"])
                cells.append(interval(*ends))
            table.row(name, part, len(some), *cells)


def number(name: str, value: float) -> str:
    """Format the mean of a measure; "-" stands for what does not exist."""
    if np.isnan(value):
        return "-"
    return f"{value:z.2f}" if name[-2:] in ("50", "90") or name == "score" else f"{value:z.4f}"


def show(text: str) -> None:
    """Print progress, apart from the tables."""
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
