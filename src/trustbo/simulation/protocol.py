"""Protocols of simulators: whole missions, or one bound after the other."""

import inspect
from collections.abc import Callable, Sequence
from typing import Protocol

from trustbo.data import Bound, Cell, Mission
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError


class Simulator(Protocol):
    """Simulator that runs a path: one of this package, a custom one, or real robots.

    Three more methods are optional: `describe() -> dict` returns settings that a campaign records;
    `describe_mission(mission) -> dict` those of the world of a mission, equal in equal worlds; and
    `expected_contact()` the contact and failures of bounds, as a `BoundTable` of
    `simulation.bound_table`, which `Truth.of` takes instead of replicates. A simulator whose world
    changes takes the number of the mission as a keyword `mission` of `run` (and of `reset`).
    """

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path from its first cell to its last, or until it fails."""
        ...


class BoundSimulator(Simulator, Protocol):
    """Simulator that can also run bound by bound, for `Truth.of`.

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


class DescribedSimulator(Summary):
    """Simulator of this package, displayed by the settings that it describes."""

    def describe(self) -> dict[str, object]:
        """Return the settings that decide what a mission measures."""
        raise NotImplementedError

    def _rows(self) -> Rows:
        settings = {name: value for name, value in self.describe().items() if name != "simulator"}
        rows = [(name, str(value)) for name, value in settings.items() if value not in (None, [])]
        return [(name, text) for name, text in rows if len(text) < 200]


def require_bounds(simulator: object, what: str) -> None:
    """Refuse a simulator that cannot run bound by bound, as `what` needs: TrustboError."""
    missing = [name for name in ("reset", "run_bound") if not hasattr(simulator, name)]
    if missing:
        raise TrustboError(
            f"{what} needs a simulator with reset(start, seed) and run_bound(k, cell); "
            f"{type(simulator).__name__} has no {' and no '.join(missing)}."
        )


def takes(function: Callable[..., object], name: str) -> bool:
    """Whether a function has a parameter of that name."""
    return name in inspect.signature(function).parameters


def require_call(simulator: object, name: str, *arguments: object, **named: object) -> None:
    """Check the signature of a simulator's method, without calling it: TrustboError."""
    method = getattr(simulator, name)
    if takes(method, "mission"):
        named["mission"] = 0
    try:
        inspect.signature(method).bind(*arguments, **named)
    except TypeError as error:
        how = {"run": "run(path, *, seed)", "reset": "reset(start, seed)"}[name]
        raise TrustboError(
            f"a simulator needs {how}; the call of {type(simulator).__name__}.{name} fails: "
            f"{error}."
        ) from None
