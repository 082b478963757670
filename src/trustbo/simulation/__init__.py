"""Bounding overwatch on a terrain, simulated or replayed."""

from trustbo.simulation.bags import Topics, read_bag, write_bag
from trustbo.simulation.bounding import Simulator
from trustbo.simulation.events import Degradation, Threat
from trustbo.simulation.measure import STATES
from trustbo.simulation.model import ModelSimulator
from trustbo.simulation.mujoco import MujocoBackend
from trustbo.simulation.overwatch import KinematicSimulator
from trustbo.simulation.replay import ReplayBackend
from trustbo.simulation.sight import SIGHT_MODES, Sight
from trustbo.simulation.tables import read_table, write_table

__all__ = [
    "SIGHT_MODES",
    "STATES",
    "Degradation",
    "KinematicSimulator",
    "ModelSimulator",
    "MujocoBackend",
    "ReplayBackend",
    "Sight",
    "Simulator",
    "Threat",
    "Topics",
    "read_bag",
    "read_table",
    "write_bag",
    "write_table",
]
