"""The loop: plan, run, learn, and plan again."""

import inspect
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from os import PathLike

import numpy as np
import xarray as xr
from tqdm import tqdm

from trustbo.campaign import Campaign
from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.models import TrustModel, diagnostics
from trustbo.planning import AwarenessBelief, Plan, Policy
from trustbo.result import Result, require_folder
from trustbo.simulation import KinematicSimulator, Simulator
from trustbo.terrain import Workspace


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
    checkpoint: str | PathLike[str] | None = None,
    callbacks: Sequence[Callable[[Campaign, Mission], None]] = (),
    seed: int = 0,
    progress: bool = True,
) -> Result:
    """Run a campaign: plan a path, run it, learn from the contact rates, plan again.

    Args:
        workspace: Where.
        start: First cell, (row, col); row 0 is the top.
        goal: Last cell.
        n_iterations: How many missions.
        model: The trust model; by default `PooledTrust()`.
        policy: A name of `planning.POLICIES`, or a callable `policy(key, draws, planner) -> Plan`.
        objective: `"terminal"` (the paper's), `"mean"`, `"success"`, `"bottleneck"` or
            `"stationary"`; see `Planner`.
        sampler: `"nuts"`, `"exact"` or `"joint"`; see `trustbo.models.fit`.
        simulator: Whatever has `run(path, *, seed) -> Mission`; by default
            `KinematicSimulator(workspace)`.
        initial: The first plan comes from one random draw of the prior (`"prior_draw"`, as in the
            paper) or from `"prior_mean"`.
        update: `"refit"` from all missions, or `"moment_matched"`; see `Campaign`.
        forgetting: How much a mission counts relative to the next, in (0, 1]; see `Campaign`.
        connectivity: 4, or 8 to allow diagonal bounds too.
        max_bounds: Which paths are admissible; see `Planner`.
        team: The team's trust is the `"mean"` or the `"min"` of its robots'.
        length_weight: What a metre of the path costs; see `Planner`.
        awareness: `"map"`, or `"belief"`, which missions correct; see `Campaign`.
        checkpoint: A folder in which the result so far is saved after each mission.
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
    runner = KinematicSimulator(workspace) if simulator is None else simulator
    if not callable(getattr(runner, "run", None)):
        raise TrustboError(f"a simulator needs run(path, *, seed) -> Mission; got {runner!r}.")
    folder = None if checkpoint is None else require_folder(checkpoint)
    describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
    settings = {
        **campaign.settings,
        **describe(),
        "trustbo_version": version("trustbo"),
        "start": list(campaign.planner.start),
        "goal": list(campaign.planner.goal),
    }
    rows: list[dict[str, object]] = []

    def keep(reason: str) -> Result:
        result = _result(campaign, rows, settings, reason)
        if folder is not None:
            result.save(folder) if len(rows) == 1 else result.checkpoint(folder)
        return result

    with tqdm(total=n_iterations, desc="missions", disable=not progress) as bar:
        for _ in range(n_iterations):
            rows.append(_iteration(campaign, runner))
            name, label = ("r_hat", "R-hat") if "r_hat" in rows[-1] else ("k_hat", "k-hat")
            bar.set_postfix_str(
                f"objective {rows[-1]['objective']:.3f}, {label} {rows[-1][name]:.3f}"
            )
            bar.update()
            for callback in callbacks:
                callback(campaign, campaign.missions[-1])
            if folder is not None and len(rows) < n_iterations:
                keep("interrupted")
    return keep("n_iterations")


def _iteration(campaign: Campaign, simulator: Simulator) -> dict[str, object]:
    """One mission, from plan to posterior; what the history keeps of it."""
    clock = time.perf_counter
    t0 = clock()
    plan = campaign.ask()
    trust_map = campaign.trust_map()
    t1 = clock()
    mission = simulator.run(
        plan.path, seed=campaign.seed_of("mission"), **_number(campaign, simulator)
    )
    t2 = clock()
    before = campaign.plans[-1] if campaign.plans else plan
    posterior = campaign.tell(mission)
    return {
        "plan": plan,
        "trust_map": trust_map,
        "objective": plan.value,
        "path_changed": plan.path != before.path,
        "contact_rate": float(np.nanmean(mission.contact_rate)),
        "status": mission.status,
        **diagnostics(posterior),
        "seconds_plan": t1 - t0,
        "seconds_run": t2 - t1,
        "seconds_fit": clock() - t2,
    }


def _number(campaign: Campaign, simulator: Simulator) -> dict[str, int]:
    """The mission's number, for simulators of a changing world."""
    takes_it = "mission" in inspect.signature(simulator.run).parameters
    return {"mission": len(campaign.missions)} if takes_it else {}


def _result(
    campaign: Campaign, rows: list[dict[str, object]], settings: dict[str, object], reason: str
) -> Result:
    recommended = campaign.recommend()
    plans: list[Plan] = [row["plan"] for row in rows]  # pyright: ignore[reportAssignmentType]
    steps = np.full((len(rows), max(len(plan.path) for plan in plans), 2), -1)
    for i, plan in enumerate(plans):
        steps[i, : len(plan.path)] = plan.path
    # The exact sampler may have fallen back on NUTS, whose diagnostics are others: NaN then.
    names = {name: None for row in rows for name in row if name not in _NOT_SCALAR}
    scalars = {name: [row.get(name, np.nan) for row in rows] for name in names}
    maps: list[xr.DataArray] = [row["trust_map"] for row in rows]  # pyright: ignore[reportAssignmentType]
    iteration = xr.DataArray(np.arange(1, len(rows) + 1), dims="iteration", name="iteration")
    history = xr.Dataset(
        {
            **{name: ("iteration", values) for name, values in scalars.items()},
            "path": (("iteration", "step", "axis"), steps),
            "trust_map": xr.concat(maps, dim=iteration),
        },
        {"iteration": iteration, "axis": ["row", "col"]},
    )
    return Result(
        campaign.workspace,
        list(campaign.missions),
        list(campaign.posteriors),
        list(recommended.path),
        recommended.trust,
        recommended.value,
        campaign.trust_map(),
        history,
        settings,
        reason,
    )


_NOT_SCALAR = ("plan", "trust_map")
