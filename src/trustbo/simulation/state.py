"""State of a mission between two bounds, and the movements of a bound."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trustbo.data import Cell


@dataclass(eq=False)
class State:
    """Positions of the team between two bounds; positions in CRS metres, headings in rad."""

    cell: Cell
    poses: np.ndarray  # (1 + robot, 3), the lead first
    stops: np.ndarray  # (1 + robot, 2), planned posts: the routes start there
    time: float
    seed: int
    tracks: np.ndarray  # (phase, robot, 2), see `sensing.new_tracks`


class Drive(NamedTuple):
    """Movements of one bound."""

    poses: np.ndarray  # (tick, 1 + robot, 3)
    lead_moves: np.ndarray  # (tick,), else T2 does
    status: str
    stops: np.ndarray  # (1 + robot, 2)

    @property
    def closing(self) -> np.ndarray:
        """Mask of the ticks in which T2 moves; the last tick if it has not moved yet."""
        closing = ~self.lead_moves
        closing[-1] |= not closing.any()
        return closing
