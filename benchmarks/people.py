"""HumanTrust on the reports of three studies, beside baselines; people predicted are left out.

Run: python benchmarks/people.py [soh] [azevedo] [du] [--data FOLDER]

The folder (`TRUSTBO_DATA` by default, or its `humans/`) holds tables that are not ours to ship,
made of the public files of clear-nus/human-trust-transfer (soh_household.csv, soh_driving.csv),
hazevedosa/bidirectional-trust (azevedo_sa.csv) and Du et al. 2025 (du_real.csv, du_vr.csv); the
columns are those that the readers below name. Du's changes of trust are almost a function of level
and event: a test of inputs, no evidence on people.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from common import Table, arguments, parsed, timed, verdict
from scipy import special
from scipy.special import expit, logit

import trustbo as tb
from trustbo.inference import loo, predict_reports
from trustbo.models import HumanTrust
from trustbo.models.people import FAILURE, SUCCESS
from trustbo.stacking import stack_missions

LEVELS = np.arange(7.0)
_PENALTY = 2.0  # of a standardised weight of the ridge, in reports
_LEAST = 0.02  # sd of a baseline's errors
SOH = {"household": (0.181, 0.160, 0.120), "driving": (0.206, 0.175, 0.135)}


def main():
    parser = arguments(
        __doc__, names=("soh", "azevedo", "du"), data=True, quick="likert scale alone"
    )
    given = parsed(parser)
    if given.data is None:
        parser.error("give --data, or set TRUSTBO_DATA: the head of the script says what it holds")
    folder = given.data / "humans" if (given.data / "humans").is_dir() else given.data
    for name in given.names:
        {"soh": soh, "azevedo": azevedo, "du": du}[name](folder, quick=given.quick)


def soh(folder, *, quick):
    """Their scale, expit(rating - 3.5), and protocol: 10 folds of people, of C, D and E alone."""
    table = Table("study", "method", "given", "MAE", "target", "met")
    for name, (means, transfer, own) in SOH.items():
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
            tree = tb.fit([people[i] for i in train], HumanTrust(scale="likert7"), whole=False)
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
        aims = {"three means": means, "tasks and outcomes": transfer, "own ratings": own}
        for method, found in errors.items():
            mae, aim = float(np.mean(found)), aims.get(method)
            known = "nothing" if method in ("three means", "tasks and outcomes") else "own ratings"
            met = "" if aim is None else verdict(mae <= aim + 0.002 * (method == "three means"))
            label = (
                "HumanTrust, " + method
                if method in ("tasks and outcomes", "own ratings")
                else method
            )
            table.row(f"{name}, {n} people", label, known, f"{mae:.3f}", aim or "", met)


def azevedo(folder, *, quick):
    """A third rating given two, of half of the people; and each part of the model by LOO."""
    people = read_azevedo_sa(folder / "azevedo_sa.csv")
    n = len(people)
    out = np.random.default_rng(0).permutation(n)[: n // 2]
    known = [without_last(m) if i in set(out.tolist()) else m for i, m in enumerate(people)]
    scale = "likert7" if quick else "ordinal7"
    models = {
        "HumanTrust": HumanTrust(scale=scale),
        "even cut points": HumanTrust(scale="likert7"),
        "symmetric": HumanTrust(scale=scale, asymmetric=False),
        "persons alike": HumanTrust(scale=scale, persons=False),
        "memory of the level": HumanTrust(scale=scale, memory="level"),
    }
    table = Table("third rating given two", "log score", "MAE", "k-hat", "seconds")
    own = expit(LEVELS - 3.0)
    answer = np.round(np.array([people[i].contact_rate[2, 0] for i in out]) * 6.0).astype(int)
    for name, model in models.items():
        tb.fit(known, model, whole=False, progress=False)  # compiles
        seconds, tree = timed(lambda model=model: tb.fit(known, model, whole=False, progress=False))
        found = predict_reports(tree, [people[i] for i in out], fitted=True, n_draws=8000)
        found = found["probability"].values[:, 2, 0]
        log = np.log(found[np.arange(len(out)), answer]).mean()
        mae = np.abs(found @ own - own[answer]).mean()
        table.row(name, f"{log:.3f}", f"{mae:.4f}", f"{tree.attrs['k_hat']:.2f}", f"{seconds:.1f}")
    print()
    table = Table("all ratings, a person left out", "elpd", "less than HumanTrust", "dse", "k > .7")
    left_out = {name: loo(tb.fit(people, model, progress=False)) for name, model in models.items()}
    best = left_out["HumanTrust"]
    for name, one in left_out.items():
        gap = best.elpd_i.values - one.elpd_i.values
        dse = np.sqrt(len(gap) * gap.var())
        bad = int((one.pareto_k.values > 0.7).sum())
        table.row(name, f"{one.elpd:.1f}", f"{gap.sum():.1f}", f"{dse:.1f}", bad)
    print()
    print(compare_people(people, {"HumanTrust": models["HumanTrust"]}).round(3).to_string())


def du(folder, *, quick):
    """One step ahead, people left out: a test of inputs."""
    for study in ("real", "vr"):
        for events in (False, True):
            people = read_du(folder / f"du_{study}.csv", events=events)
            found = compare_people(people, {"HumanTrust": HumanTrust()})
            print(f"\n{study}, {len(people)} people, {'events' if events else 'outcomes'}")
            print(found.round(4).to_string())


def read_soh(file):
    """Missions of a study of Soh et al. (2018): trust in tasks before and after two were seen.

    Bound 1 is before, with reports of tasks A to E, A and B being those that are seen then; bound 2
    is after, with reports of C, D and E. Features are the task, `task_1` to `task_12`, the outcome,
    and it again for tasks of the category of the seen ones (1 to 6, 7 to 12).
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
    """Missions of Azevedo-Sa et al. (2021): trust in a driving task after three others.

    A seen task's demand is the share of its needs, sensing and processing, that are no less than
    those of the asked task; the mean need of the asked task is the input `need`. The column trust
    is the logistic function of the rating, 1 to 7, less 4.
    """
    table = pd.read_csv(file)
    table["report"] = np.clip(np.round(logit(table["trust"].clip(0.01, 0.99)) + 4.0), 1, 7)
    pairs = [(table[n], table[f"asked_{n}"]) for n in ("sensing", "processing")]
    table["demand"] = np.mean([seen >= asked for seen, asked in pairs], axis=0)
    table["need"] = np.mean([asked for _, asked in pairs], axis=0)
    return tb.logs.read_reports(
        table, outcome="success", demand="demand", inputs=("need",), scale="likert7"
    )


def read_du(file, *, events=False):
    """Missions of Du et al. (2025): trust before and after each of ten steps.

    With `events`, outcomes are apart by the level of trust before (from .5, or below) and the
    state, in place of two inputs.
    """
    table = pd.read_csv(file)
    kinds = [f"{o}_{h}_{s}" for o in ("success", "failure") for h in ("high", "low") for s in "01"]
    rows = []
    for person, steps in table.groupby("person", sort=False):
        before = dict.fromkeys(kinds, 0.0)
        rows.append(
            {"person": person, "step": 0, "report": steps["trust_before"].iloc[0], **before}
        )
        for one in steps.to_dict("records"):
            outcome = "success" if one["task_result"] > 0.0 else "failure"
            level = "high" if one["trust_before"] >= 0.5 else "low"
            happened = before | {f"{outcome}_{level}_{int(one['state'])}": 1.0}
            rows.append({"person": person, "step": one["step"], "report": one["trust_after"],
                         "outcome": outcome, **happened})  # fmt: skip
    answers = pd.DataFrame(rows)
    if events:
        return tb.logs.read_reports(answers, inputs=kinds)
    return tb.logs.read_reports(answers, outcome="outcome")


def median_of(probability, values):
    """Median of levels with these values."""
    at = (np.cumsum(probability, axis=-1) < 0.5).sum(-1)
    return values[np.minimum(at, len(values) - 1)]


def without_last(mission):
    """Mission whose last report is not known."""
    y = mission.contact_rate.copy()
    y[-1] = np.nan
    return tb.Mission.from_arrays(
        None, mission.awareness, y, n_ticks=mission.n_ticks, features=mission.features,
        robots=mission.robots,
    )  # fmt: skip


def compare_people(missions, models, *, given="earlier", folds=5, seed=0):
    """Score predictions of reports by models and baselines, on people that none was fitted to.

    People are divided into folds at random, and those of each predicted by fits to all others.
    Baselines: `persistence`, the last report about the same task; `means`, that of reports before
    any outcome, after a success and after a failure; and `ridge`, a linear regression on the
    inputs and, given earlier reports, the last one and the person's mean. Their errors are normal.
    A row for each method: the mean absolute error `mae`, of medians, the root mean square error
    `rmse`, of means, both on the scale that was answered, the mean `log_score` (nats a report; of
    its level, or density), `coverage_90`, and the number `n` of reports.
    """
    batch = stack_missions(missions, pad=False)
    order = np.random.default_rng(seed).permutation(len(missions))
    names = [*(["persistence"] if given == "earlier" else []), "means", "ridge", *models]
    parts = {name: [] for name in names}
    for test in np.array_split(order, folds):
        train = np.setdiff1d(order, test)
        table = _Table.of(batch, missions[0].features, given)
        for name in names:
            if name in models:
                others = [missions[int(i)] for i in train]
                tree = tb.fit(others, models[name], seed=seed, whole=False, progress=False)
                people = [missions[int(i)] for i in test]
                parts[name].append(_of_model(tree, people, table.scored[test], given, seed))
            else:
                parts[name].append(table.baseline(name, train, test))
    found = pd.concat({name: pd.concat(of_folds) for name, of_folds in parts.items()})
    by_name = found.groupby(level=0, sort=False)
    scores = by_name.mean()
    return scores.assign(rmse=np.sqrt(scores["rmse"]), n=by_name.size().astype(float))


class _Table(NamedTuple):
    """Reports of all people with what they are predicted from; axes (mission, bound, robot)."""

    y: np.ndarray
    steps: np.ndarray  # of the scale, NaN on the unit scale
    kind: np.ndarray  # 0 before any outcome, 1 after a success, 2 after a failure
    inputs: np.ndarray  # (mission, bound, robot, column)
    last: np.ndarray  # NaN where there is none
    scored: np.ndarray

    @classmethod
    def of(cls, batch, features, given):
        """Columns of a batch."""
        y, z = batch.contact_rate, batch.awareness
        happened = [
            z[..., [name.startswith(start) for name in features]].sum(-1) > 0.0
            for start in (SUCCESS, FAILURE)
        ]
        kind = np.where(happened[0], 1, np.where(happened[1], 2, 0))
        last, mean = np.full(y.shape, np.nan), np.full(y.shape, np.nan)
        for k in range(1, y.shape[1]):
            last[:, k] = np.where(np.isnan(y[:, k - 1]), last[:, k - 1], y[:, k - 1])
            known = ~np.isnan(y[:, :k])
            total = np.where(known, y[:, :k], 0.0).sum((1, 2))
            with np.errstate(invalid="ignore"):
                mean[:, k] = (total / known.sum((1, 2)))[:, None]
        last = np.where(np.isnan(last), mean, last)
        seen, inputs = ~np.isnan(y), [z, np.ones_like(z[..., :1])]
        if given == "earlier":
            seen &= ~np.isnan(last)
            own = np.nan_to_num(np.stack([last, mean], axis=-1))
            inputs += [own, own[..., :1] * (kind == 1)[..., None]]
        return cls(y, batch.n_ticks, kind, np.concatenate(inputs, -1), last, seen)

    def baseline(self, name, train, test):
        """Predictions of a baseline."""
        a, b = (self.scored & np.isin(np.arange(len(self.y)), some)[:, None, None]
                for some in (train, test))  # fmt: skip
        if name == "persistence":
            fitted, mean = self.last[a], self.last[b]
        elif name == "means":
            means = np.array([self.y[a & (self.kind == k)].mean() if (a & (self.kind == k)).any()
                              else self.y[a].mean() for k in range(3)])  # fmt: skip
            fitted, mean = means[self.kind[a]], means[self.kind[b]]
        else:
            X, center = self.inputs[a], self.y[a].mean()
            scale = X.std(0) + 1e-9
            penalty = _PENALTY * np.where(X.std(0) > 0.0, scale**2, 1e-9)
            w = np.linalg.solve(X.T @ X + np.diag(penalty), X.T @ (self.y[a] - center))
            fitted, mean = (np.clip(v @ w + center, 0.0, 1.0) for v in (X, self.inputs[b]))
        sd = max(float((self.y[a] - fitted).std()), _LEAST)
        return _normal(self.y[b], self.steps[b], mean, sd)


def _normal(y, steps, mean, sd):
    """Normal predictions, of the level where reports have levels."""
    half = 0.5 / steps
    low, high = np.where(y <= 0.0, -np.inf, y - half), np.where(y >= 1.0, np.inf, y + half)
    mass = np.diff(special.ndtr((np.stack([low, high]) - mean) / sd), axis=0)[0]
    density = -0.5 * ((y - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi))
    log_score = np.where(np.isnan(steps), density, np.log(np.maximum(mass, 1e-12)))
    within = np.abs(y - mean) <= 1.6449 * sd + np.nan_to_num(half)
    unit = np.nan_to_num(steps, nan=1.0)
    return _scored(unit * y, unit * mean, unit * mean, log_score, within)


def _of_model(tree, people, scored, given, seed):
    found = predict_reports(tree, people, given=given, seed=seed)
    scored = scored[:, : found.sizes["bound"]]
    y, mean, log_score = (found[name].values[scored] for name in ("report", "mean", "log_score"))
    low, median, high = (found["quantile"].values[scored][:, i] for i in (0, 2, 4))
    return _scored(y, mean, median, log_score, (low <= y + 1e-9) & (y <= high + 1e-9))


def _scored(y, mean, median, log_score, covered):
    """Errors and scores of some reports, a row for each."""
    off = {"mae": np.abs(y - median), "rmse": (y - mean) ** 2}
    return pd.DataFrame({**off, "log_score": log_score, "coverage_90": covered.astype(float)})


if __name__ == "__main__":
    main()
