"""Experiments: cases on scenes with seeds, each a run with a record; one loop for all of them."""

import hashlib
import json
import math
import os
import socket
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.result import Result
from trustbo.campaign.running import path_class
from trustbo.campaign.stopping import RegretBound
from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError
from trustbo.files import FilePath, cache_folder, interpreting
from trustbo.models.backend import VERSIONS
from trustbo.planning import Planner
from trustbo.simulation import ModelSimulator, Truth
from trustbo.simulation.protocol import Simulator
from trustbo.study import executors
from trustbo.study.methods import Case
from trustbo.study.store import Store
from trustbo.study.table import to_dataset
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location


@dataclass(frozen=True)
class Scene:
    """Workspace with start and goal, and a simulator: where cases are run.

    Attributes:
        labels: Name of the scene along each axis of the experiment.
        identity: Settings that the numbers depend on.
        make_workspace: Function `(*, bounds)`; without awareness of bounds for a case that has
            none.
        ends: Start and goal; None for the corners at the bottom left and the top right.
        simulator: Function that makes the simulator of a workspace.
        has_truth: Whether regret is held against the truth of the simulator.
        judged: Objective and admissible paths of the best path, see `path_class`; by default those
            of the campaign.
        options: Options of the campaigns on it.
    """

    labels: Mapping[str, Any]
    identity: Mapping[str, Any]
    make_workspace: Callable[..., Workspace]
    ends: tuple[Location | None, Location | None]
    simulator: Callable[[Workspace], Simulator]
    has_truth: bool = True
    judged: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    def truth(self, *, progress: bool = False) -> Truth | None:
        """Truth of the simulator, for any awareness in the workspace; None without."""
        if not self.has_truth:
            return None
        simulator = self.simulator(self.make_workspace(bounds=True))
        if isinstance(simulator, ModelSimulator):
            return None
        return Truth.of(simulator, folder=cache_folder("truth"), progress=progress)


def corners(
    ends: tuple[Location | None, Location | None], shape: tuple[int, ...]
) -> tuple[Location, Location]:
    """Start and goal, by default the corners at the bottom left and the top right."""
    return ends[0] or (shape[0] - 1, 0), ends[1] or (0, shape[1] - 1)


@dataclass(frozen=True)
class Run:
    """One campaign of an experiment."""

    case: Case
    scene: Scene
    seed: int
    n_iterations: int

    @property
    def labels(self) -> dict[str, Any]:
        """Name of the run along each axis of the experiment."""
        return {"seed": self.seed, **self.scene.labels, **self.case.labels}

    @property
    def identity(self) -> dict[str, Any]:
        """Settings that the numbers depend on: all but the names that the user gives."""
        return {
            "case": self.case.identity(),
            "scene": self.scene.identity,
            "seed": self.seed,
            "n_iterations": self.n_iterations,
            "trustbo": version("trustbo"),
        }

    @property
    def key(self) -> str:
        """Hash of the identity: the same run has the same key on any machine."""
        text = json.dumps(_canonical(self.identity), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    def begin(self, *callbacks: Any) -> tuple[Campaign, Iterator[object]]:
        """Set up the campaign, and its missions, of which none has been run yet.

        TrustboError: impossible settings.
        """
        workspace = self.scene.make_workspace(bounds=self.case.bounds)
        ends = corners(self.scene.ends, workspace.passable.shape)
        case = replace(self.case, options={**self.case.options, **self.scene.options})
        campaign = case.campaign(workspace, ends, self.seed, callbacks)
        stop = self.case.options.get("stop")
        rule = RegretBound(**stop) if isinstance(stop, Mapping) else stop
        simulator = self.scene.simulator(workspace)
        learn = getattr(campaign.policy, "learn", None)  # of one that learns by itself
        called = callbacks if learn is None else (learn, *callbacks)
        return campaign, _calling(campaign, simulator, self.n_iterations, rule, called)

    def __str__(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.labels.items())


def _calling(
    campaign: Campaign, simulator: Simulator, n: int, stop: Any, callbacks: Sequence[Any]
) -> Iterator[object]:
    """Missions of a campaign, each followed by calls of `callback(campaign, mission)`."""
    steps = campaign.run(simulator, n, stop=stop)

    def run() -> Iterator[object]:
        for plan, mission in steps:
            for callback in callbacks:
                callback(campaign, mission)
            yield plan, mission

    return run()


@dataclass(frozen=True)
class Experiment:
    """Every case on every scene with every seed.

    Attributes:
        cases: Factories of campaigns.
        scenes: Function of a seed: scenes of the runs with it.
        seeds: Seeds of the campaigns.
        n_iterations: Missions of a campaign.
        settings: Settings, as JSON can hold them, that are kept with the results.
    """

    cases: Sequence[Case]
    scenes: Callable[[int], Sequence[Scene]]
    seeds: Sequence[int]
    n_iterations: int
    settings: Mapping[str, Any] = field(default_factory=dict)

    def runs(self) -> list[Run]:
        """List the runs, seed by seed, so that the first to end are of every kind."""
        return [
            Run(case, scene, seed, self.n_iterations)
            for seed in self.seeds
            for scene in self.scenes(seed)
            for case in self.cases
        ]

    def run(
        self,
        directory: FilePath,
        executor: Any = None,
        *,
        n_workers: int | None = None,
        progress: bool = True,
    ) -> xr.Dataset:
        """Run the runs that have not ended yet, see `run_study`."""
        executors.require_executor(executor)
        store, runs = Store(directory), self.runs()
        keys = {run.key: run for run in runs}
        pending = [run for key, run in keys.items() if not store.has(key)]
        _rehearse(pending)
        store.write_study(dict(self.settings), {key: run.labels for key, run in keys.items()})
        total, failed = len(keys), []
        done = total - len(pending)
        with tqdm(total=total, initial=done, desc="runs", disable=not progress) as bar:
            ended = executors.completed(pending, execute, executor, n_workers=n_workers)
            for run, record in ended:
                theirs = record.get("versions", VERSIONS)["trustbo"]
                if theirs != VERSIONS["trustbo"]:  # the key has ours
                    ours = VERSIONS["trustbo"]
                    record["error"] = f"the worker has trustbo {theirs}, and the study {ours}"
                store.write(run.key, {"labels": run.labels, "identity": run.identity, **record})
                if "error" in record:
                    failed.append(f"{run}: {record['error']}")
                    bar.set_postfix_str(f"{len(failed)} failed")
                bar.update()
        if failed:
            message = (
                f"{len(failed)} of {total} runs failed, and are run again at the next call: "
                f"{'; '.join(failed[:3])}{'; ...' if len(failed) > 3 else ''} "
                f"(tracebacks: {store.folder / 'failed'})"
            )
            if len(failed) == total:
                raise TrustboError(message)
            warnings.warn(message, stacklevel=3)
        return load_study(directory)


def load_study(directory: FilePath) -> xr.Dataset:
    """Read the results of a study so far.

    Runs in the folder that are of another study, or another version of trustbo, are left out.

    Returns:
        Dataset with dims run and mission (1, 2, ...). For each mission: `value` (expected objective
        of its plan), `path` and `recommended` (row and col of each step, -1 after the goal),
        `regret` (true regret of the path recommended after it, in % of the contact that the best
        path keeps, see `Truth.regret`), `lost` (contact that it loses, in bounds), `p_arrive` (its
        probability to arrive), `loss` (contact that it loses more than the path that loses least,
        in bounds, those that fail or are not reached being lost) and `best` (contact lost on
        the best path), in the world of the next mission, the same with `_followed` for the path it
        followed, in the world that it was driven in, `contact_rate` (mean), `status`, diagnostics
        of the posterior (see `models.diagnostics`), and seconds. For each run: `oracle` (contact
        lost on the best path before the first mission), the first three numbers with `_before` for
        the path recommended before the first mission, `seconds` and `seconds_cpu` (of its process).
        NaN where the truth is unknown, or where there is no such mission. Coordinates of run: its
        key, and its label along each axis of the study. Attributes: the study's number of runs,
        `n_runs`, and of failed ones, `n_failed`.

    Raises:
        TrustboError: The folder holds no study, or no run of it has ended.
    """
    store = Store(directory)
    table = store.table()
    records = {key: store.read(key) for key in table if store.has(key)}
    if not records:
        raise TrustboError(f"no run of the study in {str(store.folder)!r} has ended yet.")
    with interpreting(store.folder):
        dataset = to_dataset(records, table)
    n_failed = sum(store.failure(key) is not None for key in table)
    return dataset.assign_attrs(n_runs=len(table), n_failed=n_failed)


def failures(directory: FilePath) -> pd.DataFrame:
    """List the runs of a study that failed: labels, error and traceback, by key.

    Raises:
        TrustboError: The folder holds no study.
    """
    store = Store(directory)
    rows = {key: store.failure(key) for key in store.table()}
    return pd.DataFrame.from_dict(
        {
            key: row["labels"] | {"error": row["error"], "traceback": row.get("traceback", "")}
            for key, row in rows.items()
            if row is not None
        },
        orient="index",
    )


def execute(run: Run, caller: tuple[str, int]) -> dict[str, Any]:
    """Execute a run in this process; `caller` is the host and process of the experiment.

    Returns the record of the run and of each mission; or the `error` it failed with.
    """
    executors.prepare(caller)
    started, cpu = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as caught, threadpool_limits(1):
        warnings.simplefilter("always")
        try:
            record = _record(run)
        except Exception as error:
            record = {
                "error": f"{type(error).__name__}: {error}",
                "traceback": traceback.format_exc(),
            }
    return record | {
        "seconds": time.perf_counter() - started,
        "seconds_cpu": time.process_time() - cpu,
        "warnings": sorted({str(warning.message) for warning in caught}),
        "host": socket.gethostname(),
        "process": os.getpid(),
        "versions": {name: version(name) for name in ("trustbo", "jax", "numpyro", "numpy")},
    }


@dataclass
class _Referee:
    """Compares the path recommended after each mission, and its path, with the best one.

    A recommendation is judged in the world of the next mission, a path that was followed in the
    world of its mission.
    """

    scene: Scene
    truth: Truth | None
    rows: list[dict[str, Any]] = field(default_factory=list)
    least: dict[int, float] = field(default_factory=dict)
    """Least expected loss of a path by the identity of the truth, which lives as long."""

    def __call__(self, campaign: Campaign, mission: Mission) -> None:
        followed = self.judge(campaign, mission.path, len(self.rows))
        row = self.recommended(campaign, len(self.rows) + 1)
        self.rows.append(row | {f"{name}_followed": value for name, value in followed.items()})

    def recommended(self, campaign: Campaign, mission: int) -> dict[str, Any]:
        """Path recommended for a mission by the model, or a policy with `recommend`, its value."""
        choose = getattr(campaign.policy, "recommend", None)
        path = campaign.recommend().path if choose is None else choose(campaign)
        judged = self.judge(campaign, path, mission)
        return {"recommended": [list(cell) for cell in path], **judged}

    def judge(self, campaign: Campaign, path: tuple[Cell, ...], mission: int) -> dict[str, float]:
        """Value of a path in the world of a mission, and that of the best one.

        Regret in % and contact lost in bounds, also with what failures cost (`loss`), NaN if it
        does not lead from start to goal.
        """
        planner = campaign.planner
        unknown = dict.fromkeys(("regret", "lost", "loss", "p_arrive"), math.nan)
        if self.truth is None:
            return unknown | {"best": math.nan}
        truth, (start, goal) = self.truth.at(mission), (planner.start, planner.goal)
        best = truth.lost(truth.best(start, goal, **self.class_of(planner)))
        if (path[0], path[-1]) != (start, goal):
            return unknown | {"best": best}
        regret = truth.regret(path, **self.class_of(planner))
        loss = truth.lost_or_failed(path) - self.least_of(truth, planner)
        return {
            "regret": regret, "lost": truth.lost(path), "loss": loss,
            "p_arrive": truth.p_arrive(path), "best": best,
        }  # fmt: skip

    def least_of(self, truth: Truth, planner: Planner) -> float:
        """Least expected loss of an admissible path."""
        if id(truth) not in self.least:
            judged = self.class_of(planner)
            best = truth.best(planner.start, planner.goal, **judged, failures=True)
            self.least[id(truth)] = truth.lost_or_failed(best)
        return self.least[id(truth)]

    def class_of(self, planner: Planner) -> dict[str, Any]:
        """Paths that regret is held against."""
        return {**path_class(planner), **self.scene.judged}


def _record(run: Run) -> dict[str, Any]:
    referee = _Referee(run.scene, run.scene.truth())
    campaign, steps = run.begin(referee)
    before = referee.recommended(campaign, 0)
    for _ in steps:
        pass
    result = campaign.result()
    return {
        "missions": _rows(result, referee.rows),
        "oracle": before["best"],
        **{f"{name}_before": before[name] for name in ("regret", "lost", "p_arrive")},
        "stop_reason": result.stop_reason,
    }


def _rows(result: Result, refereed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Numbers of each mission, from the history and the referee."""
    history = result.history
    scalars = [n for n, values in history.data_vars.items() if values.dims == ("iteration",)]
    rows = []
    for i, mission in enumerate(result.missions):
        row: dict[str, Any] = {"path": [list(cell) for cell in mission.path]}
        row |= {str(name): history[name].values[i].item() for name in scalars}
        row["value"] = row.pop("objective")
        rows.append(row | refereed[i])
    return rows


def _canonical(value: Any) -> Any:
    """Value with one form for each number, 1 for 1.0, and lists for tuples."""
    if isinstance(value, dict):
        return {str(name): _canonical(v) for name, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_canonical(v) for v in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def _rehearse(runs: Sequence[Run]) -> None:
    """Set up a campaign of each kind, so that impossible ones are refused now, not in an hour."""
    seen = set()
    for run in runs:
        kind = repr({name: label for name, label in run.labels.items() if name != "seed"})
        if kind in seen:
            continue
        seen.add(kind)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run.begin()
        except (TypeError, ValueError, ImportError) as error:
            raise TrustboError(f"the run {run}: {error}") from error
