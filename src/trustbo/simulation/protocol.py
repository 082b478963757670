"""Protocol for simulators, and a base class and functions that trustbo's simulators share."""

import inspect
from collections.abc import Sequence
from typing import Any, Protocol

from trustbo import data
from trustbo.data import Cell, Mission, Station
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError
from trustbo.workspace import Workspace


class Simulator(Protocol):
    """Protocol for objects that run a path, such as a simulator or an interface to real robots.

    If `run` also has the argument `post_sets`, campaigns pass the name of the set of posts for each
    bound, if not all are standard. The robots of other simulators count as standing at their
    standard posts.

    Two methods are optional. `describe() -> dict` returns settings that a campaign records.
    `describe_world(mission) -> dict` returns the settings of a mission's world for `Truth`. To
    compute a `Truth`, the simulator also needs the attribute `workspace`.
    """

    def run(self, path: Sequence[Cell], *, seed: int, mission: int = 0) -> Mission:
        """Run a path from its first to its last cell, or until a bound fails.

        Args:
            path: Cells from start to goal, (row, col).
            seed: Random seed.
            mission: Number of the mission, from 0, for simulators whose world changes.
        """
        ...


class DescribedSimulator(Summary):
    """Base class of trustbo's simulators, which displays the settings from `describe`."""

    def describe(self) -> dict[str, object]:
        """Return the settings that affect the measurements of a mission."""
        raise NotImplementedError

    def _rows(self) -> Rows:
        settings = {name: value for name, value in self.describe().items() if name != "simulator"}
        rows = [(name, str(value)) for name, value in settings.items() if value not in (None, [])]
        return [(name, text) for name, text in rows if len(text) < 200]


def require_path(
    workspace: Workspace, path: Sequence[Station], post_sets: Sequence[str] = ()
) -> tuple[Station, ...]:
    """Return the stations of a path; raises TrustboError unless it has at least 2, all passable."""
    stations = data.stations_of(*data.split_path(path, post_sets))
    for k, (row, col, *_) in enumerate(stations):
        workspace.locate((row, col), f"path[{k}]")
    if len(stations) < 2:
        raise TrustboError(f"a path needs at least two cells, start and goal; got {stations}.")
    return stations


def reads_post_sets(simulator: Any) -> bool:
    """Return whether a simulator's `run` has the argument `post_sets`."""
    return "post_sets" in inspect.signature(simulator.run).parameters
