"""Planner of a campaign: by its options, and under the chances of bounds to fail."""

from typing import Any

import numpy as np

from trustbo.campaign.options import PLANNING, CampaignOptions, options_of
from trustbo.hazard.risk import BoundRisk
from trustbo.planning import Planner
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location

_N_DRAWS = 200
STOPPED = 2
"""Failures of a bound from which on it is not entered again without need."""
RECOVERED = 0.2
"""Mean chance to fail below which such a bound may be entered again all the same."""


def planner_of(
    options: CampaignOptions,
    workspace: Workspace,
    start: Location,
    goal: Location,
    objective: str,
    law: tuple[str, str],
) -> Planner:
    """Planner by the options of a campaign; `law` is the observation and response of its rates."""
    chosen: dict[str, Any] = {name: getattr(options, name) for name in options_of(PLANNING)}
    chosen |= {"observation": law[0], "response": law[1], "infeasible": "safest"}
    return Planner(workspace, start, goal, objective, **chosen)


def under_risk(planner: Planner, risk: BoundRisk) -> Planner:
    """Planner under the chances of bounds to fail."""
    return planner.with_risk(risk.mean, risk.draw(_N_DRAWS), risk.causes)


def to_avoid(risk: BoundRisk) -> np.ndarray:
    """Bounds that stopped robots twice, and whose posterior has not recovered, (move, row, col)."""
    with np.errstate(invalid="ignore"):
        return (risk.stopped >= STOPPED - 1e-9) & ~(risk.mean < RECOVERED)
