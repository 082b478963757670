"""HumanTrust on the reports of three studies, beside baselines; people predicted are left out.

Run: python benchmarks/people.py [soh] [azevedo] [du] [--data FOLDER]

The folder (`TRUSTBO_DATA` by default, or its `humans/`) holds tables that are not ours to ship,
made of the public files of clear-nus/human-trust-transfer (soh_household.csv, soh_driving.csv),
hazevedosa/bidirectional-trust (azevedo_sa.csv) and Du et al. 2025 (du_real.csv, du_vr.csv); the
columns are those that `trustbo.logs.read_soh`, `read_azevedo_sa` and `read_du` name. Du's changes
of trust are almost a function of level and event: a test of inputs, no evidence on people.
"""

import numpy as np
from common import Table, arguments, parsed, timed, verdict
from scipy.special import expit

import trustbo as tb
from trustbo.inference import compare_people, loo, predict_reports
from trustbo.models import HumanTrust

LEVELS = np.arange(7.0)
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
        people = tb.logs.read_soh(folder / f"soh_{name}.csv")
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
    people = tb.logs.read_azevedo_sa(folder / "azevedo_sa.csv")
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
            people = tb.logs.read_du(folder / f"du_{study}.csv", events=events)
            found = compare_people(people, {"HumanTrust": HumanTrust()})
            print(f"\n{study}, {len(people)} people, {'events' if events else 'outcomes'}")
            print(found.round(4).to_string())


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


if __name__ == "__main__":
    main()
