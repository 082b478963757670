"""Planning grid: awareness, passability, positions, routes and sight of every cell."""

from trustbo.renamed import moved
from trustbo.workspace.belief import AwarenessBelief
from trustbo.workspace.sight import Sight
from trustbo.workspace.survey import survey
from trustbo.workspace.workspace import Workspace

__all__ = ["AwarenessBelief", "Sight", "Workspace", "survey"]
__dir__ = __all__.copy  # completion lists public names alone
__getattr__ = moved(
    __name__, {"trustbo.workspace.grid": ["Grid"], "trustbo.workspace.sight": ["SIGHT_MODES"]}
)
