"""Planning: from a posterior to the most trustworthy path."""

from trustbo.hazard.risk import PathRisk
from trustbo.planning import policies
from trustbo.planning.dynamics import Dynamics, roll_trust
from trustbo.planning.graph import NoPathError
from trustbo.planning.objectives import OBJECTIVES
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.planning.planner import Planner
from trustbo.planning.policies import POLICIES, Policy
from trustbo.planning.posterior import DrawnPaths
from trustbo.planning.risk import InfeasibleError

__all__ = [
    "OBJECTIVES", "POLICIES", "QUANTILES", "DrawnPaths", "Dynamics", "InfeasibleError",
    "NoPathError", "PathRisk", "Plan", "Planner", "Policy", "policies", "roll_trust",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
