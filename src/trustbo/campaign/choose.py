"""Choice of the next path: the planner with the failures so far, the policy, and warnings."""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_kind, warn
from trustbo.hazard.risk import BoundRisk
from trustbo.models.draws import Draws
from trustbo.planning import InfeasibleError, Plan, Planner
from trustbo.planning.policies import Policy, choose_plan
from trustbo.workspace.moves import by_option

_STOPPED = 2
"""Number of failures after which a bound is avoided if failures have no cost."""
_RECOVERED = 0.2
"""Failure probability below which such a bound is allowed again."""
_ROUNDING = 1e-9
"""Largest rounding error of an expected number of failures."""


def informed_planner(planner: Planner, risk: BoundRisk) -> Planner:
    """Make a planner that accounts for the failure probabilities of bounds.

    Failures have a cost if the objective measures contact, unless `failure_cost` is 0. If they have
    none, a bound that failed twice is avoided unless there is no other path, or its failure
    probability has fallen below 0.2.
    """
    planner = planner.with_risk(risk)
    if planner.problem.cost_of_failure:
        return planner

    stopped = risk.past_failures + _ROUNDING >= _STOPPED
    if not stopped.any():
        return planner

    p_fail = by_option(risk.mean)  # (move, row, col, option)
    is_likely = ~(p_fail < _RECOVERED) & by_option(risk.exists)
    avoided = stopped & is_likely.any(-1)
    if not avoided.any():
        return planner
    return planner.avoiding(avoided, np.nanmax(p_fail, axis=-1, initial=0.0))


def choose(
    policy: Policy,
    name: str,
    rng: np.random.Generator,
    draws: Draws,
    planner: Planner,
    driven: Sequence[Sequence[Cell]] = (),
) -> Plan:
    """Plan a path with a policy, and check what it returned.

    If no path satisfies `max_failure`, the safest path is returned.

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

    return plan


def warn_if_infeasible(plan: Plan) -> None:
    """Warn if no path satisfies `max_failure`."""
    if plan.infeasible:
        warn(
            f"the plan arrives with probability {plan.p_arrive:.3g} only, and max_failure does "
            "not allow this. Suggest a safer path, or increase max_failure."
        )
