"""One run of a study: a campaign, and the record of it."""

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

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.loop import missions
from trustbo.campaign.result import Result
from trustbo.campaign.stopping import RegretBound
from trustbo.data import Cell, Mission
from trustbo.planning import POLICIES
from trustbo.simulation import Truth
from trustbo.study import workers
from trustbo.study.contenders import identity_of, resolved
from trustbo.study.parts import Simulating
from trustbo.study.terrains import Terrain


@dataclass(frozen=True)
class Run:
    """One campaign of a study.

    Attributes:
        labels: Its name along each axis of the study.
        terrain: Terrain, with start and goal.
        simulator: Simulator that runs the paths.
        model: Trust model.
        policy: Name of the policy, a policy, or the `"module:name"` of one.
        objective: Name of the objective.
        sampler: Name of the sampler.
        seed: Seed of the campaign.
        n_iterations: Number of missions.
        options: Options of the campaign, see `Study`.
    """

    labels: dict[str, Any]
    terrain: Terrain
    simulator: Simulating
    model: Any
    policy: Any
    objective: str
    sampler: str
    seed: int
    n_iterations: int
    options: dict[str, Any]

    @property
    def identity(self) -> dict[str, Any]:
        """Everything that its numbers depend on; names that the study gives to parts are not."""
        own = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "labels"}
        for name in ("terrain", "simulator", "model"):
            own[name] = own[name].identity()
        own["policy"] = identity_of(self.policy)
        return own | {"trustbo": version("trustbo")}

    @property
    def key(self) -> str:
        """Hash of the identity: the same run has the same key on any machine."""
        text = json.dumps(_canonical(self.identity), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    def begin(self, *callbacks: Any) -> tuple[Campaign, Iterator[object]]:
        """Set up the campaign, and its missions, of which none has been run yet.

        TrustboError: impossible settings.
        """
        options = dict(self.options)
        stop = options.pop("stop", None)
        workspace, policy = self.terrain.workspace(), resolved("policy", self.policy, POLICIES)
        learn = getattr(policy, "learn", None)  # of one that learns by itself
        campaign = Campaign(
            workspace,
            *self.terrain.ends,
            model=self.model.model(),
            policy=self.policy if self.policy in POLICIES else policy,
            objective=self.objective,
            sampler=self.sampler,
            seed=self.seed,
            callbacks=callbacks if learn is None else (learn, *callbacks),
            **options,
        )
        rule = RegretBound(**stop) if isinstance(stop, Mapping) else stop
        simulator = self.simulator.simulator(self.terrain)
        return campaign, missions(campaign, simulator, n_iterations=self.n_iterations, stop=rule)

    def truth(self) -> Truth | None:
        """Truth of the simulator, where it is known."""
        return self.simulator.truth(self.terrain)

    def recommend(self, campaign: Campaign) -> tuple[Cell, ...]:
        """Path that is recommended now, by the model or, where the policy has its own, by that."""
        own = getattr(campaign.policy, "recommend", None)
        return campaign.recommend().path if own is None else own(campaign)

    def __str__(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.labels.items())


@dataclass
class _Referee:
    """Compares the path recommended after each mission, and its own, with the best one."""

    run: Run
    truth: Truth | None
    rows: list[dict[str, Any]] = field(default_factory=list)

    def __call__(self, campaign: Campaign, mission: Mission) -> None:
        followed = self.judge(campaign, mission.path)
        row = self.recommended(campaign)
        self.rows.append(row | {f"{name}_followed": value for name, value in followed.items()})

    def recommended(self, campaign: Campaign) -> dict[str, Any]:
        """Path that is recommended now, and how good it is."""
        path = self.run.recommend(campaign)
        return {"recommended": [list(cell) for cell in path], **self.judge(campaign, path)}

    def judge(self, campaign: Campaign, path: tuple[Cell, ...]) -> dict[str, float]:
        """Regret in % and contact lost in bounds; NaN if it does not lead from start to goal."""
        ends = campaign.planner.start, campaign.planner.goal
        if self.truth is None or (path[0], path[-1]) != ends:
            return {"regret": math.nan, "lost": math.nan, "p_arrive": math.nan}
        value = self.truth.value(path)
        regret = self.truth.regret(path, **self.run.terrain.judged_by(campaign.planner))
        return {"regret": regret, "lost": value.lost, "p_arrive": value.p_arrive}

    def oracle(self, campaign: Campaign) -> float:
        """Contact lost on the best path, in bounds; NaN where the truth is not known."""
        if self.truth is None:
            return math.nan
        judged_by = self.run.terrain.judged_by(campaign.planner)
        return self.truth.value(self.truth.best(*self.run.terrain.ends, **judged_by)).lost


def execute(run: Run, caller: tuple[str, int]) -> dict[str, Any]:
    """Execute a run in this process; `caller` is the host and process that the study was called in.

    Returns the record of the run and of each mission; or the `error` it failed with.
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
    referee = _Referee(run, run.truth())
    campaign, steps = run.begin(referee)
    before = referee.recommended(campaign)
    for _ in steps:
        pass
    result = campaign.result()
    return {
        "missions": _rows(result, referee.rows),
        "oracle": referee.oracle(campaign),
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
