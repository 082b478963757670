from .campaign import Campaign
from .loop import iterate, missions, resume
from .options import CampaignOptions
from .result import Result
from .result_files import load_result
from .stopping import RegretBound, Seconds

__all__ = [
    "Campaign",
    "CampaignOptions",
    "RegretBound",
    "Result",
    "Seconds",
    "iterate",
    "load_result",
    "missions",
    "resume",
]
