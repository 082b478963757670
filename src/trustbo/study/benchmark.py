"""The open benchmark: contenders on worlds, and the table of what they reach."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER
from trustbo.errors import TrustboError, pip_install, require_choice, require_whole
from trustbo.files import FilePath
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.study.conduct import run_runs
from trustbo.study.contenders import BASELINES, Contender, contenders_of
from trustbo.study.run import Run
from trustbo.study.world import COURSES, Simulate, World
from trustbo.study.world_parts import InWorld, WorldCourse
from trustbo.study.world_set import worlds

SHOWN = (0, 1, 3, 8, 15)
"""Numbers of missions after which regret is shown."""
FAR = 5.0
"""Regret in % beyond which a campaign is still far off."""


@dataclass(frozen=True)
class WorldStudy:
    """Runs of contenders on worlds, for `run_runs`."""

    table: Sequence[Run]

    def runs(self) -> list[Run]:
        """List the runs."""
        return list(self.table)

    def settings(self) -> dict[str, Any]:
        """Settings as JSON can hold them."""
        return {"worlds": sorted({run.labels["world"] for run in self.table})}


def run_worlds(
    directory: FilePath,
    *,
    data: FilePath | None = None,
    only: Sequence[str] | None = None,
    courses: Sequence[str] = COURSES,
    policies: Any = (POLICY,),
    models: Any = ("places",),
    simulator: Simulate | str | None = None,
    baselines: Sequence[str] = BASELINES,
    objective: str = OBJECTIVE,
    max_bounds: int | str = "shortest+4",
    sampler: str = "exact",
    n_iterations: int = 15,
    seeds: int = 1,
    quick: bool = False,
    executor: Any = None,
    n_workers: int | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Run models x policies, and baselines, on worlds; missions are driven by the simulator.

    Called again, it goes on where it stopped. The truth of each world is found first, on all cores.

    Args:
        directory: Folder of the results, as of `run_study`.
        data: Folder of the real terrains; without it, worlds of synthetic ones and of the real one
            that comes with the package are run.
        only: Names of worlds; by default all that `data` allows.
        courses: Names in `COURSES`.
        policies: Policies: names, your own callables, or `"module:name"` of one; or only one.
        models: Models: names of kinds as in `Study`, `TrustModel`s of your own, or `"module:name"`
            of one; or only one.
        simulator: Your own simulator, a function `simulator(workspace, *, terrain, sight, team)`
            of a true world, or its `"module:name"`.
        baselines: Names of baselines: `random`, `shortest`, `paper`, `botorch`.
        objective: Objective of the policies; regret is that of `Truth.regret`, in mean contact for
            `"mean"`, else in contact lost.
        max_bounds: Admissible paths, of the policies and of the best path.
        sampler: Sampler of the posteriors, where the model allows it; else `"nuts"`.
        n_iterations: Missions of a campaign.
        seeds: Number of campaigns for each course.
        quick: Only a small world of each of three kinds, one course and 3 missions.
        executor: See `run_study`.
        n_workers: See `run_study`.
        progress: Whether to show progress.

    Returns:
        Results as `load_study` returns them; `worlds_table` makes a table of them.

    Raises:
        TrustboError: An unknown name, or a world whose files are absent.
    """
    chosen = _chosen(worlds(data), data, only)
    if quick:
        small = [World(f"{w.name}-small", w.kind, w.ground, w.sight, w.assumed, w.max_slope,
                       shape=(5, 5), side=200.0) for w in _quick(chosen)]  # fmt: skip
        chosen, courses, n_iterations = small, courses[:1], min(n_iterations, 3)
    for course in courses:
        require_choice("course", course, COURSES)
    baselines = _available(baselines)
    entrants = contenders_of(models, policies, baselines, objective, max_bounds)
    simulating = InWorld(own=simulator)
    for world in chosen:
        simulating.truth_of(world, progress=progress)
    table = []
    for seed in range(require_whole("seeds", seeds, 1)):
        for world in chosen:
            for course in courses:
                for entrant in entrants:
                    part = WorldCourse(
                        world=world, course=course, bounds=entrant.bounds,
                        judged=(objective, max_bounds), shape=world.shape,
                    )  # fmt: skip
                    table.append(_run(part, simulating, entrant, sampler, seed, n_iterations))
    study = WorldStudy(table)
    return run_runs(study, directory, executor, n_workers=n_workers, progress=progress)


def _run(
    part: WorldCourse,
    simulating: InWorld,
    entrant: Contender,
    sampler: str,
    seed: int,
    n_iterations: int,
) -> Run:
    try:
        resolve_sampler(entrant.model.model(), sampler)
    except TrustboError:
        sampler = SAMPLER
    labels = {
        "seed": seed,
        "world": part.world.name,
        "kind": part.world.kind,
        "course": part.course,
        "contender": entrant.name,
        "policy": entrant.name,
    }
    return Run(
        labels, part, simulating, entrant.model, entrant.policy, entrant.objective, sampler, seed,
        n_iterations, dict(entrant.options),
    )  # fmt: skip


def _chosen(
    known: Mapping[str, World], data: FilePath | None, only: Sequence[str] | None
) -> list[World]:
    """Worlds to run; TrustboError: an unknown name, or absent files."""
    if only is None:
        chosen = [world for world in known.values() if world.is_packaged or data is not None]
    else:
        chosen = [known[require_choice("world", name, known)] for name in only]
    for world in chosen:
        if not world.is_made:
            world.files()
    return chosen


def _available(baselines: Sequence[str]) -> list[str]:
    """Baselines whose packages are installed; a warning names those left out."""
    left_out = [name for name in baselines if name == "botorch" and find_spec(name) is None]
    if left_out:
        warnings.warn(
            f"the baseline botorch is left out: BoTorch is not installed; {pip_install('botorch')}",
            stacklevel=3,
        )
    return [name for name in baselines if name not in left_out]


def _quick(chosen: Iterable[World]) -> list[World]:
    """One synthetic world of each of three kinds."""
    made = [world for world in chosen if world.is_made]
    first = {kind: [w for w in made if w.kind == kind][:1] for kind in ("right", "aged", "canopy")}
    return [world for found in first.values() for world in found]


def worlds_table(dataset: xr.Dataset, by: str | Sequence[str] = "contender") -> pd.DataFrame:
    """Summarise the results of `run_worlds`, with 95 % intervals.

    Intervals are those of a bootstrap over pairs of world and course, which campaigns of the same
    pair enter together.

    Args:
        dataset: Results of `run_worlds`, or `load_study`.
        by: Coordinates of the rows: `contender`, `kind`, `world`, `course`.

    Returns:
        Table with columns of two levels, the quantity and `value`, `low` and `high`: the median
        `regret after n` missions in %, the median `lost after n` in bounds more than on the best
        path, `lost while learning` (the mean of that over the missions driven), the share of
        missions that `arrive`, and of campaigns still `far` off, by more than 5 %, in the end.
    """
    by = [by] if isinstance(by, str) else list(by)
    known = {str(n) for n, c in dataset.coords.items() if c.dims == ("run",)}
    for name in by:
        require_choice("coordinate", name, sorted(known))
    numbers = _numbers(dataset)
    pairs = dataset["world"].values + "/" + dataset["course"].values
    keys = list(zip(*(dataset[name].values for name in by), strict=True))
    rows = {}
    for key in dict.fromkeys(keys):
        mine = np.array([k == key for k in keys])
        rows[key if len(by) > 1 else key[0]] = _summary(
            {name: values[mine] for name, values in numbers.items()}, pairs[mine]
        )
    table = pd.DataFrame.from_dict(rows, orient="index")
    table.columns = pd.MultiIndex.from_tuples(table.columns)
    table.index.name = " and ".join(by)
    return table


def _numbers(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Numbers of each run, shape (run,)."""
    n_missions = dataset.sizes["mission"]
    best = dataset["oracle"].values
    regret = np.concatenate([dataset["regret_before"].values[:, None], dataset["regret"]], axis=1)
    lost = np.concatenate([dataset["lost_before"].values[:, None], dataset["lost"]], axis=1)
    after = [n for n in SHOWN if n <= n_missions]
    numbers = {f"regret after {n}": regret[:, n] for n in after}
    numbers |= {f"lost after {n}": lost[:, n] - best for n in after}
    driven = dataset["lost_followed"].values - best[:, None]
    numbers["lost while learning"] = np.nanmean(driven, axis=1)
    ran = dataset["status"].values != ""
    arrived = (dataset["status"].values == "ok").sum(1) / ran.sum(1)
    return numbers | {"arrive": arrived, "far": np.where(regret[:, -1] > FAR, 1.0, 0.0)}


def _summary(numbers: Mapping[str, np.ndarray], pairs: np.ndarray) -> dict[tuple[str, str], float]:
    """Value and interval of each quantity."""
    rng, (names, index) = np.random.default_rng(0), np.unique(pairs, return_inverse=True)
    members = [np.flatnonzero(index == i) for i in range(len(names))]
    drawn = [
        np.concatenate([members[i] for i in rng.integers(len(names), size=len(names))])
        for _ in range(1000)
    ]
    row = {}
    for name, values in numbers.items():
        shares = name in ("arrive", "far", "lost while learning")
        middle = np.nanmean if shares else np.nanmedian
        low, high = np.quantile([middle(values[chosen]) for chosen in drawn], [0.025, 0.975])
        row |= {(name, "value"): float(middle(values)), (name, "low"): low, (name, "high"): high}
    return row


def as_text(table: pd.DataFrame) -> str:
    """Table of `worlds_table` in Markdown, each value with its interval."""
    names = list(dict.fromkeys(name for name, _ in table.columns))
    head = [str(table.index.name), *(f"{name} (%)" if "regret" in name else name for name in names)]
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for key, row in table.iterrows():
        label = ", ".join(map(str, key)) if isinstance(key, tuple) else str(key)
        cells = []
        for name in names:
            places = 1 if "regret" in name else 2
            value, low, high = (
                f"{row[name, what]:.{places}f}" for what in ("value", "low", "high")
            )
            cells.append(f"{value} [{low}, {high}]")
        lines.append(" | ".join([label, *cells]))
    return "\n".join(f"| {line} |" for line in lines)
