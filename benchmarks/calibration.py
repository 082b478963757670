"""Simulation-based calibration of models, families and effects; prints the table of the docs.

    python benchmarks/calibration.py [row ...] --sets 200

A row is a model; its data sets are simulated from the prior on the same missions: random walks over
a small grid, with gaps. `--sampler nuts` ranks draws of NUTS.
"""

import argparse
import time

import numpy as np

import trustbo as tb
from trustbo.inference import sbc
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    HumanTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
)

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


def main():
    """Print one row for each model."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []])
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--sampler", default="importance")
    given = parser.parse_args()
    print(
        "| model | data sets | refused | parameters | smallest p | limit | 50 % | 90 % | s a set |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in given.rows or ROWS:
        model, started = ROWS[name], time.process_time()
        missions = people() if isinstance(model, HumanTrust) else walks()
        ranks = sbc(
            model,
            missions,
            sampler=given.sampler,
            n_datasets=given.sets,
            max_refused=0.2,
            progress=False,
        )
        seconds = (time.process_time() - started) / given.sets
        p, limit = float(ranks["p_value"].min()), 0.01 / ranks.sizes["parameter"]
        half, most = ranks["coverage"].mean("parameter").values
        refused, n = ranks.attrs["n_refused"], ranks.sizes["parameter"]
        row = f"| {name} | {given.sets} | {refused} | {n} | {p:.4f} | {limit:.5f} | {half:.1%} "
        print(f"{row}| {most:.1%} | {seconds:.2f} |", flush=True)


if __name__ == "__main__":
    main()
