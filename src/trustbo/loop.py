"""The loop: plan, run, learn, and plan again."""

import logging
from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from typing import Any

from tqdm import tqdm

from trustbo.campaign import Campaign
from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_choice, require_whole
from trustbo.models import TrustModel
from trustbo.planning import AwarenessBelief, Plan, Policy
from trustbo.replanning import REPLAN, require_bounds, run_replanning, takes
from trustbo.result import Result
from trustbo.simulation import KinematicSimulator, Simulator
from trustbo.stopping import Stop, reason_to_stop, require_stops
from trustbo.terrain import Workspace

Callback = Callable[[Campaign, Mission], None]
_log = logging.getLogger(__name__)


def iterate(
    workspace: Workspace,
    start: Cell,
    goal: Cell,
    *,
    n_iterations: int = 8,
    model: TrustModel | None = None,
    policy: str | Policy = "greedy",
    objective: str = "terminal",
    sampler: str = "nuts",
    simulator: Simulator | None = None,
    initial: str = "prior_draw",
    update: str = "refit",
    forgetting: float = 1.0,
    connectivity: int = 8,
    max_bounds: int | str | None = None,
    team: str = "mean",
    length_weight: float = 0.0,
    awareness: str | AwarenessBelief = "map",
    replan: str = "mission",
    stop: Stop | Sequence[Stop] | None = None,
    checkpoint: str | PathLike[str] | None = None,
    callbacks: Sequence[Callback] = (),
    seed: int = 0,
    progress: bool = True,
) -> Result:
    """Run a campaign: plan a path, run it, learn from the contact rates, plan again.

    Args:
        workspace: Where.
        start: First cell, (row, col); row 0 is the top.
        goal: Last cell.
        n_iterations: How many missions, at most.
        model: The trust model; by default `PooledTrust()`.
        policy: A name of `planning.POLICIES`, or a callable `policy(key, draws, planner) -> Plan`.
        objective: `"terminal"` (the paper's), `"mean"`, `"success"`, `"bottleneck"` or
            `"stationary"`; see `Planner`.
        sampler: `"nuts"`, `"exact"` or `"joint"`; see `trustbo.models.fit`.
        simulator: Whatever has `run(path, *, seed) -> Mission`; by default
            `KinematicSimulator(workspace)`. If it also has `regret(plan) -> float`, the truth being
            known, that goes into the history.
        initial: The first plan comes from one random draw of the prior (`"prior_draw"`, as in the
            paper) or from `"prior_mean"`.
        update: `"refit"` from all missions, or `"moment_matched"`; see `Campaign`.
        forgetting: How much a mission counts relative to the next, in (0, 1]; see `Campaign`.
        connectivity: 4, or 8 to allow diagonal bounds too.
        max_bounds: Which paths are admissible; see `Planner`.
        team: The team's trust is the `"mean"` or the `"min"` of its robots'.
        length_weight: What a metre of the path costs; see `Planner`.
        awareness: `"map"`, or `"belief"`, which missions correct; see `Campaign`.
        replan: `"mission"`: a path is run as planned. `"bound"`: after each bound the rest is
            planned again from the trust of now; see `replanning.run_replanning`.
        stop: When to end before `n_iterations`: a `RegretBound`, `Seconds`, a callable
            `stop(campaign) -> reason or None`, or several of them.
        checkpoint: A folder in which everything is kept as it goes, replacing what another campaign
            left there. If the process dies, `resume` goes on from it.
        callbacks: Each called as `callback(campaign, mission)` after each mission.
        seed: Same seed, same result.
        progress: Whether to show a progress bar.

    Returns:
        The result.

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
        initial=initial,
        update=update,
        forgetting=forgetting,
        connectivity=connectivity,
        max_bounds=max_bounds,
        team=team,
        length_weight=length_weight,
        awareness=awareness,
        seed=seed,
    )
    steps = missions(
        campaign,
        simulator,
        n_iterations=n_iterations,
        replan=replan,
        stop=stop,
        callbacks=callbacks,
        progress=progress,
    )
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
    awareness: AwarenessBelief | None = None,
    stop: Stop | Sequence[Stop] | None = None,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> Result:
    """Go on with a campaign that `iterate(checkpoint=directory)` began; the same comes out.

    Args:
        directory: Its checkpoint.
        simulator: Needed again unless it was the default.
        n_iterations: How many missions in all; by default as many as it was begun for.
        model: See `Campaign.load`.
        policy: See `Campaign.load`.
        awareness: See `Campaign.load`.
        stop: See `iterate`; not kept in the folder.
        callbacks: See `iterate`; not kept either.
        progress: Whether to show a progress bar.

    Raises:
        TrustboError: There is no campaign; another process is at work on it; or something of your
            own is missing.
    """
    with Campaign.load(directory, model=model, policy=policy, awareness=awareness) as campaign:
        notes: dict[str, Any] = dict(campaign.log.notes)
        total = notes.get("n_iterations", 8) if n_iterations is None else n_iterations
        steps = missions(
            campaign,
            simulator,
            n_iterations=total,
            replan=notes.get("replan", "mission"),
            stop=stop,
            callbacks=callbacks,
            progress=progress,
        )
        _require_same(notes, campaign.log.notes)
        for _ in steps:
            pass
        return campaign.result()


def missions(
    campaign: Campaign,
    simulator: Simulator | None = None,
    *,
    n_iterations: int = 8,
    replan: str = "mission",
    stop: Stop | Sequence[Stop] | None = None,
    callbacks: Sequence[Callback] = (),
    progress: bool = False,
) -> Iterator[tuple[Plan, Mission]]:
    """Run the missions of a campaign, one for each step of this generator.

    Args:
        campaign: New, or under way.
        simulator: See `iterate`.
        n_iterations: How many missions in all, at most.
        replan: See `iterate`.
        stop: See `iterate`.
        callbacks: See `iterate`.
        progress: Whether to show a progress bar.

    Yields:
        Each mission, learned from already, and the plan it was run for.

    Raises:
        TrustboError: Bad input, before any work starts.
        PosteriorError: A posterior's diagnostics are bad.
    """
    require_whole("n_iterations", n_iterations, 1)
    runner: Any = KinematicSimulator(campaign.workspace) if simulator is None else simulator
    if not callable(getattr(runner, "run", None)):
        raise TrustboError(f"a simulator needs run(path, *, seed) -> Mission; got {runner!r}.")
    if require_choice("replan", replan, REPLAN) == "bound":
        require_bounds(runner)
    rules = require_stops(stop)
    describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
    campaign.log.notes = {**describe(), "replan": replan, "n_iterations": n_iterations}
    return _missions(campaign, runner, n_iterations, replan, rules, callbacks, progress)


def _missions(
    campaign: Campaign,
    runner: Any,
    n_iterations: int,
    replan: str,
    rules: list[Stop],
    callbacks: Sequence[Callback],
    progress: bool,
) -> Iterator[tuple[Plan, Mission]]:
    done = len(campaign.missions)
    with tqdm(total=n_iterations, initial=done, desc="missions", disable=not progress) as bar:
        while len(campaign.missions) < n_iterations:
            plan = campaign.ask()
            mission = _run(campaign, runner, plan, replan)
            oracle = getattr(runner, "regret", None)
            campaign.tell(mission, **({"regret": oracle(plan)} if oracle else {}))
            bar.set_postfix_str(_report(campaign))
            bar.update()
            _log.info("mission %d: %s", len(campaign.missions), _report(campaign))
            for callback in callbacks:
                callback(campaign, mission)
            yield plan, mission
            if reason := reason_to_stop(rules, campaign):
                campaign.stop(reason)
                return
    campaign.stop("n_iterations")


def _run(campaign: Campaign, runner: Any, plan: Plan, replan: str) -> Mission:
    """One mission; simulators of a changing world are told its number."""
    seed, number = campaign.seed_of("mission"), len(campaign.missions)
    run = runner.reset if replan == "bound" else runner.run
    numbered = {"mission": number} if takes(run, "mission") else {}
    if replan == "bound":
        return run_replanning(campaign, runner, plan, seed=seed, **numbered)
    return runner.run(plan.path, seed=seed, **numbered)


def _report(campaign: Campaign) -> str:
    """The last mission in a line."""
    row = campaign.last
    name, label = ("r_hat", "R-hat") if "r_hat" in row else ("k_hat", "k-hat")
    regret = f", regret {row['regret']:.3f}" if "regret" in row else ""
    return f"objective {row['objective']:.3f}{regret}, {label} {row[name]:.3f}, {row['status']}"


def _require_same(before: dict[str, object], now: dict[str, object]) -> None:
    """Refuse to go on with another simulator than the one begun with."""
    for name in now:
        if name not in ("n_iterations",) and name in before and before[name] != now[name]:
            raise TrustboError(
                f"the campaign was begun with {name} = {before[name]!r}, not {now[name]!r}; give "
                "the same simulator again with simulator=."
            )
