"""From a posterior to the most trustworthy path."""

from trustbo.planning import policies
from trustbo.planning.graph import NoPathError, cell_graph
from trustbo.planning.objectives import OBJECTIVES, roll_trust
from trustbo.planning.planner import Plan, Planner
from trustbo.planning.policies import POLICIES, Policy

__all__ = [
    "OBJECTIVES",
    "POLICIES",
    "NoPathError",
    "Plan",
    "Planner",
    "Policy",
    "cell_graph",
    "policies",
    "roll_trust",
]
