"""Planning grid: awareness, passability, positions, routes and sight of every cell."""

from trustbo.workspace.belief import AwarenessBelief
from trustbo.workspace.grid import Grid
from trustbo.workspace.sight import SIGHT_MODES, Sight
from trustbo.workspace.survey import survey
from trustbo.workspace.workspace import Workspace

__all__ = [
    "SIGHT_MODES", "AwarenessBelief", "Grid", "Sight", "Workspace", "survey",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
