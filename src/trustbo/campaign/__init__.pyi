from .campaign import Campaign
from .follow import Follower
from .loop import iterate, resume
from .result import Result, load_result
from .stopping import RegretBound, TimeLimit

__all__ = [
    "Campaign",
    "Follower",
    "RegretBound",
    "Result",
    "TimeLimit",
    "iterate",
    "load_result",
    "resume",
]
