"""A mission whose path is planned again after each bound."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from trustbo.campaign import Campaign
from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError
from trustbo.models import TrustFilter
from trustbo.models.params import Params
from trustbo.planning import Plan, Planner
from trustbo.stacking import fill_awareness

REPLAN = ("mission", "bound")
THRESHOLD = 0.01
"""How much better, in the objective's value, another continuation must be to be taken."""


def require_bounds(simulator: Any) -> None:
    """Refuse a simulator that cannot run one bound after the other.

    Raises:
        TrustboError: It has no `reset` or `run_bound`.
    """
    missing = [name for name in ("reset", "run_bound") if not hasattr(simulator, name)]
    if missing:
        raise TrustboError(
            f'replan="bound" needs a simulator with reset(start, seed) and run_bound(k, cell); '
            f"{type(simulator).__name__} has no {' and no '.join(missing)}."
        )


def run_replanning(
    campaign: Campaign, simulator: Any, plan: Plan, *, threshold: float = THRESHOLD, **start: Any
) -> Mission:
    """Run a plan bound by bound; a continuation that has become better is taken.

    After each bound, a `TrustFilter` says what trust is now and how likely each posterior draw has
    become. The rest of the path is planned again from there, among what is left of the admissible
    paths, and taken if it is worth more than the old rest by the threshold.

    Args:
        campaign: Whose posterior is used; before its first mission there is none, and the plan is
            run as it is.
        simulator: With `reset`, `run_bound`, and maybe `close`.
        plan: What to begin with.
        threshold: Difference of values, see `OBJECTIVES`.
        **start: For `reset`, such as the seed.

    Returns:
        The mission, its path the cells that were chosen.
    """
    path, bounds = list(plan.path), []
    live = None if campaign.posterior is None else TrustFilter(campaign.posterior)
    if takes(simulator.reset, "next_cell"):
        start["next_cell"] = path[1]
    simulator.reset(path[0], **start)
    k = 1
    while k < len(path):
        ahead = path[k + 1] if k + 1 < len(path) else None
        bound: Bound = _run_bound(simulator, k, path[k], ahead)
        bounds.append(bound)
        if bound.status != "ok":
            break
        if live is not None and k + 1 < len(path):
            planner = campaign.planner_now().onward(path[: k + 1])
            awareness = _known(campaign, bound)
            live.update(awareness, bound.contact_rate)
            path = [*path[:k], *better_rest(planner, live, path[k:], threshold)]
        k += 1
    getattr(simulator, "close", lambda: None)()
    names = (
        tuple(str(n) for n in campaign.workspace.awareness[d].values) for d in ("feature", "robot")
    )
    return Mission(tuple(path), tuple(bounds), bounds[-1].status, *names)


def better_rest(
    planner: Planner, live: TrustFilter, rest: Sequence[Cell], threshold: float
) -> tuple[Cell, ...]:
    """The best rest of a path from the trust of now, or the old rest if that is nearly as good.

    Args:
        planner: For what is left, see `Planner.onward`.
        live: What is known of trust and parameters now.
        rest: The cells planned so far, from where the team is.
        threshold: Difference of values.
    """
    params, now = weighted_mean(live.params, live.weights), live.state.mean
    old = planner.evaluate(rest, params, x0=now)
    new = planner.plan(params, x0=now)
    return new.path if new.value > old.value + threshold else tuple(rest)


def weighted_mean(params: Params, weights: np.ndarray) -> Params:
    """Mean of draws that count differently; `weights` (draw,) sum to 1."""
    flat = params.flat()
    return type(flat)(*(np.tensordot(weights, value, 1) for value in flat))  # pyright: ignore[reportReturnType]


def _run_bound(simulator: Any, k: int, cell: Cell, ahead: Cell | None) -> Bound:
    """The protocol does not ask for `next_cell`; simulators that take it are told."""
    known = {"next_cell": ahead} if takes(simulator.run_bound, "next_cell") else {}
    return simulator.run_bound(k, cell, **known)


def takes(function: Callable[..., object], name: str) -> bool:
    """Whether a function has a parameter of that name."""
    return name in inspect.signature(function).parameters


def _known(campaign: Campaign, bound: Bound) -> np.ndarray:
    """A bound's awareness; what was not measured is what is believed of it."""
    one = Mission((bound.cell, bound.cell), (bound,), bound.status)
    return fill_awareness(one, campaign.planner_now().mean_awareness).awareness[0]
