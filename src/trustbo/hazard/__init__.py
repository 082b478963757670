"""Hazard: the chance that a bound ends the mission, learned from missions that failed."""

from trustbo.hazard.exposures import CAUSES, LostMission
from trustbo.hazard.model import Hazard, fit_hazard
from trustbo.hazard.risk import BoundRisk

__all__ = ["CAUSES", "BoundRisk", "Hazard", "LostMission", "fit_hazard"]
__dir__ = __all__.copy  # completion lists public names alone
