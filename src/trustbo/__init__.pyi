from . import (
    criticism,
    export,
    hazard,
    inference,
    logs,
    models,
    paper,
    planning,
    plots,
    report,
    simulation,
    study,
    terrain,
    workspace,
)
from .campaign import (
    Campaign,
    Follower,
    RegretBound,
    Result,
    iterate,
    load_result,
    resume,
)
from .criticism import check
from .data import Bound, Mission
from .errors import PosteriorError, TrustboError
from .inference import compare, fit
from .planning.paths import NoPathError
from .team import Robot, Team
from .workspace import Workspace

__all__ = [
    "Bound",
    "Campaign",
    "Follower",
    "Mission",
    "NoPathError",
    "PosteriorError",
    "RegretBound",
    "Result",
    "Robot",
    "Team",
    "TrustboError",
    "Workspace",
    "check",
    "compare",
    "criticism",
    "export",
    "fit",
    "hazard",
    "inference",
    "iterate",
    "load_result",
    "logs",
    "models",
    "paper",
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
