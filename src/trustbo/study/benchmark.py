"""The open benchmark: the fixed set of worlds, and methods on them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import xarray as xr

from trustbo.campaign.options import OBJECTIVE, POLICY
from trustbo.errors import require_choice, require_whole
from trustbo.files import FilePath
from trustbo.study.experiment import Experiment, Scene
from trustbo.study.methods import BASELINES, cases_of
from trustbo.study.world import COURSES, REAL, Simulate, World, scene_of
from trustbo.workspace.sight import Sight

_WALL, _BARE = Sight("wall"), Sight("bare")
_DENSE, _THIN, _LOW = Sight(extinction=0.3), Sight(extinction=0.1 / 3.0), Sight(crown_base=0.0)
_SYNTHETIC = tuple(f"synthetic-{seed}" for seed in range(3))


def _all() -> list[World]:
    kinds: list[World] = [World(ground, "right", ground) for ground in (*_SYNTHETIC, *REAL)]
    for name, sight, grounds in (
        ("wall", _WALL, ("synthetic-0", "synthetic-1", "tahoe")),
        ("bare", _BARE, ("synthetic-2", "wellington", "bcts")),
    ):
        kinds += [World(f"{ground}-{name}", name, ground, sight) for ground in grounds]
    for ground in ("synthetic-0", "synthetic-1", *REAL):
        kinds.append(World(f"{ground}-aged", "aged", ground))
    for name, assumed, grounds in (
        ("dense", _DENSE, ("synthetic-1", "wellington")),
        ("thin", _THIN, ("synthetic-2", "tahoe")),
        ("low", _LOW, ("synthetic-0", "topography", "bcts")),
    ):
        kinds += [World(f"{g}-{name}", "canopy", g, assumed=assumed) for g in grounds]
    for ground, slope in (("synthetic-0", 14.0), ("tahoe", 18.0), ("topography", 18.0)):
        kinds.append(World(f"{ground}-slopes", "slopes", ground, max_slope=slope))
    return kinds


def worlds(data: FilePath | None = None) -> dict[str, World]:
    """Worlds of the benchmark by name; see docs/worlds.md.

    Args:
        data: Folder with the real terrains, `tahoe/dem.tif` and so on. Without it, their worlds are
            listed too, but those of wellington alone, which is in the package, can be used.

    Returns:
        29 worlds, of 3 synthetic terrains and 4 real ones.
    """
    folder = None if data is None else str(data)
    return {world.name: replace(world, data=folder) for world in _all()}


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
    methods: Mapping[str, Callable[[], Any]] | None = None,
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
        policies: Policies: names, callables, or `"module:name"` of one; or only one.
        models: Models: names, `TrustModel`s, or `"module:name"` of one; or only one.
        simulator: Function `simulator(workspace, *, terrain, sight, team)` of a true world, or its
            `"module:name"`.
        baselines: Baselines: `random`, `shortest`, `paper`, or the `"module:name"` of a factory.
        methods: Further methods by the names of their rows: factories without arguments of a
            policy, which may learn by a model of another kind.
        objective: Objective of the policies; regret is that of `Truth.regret`, in mean contact for
            `"mean"`, else in contact lost.
        max_bounds: Admissible paths, of the policies and of the best path.
        sampler: Sampler of the posteriors, where the model allows it; else the default.
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
    cases = cases_of(models, policies, baselines, methods or {}, objective, max_bounds, sampler)
    n_seeds = require_whole("seeds", seeds, 1)
    scenes: list[Scene] = []
    for world in chosen:
        for course in courses:
            scenes.append(scene_of(world, course, (objective, max_bounds), simulator))
        scenes[-1].truth(progress=progress)
    settings = {"worlds": [world.name for world in chosen]}
    experiment = Experiment(
        list(cases.values()), lambda seed: scenes, range(n_seeds), n_iterations, settings
    )
    return experiment.run(directory, executor, n_workers=n_workers, progress=progress)


def _chosen(
    listed: Mapping[str, World], data: FilePath | None, only: Sequence[str] | None
) -> list[World]:
    """Worlds to run; TrustboError: an unknown name, or absent files."""
    if only is None:
        chosen = [world for world in listed.values() if world.is_packaged or data is not None]
    else:
        chosen = [listed[require_choice("world", name, listed)] for name in only]
    for world in chosen:
        if not world.is_made:
            world.files()
    return chosen


def _quick(chosen: Iterable[World]) -> list[World]:
    """One synthetic world of each of three kinds."""
    made = {world.kind: world for world in reversed(list(chosen)) if world.is_made}
    return [made[kind] for kind in ("right", "aged", "canopy") if kind in made]
