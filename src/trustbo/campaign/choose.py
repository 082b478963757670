"""Choice of the next path: the planner with the failures so far, the policy, and warnings."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from trustbo.data import Cell, path_text
from trustbo.errors import TrustboError, require_kind, warn
from trustbo.hazard.risk import BoundRisk
from trustbo.models.draws import Draws
from trustbo.planning import InfeasibleError, Plan, Planner
from trustbo.planning.policies import Policy, choose_plan
from trustbo.workspace.moves import by_option

_STOPPED = 2
"""Number of failures after which a bound is avoided."""
_RECOVERED = 0.2
"""Failure probability below which such a bound is allowed again."""
_ROUNDING = 1e-9
"""Largest rounding error of an expected number of failures."""
_HOPELESS = 0.9
"""Failure probability of the best path above which the safest path is planned instead."""
_LIKELY_ARRIVAL = 0.9
"""Arrival probability below which a campaign warns if failures have no cost and no limit."""


def informed_planner(planner: Planner, risk: BoundRisk) -> Planner:
    """Make a planner that accounts for the failure probabilities of bounds.

    A bound that failed twice is avoided unless there is no other path, or its failure probability
    has fallen below 0.2. If failures have a cost, a bound is avoided only if this applies with all
    of its next moves and sets of posts, because the search accounts for the others by their cost.

    Before the first failure, the user's slope limit is trusted, and failures have no cost unless
    the user gave `failure_cost`. Under the prior alone, a cost would rule out longer paths that
    keep contact and never fail. The cost is computed jointly over components of the hazard
    posterior, because all bounds share the slope limit.
    """
    if planner.problem.failure_cost is None and not risk.has_failures:
        planner = planner.with_failure_cost(0.0)

    planner = planner.with_risk(risk)
    problem = planner.problem
    priced = problem.objective.of_contact and problem.failure_cost != 0.0
    if priced:
        n_stopped = by_option(risk.past_failures)
    else:
        n_stopped = risk.past_failures_of_bounds[..., None]
    stopped = n_stopped + _ROUNDING >= _STOPPED
    if not stopped.any():
        return planner

    p_fail = by_option(risk.mean)  # (move, row, col, option)
    exists = by_option(risk.exists)
    is_likely = ~(p_fail < _RECOVERED)
    if priced:
        stopped &= is_likely
        avoided = stopped.any(-1) & (stopped | ~exists).all(-1)
    else:
        avoided = stopped.any(-1) & (is_likely & exists).any(-1)
    if not avoided.any():
        return planner
    return planner.avoiding(avoided, np.nanmax(p_fail, axis=-1, initial=0.0))


def instead_of_failure(planner: Planner, plan: Plan, draws: Draws) -> Plan:
    """Return the plan, or the safest one if the plan almost certainly fails.

    If all paths are likely to fail, their costs of failure are nearly equal, so that the plan would
    minimise lost contact again. This function has an effect only if failures have a cost.

    Args:
        planner: Planner of `informed_planner`.
        plan: Plan of a policy.
        draws: Parameter draws, under whose mean the safest path is evaluated.
    """
    problem = planner.problem
    if problem.risk is None or not problem.cost_of_failure:
        return plan
    if problem.risk.failure(plan.stations) <= _HOPELESS:
        return plan

    path, _ = problem.safest()
    return planner.evaluate(path, draws.mean())


def choose(
    policy: Policy,
    name: str,
    rng: np.random.Generator,
    draws: Draws,
    planner: Planner,
    driven: Sequence[Sequence[Cell]] = (),
) -> Plan:
    """Plan a path with a policy, and check what it returned.

    If no path satisfies `max_failure`, or the chosen one almost certainly fails, the safest path is
    returned.

    Args:
        policy: Policy that chooses the path.
        name: Name of the policy.
        rng: Generator of the policy's random numbers.
        draws: Parameter draws.
        planner: Planner of `informed_planner`.
        driven: Paths of all missions.

    Raises:
        TrustboError: The policy did not return a plan, or its path is invalid.
    """
    try:
        plan = choose_plan(policy, rng, draws, planner, driven)
    except InfeasibleError as error:  # `warn_if_infeasible` issues the warning
        return planner.evaluate(error.stations, draws.mean())

    name = f"policy {name!r}"
    require_kind(name, plan, Plan, "a policy must return a trustbo.planning.Plan")
    try:
        planner.require_path(plan.stations)
    except TrustboError as error:
        raise TrustboError(f"{name}: {error}") from None

    safest = instead_of_failure(planner, plan, draws)
    if safest.stations != plan.stations:
        warn(
            f"the path {path_text(plan.path)} almost certainly fails; the safest path is "
            f"planned instead, which arrives with probability {safest.p_arrive:.2g}."
        )
    return safest


def warn_if_infeasible(plan: Plan) -> None:
    """Warn if no path satisfies `max_failure`."""
    if plan.infeasible:
        warn(
            f"the plan arrives with probability {plan.p_arrive:.3g} only, and max_failure does "
            "not allow this. Suggest a safer path, or increase max_failure."
        )


def warn_of_risk(plan: Plan, risk: BoundRisk, planner: Planner, options: dict[str, Any]) -> bool:
    """Warn if failure is likely but does not influence the plans; returns whether it did.

    Args:
        plan: Plan of the next mission.
        risk: Failure probabilities that the plan was made with.
        planner: Planner of the campaign.
        options: Options of the planner in the settings of the campaign.
    """
    is_limited = any(options.get(name) is not None for name in ("max_failure", "failure_cost"))
    if is_limited or risk.has_failures:
        return False
    if plan.p_arrive is None or plan.p_arrive >= _LIKELY_ARRIVAL:
        return False

    remedy = 'planner={"max_failure": ...}'
    if planner.problem.objective.of_contact:
        remedy += ' or planner={"failure_cost": ...}'
    warn(
        f"the plan arrives with a probability of only {plan.p_arrive:.2f}, and paths are "
        "chosen without regard to this probability until a mission has failed. To avoid risky "
        f"paths from the start, pass {remedy}. If the max_slope of the robots is uncertain, "
        "lower it. The page Failures of the documentation explains the probability."
    )
    return True
