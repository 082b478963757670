"""Search for the most trustworthy path, given a posterior of the trust model."""

from trustbo.planning import policies
from trustbo.planning.objectives import OBJECTIVES
from trustbo.planning.paths import NoPathError
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.policies import POLICIES
from trustbo.planning.problem import InfeasibleError
from trustbo.planning.recursion import expected_trust
from trustbo.planning.threats import threat_map
from trustbo.planning.watchers import at_least, contact_dependence
from trustbo.planning.ways import Ways

__all__ = [
    "OBJECTIVES",
    "POLICIES",
    "InfeasibleError",
    "NoPathError",
    "Plan",
    "Planner",
    "Ways",
    "at_least",
    "contact_dependence",
    "expected_trust",
    "policies",
    "threat_map",
]  # fmt: skip
__dir__ = __all__.copy  # tab completion lists only public names
