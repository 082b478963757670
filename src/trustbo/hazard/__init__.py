"""Hazard: the probability that a bound ends the mission, inferred from past missions."""

from trustbo.hazard.model import fit_hazard
from trustbo.hazard.prior import Hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import CAUSES

__all__ = ["CAUSES", "BoundRisk", "Hazard", "fit_hazard"]
__dir__ = __all__.copy  # tab completion lists only public names
