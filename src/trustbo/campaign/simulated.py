"""Missions of a campaign in a simulator."""

import json
from collections.abc import Callable, Generator, Sequence
from typing import Any

from trustbo.campaign.result import Result, in_a_line
from trustbo.campaign.settings import name_of
from trustbo.campaign.stopping import Stop
from trustbo.data import Cell, Mission
from trustbo.display import bar as progress_bar
from trustbo.display import refreshing
from trustbo.errors import TrustboError, warn
from trustbo.files import to_json
from trustbo.planning import Plan
from trustbo.simulation import KinematicSimulator, RealtimeAwareness
from trustbo.simulation.protocol import Simulator, reads_post_sets


def require_simulator(campaign: Result, simulator: Simulator | None) -> Simulator:
    """Return the simulator of a campaign; by default, the kinematic one.

    The default robots measure awareness if the campaign learns from it. Raises TrustboError for
    another object.
    """
    if simulator is None:
        usual = KinematicSimulator(campaign.workspace)
        is_measured = campaign.state.settings["awareness"] == "measured"
        return RealtimeAwareness(usual) if is_measured else usual

    if isinstance(simulator, type) or not callable(getattr(simulator, "run", None)):
        raise TrustboError(
            f"simulator needs a method run(path, *, seed, mission) -> Mission; got {simulator!r}."
        )

    if campaign.workspace.n_posts > 1 and not reads_post_sets(simulator):
        warn(
            "the simulator's robots always stand at their standard posts, because its method run "
            "has no argument post_sets, but plans choose among "
            f"{campaign.workspace.n_posts} sets of posts; add the argument, or make the workspace "
            "with n_posts=1."
        )
    return simulator


def settings_of(
    simulator: Simulator, n_iterations: int, courses: Sequence[tuple[Cell, Cell]]
) -> dict[str, Any]:
    """Return the settings of a simulation as if they were read from a file."""
    describe = getattr(simulator, "describe", lambda: {"simulator": type(simulator).__name__})
    settings = {**describe(), "n_iterations": n_iterations}
    if courses:
        settings["courses"] = courses
    return json.loads(to_json(settings))


def run_missions(
    campaign: Result,
    ask: Callable[..., Plan],
    tell: Callable[..., Any],
    simulator: Simulator,
    n_iterations: int,
    courses: Sequence[tuple[Cell, Cell]],
    stop: Stop | None,
    progress: bool,
) -> Generator[tuple[Plan, Mission], None, str]:
    """Run missions for `Campaign.run`; returns the reason why they ended.

    Without `courses`, all missions have the course of the campaign.
    """
    options = {"total": n_iterations, "initial": len(campaign.missions), "desc": "missions"}
    with progress_bar(progress, **options) as bar, refreshing(bar):
        # Check the rule before each mission: it may already apply when a campaign is resumed.
        while not (reason := _reason_to_end(campaign, n_iterations, stop)):
            n = len(campaign.state.entries)
            plan = ask(*courses[n % len(courses)]) if courses else ask()
            seed = campaign.state.seed_of("mission")
            mission = simulator.run(plan.path, seed=seed, mission=n, **sets_for(simulator, plan))
            tell(mission, again=True)  # a simulator without noise may repeat itself
            bar.set_postfix_str(in_a_line(campaign.state.row(n)), refresh=False)
            bar.update()
            yield plan, mission
    return reason


def sets_for(simulator: Simulator, plan: Plan) -> dict[str, Sequence[str]]:
    """Return the argument `post_sets` for a simulator that has it, if not all are standard."""
    return {"post_sets": plan.post_sets} if plan.post_sets and reads_post_sets(simulator) else {}


def _reason_to_end(campaign: Result, n_iterations: int, stop: Stop | None) -> str | None:
    """Return the reason to stop, or None to continue."""
    n = len(campaign.state.entries)
    if n and stop is not None:
        verdict = stop(campaign)
        if verdict:
            return verdict if isinstance(verdict, str) else name_of(stop)
    return "n_iterations" if n >= n_iterations else None
