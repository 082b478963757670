"""Simulators of bounding overwatch, including the replay of recorded missions."""

from trustbo.simulation.events import Degradation, Dust, Event, Fouling, Jam, Season, Trees
from trustbo.simulation.kinematic import KinematicSimulator
from trustbo.simulation.model import ModelSimulator
from trustbo.simulation.radio import RadioSimulator
from trustbo.simulation.realtime import RealtimeAwareness
from trustbo.simulation.replay import ReplaySimulator
from trustbo.simulation.truth import Truth

__all__ = [
    "Degradation", "Dust", "Event", "Fouling", "Jam", "KinematicSimulator", "ModelSimulator",
    "RadioSimulator", "RealtimeAwareness", "ReplaySimulator", "Season", "Trees", "Truth",
]  # fmt: skip
__dir__ = __all__.copy  # tab completion lists only public names
