"""One run of a study: a campaign, and what is kept of it."""

import hashlib
import json
import math
import os
import socket
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from trustbo.campaign import Campaign
from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError
from trustbo.loop import Callback, missions
from trustbo.planning import Planner
from trustbo.result import Result
from trustbo.simulation import ModelSimulator, Simulator
from trustbo.stopping import RegretBound
from trustbo.study import workers
from trustbo.study.models import Model
from trustbo.study.simulators import Simulating
from trustbo.study.terrains import Terrain

OF_THE_LOOP = ("replan", "stop")
"""The options that are not the campaign's own."""


@dataclass(frozen=True)
class Run:
    """One campaign of a study.

    Attributes:
        labels: What it is called along each axis of the study.
        terrain: Where.
        simulator: What runs the paths.
        model: The trust model.
        policy: Name of the policy.
        objective: Name of the objective.
        sampler: Name of the sampler.
        seed: Of the campaign.
        n_iterations: How many missions.
        options: More options of `iterate`.
    """

    labels: dict[str, Any]
    terrain: Terrain
    simulator: Simulating
    model: Model
    policy: str
    objective: str
    sampler: str
    seed: int
    n_iterations: int
    options: dict[str, Any]

    @property
    def identity(self) -> dict[str, Any]:
        """All that its numbers depend on; names that the study gives to parts are not among it."""
        own = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "labels"}
        for name in ("terrain", "simulator", "model"):
            own[name] = own[name].identity()
        return own | {"trustbo": version("trustbo")}

    @property
    def key(self) -> str:
        """Hash of the identity: the same run has the same key on any machine."""
        text = json.dumps(_canonical(self.identity), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    def begin(self, *callbacks: Callback) -> tuple[Campaign, Iterator[object], Simulator]:
        """The campaign, its missions, of which none has been run yet, and what runs them.

        Raises:
            TrustboError: Settings that cannot be.
        """
        workspace = self.terrain.workspace()
        simulator = self.simulator.simulator(workspace)
        campaign = Campaign(
            workspace,
            *self.terrain.ends,
            model=self.model.model(),
            policy=self.policy,
            objective=self.objective,
            sampler=self.sampler,
            seed=self.seed,
            **{name: v for name, v in self.options.items() if name not in OF_THE_LOOP},
        )
        looped = {name: v for name, v in self.options.items() if name in OF_THE_LOOP}
        if isinstance(looped.get("stop"), Mapping):
            looped["stop"] = RegretBound(**looped["stop"])
        steps = missions(
            campaign, simulator, n_iterations=self.n_iterations, callbacks=callbacks, **looped
        )
        return campaign, steps, simulator

    def __str__(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.labels.items())


@dataclass
class _Referee:
    """Holds each mission against the best path there is, where the truth is known."""

    simulator: object = None
    rows: list[dict[str, Any]] = field(default_factory=list)
    oracle: float = math.nan

    def __call__(self, campaign: Campaign, mission: Mission) -> None:
        recommended = campaign.recommend().path
        row: dict[str, Any] = {"recommended": [list(cell) for cell in recommended]}
        truth = self.simulator
        if isinstance(truth, ModelSimulator):
            planner = campaign.planner.with_awareness(truth.awareness)
            if math.isnan(self.oracle):
                self.oracle = planner.plan(truth.params).value
            row["regret"] = self.oracle - _value(planner, recommended, truth)
            row["regret_followed"] = self.oracle - _value(planner, mission.path, truth)
        self.rows.append(row)


def execute(run: Run, caller: tuple[str, int]) -> dict[str, Any]:
    """Run it in this process.

    Args:
        run: The run.
        caller: Host and process the study was called in.

    Returns:
        What is kept of it: of each mission and in all; or the `error` it failed with.
    """
    workers.prepare(caller)
    started, cpu = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as caught, threadpool_limits(1):
        warnings.simplefilter("always")
        try:
            kept = _missions(run)
        except Exception as error:
            kept = {
                "error": f"{type(error).__name__}: {error}",
                "traceback": traceback.format_exc(),
            }
    return kept | {
        "seconds": time.perf_counter() - started,
        "seconds_cpu": time.process_time() - cpu,
        "warnings": sorted({str(warning.message) for warning in caught}),
        "host": socket.gethostname(),
        "process": os.getpid(),
        "versions": {name: version(name) for name in ("trustbo", "jax", "numpyro", "numpy")},
    }


def _missions(run: Run) -> dict[str, Any]:
    referee = _Referee()
    campaign, steps, referee.simulator = run.begin(referee)
    for _ in steps:
        pass
    result = campaign.result()
    return {
        "missions": _rows(result, referee.rows),
        "oracle": referee.oracle,
        "stop_reason": result.stop_reason,
    }


def _rows(result: Result, refereed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The history's numbers of each mission, and the referee's."""
    history = result.history
    scalars = [n for n, values in history.data_vars.items() if values.dims == ("iteration",)]
    rows = []
    for i, mission in enumerate(result.missions):
        row: dict[str, Any] = {"path": [list(cell) for cell in mission.path]}
        row |= {str(name): history[name].values[i].item() for name in scalars}
        row["value"] = row.pop("objective")
        rows.append(row | refereed[i])
    return rows


def _value(planner: Planner, path: tuple[Cell, ...], truth: ModelSimulator) -> float:
    """What a path is truly worth; NaN if it does not lead from start to goal."""
    try:
        return planner.evaluate(path, truth.params).value
    except TrustboError:
        return math.nan


def _canonical(value: Any) -> Any:
    """The same text for the same number: 1 for 1.0, lists for tuples."""
    if isinstance(value, dict):
        return {str(name): _canonical(v) for name, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_canonical(v) for v in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value
