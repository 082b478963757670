"""Missions of a campaign, run by a simulator; their paths may be planned again after each bound."""

import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from trustbo.campaign.planners import path_class
from trustbo.campaign.progress import Progress
from trustbo.campaign.stopping import Stop, reason_to_stop, require_stops, rules_to_record
from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.files import to_json
from trustbo.inference import TrustFilter, params_of
from trustbo.models.params import Params
from trustbo.planning import Plan, Planner
from trustbo.simulation import KinematicSimulator, ReplaySimulator, Truth
from trustbo.simulation.protocol import Simulator, require_bounds, require_call, takes
from trustbo.workspace import Workspace

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

THRESHOLD = 0.01
"""Least gain in the objective's value for which another continuation is taken."""


def run_missions(
    campaign: "Campaign",
    simulator: Simulator | None,
    n_iterations: int,
    truth: Truth | None,
    stop: Stop | Sequence[Stop] | None,
    progress: bool | str,
) -> Iterator[tuple[Plan, Mission]]:
    """Check everything, then run the missions of a campaign, see `Campaign.run`."""
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
        truth.require_best()
    rules = require_stops(stop)
    describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
    # As a file gives them back: tuples are lists there, and arrays too.
    simulated = json.loads(to_json(describe()))
    asked = {"n_iterations": n_iterations, "stop": rules_to_record(rules)}
    campaign.state.notes = {**simulated, **asked}
    return _run_missions(campaign, runner, n_iterations, truth, rules, progress)


def _run_missions(
    campaign: "Campaign",
    runner: Any,
    n_iterations: int,
    truth: Truth | None,
    rules: list[Stop],
    progress: bool | str,
) -> Iterator[tuple[Plan, Mission]]:
    replans = campaign.options.replan == "bound"
    numbered = takes(runner.reset if replans else runner.run, "mission")
    to_posts = not replans and takes(runner.run, "posts")
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
            settings: dict[str, Any] = {"seed": campaign.seed_of("mission")}
            if numbered:  # its world changes
                settings["mission"] = n
            if to_posts and (posts := _posts_of(plan, runner)) is not None:
                settings["posts"] = posts
            if replans:
                mission = run_replanning(campaign, runner, plan, **settings)
            else:
                mission = runner.run(plan.path, **settings)
            extra = {}
            if truth is not None:
                extra["regret"] = truth.at(n).regret(plan, **path_class(campaign.planner))
            # Deviations from the plan, and repetitions, are expected here; only another start
            # suggests that row and col are swapped.
            other = mission.path[:1] == plan.path[:1] or isinstance(runner, ReplaySimulator)
            campaign.tell(mission, other_path=other, again=True, **extra)
            shown.step()
            for callback in campaign.options.callbacks:
                callback(campaign, mission)
            yield plan, mission
        campaign.stop("n_iterations")


def _posts_of(plan: Plan, runner: Any) -> np.ndarray | None:
    """Posts that a plan assigns, if the robots can get there where the simulator drives."""
    posts, workspace = plan.own_posts, getattr(runner, "workspace", plan.workspace)
    if posts is None or not isinstance(workspace, Workspace) or workspace.ground is None:
        return posts
    return posts if workspace.ground.posts.are_reached(plan.path, posts).all() else None


def run_replanning(campaign: "Campaign", simulator: Any, plan: Plan, **start: Any) -> Mission:
    """Run a plan bound by bound; a continuation that has become better is taken.

    After each bound, a `TrustFilter` gives the current trust and a weight of each posterior draw.
    The rest of the path is planned again from there, among the admissible paths that are left, and
    replaced if the value of the new rest is greater by `THRESHOLD`.
    Before the first mission there is no posterior, and the plan is run unchanged.

    Args:
        campaign: Campaign with its posterior.
        simulator: Simulator with `reset`, `run_bound`, and maybe `close`.
        plan: Plan to begin with.
        **start: Arguments of `reset`, such as the seed.
    """
    path, bounds, live = list(plan.path), [], None
    names = campaign.workspace.features, campaign.workspace.team.names
    if (posterior := campaign.state.last_tree) is not None:
        response, observation = campaign.model.response, campaign.learner.observation
        live = TrustFilter(
            params_of(posterior, day=True),
            len(names[1]),
            response=response,
            observation=observation,
        )
    if takes(simulator.reset, "next_cell"):
        start["next_cell"] = path[1]
    simulator.reset(path[0], **start)
    k = 1
    while k < len(path):
        bounds.append(bound := _run_bound(simulator, k, path))
        if bound.status != "ok":
            break
        if live is not None and k + 1 < len(path):
            planner = campaign.planner_now().onward(path[: k + 1])
            crossed = path[k - 1], bound.cell
            driven = Mission(crossed, (bound,), bound.status)
            live.update(
                campaign.as_learned(driven).awareness[0],
                bound.contact_rate,
                crossed,
                n_ticks=bound.n_ticks,
            )
            path = [*path[:k], *better_rest(planner, live, path[k:])]
        k += 1
    getattr(simulator, "close", lambda: None)()
    return Mission(tuple(path), tuple(bounds), bounds[-1].status, *names)


def better_rest(
    planner: Planner, live: TrustFilter, rest: Sequence[Cell], threshold: float = THRESHOLD
) -> tuple[Cell, ...]:
    """Replan the rest of a path from the current trust; the old rest if the gain is small.

    Args:
        planner: Planner of the paths that are left, see `Planner.onward`.
        live: Filter of trust and parameters after the last bound.
        rest: Remaining cells of the old plan, the current one first.
        threshold: Least gain in the value of the objective.
    """
    params, now = weighted_mean(live.params, live.weights), live.state.mean
    old = planner.evaluate(rest, params, x0=now)
    new = planner.plan(params, x0=now)
    return new.path if new.value > old.value + threshold else tuple(rest)


def weighted_mean(params: Params, weights: np.ndarray) -> Params:
    """Weighted mean of draws; `weights` (draw,) sum to 1."""
    flat = params.flat()
    return flat.map(lambda value, _: np.tensordot(weights, value, 1))


def _run_bound(simulator: Any, k: int, path: Sequence[Cell]) -> Bound:
    """Run bound `k` of a path; a simulator that takes `next_cell`, which is optional, gets it."""
    following = path[k + 1] if k + 1 < len(path) else None
    optional = {"next_cell": following} if takes(simulator.run_bound, "next_cell") else {}
    bound = simulator.run_bound(k, path[k], **optional)
    if not isinstance(bound, Bound):
        raise TrustboError(f"run_bound({k}, {path[k]}) must return a trustbo.Bound; got {bound!r}.")
    return bound
