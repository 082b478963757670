"""Protocols of simulators: whole missions, or one bound after the other."""

import inspect
from collections.abc import Callable, Sequence
from typing import Protocol

from trustbo.data import Bound, Cell, Mission


class Simulator(Protocol):
    """Simulator that runs a path: one of this package, a user's own, or real robots.

    One more method is optional: `describe() -> dict` gives settings that a campaign records. A
    simulator whose world changes takes the number of the mission as a keyword `mission` of `run`
    (and of `reset`).
    """

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path from its first cell to its last, or until it fails."""
        ...


class BoundSimulator(Simulator, Protocol):
    """Simulator that can also run bound by bound, for `iterate(..., replan="bound")`.

    If `reset` and `run_bound` take a keyword `next_cell`, they are given the cell after the bound,
    so that the robots can take positions that see it.
    """

    def reset(self, start: Cell, seed: int) -> None:
        """Begin a mission with the team in its start cell."""
        ...

    def run_bound(self, k: int, cell: Cell) -> Bound:
        """Run bound k, 1 for the first, into a cell."""
        ...

    def close(self) -> None:
        """End the mission."""
        ...


def takes(function: Callable[..., object], name: str) -> bool:
    """Whether a function has a parameter of that name."""
    return name in inspect.signature(function).parameters
