"""Simulation-based calibration of models, families and effects; prints the table of the docs.

    python benchmarks/sbc.py [row ...] --sets 200 --jobs 16 --csv FILE

A row is a model; its data sets are simulated from the prior on the same missions: random walks over
a small grid, with gaps. Each parameter's ranks are tested for uniformity; a row counts those that
are rejected at 1 % after Holm's correction for all tests of the run.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from common import Table
from joblib import Parallel, delayed
from tqdm import tqdm

import trustbo as tb
from trustbo.errors import PosteriorError
from trustbo.inference import sbc
from trustbo.inference.sbc import uniformity
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


def ranks_of(name, n, seed):
    """Ranks (data set, parameter) of n data sets of a row, and the number refused."""
    model = ROWS[name]
    missions = people() if isinstance(model, HumanTrust) else walks()
    size = {"n_datasets": n, "n_ranked": N_RANKED, "max_refused": 1.0}
    try:
        found = sbc(model, missions, seed=seed, progress=False, **size)
    except PosteriorError:  # none is left
        return None, n
    return found["rank"].to_pandas(), found.attrs["n_refused"]


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
    done = Parallel(given.jobs, return_as="generator")(delayed(ranks_of)(*task) for task in tasks)
    done = list(tqdm(done, total=len(tasks), desc="parts"))
    tests = {}
    for i, name in enumerate(names):
        ranks, refused = zip(*done[i * parts : (i + 1) * parts], strict=True)
        ranks = [some for some in ranks if some is not None]
        tests[name] = pd.concat(ranks) if ranks else pd.DataFrame(), sum(refused)

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
