"""Missions of a campaign, run by a simulator."""

import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from trustbo.campaign.planners import path_class
from trustbo.campaign.progress import Progress
from trustbo.campaign.stopping import Stop, reason_to_stop, require_stops
from trustbo.data import Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.files import to_json
from trustbo.planning import Plan
from trustbo.simulation import KinematicSimulator, Truth
from trustbo.simulation.protocol import Simulator

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign


def run_missions(
    campaign: "Campaign",
    simulator: Simulator | None,
    n_iterations: int,
    truth: Truth | None,
    stop: Stop | Sequence[Stop] | None,
    progress: bool,
) -> Iterator[tuple[Plan, Mission]]:
    """Check everything, then run the missions of a campaign, see `Campaign.run`."""
    require_whole("n_iterations", n_iterations, 1)
    runner: Any = KinematicSimulator(campaign.workspace) if simulator is None else simulator
    if isinstance(runner, type) or not callable(getattr(runner, "run", None)):
        made = "; make one of the class" if isinstance(runner, type) else ""
        raise TrustboError(
            f"a simulator needs run(path, *, seed, mission) -> Mission; got {runner!r}{made}."
        )
    if truth is not None:
        if not isinstance(truth, Truth):
            raise TrustboError(f"truth must be Truth.of(simulator); got {truth!r}.")
    rules = require_stops(stop)
    describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
    # As a file gives them back: tuples are lists there, and arrays too.
    simulated = json.loads(to_json(describe()))
    campaign.state.notes = {**simulated, "n_iterations": n_iterations}
    return _run_missions(campaign, runner, n_iterations, truth, rules, progress)


def _run_missions(
    campaign: "Campaign",
    runner: Any,
    n_iterations: int,
    truth: Truth | None,
    rules: list[Stop],
    progress: bool,
) -> Iterator[tuple[Plan, Mission]]:
    with Progress(campaign, n_iterations, progress) as shown:
        while True:
            n = len(campaign.missions)
            # Before each mission: of a campaign that goes on, the rules may be satisfied already.
            if n and (reason := reason_to_stop(rules, campaign)):
                campaign.stop(reason)
                return
            if n >= n_iterations:
                break
            plan = campaign.ask()
            mission = runner.run(plan.path, seed=campaign.seed_of("mission"), mission=n)
            extra = {}
            if truth is not None:
                extra["regret"] = truth.at(n).regret(plan.path, **path_class(campaign.planner))
            campaign.tell(mission, **extra)
            shown.step()
            for callback in campaign.options.callbacks:
                callback(campaign, mission)
            yield plan, mission
        campaign.stop("n_iterations")
