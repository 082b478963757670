"""Truth of a simulator: expected contact of paths, the best of them, and regret."""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.errors import (
    DamagedFileError,
    TrustboError,
    require_choice,
    require_positive,
    require_whole,
)
from trustbo.files import FilePath, cache_folder, require_folder, to_json
from trustbo.logs.netcdf import read_tree, write_tree
from trustbo.models.backend import VERSIONS
from trustbo.planning import Plan
from trustbo.planning.paths import AdmissiblePaths, PathClass
from trustbo.simulation.bound_table import BoundTable, tabulate
from trustbo.simulation.model_contact import ModelContact
from trustbo.simulation.overwatch import KinematicSimulator
from trustbo.simulation.protocol import takes
from trustbo.simulation.replicates import KinematicReplicates, PlainReplicates
from trustbo.terrain.read import digest_of
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location

OBJECTIVES = ("lost_contact", "mean")
"""Objectives for which a truth has a best path."""


class PathContact(NamedTuple):
    """Expected contact lost and kept on a path, and the probability to arrive."""

    lost: float
    """Expected contact lost, in bounds: the sum over bounds of 1 - contact, mean over robots."""
    mean: float
    """Expected contact rate, mean over bounds and robots."""
    p_arrive: float
    """Probability that no bound fails."""


class Truth(Summary):
    """Expected contact of every path of a simulator, in the world of a mission.

    Contact is expected given that no bound fails; `PathContact.p_arrive` is the probability of
    that.

    Attributes:
        workspace: Workspace of the paths.
        bounds: Expected contact of bounds: a `BoundTable`, whose `data` has it all, or a
            `ModelContact`.
    """

    def __init__(
        self,
        workspace: Workspace,
        bounds: BoundTable | ModelContact,
        at_mission: "Callable[[int], Truth] | None" = None,
    ) -> None:
        """Store the contact of bounds; `at(mission)` is the truth of another mission's world."""
        self.workspace, self.bounds, self._other = workspace, bounds, at_mission
        self._best: dict[tuple[Any, ...], tuple[Cell, ...]] = {}

    def _rows(self) -> Rows:
        grid = self.workspace.grid
        source = f"{type(self.bounds).__name__}, of {grid.shape[0]} x {grid.shape[1]} cells"
        error = f"{self.standard_error:.2g} of a bound's contact, mean over robots"
        rows = [
            ("bounds", source),
            ("standard error", error),
            ("worlds", "one" if self._other is None else "of each mission, see at(mission)"),
        ]
        return rows

    @classmethod
    def of(
        cls,
        simulator: Any,
        *,
        seed: int = 0,
        standard_error: float = 0.005,
        mission: int = 0,
        folder: FilePath | None = None,
        progress: bool = False,
    ) -> Self:
        """Find the truth of a simulator.

        A simulator with a method `expected_contact`, such as `ModelSimulator`, has it in closed
        form. Of another, every bound, followed by each that can follow it, is replicated until the
        standard error is reached; the result is cached on disk under a hash of the world's
        settings (`describe_mission(mission)`, else `describe()`), the workspace and the code. Of
        what varies within a mission (`Fouling`), contact is the expectation in the long run.

        Args:
            simulator: Simulator with a `workspace`, and with `reset` and `run_bound`.
            seed: Seed of the replicates.
            standard_error: Standard error of the contact of a bound, mean over robots.
            mission: Number of the mission, where the world changes.
            folder: Folder to keep it in; by default `truth` in trustbo's cache, which is
                `$XDG_CACHE_HOME/trustbo`.
            progress: Whether to show a progress bar.

        Raises:
            TrustboError: A simulator without a workspace or bounds; a standard error that is not
                positive.
        """
        workspace = getattr(simulator, "workspace", None)
        if not isinstance(workspace, Workspace):
            raise TrustboError(
                f"truth needs a simulator with a workspace; {type(simulator).__name__} has none."
            )
        if hasattr(simulator, "expected_contact"):
            return cls(workspace, simulator.expected_contact())
        numbers = require_whole("seed", seed, 0), require_positive("standard_error", standard_error)
        cached: dict[str, Self] = {}

        def of_mission(number: int) -> Self:
            world = _world(simulator, require_whole("mission", number, 0))
            if (key := to_json(world)) not in cached:
                table = _table(simulator, number, world, *numbers, folder, progress)
                cached[key] = cls(workspace, table, of_mission)
            return cached[key]

        return of_mission(mission)

    @property
    def standard_error(self) -> float:
        """Standard error of the contact of a bound, mean over robots: root mean square over all."""
        return self.bounds.standard_error

    def at(self, mission: int) -> "Truth":
        """Truth of the world of another mission, counted from 0."""
        return self if self._other is None else self._other(mission)

    def best(
        self,
        start: Location,
        goal: Location,
        objective: str = "lost_contact",
        max_bounds: int | str = "shortest+4",
        *,
        connectivity: int = 8,
    ) -> tuple[Cell, ...]:
        """Find the best admissible path, exactly.

        Args:
            start: First cell, or a position in it; see `Workspace.locate`.
            goal: Last cell, or a position in it.
            objective: `"lost_contact"`, the least contact lost, or `"mean"`, the largest mean rate.
            max_bounds: Admissible paths, and
            connectivity: moves, both as for `Planner`.

        Raises:
            TrustboError: An unknown name; a cell off the grid, or impassable.
            NoPathError: The goal cannot be reached.
        """
        require_choice("objective of a truth", objective, OBJECTIVES)
        a, b = (self.workspace.require_cell(*e) for e in (("start", start), ("goal", goal)))
        key = a, b, objective, max_bounds, connectivity
        if key not in self._best:
            paths = AdmissiblePaths(self.workspace, a, b, PathClass(connectivity, max_bounds))
            self._best[key] = self.bounds.best(paths, objective)
        return self._best[key]

    def value(self, path: Plan | Sequence[Cell]) -> PathContact:
        """Expected contact of a path, or of a plan, and its probability to arrive.

        Raises:
            TrustboError: A cell is off the grid or impassable, or no neighbour of the last.
        """
        cells = self._cells(path)
        rates = self.bounds.contact(cells).mean(1)
        arrives = float(np.prod(1.0 - self.bounds.failure(cells)))
        return PathContact(float((1.0 - rates).sum()), float(rates.mean()), arrives)

    def regret(
        self,
        path: Plan | Sequence[Cell],
        objective: str = "lost_contact",
        max_bounds: int | str = "shortest+4",
        *,
        connectivity: int = 8,
    ) -> float:
        """Regret of a path, or of a plan's, in % of the contact that the best path keeps.

        100 (contact lost on it - lost on the best) / contact kept on the best, both in bounds; for
        `"mean"` of mean rates. The best path is that of `best`, with the same ends; negative if
        the path is better than all those admissible.

        Raises:
            TrustboError: See `best` and `value`.
        """
        cells = self._cells(path)
        best_path = self.best(cells[0], cells[-1], objective, max_bounds, connectivity=connectivity)
        best, value = self.value(best_path), self.value(cells)
        if objective == "mean":
            return _percent(best.mean - value.mean, best.mean)
        return _percent(value.lost - best.lost, len(best_path) - 1 - best.lost)

    def require_workspace(self, workspace: Workspace) -> None:
        """Refuse another workspace than that of the truth; its features may differ.

        Raises:
            TrustboError: The grid, passable cells or terrain differ.
        """
        for name, mine, other in _differences(self.workspace, workspace):
            raise TrustboError(
                f"the truth is of another workspace: its {name} is {mine}, the campaign's {other}; "
                "make it with Truth.of(simulator) of this workspace's simulator."
            )

    def _cells(self, path: Plan | Sequence[Cell]) -> tuple[Cell, ...]:
        cells = path.path if isinstance(path, Plan) else path
        cells = tuple(self.workspace.require_cell(f"path[{k}]", c) for k, c in enumerate(cells))
        if len(cells) < 2:
            raise TrustboError(f"a path needs at least two cells; got {cells}.")
        return cells


def _percent(lacking: float, whole: float) -> float:
    return 100.0 * lacking / whole if whole > 0.0 else np.nan


def _world(simulator: Any, mission: int) -> tuple[object, int]:
    """Settings of the world of a mission, None if unknown, and its number if they lack it."""
    if hasattr(simulator, "describe_mission"):
        return simulator.describe_mission(mission), 0
    describe, begin = (getattr(simulator, name, None) for name in ("describe", "reset"))
    numbered = begin is not None and takes(begin, "mission")
    return None if describe is None else describe(), mission if numbered else 0


def _table(
    simulator: Any,
    mission: int,
    world: tuple[object, int],
    seed: int,
    standard_error: float,
    folder: FilePath | None,
    progress: bool,
) -> BoundTable:
    """Table of a simulator, from the disk cache if present."""
    file = None
    if world[0] is not None:  # else its identity is unknown
        about = [world, seed, standard_error, VERSIONS["trustbo"], _code()]
        kept = cache_folder("truth") if folder is None else require_folder(folder)
        digest = hashlib.sha256(to_json(about).encode())
        for content in _content(simulator):
            digest.update(content)
        file = kept / f"{digest.hexdigest()[:20]}.nc"
        if file.exists():
            try:
                return BoundTable(read_tree(file)["bounds"].to_dataset())
            except (DamagedFileError, KeyError):
                pass  # computed again
    kind = type(simulator) is KinematicSimulator
    source = (KinematicReplicates if kind else PlainReplicates)(simulator, mission, seed)
    table = tabulate(simulator.workspace, source, standard_error=standard_error, progress=progress)
    if file is not None:
        write_tree(file, xr.DataTree.from_dict({"bounds": table.data}))
    return table


def _content(simulator: Any) -> list[bytes]:
    """Contents of the workspace on which contact depends."""
    workspace: Workspace = simulator.workspace
    settings = [workspace.grid, workspace.team, workspace.sights]
    contents = [to_json(settings).encode(), _bytes(workspace.passable)]
    if workspace.terrain is None or workspace.pixels is None:
        return [*contents, _bytes(workspace.awareness)]
    pixels = [_bytes(workspace.pixels[name]) for name in ("traversability", "passable")]
    return [*contents, digest_of(workspace.terrain).encode(), *pixels]


def _bytes(array: xr.DataArray) -> bytes:
    return np.ascontiguousarray(array.values).tobytes()


@cache
def _code() -> str:
    """Source hash of the simulator: invalidates cached truths during development."""
    digest, root = hashlib.sha256(), Path(__file__).parents[1]
    for room in ("simulation", "terrain", "workspace"):
        for file in sorted((root / room).glob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _differences(a: Workspace, b: Workspace) -> list[tuple[str, str, str]]:
    """Names of settings that differ, with both values as text."""
    if a.grid != b.grid:
        mine, theirs = (
            f"{g.shape[0]} x {g.shape[1]} cells of {g.cell_height:g} m x {g.cell_width:g} m at "
            f"{g.left:g}, {g.top:g}"
            for g in (a.grid, b.grid)
        )
        return [("grid", mine, theirs)]
    if not np.array_equal(a.passable.values, b.passable.values):
        n, other = (f"{int(w.passable.sum())} passable cells" for w in (a, b))
        return [("passability", n, other)]
    if a.terrain is None or b.terrain is None:
        return []
    differences = []
    for name in ("dem", "dsm"):
        mine, theirs = a.terrain[name].values, b.terrain[name].values
        if mine.shape != theirs.shape or not np.array_equal(mine, theirs, equal_nan=True):
            mean, other = (f"of mean height {np.nanmean(h):.2f} m" for h in (mine, theirs))
            differences.append((name, mean, other))
    return differences
