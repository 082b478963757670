"""The loop: plan, run, learn, and plan again."""

import logging
from collections.abc import Iterator, Sequence
from os import PathLike
from typing import Any

from tqdm import tqdm

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER, CampaignOptions
from trustbo.campaign.replanning import require_bounds, run_replanning, takes
from trustbo.campaign.result import Result
from trustbo.campaign.stopping import Stop, reason_to_stop, require_stops
from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.models import TrustModel
from trustbo.planning import Plan, Policy
from trustbo.simulation import KinematicSimulator, Simulator
from trustbo.workspace import Workspace

_log = logging.getLogger(__name__)


def iterate(
    workspace: Workspace,
    start: Cell,
    goal: Cell,
    *,
    n_iterations: int = 8,
    model: TrustModel | None = None,
    policy: str | Policy = POLICY,
    objective: str = OBJECTIVE,
    sampler: str = SAMPLER,
    simulator: Simulator | None = None,
    stop: Stop | Sequence[Stop] | None = None,
    checkpoint: str | PathLike[str] | None = None,
    seed: int = 0,
    progress: bool = True,
    **options: Any,
) -> Result:
    """Run a campaign: plan a path, run it, learn from the contact rates, plan again.

    Args:
        workspace: Workspace of the paths.
        start: First cell, (row, col); row 0 is the top.
        goal: Last cell.
        n_iterations: Largest number of missions.
        model: Trust model; by default `PooledTrust()`.
        policy: Name in `planning.POLICIES`, or a callable `policy(key, draws, planner) -> Plan`.
        objective: `"terminal"` (the paper's), `"mean"`, `"success"`, `"bottleneck"` or
            `"stationary"`; see `Planner`.
        sampler: `"nuts"`, `"exact"` or `"joint"`; see `trustbo.models.fit`.
        simulator: Simulator with `run(path, *, seed) -> Mission`; by default
            `KinematicSimulator(workspace)`. If it also has `regret(plan) -> float`, the truth being
            known, that goes into the history.
        stop: Rules to end before `n_iterations`: a `RegretBound`, `Seconds`, a callable
            `stop(campaign) -> reason or None`, or several of them.
        checkpoint: Folder in which everything is kept as it goes, replacing another campaign in it.
            If the process dies, `resume` goes on from it.
        seed: Seed of everything random.
        progress: Whether to show a progress bar.
        **options: Fields of `CampaignOptions`, or a whole one as `options`.

    Returns:
        Result of all missions.

    Raises:
        TrustboError: Bad input, before any work starts.
        NoPathError: The goal cannot be reached.
        PosteriorError: A posterior's diagnostics are bad.
    """
    n_iterations = require_whole("n_iterations", n_iterations, 1)
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
    steps = missions(campaign, simulator, n_iterations=n_iterations, stop=stop, progress=progress)
    with campaign:
        if checkpoint is not None:
            campaign.keep(checkpoint)
        for _ in steps:
            pass
        return campaign.result()


def resume(
    directory: str | PathLike[str],
    *,
    simulator: Simulator | None = None,
    n_iterations: int | None = None,
    model: TrustModel | None = None,
    policy: Policy | None = None,
    stop: Stop | Sequence[Stop] | None = None,
    progress: bool = True,
    **own: Any,
) -> Result:
    """Go on with a campaign that `iterate(checkpoint=directory)` began, with identical results.

    Args:
        directory: Folder of its checkpoint.
        simulator: The same simulator, unless it was the default.
        n_iterations: Number of missions in all; by default as many as it was begun for.
        model: The same model; see `Campaign.load`.
        policy: The same policy; see `Campaign.load`.
        stop: Rules as in `iterate`; not kept in the folder.
        progress: Whether to show a progress bar.
        **own: The same `awareness` and `callbacks`; see `Campaign.load`.

    Raises:
        TrustboError: There is no campaign; another process is at work on it; or something of your
            own is missing.
    """
    with Campaign.load(directory, model=model, policy=policy, **own) as campaign:
        notes = campaign.log.notes
        total = notes.get("n_iterations", 8) if n_iterations is None else n_iterations
        steps = missions(campaign, simulator, n_iterations=total, stop=stop, progress=progress)
        _require_same(notes, campaign.log.notes)
        for _ in steps:
            pass
        return campaign.result()


def missions(
    campaign: Campaign,
    simulator: Simulator | None = None,
    *,
    n_iterations: int = 8,
    stop: Stop | Sequence[Stop] | None = None,
    progress: bool = False,
) -> Iterator[tuple[Plan, Mission]]:
    """Run the missions of a campaign, one for each step of this generator.

    Args:
        campaign: Campaign, new or under way.
        simulator: Simulator as in `iterate`.
        n_iterations: Largest number of missions in all.
        stop: Rules as in `iterate`.
        progress: Whether to show a progress bar.

    Yields:
        Plan of each mission, and the mission, learned from already.

    Raises:
        TrustboError: Bad input, before any work starts.
        PosteriorError: A posterior's diagnostics are bad.
    """
    require_whole("n_iterations", n_iterations, 1)
    runner: Any = KinematicSimulator(campaign.workspace) if simulator is None else simulator
    if not callable(getattr(runner, "run", None)):
        raise TrustboError(f"a simulator needs run(path, *, seed) -> Mission; got {runner!r}.")
    if campaign.options.replan == "bound":
        require_bounds(runner)
    rules = require_stops(stop)
    describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
    campaign.log.notes = {**describe(), "n_iterations": n_iterations}
    return _missions(campaign, runner, n_iterations, rules, progress)


def _missions(
    campaign: Campaign, runner: Any, n_iterations: int, rules: list[Stop], progress: bool
) -> Iterator[tuple[Plan, Mission]]:
    done = len(campaign.missions)
    with tqdm(total=n_iterations, initial=done, desc="missions", disable=not progress) as bar:
        while len(campaign.missions) < n_iterations:
            plan = campaign.ask()
            mission = _run(campaign, runner, plan)
            oracle = getattr(runner, "regret", None)
            campaign.tell(mission, **({"regret": oracle(plan)} if oracle else {}))
            bar.set_postfix_str(_report(campaign))
            bar.update()
            _log.info("mission %d: %s", len(campaign.missions), _report(campaign))
            for callback in campaign.options.callbacks:
                callback(campaign, mission)
            yield plan, mission
            if reason := reason_to_stop(rules, campaign):
                campaign.stop(reason)
                return
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


def _report(campaign: Campaign) -> str:
    """Describe the last mission in a line."""
    row = campaign.log.entries[-1].row
    name, label = ("r_hat", "R-hat") if "r_hat" in row else ("k_hat", "k-hat")
    regret = f", regret {row['regret']:.3f}" if "regret" in row else ""
    return f"objective {row['objective']:.3f}{regret}, {label} {row[name]:.3f}, {row['status']}"


def _require_same(before: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to go on with another simulator than the one begun with."""
    for name in now:
        if name != "n_iterations" and name in before and before[name] != now[name]:
            raise TrustboError(
                f"the campaign was begun with {name} = {before[name]!r}, not {now[name]!r}; give "
                "the same simulator again with simulator=."
            )
