from . import export, models, planning, plots, simulation, terrain
from .campaign import Campaign
from .data import Bound, Mission, Robot, Team
from .errors import PosteriorError, ShapeError, TerrainError, TrustboError
from .loop import iterate
from .planning import NoPathError
from .result import Result, load_result
from .terrain import Workspace

__all__ = [
    "Bound",
    "Campaign",
    "Mission",
    "NoPathError",
    "PosteriorError",
    "Result",
    "Robot",
    "ShapeError",
    "Team",
    "TerrainError",
    "TrustboError",
    "Workspace",
    "export",
    "iterate",
    "load_result",
    "models",
    "planning",
    "plots",
    "simulation",
    "terrain",
]
__version__: str
