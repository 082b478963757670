"""Planning grid: awareness of bounds, passable cells, posts, routes and line of sight."""

from trustbo.workspace.moves import MOVES
from trustbo.workspace.sight import Sight
from trustbo.workspace.workspace import Workspace

__all__ = ["MOVES", "Sight", "Workspace"]
__dir__ = __all__.copy  # tab completion lists only public names
