"""Planner of a campaign, from its options and the failure chances of bounds."""

from typing import Any

import numpy as np

from trustbo.campaign.options import PLANNING_OPTIONS, CampaignOptions
from trustbo.hazard.risk import BoundRisk
from trustbo.planning import Planner
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location

_N_DRAWS = 200
_STOPPED, _RECOVERED = 2, 0.2
"""Number of failures that makes a bound avoided, and the failure chance below which it is not."""


def planner_of(
    options: CampaignOptions,
    workspace: Workspace,
    start: Location,
    goal: Location,
    objective: str,
    observation: str,
    response: str,
) -> Planner:
    """Planner from the options of a campaign, for the observation and response of its model."""
    chosen: dict[str, Any] = {name: getattr(options, name) for name in PLANNING_OPTIONS}
    chosen |= {"observation": observation, "response": response}
    return Planner(workspace, start, goal, objective, **chosen, infeasible="safest")


def under_risk(planner: Planner, risk: BoundRisk) -> Planner:
    """Planner that takes the failure chances of bounds into account."""
    return planner.with_risk(risk.mean, risk.draw(_N_DRAWS), risk.causes)


def to_avoid(risk: BoundRisk) -> np.ndarray:
    """Bounds with two failures whose failure chance has not recovered, (move, row, col)."""
    with np.errstate(invalid="ignore"):
        return (risk.stopped >= _STOPPED - 1e-9) & ~(risk.mean < _RECOVERED)


def path_class(planner: Planner) -> dict[str, Any]:
    """Arguments of `Truth.best` and `Truth.regret` for the planner's admissible paths.

    The objective is contact lost, or mean contact where that is the planner's.
    """
    return {
        "objective": "mean" if planner.objective == "mean" else "lost_contact",
        "max_bounds": planner.max_bounds,
        "connectivity": planner.connectivity,
    }
