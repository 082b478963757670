"""A mission whose path is planned again after each bound."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError
from trustbo.inference import TrustFilter, params_of
from trustbo.models.params import Params
from trustbo.planning import Plan, Planner
from trustbo.simulation.protocol import takes
from trustbo.stacking import fill_awareness

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

THRESHOLD = 0.01
"""Least gain in the objective's value for which another continuation is taken."""


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
    names = [tuple(map(str, campaign.workspace.awareness[d].values)) for d in ("feature", "robot")]
    if (posterior := campaign.state.last_tree) is not None:
        response, observation = campaign.model.response, campaign.learner.observation
        live = TrustFilter(
            params_of(posterior), len(names[1]), response=response, observation=observation
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
            filled = fill_awareness(driven, campaign.known_along(crossed))
            live.update(filled.awareness[0], bound.contact_rate, crossed, n_ticks=bound.n_ticks)
            path = [*path[:k], *better_rest(planner, live, path[k:])]
        k += 1
    getattr(simulator, "close", lambda: None)()
    return Mission(tuple(path), tuple(bounds), bounds[-1].status, *names)


def better_rest(
    planner: Planner, live: TrustFilter, rest: Sequence[Cell], threshold: float = THRESHOLD
) -> tuple[Cell, ...]:
    """Plan the rest of a path from the current trust; the old rest if that is nearly as good.

    Args:
        planner: Planner of the paths that are left, see `Planner.onward`.
        live: Filter of trust and parameters after the last bound.
        rest: Cells planned so far, from that of the team on.
        threshold: Difference of values.
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
