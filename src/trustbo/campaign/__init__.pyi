from .campaign import Campaign
from .follow import Follower
from .loop import iterate, resume
from .result import Result, load_result
from .stopping import RegretBound

__all__ = [
    "Campaign",
    "Follower",
    "RegretBound",
    "Result",
    "iterate",
    "load_result",
    "resume",
]
