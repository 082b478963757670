"""Compare predictions of HumanTrust and baselines for people left out of the fit in two studies.

    python benchmarks/people.py [soh] [azevedo] [--data FOLDER]

The folder (by default, the environment variable `TRUSTBO_DATA`), or its subfolder `humans/`,
contains tables that this project may not distribute. They were made from public files of
clear-nus/human-trust-transfer (soh_household.csv, soh_driving.csv) and of
hazevedosa/bidirectional-trust (azevedo_sa.csv). `read_soh` and `read_azevedo_sa` name the columns.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
from common import Table, arguments, parsed, timed
from scipy.special import expit, logit

import trustbo as tb
from trustbo.inference import loo, predict_reports
from trustbo.models import HumanTrust

LEVELS = np.arange(7.0)
SOH = "household", "driving"


def main():
    parser = arguments(__doc__, names=("soh", "azevedo"), data=True)
    given = parsed(parser)
    if given.data is None:
        print("The tables of people are not run: give --data or set TRUSTBO_DATA (see --help).")
        return

    folder = given.data / "humans" if (given.data / "humans").is_dir() else given.data
    for name in given.names:
        {"soh": soh, "azevedo": azevedo}[name](folder)


def soh(folder):
    """Score predictions for tasks C, D and E as the study does: 10 folds, expit(rating - 3.5)."""
    table = Table("study", "method", "given", "MAE", name="people_soh")
    for name in SOH:
        people = read_soh(folder / f"soh_{name}.csv")
        y = np.array([mission.contact_rate for mission in people]) * 6.0
        truth, n = expit(y - 2.5)[:, :, 2:], len(people)
        success = np.array([mission.awareness[1, 2, 12] for mission in people]) > 0.0
        folds = np.array_split(np.arange(n), 10)
        errors = {name: [] for name in ("three means", "tasks and outcomes", "own ratings",
                                        "own rating and mean shift", "persistence")}  # fmt: skip
        for test in folds:
            train = np.setdiff1d(np.arange(n), test)
            before = np.full((len(test), 3), truth[train, 0].mean())
            of = [truth[train, 1][success[train] == k].mean() for k in (False, True)]
            after = np.array(of)[success[test].astype(int)][:, None] * np.ones(3)
            errors["three means"].append(np.abs(np.stack([before, after], 1) - truth[test]).mean())
            tree = tb.fit([people[i] for i in train], HumanTrust(scale="likert7"), latent=False)
            for method, known in (("tasks and outcomes", "none"), ("own ratings", "earlier")):
                found = predict_reports(tree, [people[i] for i in test], given=known)
                guess = median_of(found["probability"].values, expit(LEVELS - 2.5))[:, :, 2:]
                off = np.abs(guess - truth[test])
                errors[method].append((off if known == "none" else off[:, 1]).mean())
            shift = [(y[train, 1] - y[train, 0])[success[train] == k, 2:].mean() for k in (0, 1)]
            moved = y[test, 0, 2:] + np.array(shift)[success[test].astype(int)][:, None]
            moved = expit(np.clip(moved, 0.0, 6.0) - 2.5)
            errors["own rating and mean shift"].append(np.abs(moved - truth[test, 1]).mean())
            errors["persistence"].append(np.abs(truth[test, 0] - truth[test, 1]).mean())
        for method, found in errors.items():
            mae = float(np.mean(found))
            known = "nothing" if method in ("three means", "tasks and outcomes") else "own ratings"
            label = (
                "HumanTrust, " + method
                if method in ("tasks and outcomes", "own ratings")
                else method
            )
            table.row(f"{name}, {n} people", label, known, f"{mae:.3f}")


def azevedo(folder):
    """Predict the third rating of half of the people; compare variants of the model by LOO."""
    people = read_azevedo_sa(folder / "azevedo_sa.csv")
    n = len(people)
    out = np.random.default_rng(0).permutation(n)[: n // 2]
    known = [without_last(m) if i in set(out.tolist()) else m for i, m in enumerate(people)]
    models = {
        "HumanTrust": HumanTrust(scale="likert7"),
        "persons alike": HumanTrust(scale="likert7", tau_start=0.01, tau_level=0.01, tau_gain=0.01),
    }
    table = Table("third rating given two", "log score", "MAE", "k-hat", "seconds",
                  name="people_azevedo_sa")  # fmt: skip
    own = expit(LEVELS - 3.0)
    answer = np.round(np.array([people[i].contact_rate[2, 0] for i in out]) * 6.0).astype(int)
    for name, model in models.items():
        tb.fit(known, model, latent=False, progress=False)  # compiles
        seconds, tree = timed(
            lambda model=model: tb.fit(known, model, latent=False, progress=False)
        )
        found = predict_reports(tree, [people[i] for i in out], fitted=True, n_draws=8000)
        found = found["probability"].values[:, 2, 0]
        log = np.log(found[np.arange(len(out)), answer]).mean()
        mae = np.abs(found @ own - own[answer]).mean()
        table.row(name, f"{log:.3f}", f"{mae:.4f}", f"{tree.attrs['k_hat']:.2f}", f"{seconds:.1f}")
    print()
    table = Table("all ratings, a person left out", "elpd", "less than HumanTrust", "dse", "k > .7",
                  name="people_left_out")  # fmt: skip
    left_out = {name: loo(tb.fit(people, model, progress=False)) for name, model in models.items()}
    best = left_out["HumanTrust"]
    for name, one in left_out.items():
        gap = best.elpd_i.values - one.elpd_i.values
        dse = np.sqrt(len(gap) * gap.var())
        bad = int((one.pareto_k.values > 0.7).sum())
        table.row(name, f"{one.elpd:.1f}", f"{gap.sum():.1f}", f"{dse:.1f}", bad)


def read_soh(file):
    """Read missions of a study of Soh et al. (2018): trust in tasks before and after watching two.

    Bound 1 contains the reports on tasks A to E before watching, and bound 2 the reports on C, D
    and E after watching A and B. The features are the task (`task_1` to `task_12`), the outcome,
    and the outcome again for tasks in the category (1 to 6 or 7 to 12) of the watched tasks.
    """
    table = pd.read_csv(file)
    features = [f"task_{n}" for n in range(1, 13)]
    features += ["success", "failure", "success_same", "failure_same"]
    missions = []
    for row in table.to_dict("records"):
        z, y = np.zeros((2, 5, len(features))), np.full((2, 5), np.nan)
        succeeded = np.array([row["B_SF"] == 1, row["B_SF"] == 0], dtype=float)
        for r, t in enumerate("ABCDE"):
            z[:, r, int(row[f"{t}_ID"]) - 1] = 1.0
            y[0, r] = row[f"{t}_rating" if t in "AB" else f"{t}1_rating"]
            if t in "CDE":
                y[1, r] = row[f"{t}2_rating"]
            z[1, r, 12:14] = succeeded
            z[1, r, 14:] = succeeded * ((row[f"{t}_ID"] > 6) == (row["A_ID"] > 6))
        made = tb.Mission.from_arrays(
            None, z, (y - 1.0) / 6.0, n_ticks=6, features=features, robots=tuple("ABCDE")
        )
        missions.append(replace(made, scale="likert7"))
    return missions


def read_azevedo_sa(file):
    """Read missions of Azevedo-Sa et al. (2021): trust in a driving task after watching others.

    Each task needs a level of sensing and of processing. The demand of a watched task is the
    fraction of these needs that are at least as large as in the task asked about. The input `need`
    is the mean need of the task asked about. The column `trust` is expit(rating - 4), with ratings
    from 1 to 7.
    """
    table = pd.read_csv(file)
    table["report"] = np.clip(np.round(logit(table["trust"].clip(0.01, 0.99)) + 4.0), 1, 7)
    pairs = [(table[n], table[f"asked_{n}"]) for n in ("sensing", "processing")]
    demand = np.mean([seen >= asked for seen, asked in pairs], axis=0)
    table["success_demand"] = (table["success"] == 1) * demand
    table["failure_demand"] = (table["success"] == 0) * (1.0 - demand)
    table["need"] = np.mean([asked for _, asked in pairs], axis=0)
    inputs = "success_demand", "failure_demand", "need"
    return tb.logs.read_reports(table, outcome="success", inputs=inputs, scale="likert7")


def median_of(probability, values):
    """Return the median of a distribution over levels with these values."""
    at = (np.cumsum(probability, axis=-1) < 0.5).sum(-1)
    return values[np.minimum(at, len(values) - 1)]


def without_last(mission):
    """Return a copy of a mission whose last report is missing."""
    y = mission.contact_rate.copy()
    y[-1] = np.nan
    return tb.Mission.from_arrays(
        None, mission.awareness, y, n_ticks=mission.n_ticks, features=mission.features,
        robots=mission.robots,
    )  # fmt: skip


if __name__ == "__main__":
    main()
