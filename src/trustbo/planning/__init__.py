"""From a posterior to the most trustworthy path."""

from trustbo.planning import policies
from trustbo.planning.belief import AwarenessBelief
from trustbo.planning.dynamics import Dynamics, drift, dynamics, roll_trust
from trustbo.planning.graph import NoPathError, cell_graph
from trustbo.planning.information import information_gain
from trustbo.planning.objectives import OBJECTIVES
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.planning.planner import Planner
from trustbo.planning.policies import POLICIES, Policy
from trustbo.planning.posterior import DrawnPaths

__all__ = [
    "OBJECTIVES",
    "POLICIES",
    "QUANTILES",
    "AwarenessBelief",
    "DrawnPaths",
    "Dynamics",
    "NoPathError",
    "Plan",
    "Planner",
    "Policy",
    "cell_graph",
    "drift",
    "dynamics",
    "information_gain",
    "policies",
    "roll_trust",
]
