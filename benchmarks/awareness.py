"""Test whether measured awareness improves predictions of the next mission; print a table.

    python benchmarks/awareness.py --out out/awareness
    python benchmarks/awareness.py --data DIR -n 30

In each world, eight missions on random paths are simulated once, with the awareness that the robots
measured (`simulation.RealtimeAwareness`). After some of these missions, the model is fitted twice:
to the awareness of the map and to the measured awareness. Both posteriors predict the next mission
from the map, because nothing has been measured in that mission yet. In the third row, the next
mission is predicted from the awareness that will be measured in it, which is not available to a
planner. Worlds differ in their terrain and in what is wrong with the map. The last world is the
terrain of the paper, with several sets of missions. Differences are paired by world, and their
intervals are based on the t-distribution over worlds. With --data, the script uses the worlds on
the real terrains in this folder. Results in --out are reused.
"""

import warnings
from collections.abc import Iterator
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import interval
from scipy import stats
from world_set import COURSES, World, worlds

import trustbo as tb
from trustbo.data import Cell
from trustbo.models import TrustParams, default_model
from trustbo.planning.policies import random

N_MISSIONS = 8
PAPER = "paper's terrain"
MODELS = {
    "cells": ("paper's model, cells", tb.paper.CAMPAIGN["model"], tb.paper.WORKSPACE, (2, 4, 7)),
    "bounds": ("default model, bounds", default_model(), {}, (4,)),
}
"""Title, model, options of the workspace, and numbers of missions after which it is fitted."""
RIVALS = ("map", "measured", "measured, also ahead")


def main():
    parser = arguments(
        __doc__, data=True, names=MODELS, n=20, out="out/awareness", quick="two worlds"
    )
    given = parsed(parser)
    n = 2 if given.quick else given.n
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names:
        title, model, options, after = MODELS[name]
        rows = []
        for label, make, seed in scenes(given.data, n, options):
            file = given.out / f"{name}-{label}-{seed}.csv"
            if not file.exists():
                compare(*make(), model, after, seed).to_csv(file, index=False)
            rows.append(pd.read_csv(file).assign(world=label, seed=seed))
        report(name, title, pd.concat(rows))


def scenes(data: Path | None, n: int, options: dict[str, Any]) -> Iterator[tuple[str, Any, int]]:
    """Name n worlds of all kinds in turn, and the paper's terrain with five seeds.

    The worlds are those on the terrains in `data` or, without it, on those of the package.
    """
    kinds: dict[str, list[World]] = {}
    for world in worlds(data).values():
        if world.is_packaged == (data is None) and not world.radio:
            kinds.setdefault(world.kind, []).append(world)
    mixed = [world for of_kinds in zip_longest(*kinds.values()) for world in of_kinds if world]
    for world in mixed[:n]:
        yield world.name, partial(scene_of, world, options), 0
    for seed in range(5):
        yield PAPER, partial(paper_scene, options), seed


def scene_of(world: World, options: dict[str, Any]) -> tuple[Any, ...]:
    """Make the simulator of a world, with its start and goal."""
    workspace = world.workspace()
    if options:  # the features of the paper
        sight = workspace.sight
        workspace = tb.Workspace.from_terrain(
            workspace.terrain, world.shape, workspace.team, sight=sight, **options
        )
    return world.simulator(workspace), *world.ends(COURSES[0])


def paper_scene(options: dict[str, Any]) -> tuple[Any, ...]:
    """Make the simulator of notebooks/2_paper_experiment.ipynb, with its start and goal."""
    terrain = tb.terrain.synthetic_terrain((500.0, 500.0), 1.0, seed=2)
    workspace = tb.Workspace.from_terrain(terrain, (10, 10), tb.Team(3), **options)
    return tb.simulation.KinematicSimulator(workspace), (9, 0), (0, 9)


def compare(
    simulator: Any, start: Cell, goal: Cell, model: Any, after: tuple[int, ...], seed: int
) -> pd.DataFrame:
    """Score the next mission after some missions, with each source of awareness."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the loading of|the first component")
        robots = tb.simulation.RealtimeAwareness(simulator, seed=seed)

    workspace = robots.workspace
    planner = tb.Planner(workspace, start, goal)
    nothing = TrustParams(0.0, np.zeros(len(workspace.features)), 0.0, 0.1, 0.1)
    measured = []
    for n in range(N_MISSIONS):
        path = random(np.random.default_rng([seed, n]), nothing, planner).path
        measured.append(robots.run(path, seed=1000 * seed + n, mission=n))
    mapped = [
        mission.with_awareness(workspace.along(mission.path)[: len(mission.bounds)])
        for mission in measured
    ]

    rows = []
    for n in after:
        for rival, learned, ahead in zip(
            RIVALS, (mapped, measured, measured), (mapped, mapped, measured), strict=True
        ):
            if rival != RIVALS[2]:  # the last two have the same posterior
                posterior = tb.fit(
                    learned[:n], model, workspace=workspace, sampler="importance", progress=False
                )
            scores = tb.inference.score(posterior, [ahead[n]], workspace=workspace)
            numbers = {name: float(scores[name]) for name in ("mean_log_score", "r2", "n")}
            rows.append({"awareness": rival, "after": n, **numbers})
    return pd.DataFrame(rows)


def report(name: str, title: str, rows: pd.DataFrame) -> None:
    """Print the mean log score of each source, and its difference from the map's."""
    print(f"\n**{title}**\n")
    table = Table(
        "next mission", "awareness", "log score per rate, nats", "minus the map's [95 %]",
        "better in", name=f"awareness_{name}",
    )  # fmt: skip
    for what, some in (
        ("worlds", rows[rows["world"] != PAPER]),
        (PAPER, rows[rows["world"] == PAPER]),
    ):
        by = some.groupby(["world", "seed", "awareness"])["mean_log_score"].mean().unstack()
        for rival in RIVALS:
            less = by[rival] - by[RIVALS[0]]
            mean = less.mean()
            half = stats.t.ppf(0.975, len(by) - 1) * less.sem()
            cells = interval(mean, mean - half, mean + half), f"{(less > 0.0).sum()} of {len(by)}"
            is_map = rival == RIVALS[0]
            table.row(what, rival, f"{by[rival].mean():.3f}", *(("", "") if is_map else cells))


if __name__ == "__main__":
    main()
