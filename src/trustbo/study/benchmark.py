"""The open benchmark: methods on the fixed set of worlds."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import xarray as xr

from trustbo.errors import TrustboError, require_choice, require_whole
from trustbo.files import FilePath
from trustbo.study.experiment import Experiment, Scene
from trustbo.study.methods import BASELINES, cases_of
from trustbo.study.world import COURSES, Simulate, World, scene_of
from trustbo.study.world_set import worlds


def run_worlds(
    directory: FilePath,
    *,
    data: FilePath | None = None,
    only: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    courses: Sequence[str] = COURSES,
    policies: Any = ("greedy",),
    models: Any = ("robots",),
    simulator: Simulate | str | None = None,
    baselines: Sequence[str] = tuple(BASELINES),
    methods: Mapping[str, Callable[[], Any]] | None = None,
    objective: str = "lost_contact",
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
        only: Names of worlds; by default all of the kinds that `data` allows.
        kinds: Kinds of worlds; by default all.
        courses: Names in `COURSES`.
        policies: Policies: names, callables, or `"module:name"` of one; or only one.
        models: Models: names, `TrustModel`s, or `"module:name"` of one; or only one.
        simulator: Function `simulator(workspace, *, terrain, sight, team)` of a true world, and
            with `events` of one where something happens, or its `"module:name"`.
        baselines: Baselines: `random`, `shortest`, `paper`, or the `"module:name"` of a factory.
        methods: Further methods by the names of their rows: factories without arguments of a
            policy, which may learn by a model of another kind.
        objective: Objective of the policies; regret is that of `Truth.regret`, in mean contact for
            `"mean"`, else in contact lost.
        max_bounds: Admissible paths, of the policies and of the best path.
        sampler: Sampler of the posteriors, where the model allows it; else the default.
        n_iterations: Missions of a campaign.
        seeds: Number of campaigns for each course.
        quick: Only a small world of each of five kinds, one course and 3 missions.
        executor: See `run_study`.
        n_workers: See `run_study`.
        progress: Whether to show progress.

    Returns:
        Results as `load_study` returns them; `worlds_table` makes a table of them.

    Raises:
        TrustboError: An unknown name, or a world whose files are absent.
    """
    chosen = _chosen(worlds(data), data, only, kinds)
    if quick:
        chosen = [
            replace(world, name=f"{world.name}-small", shape=(5, 5), cell=40.0)
            for world in _quick(chosen)
        ]
        courses, n_iterations = courses[:1], min(n_iterations, 3)
    for course in courses:
        require_choice("course", course, COURSES)
    cases = cases_of(models, policies, baselines, methods or {}, objective, max_bounds, sampler)
    n_seeds = require_whole("seeds", seeds, 1)
    scenes: list[Scene] = []
    for world in chosen:
        for course in courses:
            scenes.append(scene_of(world, course, (objective, max_bounds), simulator))
        truth = scenes[-1].truth(progress=progress)
        if truth is not None:
            for mission in range(n_iterations + 1):
                truth.at(mission)  # on disk before the runs
    settings = {"worlds": [world.name for world in chosen]}
    experiment = Experiment(
        list(cases.values()), lambda seed: scenes, range(n_seeds), n_iterations, settings
    )
    return experiment.run(directory, executor, n_workers=n_workers, progress=progress)


def _chosen(
    listed: Mapping[str, World],
    data: FilePath | None,
    only: Sequence[str] | None,
    kinds: Sequence[str] | None,
) -> list[World]:
    """Worlds to run; TrustboError: an unknown name or kind, none of both, or absent files."""
    every = list(dict.fromkeys(world.kind for world in listed.values()))
    allowed = [require_choice("kind of world", kind, every) for kind in kinds or every]
    if only is None:
        chosen = [world for world in listed.values() if world.is_packaged or data is not None]
    else:
        chosen = [listed[require_choice("world", name, listed)] for name in only]
    chosen = [world for world in chosen if world.kind in allowed]
    if not chosen:
        raise TrustboError(f"no world of {', '.join(only or ())} is of kind {', '.join(allowed)}.")
    for world in chosen:
        if not world.is_made:
            world.files()
    return chosen


def _quick(chosen: Iterable[World]) -> list[World]:
    """One synthetic world of each of some kinds."""
    made = {world.kind: world for world in reversed(list(chosen)) if world.is_made}
    return [made[kind] for kind in ("right", "aged", "canopy", "days", "physics") if kind in made]
