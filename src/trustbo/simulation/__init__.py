"""Simulators of bounding overwatch, and replay of recorded missions."""

from trustbo.simulation.events import Degradation, Threat
from trustbo.simulation.model import ModelSimulator
from trustbo.simulation.mujoco import MujocoSimulator
from trustbo.simulation.overwatch import KinematicSimulator
from trustbo.simulation.protocol import BoundSimulator, Simulator
from trustbo.simulation.replay import ReplaySimulator
from trustbo.simulation.truth import Truth

__all__ = [
    "BoundSimulator", "Degradation", "KinematicSimulator", "ModelSimulator", "MujocoSimulator",
    "ReplaySimulator", "Simulator", "Threat", "Truth",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
