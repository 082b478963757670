"""What a simulator is, and what one bound of ours is made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from trustbo.data import Cell, Mission

BOUNDING = ("successive", "alternate")
"""T2 closes up to the lead after each bound, or passes it in the next."""


class Simulator(Protocol):
    """Whatever runs a path: this package's simulator, yours, or real robots."""

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path from its first cell to its last, or as far as it goes."""
        ...


@dataclass(eq=False)
class State:
    """Where everybody is; positions in CRS metres, headings in rad."""

    cells: tuple[Cell, Cell]  # of the lead, and of T2
    poses: np.ndarray  # (1 + robot, 3), the lead first
    time: float
    seed: int
    tracks: np.ndarray  # (phase, robot, 2), see `sensing.new_tracks`


class Drive(NamedTuple):
    """One bound's movements."""

    poses: np.ndarray  # (tick, 1 + robot, 3)
    lead_moves: np.ndarray  # (tick,), else T2 does
    status: str
    cells: tuple[Cell, Cell]

    def closing(self, n_ticks: int) -> np.ndarray:
        """In which of its first ticks T2 moves; if it has not yet, it measures where it stands."""
        closing = ~self.lead_moves[:n_ticks]
        closing[-1] |= not closing.any()
        return closing


def turns(bounding: str, k: int, is_last: bool) -> tuple[str, ...]:
    """Who moves in bound k, one after the other: the `"lead"`, `"t2"`."""
    if bounding == "successive":
        return "lead", "t2"
    first, other = ("lead", "t2") if k % 2 else ("t2", "lead")
    return (first, other) if is_last else (first,)
