"""Settings of a study, checked before any work starts, and the experiment that they mean."""

import inspect
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache, partial
from os import PathLike
from pathlib import Path
from typing import Any, Self

import xarray as xr

from trustbo.errors import (
    TrustboError,
    require_choice,
    require_known,
    require_pair,
    require_whole,
)
from trustbo.files import FilePath, read_yaml
from trustbo.inference.samplers.choice import SAMPLERS, resolve_sampler
from trustbo.models.model import TrustModel
from trustbo.planning import OBJECTIVES, POLICIES
from trustbo.simulation import ModelSimulator
from trustbo.simulation.protocol import Simulator
from trustbo.study.calls import FILES, call_of, identity, made, parameters_of, seeded
from trustbo.study.experiment import Experiment, Scene, corners
from trustbo.study.methods import FIT_OPTIONS, PLANNER_OPTIONS, Case, Model, model_from, model_of
from trustbo.team import Team
from trustbo.workspace import Workspace, survey
from trustbo.workspace.location import CELL, named

OPTIONS = (
    *PLANNER_OPTIONS,
    *FIT_OPTIONS,
    "initial",
    "hazard",
    "stop",
)
"""Names in `Study.options`."""
TERRAINS = ("synthetic_terrain", "read_terrain", "read_lidar", "example", "random_workspace")
SIMULATORS = ("KinematicSimulator", "ModelSimulator")
MODEL_KINDS = ("PooledTrust", "HierarchicalTrust", "CoupledTrust")
_GRID = tuple(inspect.signature(Workspace.from_terrain).parameters)[1:]
"""Keywords of the planning grid, which a terrain has in addition to those of its constructor."""
_ENDS = ("start", "goal")


def _scene(
    labels: Mapping[str, Any], terrain: Mapping[str, Any], simulating: Mapping[str, Any], seed: int
) -> Scene:
    """Scene of the run with this seed, from settings of a terrain and a simulator."""
    terrain, simulator = seeded(terrain, seed), seeded(simulating, seed)
    known_truth = simulator.pop("known_truth")
    alone, grid = _of_grid(terrain)
    ends = tuple(terrain.get(name) for name in _ENDS)
    settings = {"terrain": identity(alone), "grid": identity(grid), "ends": ends,
                "simulator": identity(simulator), "known_truth": known_truth}  # fmt: skip
    has_truth = known_truth or simulator["kind"] == ModelSimulator.__name__  # which costs nothing
    workspace = partial(_workspace, json.dumps(terrain))
    return Scene(labels, settings, workspace, made(ends), partial(_simulate, simulator), has_truth)


def _simulate(settings: Mapping[str, Any], workspace: Workspace) -> Simulator:
    return made(settings, workspace=workspace)


def _of_grid(terrain: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings of the terrain alone, and of its planning grid."""
    names = "kind", *parameters_of(terrain["kind"])
    alone = {n: v for n, v in terrain.items() if n in names}
    return alone, {n: v for n, v in terrain.items() if n not in (*alone, *_ENDS)}


@lru_cache(maxsize=4)
def _workspace(settings: str, *, bounds: bool) -> Workspace:
    """Workspace of a terrain's settings in JSON, made once per process, for a few terrains."""
    terrain = json.loads(settings)
    alone, grid = _of_grid(terrain)
    ground, keywords = made(alone), made(grid)
    if isinstance(ground, Workspace):
        if keywords:
            raise TrustboError(
                f"{terrain['kind']} makes a workspace, which takes no {', '.join(keywords)}."
            )
        return ground
    if not isinstance(ground, xr.Dataset):
        raise TrustboError(f"{terrain['kind']} must make a terrain or a Workspace; got {ground!r}.")
    cells = survey(ground, keywords.get("shape", (10, 10)), keywords.get("team") or Team())
    start, goal = (made(terrain.get(name)) for name in _ENDS)
    for name, end in zip(_ENDS, corners((start, goal), cells.grid.shape), strict=True):
        cells.require_cell(name, end)  # before awareness is computed
    return Workspace.from_terrain(ground, **{"bounds": bounds} | keywords)


@dataclass(frozen=True)
class Study:
    """Every policy with every objective, model, sampler, simulator, terrain, option and seed.

    Terrains, simulators and models are mappings of names to settings: the `kind` is a public
    constructor, such as `KinematicSimulator`, or `"module:name"`, and the rest its keywords, which
    may have a `kind` too; or lists of kinds, with their defaults. See docs/studies.md.

    Attributes:
        terrains: Terrains, with keywords of `Workspace.from_terrain`, `start` and `goal`.
        policies: Names in `planning.POLICIES`.
        objectives: Names in `planning.OBJECTIVES`.
        models: Models, or the names `robots`, `places`, `pooled`, `hierarchical`, `coupled`.
        samplers: `"auto"`, `"exact"`, `"nuts"`.
        simulators: Simulators, with `known_truth` where regret is asked for.
        seeds: Seeds, or their number: 0, 1, ...
        n_iterations: Missions of a run.
        options: Options of `Planner` and of `fit`, `initial`, `hazard`, and `stop`, the settings of
            a `RegretBound`; a list of values means each of them.

    Raises:
        TrustboError: An unknown name or setting, or an impossible value.
    """

    terrains: Any
    policies: Any = ("greedy",)
    objectives: Any = ("lost_contact",)
    models: Any = ("pooled",)
    samplers: Any = ("auto",)
    simulators: Any = ("KinematicSimulator",)
    seeds: Any = 1
    n_iterations: int = 8
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        keep = object.__setattr__
        for what, check in (("terrain", _terrain), ("simulator", _simulator), ("model", _model)):
            keep(self, f"{what}s", _by_name(what, getattr(self, f"{what}s"), check))
        for what, plural, choices in (
            ("policy", "policies", POLICIES),
            ("objective", "objectives", OBJECTIVES),
            ("sampler", "samplers", SAMPLERS),
        ):
            names = _listed(plural, getattr(self, plural))
            keep(self, plural, tuple(require_choice(what, name, choices) for name in names))
        seeds = self.seeds
        if not isinstance(seeds, list | tuple | range):
            seeds = range(require_whole("seeds (how many, or a list)", seeds, 1))
        seeds = [require_whole("seed", seed, 0) for seed in _listed("seeds", list(seeds))]
        keep(self, "seeds", tuple(seeds))
        keep(self, "n_iterations", require_whole("n_iterations", self.n_iterations, 1))
        keep(self, "options", _options(self.options))
        for name, model in self.models.items():
            for sampler in self.samplers:
                try:
                    resolve_sampler(model_of(model), sampler)
                except TrustboError as error:
                    raise TrustboError(f"model {name!r}: {error}") from None

    @classmethod
    def of(cls, configuration: "Study | Mapping[str, Any]") -> Self:
        """Study with these settings.

        Raises:
            TrustboError: The settings are no mapping, or one of them is unknown.
        """
        if isinstance(configuration, cls):
            return configuration
        if not isinstance(configuration, Mapping):
            raise TrustboError(f"a study is a Study or a mapping; got {configuration!r}.")
        require_known("setting of a study", configuration, [f.name for f in fields(cls)])
        if "terrains" not in configuration:
            raise TrustboError("a study needs terrains, e.g. terrains: [random_workspace].")
        return cls(**configuration)

    def experiment(self) -> Experiment:
        """Every case of a model and a policy on every terrain, with every simulator and seed."""
        axes: dict[str, Any] = {
            "model": self.models,
            "sampler": self.samplers,
            "objective": self.objectives,
            **self.options,
            "policy": self.policies,
        }
        cases = []
        for values in itertools.product(*axes.values()):
            labels = dict(zip(axes, values, strict=True))
            cases.append(Case(
                labels, self.models[labels["model"]], labels["policy"], labels["objective"],
                labels["sampler"], {name: labels[name] for name in self.options},
            ))  # fmt: skip
        return Experiment(cases, self._scenes, self.seeds, self.n_iterations, self.settings())

    def _scenes(self, seed: int) -> list[Scene]:
        return [
            _scene({"terrain": ground, "simulator": name}, terrain, simulator, seed)
            for ground, terrain in self.terrains.items()
            for name, simulator in self.simulators.items()
        ]

    def settings(self) -> dict[str, Any]:
        """JSON-serialisable settings, which `Study.of` reads."""
        settings = {f.name: getattr(self, f.name) for f in fields(self)}
        models = self.models.items()
        settings["models"] = {n: repr(m) if isinstance(m, TrustModel) else m for n, m in models}
        return settings


def run_study(
    study: Study | Mapping[str, Any] | FilePath,
    directory: FilePath,
    executor: Any = None,
    *,
    n_workers: int | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Run the runs of a study that have not ended yet.

    Args:
        study: Study, a mapping of its settings, or a YAML file of them.
        directory: Folder of the results, a file for each run. Called again, a study goes on where
            it stopped, and repeats runs that failed.
        executor: `None` or `"serial"`: this process, one run after the other. `"loky"` or `"dask"`:
            a process for each core, of a local cluster in the case of Dask. The address of a Dask
            scheduler (`"tcp://..."`), a `distributed.Client`, or any `concurrent.futures.Executor`
            that does not fork.
        n_workers: Number of processes that `"loky"` and `"dask"` start; by default one for each
            core.
        progress: Whether to show a progress bar.

    Returns:
        Results as `load_study` returns them. A warning names runs that failed; `failures` lists
        them.

    Raises:
        TrustboError: An impossible study or executor, before any work starts; or every run failed.
    """
    if isinstance(study, str | PathLike):
        study = read_study(study)
    experiment = Study.of(study).experiment()
    return experiment.run(directory, executor, n_workers=n_workers, progress=progress)


def read_study(path: FilePath) -> Study:
    """Read a study from a YAML file, of this version or 0.2; files are relative to its folder.

    Raises:
        TrustboError: No such file, no YAML, or settings that `Study` refuses.
    """
    file = Path(path)
    configuration = read_yaml(file)
    try:
        return Study.of(_from_folder(file.parent, configuration))
    except TrustboError as error:
        raise TrustboError(f"{file}: {error}") from None


_OLD = {
    "terrain": {"synthetic": "synthetic_terrain", "files": "read_terrain",
                "random": "random_workspace"},
    "simulator": {"kinematic": "KinematicSimulator", "model": "ModelSimulator"},
    "model": {"pooled": "PooledTrust", "places": "PooledTrust", "hierarchical": "HierarchicalTrust",
              "coupled": "CoupledTrust"},
}  # fmt: skip
"""Kinds of version 0.2, which models may still have, and the constructors that they mean."""


def migrate(what: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a terrain, simulator or model of version 0.2 as those of this one.

    Settings of this version are returned unchanged.
    """
    new = dict(settings)
    kind = new.pop("kind", None)
    if kind == "own" and what == "model":
        return {"kind": new.get("source")}
    if kind not in _OLD[what]:
        return dict(settings)
    if kind in ("synthetic", "files") and (n_robots := new.pop("n_robots", 3)) != 3:
        new["team"] = {"kind": "Team", "n_robots": n_robots}
    if kind == "places":
        names = [name for name in ("cells", "bounds") if name in new]
        new["place"] = {"kind": "PlaceEffect", **{name: new.pop(name) for name in names}}
    if what == "model" and new.get("priors") == "default":
        del new["priors"]
    if kind == "model":
        observation = new.pop("observation", "gaussian")
        n_ticks = {"n_ticks": new.pop("n_ticks")} if "n_ticks" in new else {}
        new = {"params": {"kind": "TrustParams", **new}, **n_ticks}
        if observation != "gaussian":
            new["model"] = {"kind": "PooledTrust", "observation": observation}
    return {"kind": _OLD[what][kind], **new}


def _by_name(what: str, given: object, check: Any) -> dict[str, Any]:
    """Settings of terrains, simulators or models by their names.

    Given are names of kinds, or a mapping of names to settings, whose `kind` may be left out where
    the name is that of a kind. TrustboError: another type, or an unknown kind or setting.
    """
    if not isinstance(given, Mapping):
        names = [given] if isinstance(given, str) else given
        names = names if isinstance(names, list | tuple) else (names,)
        given = {name: None for name in names if isinstance(name, str)}
        if len(given) != len(names):
            raise TrustboError(
                f"{what}s must be distinct names of kinds, or a mapping of names to settings; "
                f"got {names!r}."
            )
    if not given:
        raise TrustboError(f"a study needs at least one {what}; got none.")
    checked = {}
    for name, settings in given.items():
        noun = f"{what} {str(name)!r}"
        if isinstance(settings, Mapping | None):
            settings = migrate(what, {"kind": str(name), **(settings or {})})
        elif not (what == "model" and isinstance(settings, TrustModel)):
            raise TrustboError(f"{noun} must be a mapping of settings; got {settings!r}.")
        try:
            checked[str(name)] = check(noun, settings)
        except TrustboError as error:
            prefix = "" if repr(str(name)) in str(error) else f"{noun}: "
            raise TrustboError(f"{prefix}{error}") from None
    return checked


def _terrain(noun: str, settings: dict[str, Any]) -> dict[str, Any]:
    whole = settings["kind"] == "random_workspace"  # a workspace takes no keywords of a grid
    checked = call_of(noun, settings, TERRAINS, more=(*(() if whole else _GRID), *_ENDS))
    if checked.get("shape") is not None:
        require_pair("shape", checked["shape"])
    for name in _ENDS:
        if checked.get(name) is not None:
            end = named(name, checked[name])
            checked[name] = list(end.values) if end.names == CELL else end.text
    return {name: value for name, value in checked.items() if name not in _ENDS or value}


def _simulator(noun: str, settings: dict[str, Any]) -> dict[str, Any]:
    more = ("known_truth",)
    checked = {"known_truth": False} | call_of(
        noun, settings, SIMULATORS, given=("workspace",), more=more
    )
    if not isinstance(checked["known_truth"], bool):
        raise TrustboError(f"known_truth must be true or false; got {checked['known_truth']!r}.")
    return checked


def _model(noun: str, settings: dict[str, Any] | TrustModel) -> Model:
    if isinstance(settings, TrustModel):
        return settings
    kind = settings["kind"]
    if len(settings) == 1 and (isinstance(kind, TrustModel) or ":" in str(kind)):
        return model_from(kind)
    checked = call_of(noun, settings, MODEL_KINDS)
    model_of(checked)
    return checked


def _from_folder(folder: Path, settings: Any, name: str = "") -> Any:
    """Settings with the names of files relative to a folder."""
    if isinstance(settings, Mapping):
        return {n: _from_folder(folder, value, n) for n, value in settings.items()}
    if isinstance(settings, list):
        return [_from_folder(folder, one, name) for one in settings]
    return str(folder / settings) if name in FILES and isinstance(settings, str) else settings


def _listed(what: str, values: object) -> Sequence[Any]:
    """List of distinct values, at least one."""
    listed = list(values) if isinstance(values, list | tuple) else [values]
    if not listed or len({repr(value) for value in listed}) < len(listed):
        raise TrustboError(f"{what} must be at least one, and distinct; got {listed}.")
    return listed


def _options(options: object) -> dict[str, tuple[Any, ...]]:
    """Values of each option."""
    if not isinstance(options, Mapping):
        raise TrustboError(f"options must be a mapping of names to values; got {options!r}.")
    for name, value in options.items():
        require_choice("option", name, OPTIONS)
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            raise TrustboError(
                f"option {name!r} must be a number, a name, or a list of these; got {value!r}."
            ) from None
    return {name: tuple(_listed(name, value)) for name, value in options.items()}
