"""Compare predicted and true arrivals of first plans under priors of the hazard.

    python benchmarks/arrivals.py --data DIR --csv out/arrivals.csv --picture out/arrivals.png
    python benchmarks/arrivals.py --rows benchmarks/reference/arrivals.csv

In each world, first plans are made on the first five courses of each set of `patrols.py`, before
any mission. The probability that a plan arrives is predicted by the prior of the hazard. The true
one is that of the truth of the world. The excess is the expected contact lost, failures counted,
minus that of the best path, in bounds.

The prior for a limit from a data sheet, the default, was calibrated on the synthetic terrains with
a wrong slope limit. The tables show those on other terrains apart.
"""

import sys
import warnings
from argparse import Namespace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import clustered, grounds_of
from joblib import Parallel, delayed, parallel_config
from patrols import PLANNER, courses, ground_of
from threadpoolctl import threadpool_limits
from world_set import World, worlds

import trustbo as tb
from trustbo.files import write_text
from trustbo.hazard import BoundRisk, Hazard, fit_hazard

SETS = (0, 1, 2)
COURSES = 5
"""Number of courses of each set."""
BEFORE = Hazard(limit=(0.1, 4.0), log_width=(-1.2, 0.5))
"""Prior of version 0.6."""
CASES: dict[str, tuple[Hazard, bool]] = {
    "data sheet": (Hazard(), True),
    "measured": (Hazard(limit="measured"), True),
    "guessed": (Hazard(limit="guessed"), True),
    "prior of 0.6": (BEFORE, True),
    "0.6, failures are free": (BEFORE, False),
}
"""Prior of the hazard, and whether a failure costs the bounds of a shortest path."""
_BINS = (0.0, 0.6, 0.75, 0.85, 0.9, 0.95, 0.98, 1.0)
"""Bins of predicted arrivals in the reliability curve."""
_DECIMALS = 5


def run_world(world: World, truths: Path | None) -> list[dict[str, Any]]:
    """Plan all courses of a world in all cases; return a row for each plan."""
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore")  # of bounds without contact
        ground = ground_of(world, truths)
        workspace, truth = ground.workspace, ground.truth.at(0)
        campaign = tb.Campaign(workspace, planner=PLANNER, progress=False)
        belief = campaign.belief.mean()
        risks = {
            name: BoundRisk(fit_hazard([], workspace, hazard), workspace)
            for name, (hazard, _) in CASES.items()
        }

        rows = []
        labels = {"world": world.name, "kind": world.kind, "case": world.case}
        for which in SETS:
            for number, ends in enumerate(courses(ground, which, COURSES)):
                best = truth.best(*ends, max_bounds=PLANNER["max_bounds"], failures=True)
                planner = tb.Planner(workspace, *ends, **PLANNER)
                free = planner.with_failure_cost(0.0)
                for name, risk in risks.items():
                    priced = CASES[name][1]
                    plan = (planner if priced else free).with_risk(risk).plan(belief)
                    rows.append({
                        **labels, "set": which, "course": number, "prior": name,
                        "predicted": plan.p_arrive, "arrives": truth.p_arrive(plan.path),
                        "best_arrives": truth.p_arrive(best),
                        "excess": truth.lost_or_failed(plan.path) - truth.lost_or_failed(best),
                    })  # fmt: skip
    print(world.name, file=sys.stderr, flush=True)
    return rows


def run(given: Namespace) -> pd.DataFrame:
    """Plan in all worlds for which there are data; return all rows."""
    some = [world for world in worlds(given.data).values() if given.data or world.is_packaged]
    if given.quick:
        some = some[:2]
    with parallel_config("loky", inner_max_num_threads=1):
        found = Parallel(given.jobs)(delayed(run_world)(world, given.truths) for world in some)
    return pd.DataFrame([row for rows in found for row in rows]).round(_DECIMALS)


# --- tables ---


def means_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Average plans by world and prior.

    The columns are world, kind, case, prior, `predicted`, `arrives`, `best_arrives`, `excess`,
    `brier` (expectation of (predicted - arrived)^2 over missions), and `first_arrives` and
    `first_best` of the first courses.
    """
    rows = rows.dropna(subset=["predicted", "arrives", "excess"])
    error = rows["predicted"] - rows["arrives"]
    rows = rows.assign(brier=error**2 + rows["arrives"] * (1.0 - rows["arrives"]))
    by = ["world", "kind", "case", "prior"]
    columns = ["predicted", "arrives", "best_arrives", "excess", "brier"]
    means = rows.groupby(by, sort=False)[columns].mean()
    first = rows[rows["course"] == 0].groupby(by, sort=False)
    means[["first_arrives", "first_best"]] = first[["arrives", "best_arrives"]].mean()
    return means.round(_DECIMALS).reset_index()


def groups_of(rows: pd.DataFrame) -> dict[str, pd.Series]:
    """Return for each group which rows belong to it."""
    wrong, low = rows["kind"] == "limit", rows["case"].str.contains("low")
    steep, ours = rows["kind"] == "slopes", rows["world"].str.startswith("synthetic")
    groups = {
        "limit right": ~wrong & ~steep,
        "limit right, steep ground": steep,
        "limit too low": wrong & low,
        "limit too high": wrong & ~low,
        "limit too high, calibration": wrong & ~low & ours,
        "limit too high, other terrains": wrong & ~low & ~ours,
    }
    return {name: chosen for name, chosen in groups.items() if chosen.any()}


def report(means: pd.DataFrame) -> None:
    """Print means by group and prior, with the 95 % interval of the predictions' errors."""
    table = Table(
        "group (worlds)", "prior", "predicted", "arrive", "predicted - arrive [95 %]", "Brier",
        "first courses arrive", "excess",
    )  # fmt: skip
    for group, chosen in groups_of(means).items():
        own = means[chosen]
        name = f"{group} ({own['world'].nunique()})"
        for prior in CASES:
            some = own[own["prior"] == prior]
            error = some["predicted"] - some["arrives"]
            mean, low, high, _ = clustered(error.to_numpy(), grounds_of(some["world"]))
            table.row(
                name, prior, f"{some['predicted'].mean():.3f}", f"{some['arrives'].mean():.3f}",
                f"{mean:.3f} [{low:.3f}, {high:.3f}]", f"{some['brier'].mean():.3f}",
                f"{some['first_arrives'].mean():.3f}", f"{some['excess'].mean():.3f}",
            )  # fmt: skip
        best = own["best_arrives"].mean(), own["first_best"].mean()
        table.row(name, "best path", "", f"{best[0]:.3f}", "", "", f"{best[1]:.3f}", "")


def draw(rows: pd.DataFrame, file: Path) -> None:
    """Draw the reliability curves of the default prior and of that of version 0.6."""
    rows = rows.dropna(subset=["predicted", "arrives"])
    rows = rows[~((rows["kind"] == "limit") & rows["case"].str.contains("low"))]
    fig, ax = plt.subplots(figsize=(4.5, 4.0), layout="constrained")
    ax.axline((0.0, 0.0), slope=1.0, color="0.6", lw=1.0)
    styles = {"0.6, failures are free": "C7", "data sheet": "C0"}
    names = {"0.6, failures are free": "0.6, failures are free", "data sheet": "default"}
    for prior, color in styles.items():
        some = rows[rows["prior"] == prior]
        which = np.digitize(some["predicted"], _BINS[1:-1])
        by_bin = some.groupby(which)
        n = by_bin.size()
        means = by_bin[["predicted", "arrives"]].mean()[n >= 5]
        ax.plot(means["predicted"], means["arrives"], color=color, marker="o", label=names[prior])
    ax.set(xlabel="predicted arrival", ylabel="true arrival", xlim=(0, 1.02), ylim=(0, 1.02))
    ax.legend(frameon=False)
    fig.savefig(file, dpi=150)


def main() -> None:
    parser = arguments(__doc__ or "", data=True, quick="two worlds")
    parser.add_argument("--truths", type=Path, default=Path("out/truths"), help="folder of truths")
    parser.add_argument("--jobs", type=int, default=-1, help="processes, default one per core")
    parser.add_argument("--csv", type=Path, help="CSV file for the means by world")
    parser.add_argument("--rows", type=Path, help="CSV file with means")
    parser.add_argument("--picture", type=Path, help="file of the reliability curves")
    given = parsed(parser)

    if given.rows is not None:
        means = pd.read_csv(given.rows)
    else:
        rows = run(given)
        means = means_of(rows)
        if given.picture is not None:
            draw(rows, given.picture)
    if given.csv is not None:
        write_text(given.csv, means.to_csv(index=False))
    report(means)


if __name__ == "__main__":
    main()
