"""Hazard: the chance that a bound ends the mission, learned from missions that failed."""

from trustbo.hazard.prior import Hazard

__all__ = ["Hazard"]
__dir__ = __all__.copy  # completion lists public names alone
