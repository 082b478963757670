"""Planning: from a posterior to the most trustworthy path."""

from trustbo.planning import policies
from trustbo.planning.dynamics import roll_trust
from trustbo.planning.objectives import OBJECTIVES
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.policies import POLICIES, Policy
from trustbo.planning.risk import InfeasibleError
from trustbo.renamed import moved

__all__ = [
    "OBJECTIVES", "POLICIES", "InfeasibleError", "Plan", "Planner", "Policy", "policies",
    "roll_trust",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
__getattr__ = moved(__name__, {
    "trustbo": ("NoPathError",),
    "trustbo.hazard.risk": ("PathRisk",),
    "trustbo.planning.dynamics": ("Dynamics",),
    "trustbo.planning.plan": ("QUANTILES",),
    "trustbo.planning.posterior": ("DrawnPaths",),
})  # fmt: skip
