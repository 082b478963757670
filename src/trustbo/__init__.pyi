from . import export, models, planning, plots, report, simulation, study, terrain
from .campaign import Campaign
from .data import Bound, Mission, Robot, Team
from .errors import PosteriorError, ShapeError, TerrainError, TrustboError
from .loop import iterate, missions, resume
from .planning import NoPathError
from .result import Result, load_result
from .stopping import RegretBound, Seconds
from .terrain import Workspace

__all__ = [
    "Bound",
    "Campaign",
    "Mission",
    "NoPathError",
    "PosteriorError",
    "RegretBound",
    "Result",
    "Robot",
    "Seconds",
    "ShapeError",
    "Team",
    "TerrainError",
    "TrustboError",
    "Workspace",
    "export",
    "iterate",
    "load_result",
    "missions",
    "models",
    "planning",
    "plots",
    "report",
    "resume",
    "simulation",
    "study",
    "terrain",
]
__version__: str
