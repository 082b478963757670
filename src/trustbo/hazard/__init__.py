"""Hazard: the probability that a bound ends the mission, inferred from past missions."""

from trustbo.hazard.prior import Hazard

__all__ = ["Hazard"]
__dir__ = __all__.copy  # tab completion lists only public names
