"""The loop: plan, run, learn, and plan again."""

from collections.abc import Sequence
from typing import Any

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER, CampaignOptions
from trustbo.campaign.result import Result
from trustbo.campaign.stopping import Stop
from trustbo.errors import TrustboError, require_whole
from trustbo.files import FilePath, to_json
from trustbo.models.model import TrustModel
from trustbo.planning import Policy
from trustbo.simulation import Truth
from trustbo.simulation.protocol import Simulator
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
    overwrite: bool = False,
    seed: int = 0,
    progress: bool = True,
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
        model: Trust model; by default `models.default_model()`, with effects of places and robots.
        policy: Name in `planning.POLICIES`, or a callable `policy(key, draws, planner) -> Plan`.
        objective: `"lost_contact"`, `"terminal"` (the paper's), `"mean"`, `"success"`,
            `"bottleneck"` or `"stationary"`; see `Planner`.
        sampler: `"auto"`, `"exact"` or `"nuts"`; see `trustbo.fit`.
        simulator: Simulator with `run(path, *, seed) -> Mission`; by default
            `KinematicSimulator(workspace)`.
        truth: Truth of the simulator, `simulation.Truth.of(simulator)`: the regret of each plan
            goes into the history, in % of the contact that the best admissible path keeps.
        stop: Rules to end before `n_iterations`, asked between missions: a `RegretBound`,
            `TimeLimit`, a callable `stop(campaign) -> reason or None`, or several of them.
        checkpoint: Folder that is updated after each mission. If the process dies, `resume` goes on
            from it.
        overwrite: Whether to remove another campaign or result in that folder first.
        seed: Seed of everything random.
        progress: Whether to show a progress bar, and in a notebook a map that follows the
            missions; `"bar"` for the bar alone.
        **options: Fields of `CampaignOptions`, or a whole one as `options`.

    Returns:
        Result of all missions.

    Raises:
        TrustboError: Bad input, or a folder that holds a campaign, before any work starts.
        NoPathError: The goal cannot be reached.
    """
    n_iterations = require_whole("n_iterations", n_iterations, 1)
    campaign = Campaign(
        workspace, start, goal, model=model, policy=policy, objective=objective, sampler=sampler,
        seed=seed, options=CampaignOptions.from_keywords(options, iterate),
    )  # fmt: skip
    steps = campaign.run(simulator, n_iterations, truth=truth, stop=stop, progress=progress)
    with campaign:
        if checkpoint is not None:
            campaign.save(checkpoint, keep=True, overwrite=overwrite)
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
    progress: bool = True,
    **custom: Any,
) -> Result:
    """Go on with a campaign that `iterate(checkpoint=directory)` began, with identical results.

    If a rule has ended the campaign, its result is returned, unless `stop` or more missions are
    requested. Rules are not stored: give them again. They are evaluated before the first mission.

    Args:
        directory: Folder of its checkpoint.
        simulator: The same simulator, unless it was the default.
        truth: Truth of the simulator, see `iterate`.
        n_iterations: Number of missions in all; by default the number it was started with.
        model: The same model; see `Campaign.load`.
        policy: The same policy; see `Campaign.load`.
        stop: Rules to end before `n_iterations`, as in `iterate`.
        progress: Progress to show, as in `iterate`.
        **custom: The same `callbacks`; see `Campaign.load`.

    Raises:
        TrustboError: There is no campaign; another process has locked it; or a custom object is
            missing.
        DamagedFileError: A file of the folder is missing or damaged.
    """
    with Campaign.load(directory, model=model, policy=policy, **custom) as campaign:
        state, done = campaign.state, len(campaign.missions)
        total = state.notes.get("n_iterations", 8) if n_iterations is None else n_iterations
        ended = state.stop_reason not in ("interrupted", "n_iterations")
        if ended and stop is None and total <= max(done, state.notes.get("n_iterations", 8)):
            return campaign.result()
        before = dict(state.notes)
        steps = campaign.run(simulator, total, truth=truth, stop=stop, progress=progress)
        _require_same(before, state.notes)
        state.stop_reason = "interrupted"
        for _ in steps:
            pass
        return campaign.result()


def _require_same(before: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse a simulator that differs from the one the campaign was started with."""
    for name in now.keys() - {"n_iterations"}:
        if to_json(old := before.get(name)) != to_json(now[name]):  # as text: NaN equals itself
            raise TrustboError(
                f"the campaign was begun with {name} = {old!r}, not {now[name]!r}; give the same "
                "simulator again with simulator=."
            )
