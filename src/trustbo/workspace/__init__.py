"""Planning grid with awareness, passability, positions, routes and sight."""

from trustbo.workspace.sight import Sight
from trustbo.workspace.workspace import Workspace

__all__ = ["Sight", "Workspace"]
__dir__ = __all__.copy  # completion lists public names alone
