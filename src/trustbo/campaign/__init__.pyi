from .campaign import Campaign as Campaign
from .follow import Follower as Follower
from .loop import iterate as iterate
from .loop import resume as resume
from .read import load_result as load_result
from .result import Result as Result
from .stopping import RegretBound as RegretBound
