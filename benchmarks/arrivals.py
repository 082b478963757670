"""Compare predicted and true arrivals of first plans under priors of the hazard.

    python benchmarks/arrivals.py --data DIR --csv out/arrivals.csv

In each world, first plans are made on the first five courses of each set of `contact.py`, before
any mission. Workspaces have one set of posts, since truths of three sets take eight times as long;
the risk of a path hardly depends on them. The probability that a plan arrives is predicted by the
prior of the hazard. The true one is that of the truth of the world. The excess is the expected
contact lost, failures counted, minus that of the best path, in bounds.

The prior for a limit from a data sheet, the default, was calibrated on the synthetic terrains with
a wrong slope limit. The tables show those on other terrains apart.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from common import Table, arguments, parsed
from contact import SETTINGS, changing_courses
from groups import interval, over_worlds
from world_set import World, available
from worlds_in_parallel import rows_of_worlds

import trustbo as tb
from trustbo.files import write_text
from trustbo.hazard import BoundRisk, Hazard, fit_hazard

COURSES = 5
"""Number of courses of each set."""
CASES: dict[str, tuple[Hazard, bool]] = {
    "data sheet": (Hazard(), True),
    "measured": (Hazard(limit="measured"), True),
    "guessed": (Hazard(limit="guessed"), True),
    "data sheet, failures are free": (Hazard(), False),
}
"""Prior of the hazard, and whether a failure costs the bounds of a shortest path."""
_DECIMALS = 5


def rows_of(world: World) -> Iterator[dict[str, Any]]:
    """Yield a row for each plan, on all courses and in all cases."""
    workspace = world.workspace()
    truth = tb.simulation.Truth.from_simulator(world.simulator(workspace)).at(0)
    belief = tb.Campaign(workspace, progress=False).belief.mean()
    risks = {
        name: BoundRisk(fit_hazard([], workspace, hazard), workspace)
        for name, (hazard, _) in CASES.items()
    }
    labels = {"world": world.name, "kind": world.kind, "case": world.case}
    for which in SETTINGS["changing"]:
        for number, ends in enumerate(changing_courses(world, which, COURSES)):
            best = truth.best(*ends, failures=True)
            planner = tb.Planner(workspace, *ends)
            free = planner.with_failure_cost(0.0)
            for name, risk in risks.items():
                priced = CASES[name][1]
                plan = (planner if priced else free).with_risk(risk).plan(belief)
                yield {
                    **labels, "set": which, "course": number, "prior": name,
                    "predicted": plan.p_arrive, "arrives": truth.p_arrive(plan.path),
                    "best_arrives": truth.p_arrive(best),
                    "excess": truth.lost_or_failed(plan.path) - truth.lost_or_failed(best),
                }  # fmt: skip


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
            *ends, _ = over_worlds(error.to_numpy(), some["world"])
            table.row(
                name, prior, f"{some['predicted'].mean():.3f}", f"{some['arrives'].mean():.3f}",
                interval(*ends), f"{some['brier'].mean():.3f}",
                f"{some['first_arrives'].mean():.3f}", f"{some['excess'].mean():.3f}",
            )  # fmt: skip
        best = own["best_arrives"].mean(), own["first_best"].mean()
        table.row(name, "best path", "", f"{best[0]:.3f}", "", "", f"{best[1]:.3f}", "")


def main() -> None:
    parser = arguments(__doc__ or "", data=True, out="out/arrivals", quick="two worlds")
    parser.add_argument("--jobs", type=int, default=-1, help="processes, default one per core")
    parser.add_argument("--csv", type=Path, help="CSV file for the means by world")
    given = parsed(parser)
    some = list(available(given.data).values())[: 2 if given.quick else None]
    means = means_of(rows_of_worlds(rows_of, some, given.jobs, given.out))
    if given.csv is not None:
        write_text(given.csv, means.to_csv(index=False))
    report(means)


if __name__ == "__main__":
    main()
