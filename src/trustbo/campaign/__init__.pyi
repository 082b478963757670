from .campaign import Campaign
from .follow import Follower
from .loop import iterate, resume
from .options import CampaignOptions
from .result import Result
from .stopping import RegretBound, TimeLimit
from .storage import load_result

__all__ = [
    "Campaign",
    "CampaignOptions",
    "Follower",
    "RegretBound",
    "Result",
    "TimeLimit",
    "iterate",
    "load_result",
    "resume",
]
