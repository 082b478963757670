"""The loop: plan, run, learn, and plan again."""

import json
from collections.abc import Iterator, Sequence
from typing import Any

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.migrate import migrate_notes
from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER, CampaignOptions
from trustbo.campaign.progress import PAGE, PAGE_ALONE, Progress, continued
from trustbo.campaign.replanning import run_replanning
from trustbo.campaign.result import Result
from trustbo.campaign.stopping import (
    Stop,
    reason_to_stop,
    require_stops,
    rules_of,
    rules_to_record,
)
from trustbo.data import Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.files import FilePath, as_path, to_json
from trustbo.models.model import TrustModel
from trustbo.planning import Plan, Planner, Policy
from trustbo.simulation import KinematicSimulator, ReplaySimulator, Truth
from trustbo.simulation.protocol import Simulator, require_bounds, require_call, takes
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location


def iterate(
    workspace: Workspace,
    start: Location,
    goal: Location,
    *,
    n_iterations: int = 8,
    model: TrustModel | None = None,
    policy: str | Policy = POLICY,
    objective: str = OBJECTIVE,
    sampler: str = SAMPLER,
    simulator: Simulator | None = None,
    truth: Truth | None = None,
    stop: Stop | Sequence[Stop] | None = None,
    checkpoint: FilePath | None = None,
    seed: int = 0,
    progress: bool | str = True,
    **options: Any,
) -> Result:
    """Run a campaign: plan a path, run it, learn from the contact rates, plan again.

    Args:
        workspace: Workspace of the paths.
        start: First cell, (row, col) with row 0 at the top; or a position in it, in metres of the
            CRS, `"x=1748000,y=5427000"`, or in degrees, `"lon=174.7,lat=-41.3"`, or mappings of
            these names; see `Workspace.locate`.
        goal: Last cell, or a position in it.
        n_iterations: Largest number of missions.
        model: Trust model; by default `PooledTrust(place=PlaceEffect())`.
        policy: Name in `planning.POLICIES`, or a callable `policy(key, draws, planner) -> Plan`.
        objective: `"lost_contact"`, `"terminal"` (the paper's), `"mean"`, `"success"`,
            `"bottleneck"` or `"stationary"`; see `Planner`.
        sampler: `"auto"`, `"exact"`, `"nuts"` or `"joint"`; see `trustbo.fit`.
        simulator: Simulator with `run(path, *, seed) -> Mission`; by default
            `KinematicSimulator(workspace)`.
        truth: Truth of the simulator, `simulation.Truth.of(simulator)`: the regret of each plan
            goes into the history, in % of the contact that the best admissible path keeps.
        stop: Rules to end before `n_iterations`, asked between missions: a `RegretBound`,
            `Seconds`, a callable `stop(campaign) -> reason or None`, or several of them.
        checkpoint: Folder in which everything is kept as it goes, replacing another campaign in it.
            If the process dies, `resume` goes on from it.
        seed: Seed of everything random.
        progress: Whether to show a progress bar, and in a notebook a map that follows the
            missions; `"bar"` for the bar alone; `"page"` for report.html in the campaign's folder
            too, a page that reloads itself while the campaign runs; `"page_alone"` for it alone.
        **options: Fields of `CampaignOptions`, or a whole one as `options`.

    Returns:
        Result of all missions.

    Raises:
        TrustboError: Bad input, before any work starts.
        NoPathError: The goal cannot be reached.
    """
    n_iterations = require_whole("n_iterations", n_iterations, 1)
    if progress in (PAGE, PAGE_ALONE) and checkpoint is None:
        raise TrustboError(
            f'progress="{progress}" writes report.html into the checkpoint; give one.'
        )
    campaign = Campaign(
        workspace,
        start,
        goal,
        model=model,
        policy=policy,
        objective=objective,
        sampler=sampler,
        seed=seed,
        options=CampaignOptions.of(options, iterate),
    )
    steps = missions(
        campaign, simulator, n_iterations=n_iterations, truth=truth, stop=stop, progress=progress
    )
    with campaign:
        if checkpoint is not None:
            campaign.save(checkpoint, keep=True)
        for _ in steps:
            pass
        return campaign.result()


def resume(
    directory: FilePath,
    *,
    simulator: Simulator | None = None,
    truth: Truth | None = None,
    n_iterations: int | None = None,
    model: TrustModel | None = None,
    policy: Policy | None = None,
    stop: Stop | Sequence[Stop] | None = None,
    progress: bool | str = True,
    **own: Any,
) -> Result:
    """Go on with a campaign that `iterate(checkpoint=directory)` began, with identical results.

    One that its rule has ended gives back its result, unless `stop` or more missions are asked for;
    the rules, new or those that it was begun with, are asked before anything is driven.

    Args:
        directory: Folder of its checkpoint.
        simulator: The same simulator, unless it was the default.
        truth: Its truth, see `iterate`.
        n_iterations: Number of missions in all; by default as many as it was begun for.
        model: The same model; see `Campaign.load`.
        policy: The same policy; see `Campaign.load`.
        stop: Rules in place of those that it was begun with; needed where one was your own.
        progress: Whether to show a progress bar, and in a notebook a map that follows the
            missions; `"bar"` for the bar alone; `"page"` for report.html in the campaign's folder
            too, a page that reloads itself while the campaign runs; `"page_alone"` for it alone.
            A page that the run before left is renewed in any case.
        **own: The same `awareness` and `callbacks`; see `Campaign.load`.

    Raises:
        TrustboError: There is no campaign; another process is at work on it; or something of your
            own is missing.
        DamagedFileError: A file of the folder is missing or damaged.
    """
    with Campaign.load(directory, model=model, policy=policy, **own) as campaign:
        state, done = campaign.state, len(campaign.missions)
        total = state.notes.get("n_iterations", 8) if n_iterations is None else n_iterations
        ended = state.stop_reason not in ("interrupted", "n_iterations")
        if ended and stop is None and total <= max(done, state.notes.get("n_iterations", 8)):
            return campaign.result()
        rules = rules_of(state.notes.get("stop", [])) if stop is None else require_stops(stop)
        before = dict(state.notes)
        shown = continued(progress, as_path(directory))
        steps = missions(
            campaign, simulator, n_iterations=total, truth=truth, stop=rules, progress=shown
        )
        _require_same(before, state.notes)
        state.stop_reason = "interrupted"
        for _ in steps:
            pass
        return campaign.result()


def missions(
    campaign: Campaign,
    simulator: Simulator | None = None,
    *,
    n_iterations: int = 8,
    truth: Truth | None = None,
    stop: Stop | Sequence[Stop] | None = None,
    progress: bool | str = False,
) -> Iterator[tuple[Plan, Mission]]:
    """Run the missions of a campaign, one for each step of this generator.

    Args:
        campaign: Campaign, new or under way.
        simulator: Simulator as in `iterate`.
        n_iterations: Largest number of missions in all.
        truth: Truth as in `iterate`.
        stop: Rules as in `iterate`.
        progress: Whether to show a progress bar, and in a notebook a map that follows the
            missions; `"bar"` for the bar alone; `"page"` for report.html in the campaign's folder
            too, a page that reloads itself while the campaign runs; `"page_alone"` for it alone.

    Yields:
        Plan of each mission, and the mission, learned from already.

    Raises:
        TrustboError: Bad input, before any work starts.
    """
    require_whole("n_iterations", n_iterations, 1)
    runner: Any = KinematicSimulator(campaign.workspace) if simulator is None else simulator
    if isinstance(runner, type) or not callable(getattr(runner, "run", None)):
        made = "; make one of the class" if isinstance(runner, type) else ""
        raise TrustboError(
            f"a simulator needs run(path, *, seed) -> Mission; got {runner!r}{made}."
        )
    if campaign.options.replan == "bound":
        require_bounds(runner, 'replan="bound"')
        require_call(runner, "reset", campaign.planner.start, seed=0)
    else:
        require_call(runner, "run", [], seed=0)
    if truth is not None:
        if not isinstance(truth, Truth):
            raise TrustboError(f"truth must be Truth.of(simulator); got {truth!r}.")
        truth.require_workspace(campaign.workspace)
    rules = require_stops(stop)
    describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
    # As a file gives them back: tuples are lists there, and arrays too.
    simulated = json.loads(to_json(describe()))
    asked = {"n_iterations": n_iterations, "stop": rules_to_record(rules)}
    campaign.state.notes = {**simulated, **asked}
    return _missions(campaign, runner, n_iterations, truth, rules, progress)


def path_class(planner: Planner) -> dict[str, Any]:
    """Arguments of `Truth.best` and `Truth.regret` for the planner's admissible paths.

    The objective is contact lost, or mean contact where that is the planner's.
    """
    return {
        "objective": "mean" if planner.objective == "mean" else "lost_contact",
        "max_bounds": planner.max_bounds,
        "connectivity": planner.connectivity,
    }


def _missions(
    campaign: Campaign,
    runner: Any,
    n_iterations: int,
    truth: Truth | None,
    rules: list[Stop],
    progress: bool | str,
) -> Iterator[tuple[Plan, Mission]]:
    with Progress(campaign, n_iterations, progress) as shown:
        while True:
            # Before each mission: of a campaign that goes on, the rules may be satisfied already.
            if campaign.missions and (reason := reason_to_stop(rules, campaign)):
                campaign.stop(reason)
                return
            if len(campaign.missions) >= n_iterations:
                break
            plan = campaign.ask()
            mission = _run(campaign, runner, plan)
            extra = {}
            if truth is not None:
                now = truth.at(len(campaign.missions))
                extra["regret"] = now.regret(plan, **path_class(campaign.planner))
            # Another path from the same start is the loop's own doing, or the simulator's, and so
            # is one that repeats itself; from another start, row and col may be swapped.
            other = mission.path[:1] == plan.path[:1] or isinstance(runner, ReplaySimulator)
            campaign.tell(mission, other_path=other, again=True, **extra)
            shown.step()
            for callback in campaign.options.callbacks:
                callback(campaign, mission)
            yield plan, mission
        campaign.stop("n_iterations")


def _run(campaign: Campaign, runner: Any, plan: Plan) -> Mission:
    """Run one mission; simulators of a changing world get its number."""
    seed, number = campaign.seed_of("mission"), len(campaign.missions)
    replans = campaign.options.replan == "bound"
    numbered = (
        {"mission": number} if takes(runner.reset if replans else runner.run, "mission") else {}
    )
    if replans:
        return run_replanning(campaign, runner, plan, seed=seed, **numbered)
    return runner.run(plan.path, seed=seed, **numbered)


def _require_same(before: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to go on with another simulator than the one begun with."""
    before = migrate_notes(before, now)
    for name in now.keys() - {"n_iterations", "stop"}:
        if to_json(old := before.get(name)) != to_json(now[name]):  # as text: NaN equals itself
            raise TrustboError(
                f"the campaign was begun with {name} = {old!r}, not {now[name]!r}; give the same "
                "simulator again with simulator=."
            )
