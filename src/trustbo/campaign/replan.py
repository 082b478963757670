"""Replanning of a mission in progress: the bounds so far, and the plan of the whole mission."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import stats

from trustbo.campaign.choose import choose, informed_planner
from trustbo.campaign.learning import as_learned, learn_hazard
from trustbo.campaign.past_failures import with_past_failures
from trustbo.campaign.result import Result
from trustbo.data import Cell, Mission, Station, cells_of, path_text
from trustbo.errors import TrustboError
from trustbo.hazard.path_risk import PathRisk
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import CAUSES
from trustbo.inference import TrustFilter
from trustbo.planning import Plan, Planner
from trustbo.planning.plan import QUANTILES
from trustbo.planning.policies import Policy
from trustbo.planning.problem import Problem
from trustbo.workspace import Workspace

Pair = tuple[Cell, ...]
"""Cell left and cell entered."""


class Driven(NamedTuple):
    """Bounds of a mission in progress.

    Attributes:
        path: Stations so far, from the start to the cell in which the team is now.
        contact_rate: Contact rates, shape (bound, robot); NaN where not measured.
        trust: Trust after each bound given the rates up to it, shape (bound, robot).
        bands: Quantiles of this trust at the levels `QUANTILES`, shape (quantile, bound, robot).
        blocked: Pairs of cells between which a bound failed or is blocked.
        filter: Trust and parameters after the last bound.
    """

    path: tuple[Station, ...]
    contact_rate: np.ndarray
    trust: np.ndarray
    bands: np.ndarray
    blocked: tuple[Pair, ...]
    filter: TrustFilter


def trust_filter(result: Result, workspace: Workspace) -> TrustFilter:
    """Make the filter of a campaign's next mission, from its last posterior or from its prior.

    Args:
        result: Campaign.
        workspace: Workspace of the plan, whose team are the robots that take part.
    """
    return TrustFilter(result.forecast, workspace.team.n_robots, workspace=workspace)


def follow(
    result: Result, plan: Plan, cell: Cell, so_far: Mission | None, blocked: Sequence[Pair]
) -> Driven:
    """Follow the bounds of a mission so far; see `Campaign.replan` for the arguments and errors."""
    workspace = plan.workspace
    closed = [*plan.blocked, *blocked]
    if so_far is None:
        path = _planned(plan.stations, cell)
        n_robots = workspace.team.n_robots
        rates = np.full((len(path) - 1, n_robots), np.nan)
        n_ticks = rates
        z = workspace.along(path, anywhere=True)
    else:
        path = so_far.driven_stations
        if so_far.path[0] != plan.start:
            raise TrustboError(
                f"the mission starts in cell {so_far.path[0]}; it must start in {plan.start}."
            )

        rates = so_far.contact_rate
        n_ticks = so_far.n_ticks
        z = as_learned(so_far, workspace, result.state.settings["awareness"]).awareness
        closed += failed_bounds(so_far)

        if cell != path[-1][:2]:
            path = _returned(path, cell, so_far)
            z = np.concatenate([z, workspace.along(path[-2:], anywhere=True)])
            rates = np.pad(rates, ((0, 1), (0, 0)), constant_values=np.nan)
            n_ticks = np.pad(n_ticks, ((0, 1), (0, 0)), constant_values=np.nan)

    trust = trust_filter(result, workspace)
    means = [np.empty((0, *trust.state.mean.shape))]
    sds = list(means)
    for k, bound in enumerate(pairwise(path)):
        state = trust.update(z[k], rates[k], bound, n_ticks=n_ticks[k])
        means.append(state.mean[None])
        sds.append(state.sd[None])

    mean = np.concatenate(means)
    steps = stats.norm.ppf(QUANTILES)[:, None, None]
    bands = mean + steps * np.concatenate(sds)
    return Driven(path, rates, mean, bands, tuple(dict.fromkeys(closed)), trust)


def _is_completed(so_far: Mission) -> bool:
    """Return whether the last bound was completed; then, only the mission has another status."""
    return so_far.bounds[-1].status == "ok" and so_far.status not in CAUSES


def _planned(path: tuple[Station, ...], cell: Cell) -> tuple[Station, ...]:
    """Return the planned path up to a cell."""
    cells = cells_of(path)
    if cells.count(cell) != 1:
        often = "does not enter" if cell not in cells else "enters more than once"
        raise TrustboError(
            f"the plan {path_text(path)} {often} the cell {cell}; pass the bounds so far as a "
            "mission."
        )
    return path[: cells.index(cell) + 1]


def _returned(path: tuple[Station, ...], cell: Cell, so_far: Mission) -> tuple[Station, ...]:
    """Return the path so far, followed by a bound back from the cell that was not reached."""
    possible = cells_of(path[-1:] if _is_completed(so_far) else path[-2:])
    if cell not in possible:
        places = " or ".join(map(str, possible))
        raise TrustboError(f"after the bounds so far, the team is in {places}, not in {cell}.")
    return *path, cell


def failed_bounds(mission: Mission) -> list[Pair]:
    """Return the cells left and entered of each bound that failed."""
    bounds = zip(pairwise(mission.path), mission.statuses, strict=False)
    return [bound for bound, status in bounds if status in CAUSES]


def plan_rest(
    result: Result,
    base: Planner,
    policy: Policy,
    plan: Plan,
    cell: Cell,
    so_far: Mission | None,
    blocked: Sequence[Pair],
) -> Plan:
    """Plan the rest of a mission in progress; see `Campaign.replan` for the arguments and errors.

    Args:
        result: Campaign.
        base: Planner of the campaign before any learning.
        policy: Policy of the campaign.
        plan: Plan of the mission so far.
        cell: Cell in which the team is.
        so_far: Bounds that were run; None if the team drove the plan up to the cell.
        blocked: Further bounds that cannot be driven.

    Returns:
        The plan of the whole mission.
    """
    state = result.state
    driven = follow(result, plan, cell, so_far, blocked)
    n_driven = len(driven.path) - 1

    risk = result.risk
    if so_far is not None:
        risk = BoundRisk(learn_hazard(state, result.workspace, so_far), result.workspace)
    ahead = base.from_cell(
        cell, x0=driven.filter.state.mean, blocked=driven.blocked, n_driven=n_driven
    )
    planner = informed_planner(ahead, risk)

    rng = np.random.default_rng([state.seed_of("policy"), n_driven])
    draws = driven.filter.resample()
    rest = choose(policy, state.settings["policy"], rng, draws, planner)
    rest = rest.with_draws(planner.evaluate(rest.stations, draws))
    whole = whole_plan(base.problem, driven, rest)
    if so_far is not None and not _is_completed(so_far):
        whole = replace(whole, abandoned=(*plan.abandoned, plan.stations))
    return with_past_failures(whole, state, planner, so_far)


def whole_plan(problem: Problem, driven: Driven, rest: Plan) -> Plan:
    """Put the bounds so far before a plan of the rest.

    For an objective that measures contact, the contact lost so far is subtracted from the value.
    For other objectives, the value is that of the rest. The failure probability of past bounds is
    0.

    Args:
        problem: Planning problem of the campaign.
        driven: Bounds so far.
        rest: Plan from the last cell of `driven` to the goal.
    """
    path = (*driven.path[:-1], *rest.stations)  # with the posts that the rest begins with
    n_driven = len(driven.path) - 1

    risk = rest.risk
    if risk is not None:
        p_fail = np.concatenate([np.zeros(n_driven), risk.p_fail])
        risk = PathRisk(p_fail, risk.p_arrive, risk.p_arrive_band)

    lost = 0.0
    if problem.objective.of_contact and n_driven:
        lost = _contact_lost(driven) + problem.bound_cost_along(driven.path)
    band = rest.value_band
    if band is not None:
        band = band[0] - lost, band[1] - lost

    return replace(
        rest,
        path=path,
        post_sets=(),  # as in the path
        trust=np.concatenate([driven.trust, rest.trust]),
        bands=np.concatenate([driven.bands, rest.bands], axis=1),
        value=rest.value - lost,
        limit=rest.limit - lost,
        value_band=band,
        risk=risk,
        blocked=driven.blocked,
        n_driven=n_driven,
    )


def _contact_lost(driven: Driven) -> float:
    """Compute the contact lost so far, in bounds; expected contact is used where none is known."""
    noise_sd = driven.filter.space.rate_sd.mean()
    expected = driven.filter.likelihood.mean_rate(driven.trust, noise_sd)
    rates = np.where(np.isnan(driven.contact_rate), expected, driven.contact_rate)
    return float((1.0 - rates).mean(1).sum())
