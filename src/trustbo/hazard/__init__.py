"""Hazard: the chance that a bound ends the mission, learned from missions that failed."""

from trustbo.hazard.model import Hazard, fit_hazard

__all__ = ["Hazard", "fit_hazard"]
__dir__ = __all__.copy  # completion lists public names alone
