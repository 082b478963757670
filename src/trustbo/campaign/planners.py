"""Planner of a campaign: from its options, and given what was learned."""

from typing import Any

import numpy as np

from trustbo.campaign.learning import Learner
from trustbo.campaign.options import PLANNING_OPTIONS, CampaignOptions
from trustbo.campaign.state import CampaignState
from trustbo.hazard.risk import BoundRisk
from trustbo.planning import Plan, Planner
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location

_N_DRAWS = 200
_STOPPED, _RECOVERED = 2, 0.2
"""Number of failures that makes a bound avoided, and the failure chance below which it is not."""
_ARRIVES = 0.9
"""Chance to arrive of a plan below which a campaign without a price of failures warns."""


def planner_of(
    options: CampaignOptions,
    workspace: Workspace,
    start: Location,
    goal: Location,
    objective: str,
    observation: str,
) -> Planner:
    """Planner from the options of a campaign, for the observation of its model."""
    chosen: dict[str, Any] = {name: getattr(options, name) for name in PLANNING_OPTIONS}
    chosen["observation"] = observation
    return Planner(workspace, start, goal, objective, **chosen, infeasible="safest")


def planner_given(planner: Planner, learner: Learner, state: CampaignState) -> Planner:
    """Planner given the belief of a learner and the failures of a state, see `planner_now`."""
    planner = planner.with_observation(learner.observation)
    risk = learner.hazard(state)[1]
    if (state.entries or state.failures) and (avoid := to_avoid(risk)).any():
        planner = planner.avoiding(avoid, risk.mean)
    return under_risk(planner, risk)


def under_risk(planner: Planner, risk: BoundRisk) -> Planner:
    """Planner that takes the failure chances of bounds into account.

    The slope limit that the user states is believed until a failure contradicts it: before the
    first one, a failure costs nothing unless the user gave `failure_cost`. Its price under the
    prior alone would forbid longer paths that keep contact and on which nothing fails. From then on
    it is joint over strata of the posterior, since bounds share the slope limit.
    """
    if planner.problem.rule.failure_cost is None and not risk.has_failures:
        planner = planner.with_failure_cost(0.0)
    strata = risk.strata() if planner.problem.failure_cost > 0.0 else None
    return planner.with_risk(risk.mean, risk.draw(_N_DRAWS), risk.causes, strata)


def unpriced_risk(options: CampaignOptions, risk: BoundRisk, plan: Plan) -> str:
    """Warning of a plan that may well fail although a failure costs nothing in it; else empty."""
    limited = options.max_failure is not None or options.failure_cost is not None
    if limited or risk.has_failures or plan.p_arrive is None or plan.p_arrive >= _ARRIVES:
        return ""
    return (
        f"the plan arrives with a chance of {plan.p_arrive:.2f} only, and a failure costs nothing "
        "in it as none was recorded yet; set max_failure or failure_cost, or lower max_slope of "
        "the team's robots."
    )


def to_avoid(risk: BoundRisk) -> np.ndarray:
    """Bounds with two failures whose failure chance has not recovered, (move, row, col)."""
    with np.errstate(invalid="ignore"):
        return (risk.stopped >= _STOPPED - 1e-9) & ~(risk.mean < _RECOVERED)


def path_class(planner: Planner) -> dict[str, Any]:
    """Arguments of `Truth.best` and `Truth.regret` for the planner's admissible paths."""
    return {"max_bounds": planner.max_bounds, "connectivity": planner.connectivity}
