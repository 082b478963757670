"""Hazard: the probability that a bound ends the mission, learned from failed missions."""

from trustbo.hazard.prior import Hazard

__all__ = ["Hazard"]
__dir__ = __all__.copy  # completion lists public names alone
