"""Missions read from poses and detections, compared with the bounds of the simulator.

    python benchmarks/tracks.py [-n 200] [--quick]

Each log is a simulated mission between two places of the example terrain. Half of the places are
those whose stops are closest to the edge of their cell. Positions have slowly varying errors with a
standard deviation of 0, 0.5, 1 or 2 m, and the clock of each robot is wrong by up to 0.5 s. One
log in four is of robots that get stuck on steep ground. The bounds of the simulator are those of a
table of legs.
"""

import warnings

import numpy as np
import pandas as pd
from common import Table, arguments, parsed

import trustbo as tb

ERRORS = (0.0, 0.5, 1.0, 2.0)
"""Standard deviations of positions, m."""
CORRELATION = 20.0
"""Time over which errors of positions are alike, s."""
OFFSET = 0.5
"""Largest error of a clock, s."""
TICK = 0.5
WEAKER = 0.6
"""Slope limit of robots that get stuck, as a part of the planned one."""
FEW = 5
"""Number of readings below which a rate is hardly known."""
NAMES = ("alpha", "bravo", "charlie")


def slow_error(rng, t, sd):
    """Errors of positions at times t, (time, 2), m: an Ornstein-Uhlenbeck process."""
    kept = np.exp(-np.diff(t, prepend=t[0]) / CORRELATION)
    error = rng.normal(size=(len(t), 2))
    for i in range(1, len(t)):
        error[i] = kept[i] * error[i - 1] + np.sqrt(1.0 - kept[i] ** 2) * error[i]
    return sd * error


def tables_of(mission, sd, rng):
    """Poses and detections of a simulated mission, with errors of positions and of clocks."""
    t = np.concatenate([b.t0 + (np.arange(len(b.poses)) + 0.5) * TICK for b in mission.bounds])
    places = np.concatenate([bound.poses[:, :, :2] for bound in mission.bounds])
    contact = np.concatenate([bound.contact for bound in mission.bounds])

    poses, seen = [], []
    for i, name in enumerate(("lead", *NAMES)):
        clock = t + rng.uniform(-OFFSET, OFFSET)
        x, y = (places[:, i] + slow_error(rng, t, sd)).T
        poses.append(pd.DataFrame({"t": clock, "robot": name, "x": x, "y": y}))
        if i:
            there = contact[:, i - 1].astype(bool)
            seen.append(pd.DataFrame({"t": clock[there], "watcher": name, "seen": "lead"}))
    return pd.concat(poses), pd.concat(seen)


def distance_to_edge(workspace, cell):
    """Distance of the stop in a cell from the nearest edge of the cell, m."""
    grid = workspace.grid
    row, col = grid.to_cell(*workspace.posts.stop(cell))
    down, right = abs(row - round(row)), abs(col - round(col))
    return min(down * grid.cell_height, right * grid.cell_width)


def courses(workspace, rng):
    """Yield pairs of places without end; every second goal has a stop close to an edge."""
    cells = [tuple(map(int, cell)) for cell in np.argwhere(workspace.passable.values)]
    edgy = sorted(cells, key=lambda cell: distance_to_edge(workspace, cell))[: len(cells) // 6]
    k = 0
    while True:
        goals = edgy if k % 2 else cells
        start, goal = cells[rng.integers(len(cells))], goals[rng.integers(len(goals))]
        if max(abs(start[0] - goal[0]), abs(start[1] - goal[1])) >= 4:
            k += 1
            yield start, goal


def outcome(workspace, simulator, course, posterior, sd, seed):
    """Compare a log of a mission with its legs: a row of numbers, and the errors of its rates."""
    plan = tb.planning.Planner(workspace, *course).plan(posterior)
    mission = simulator.run(plan.path, seed=seed, mission=0)
    told = {} if mission.status == "ok" else {"status": mission.status}
    tables = tables_of(mission, sd, np.random.default_rng(seed))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (read,) = tb.logs.read_tracks(*tables, workspace, path=plan.path, tick=TICK, **told)

    same = read.statuses == mission.statuses and read.driven == mission.driven
    n_run = sum(status == "ok" for status in mission.statuses)
    row = {
        "error of positions (m)": f"{sd:g}",
        "logs": 1,
        "failed": mission.status != "ok",
        "wrong": not same,
        "bounds": n_run,
        "few readings": int((read.n_ticks[:n_run] < FEW).any(axis=1).sum()),
    }
    rates = read.contact_rate[:n_run] - mission.contact_rate[:n_run] if same else np.empty((0, 3))
    return row, np.abs(rates).ravel()


def main():
    given = parsed(arguments(__doc__, n=200, out="out/tracks", quick="12 logs"))
    n = 12 if given.quick else given.n

    workspace = tb.Workspace.from_terrain(
        tb.terrain.example(), (10, 10), team=tb.Team(3, names=NAMES), n_posts=1
    )
    robots = (tb.Robot(), tb.Robot(detection=0.6), tb.Robot())
    weaker = [
        tb.Robot(max_slope=WEAKER * robot.max_slope, detection=robot.detection) for robot in robots
    ]
    steady = tb.simulation.KinematicSimulator(
        workspace, team=tb.Team(robots=robots, names=NAMES), tick=TICK
    )
    failing = tb.simulation.KinematicSimulator(
        workspace, team=tb.Team(robots=weaker, names=NAMES), tick=TICK
    )
    learned = tb.iterate(
        workspace, (8, 1), (1, 8), n_iterations=1, seed=0, sampler="importance", progress=False
    )

    rng = np.random.default_rng(0)
    rows, errors = [], []
    for k, course in zip(range(n), courses(workspace, rng), strict=False):
        simulator = failing if k % 4 == 3 else steady
        row, error = outcome(
            workspace, simulator, course, learned.posterior, ERRORS[k // 4 % len(ERRORS)], seed=k
        )
        rows.append(row)
        errors.append(error)

    table = pd.DataFrame(rows)
    counts = ["logs", "failed", "wrong", "bounds", "few readings"]
    quantiles = {"median": 0.5, "95 %": 0.95, "largest": 1.0}
    shown = Table("error of positions (m)", *counts, *(f"error of rates: {q}" for q in quantiles),
                  name="tracks")  # fmt: skip
    groups = [*table.groupby("error of positions (m)").groups.items(), ("all", table.index)]
    for name, index in groups:
        of_group = np.quantile(np.concatenate([errors[i] for i in index]), [*quantiles.values()])
        total = table.loc[index, counts].sum()
        shown.row(name, *map(int, total), *(f"{error:.3f}" for error in of_group))


if __name__ == "__main__":
    main()
