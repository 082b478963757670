from . import export, logs, models, planning, plots, report, simulation, study, terrain, workspace
from .campaign import (
    Campaign,
    CampaignOptions,
    RegretBound,
    Result,
    Seconds,
    iterate,
    load_result,
    missions,
    resume,
)
from .data import Bound, Mission
from .errors import DamagedFileError, PosteriorError, ShapeError, TerrainError, TrustboError
from .planning import NoPathError
from .team import Robot, Team
from .workspace import Workspace

__all__ = [
    "Bound",
    "Campaign",
    "CampaignOptions",
    "DamagedFileError",
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
    "logs",
    "missions",
    "models",
    "planning",
    "plots",
    "report",
    "resume",
    "simulation",
    "study",
    "terrain",
    "workspace",
]
__version__: str
