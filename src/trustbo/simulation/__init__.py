"""Missions simulated on a terrain."""

from trustbo.simulation.overwatch import KinematicSimulator, Simulator
from trustbo.simulation.sight import SIGHT_MODES, Sight

__all__ = ["SIGHT_MODES", "KinematicSimulator", "Sight", "Simulator"]
