"""Simulation-based calibration of models, families and effects; prints the table of the docs.

    python benchmarks/sbc.py [row ...] --sets 200 --jobs 16 --csv FILE

Each true parameter is ranked among posterior draws, over data sets simulated from the prior (Talts
et al. 2018). If prior, likelihood and sampler are consistent, ranks are uniform. A row is a model;
its missions are random walks over a small grid, with gaps. Each parameter's ranks are tested for
uniformity; a row counts those that are rejected at 1 % after Holm's correction for all tests of the
run. To check a model of your own, add a row.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from common import Table
from joblib import Parallel, delayed
from scipy import stats
from tqdm import tqdm

import trustbo as tb
from trustbo.inference.fit import by_importance
from trustbo.inference.importance import MAX_KHAT
from trustbo.inference.posterior import Posterior
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    HumanTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
)

LEVEL = 0.01  # of a test over all rows
N_RANKED = 399  # draws that each truth is ranked among
PART = 10  # data sets of a process at a time
EFFECTS = (PlaceEffect(), RobotEffect())
ROWS = {
    "pooled": PooledTrust(),
    "pooled, deviations": PooledTrust(memory="deviation"),
    "pooled, shared noise": PooledTrust(shared_noise=True),
    "pooled, places and robots": PooledTrust(effects=EFFECTS),
    "pooled, all": PooledTrust(shared_noise=True, effects=EFFECTS),
    "hierarchical, robots": HierarchicalTrust(effects=(RobotEffect(),)),
    "coupled": CoupledTrust(),
    "coupled, robots": CoupledTrust(effects=(RobotEffect(),)),
    "censored, robots": PooledTrust(observation="censored", effects=(RobotEffect(),)),
    "censored, places": PooledTrust(observation="censored", effects=(PlaceEffect(),)),
    "counts": PooledTrust(observation="beta_binomial"),
    "likert7": HumanTrust(scale="likert7"),
}


def walks(n_missions=4, n_bounds=6, n_robots=2, size=4):
    """Missions over random walks, whose rates are replaced."""
    rng, missions = np.random.default_rng(0), []
    for _ in range(n_missions):
        path = [tuple(rng.integers(size, size=2).tolist())]
        while len(path) <= n_bounds:
            step = np.array(path[-1]) + rng.integers(-1, 2, size=2)
            if (step >= 0).all() and (step < size).all() and tuple(step.tolist()) != path[-1]:
                path.append(tuple(step.tolist()))
        z, y = rng.uniform(size=(n_bounds, n_robots, 2)), np.full((n_bounds, n_robots), 0.5)
        y[rng.integers(n_bounds), rng.integers(n_robots)] = np.nan
        ticks, features = np.full(y.shape, 40.0), ["line_of_sight", "slope"]
        missions.append(tb.Mission.from_arrays(path, z, y, n_ticks=ticks, features=features))
    return missions


def people(n_persons=10, n_steps=5):
    """Persons who meet successes and failures."""
    rng, persons = np.random.default_rng(0), []
    for _ in range(n_persons):
        z = rng.uniform(size=(n_steps, 1, 2))
        y, ticks = np.full((n_steps, 1), 0.5), np.full((n_steps, 1), 6.0)
        features = ["success", "failure"]
        persons.append(tb.Mission.from_arrays(None, z, y, n_ticks=ticks, features=features))
    return persons


def rank(model, missions, n, seed, n_ranked=N_RANKED):
    """Ranks (data set, parameter) of n data sets, and the number that the sampler refused.

    Measured rates are replaced by simulated ones; Gaussian rates are not clipped to [0, 1].
    """
    model = model.for_features(missions[0].features)
    slots = model.slots(missions)
    before, measured, ranks = Posterior(model, slots), ~np.isnan(slots.y), []
    for j in range(n):
        rng = np.random.default_rng([seed, j])
        truth = before.draw_prior(1, rng)
        rates = np.where(measured, before.replicate(truth, rng)[0], np.nan)
        posterior = Posterior(model, slots._replace(y=rates))
        drawn, _, summary = by_importance(posterior, n_ranked, int(rng.integers(2**31)))
        if summary["k_hat"] <= MAX_KHAT:
            found, true = (numbers(posterior.named(d)) for d in (drawn, truth))
            ranks.append({name: int((found[name] < true[name][0]).sum()) for name in found})
    return pd.DataFrame(ranks), n - len(ranks)


def numbers(groups):
    """Draws of every parameter, and of the first and last element of each effect."""
    found = {}
    for group, variables in groups.items():
        for name, values in variables.items():
            flat = values.reshape(len(values), -1)
            columns = range(flat.shape[1])
            if group != "posterior":
                columns = sorted({0, flat.shape[1] - 1})
            found |= {label(name, values, i): flat[:, i] for i in columns}
    return {n: v for n, v in found.items() if len(v) == 1 or np.ptp(v) > 0.0}


def label(name, values, i):
    """Name of element i of a variable."""
    if values.ndim == 1:
        return name
    return f"{name}[{','.join(map(str, np.unravel_index(i, values.shape[1:])))}]"


def uniformity(ranks, n_ranked):
    """P-value of a chi-squared test; bins are as equal as n_ranked + 1 ranks allow."""
    n_bins = min(20, max(2, len(ranks) // 5))  # five ranks to a bin, for the test to hold
    edges = np.linspace(0, n_ranked + 1, n_bins + 1).astype(int)
    counts, _ = np.histogram(ranks, edges - 0.5)
    expected = len(ranks) * np.diff(edges) / (n_ranked + 1)
    return float(stats.chisquare(counts, expected).pvalue)


def part_of(name, n, seed):
    """Ranks of some data sets of a row, in a process of their own."""
    model = ROWS[name]
    return rank(model, people() if isinstance(model, HumanTrust) else walks(), n, seed)


def holm(p):
    """P-values adjusted for the number of tests (Holm 1979)."""
    order = np.argsort(p)
    adjusted = np.maximum.accumulate(np.asarray(p)[order] * np.arange(len(p), 0, -1))
    return np.minimum(adjusted, 1.0)[np.argsort(order)]


def main():
    """Rank in processes, and print one row for each model."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []])
    parser.add_argument("--sets", type=int, default=200, help="data sets of a row")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--csv", type=Path, help="file of the table")
    given = parser.parse_args()
    names = given.rows or list(ROWS)

    parts = -(-given.sets // PART)
    sizes = [min(PART, given.sets - PART * i) for i in range(parts)]
    tasks = [(name, n, seed) for name in names for seed, n in enumerate(sizes)]
    done = Parallel(given.jobs, return_as="generator")(delayed(part_of)(*task) for task in tasks)
    done = list(tqdm(done, total=len(tasks), desc="parts"))
    tests = {}
    for i, name in enumerate(names):
        ranks, refused = zip(*done[i * parts : (i + 1) * parts], strict=True)
        tests[name] = pd.concat(ranks), sum(refused)

    p = [uniformity(r, N_RANKED) for ranks, _ in tests.values() for r in ranks.to_numpy().T]
    adjusted, first = holm(p), 0
    table = Table(
        "row", "sets", "refused", "parameters", "least p", "of", "rejected", "50 %", "90 %"
    )
    for name, (ranks, refused) in tests.items():
        of_row = slice(first, first := first + ranks.shape[1])
        if not ranks.size:
            table.row(name, given.sets, refused, 0, "", "", "", "", "")
            continue
        least = int(np.argmin(p[of_row]))
        off = abs((ranks.to_numpy() + 0.5) / (N_RANKED + 1) - 0.5)
        table.row(
            name, given.sets, refused, ranks.shape[1], f"{p[of_row][least]:.4f}",
            ranks.columns[least], int((adjusted[of_row] < LEVEL).sum()),
            f"{(off < 0.25).mean():.1%}", f"{(off < 0.45).mean():.1%}",
        )  # fmt: skip
    if given.csv:
        table.write(given.csv)


if __name__ == "__main__":
    main()
