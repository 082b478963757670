"""Simulators of bounding overwatch, and replay of recorded missions."""

from trustbo.simulation.events import Degradation, Dust, Fouling, Season, Threat, Vegetation
from trustbo.simulation.model import ModelSimulator
from trustbo.simulation.overwatch import KinematicSimulator
from trustbo.simulation.radio import RadioSimulator
from trustbo.simulation.replay import ReplaySimulator
from trustbo.simulation.truth import Truth

__all__ = [
    "Degradation", "Dust", "Fouling", "KinematicSimulator", "ModelSimulator",
    "RadioSimulator", "ReplaySimulator", "Season", "Threat", "Truth", "Vegetation",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
