"""Simulators of bounding overwatch, and replay of recorded missions."""

from trustbo.renamed import moved
from trustbo.simulation.events import Degradation, Threat
from trustbo.simulation.model import ModelSimulator
from trustbo.simulation.mujoco import MujocoSimulator
from trustbo.simulation.overwatch import KinematicSimulator
from trustbo.simulation.replay import ReplaySimulator
from trustbo.simulation.truth import Truth

__all__ = [
    "Degradation", "KinematicSimulator", "ModelSimulator", "MujocoSimulator", "ReplaySimulator",
    "Threat", "Truth",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
__getattr__ = moved(__name__, {"trustbo.simulation.protocol": ("BoundSimulator", "Simulator")})
