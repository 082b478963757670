"""Truth of a simulator: expected contact of every bound, best path, and regret.

The expected contact of a bound depends on the cell left, the cell entered and the next cell,
because robots choose their posts for the next bound, and on the sets of posts in the cells left and
entered. The best path is found exactly by dynamic programming over bounds and the number of
remaining bounds.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Self

import numpy as np
import xarray as xr

from trustbo.data import POST_SETS, Cell, Station, cells_of, stations_of
from trustbo.display import Rows, Summary, announced
from trustbo.errors import TrustboError, require_count, require_switch, require_whole
from trustbo.files import FilePath, to_json, to_path, write_file
from trustbo.fixed import fix
from trustbo.identity import fingerprint
from trustbo.models.backend import VERSIONS
from trustbo.planning.paths import AdmissiblePaths, NoPathError
from trustbo.simulation.model import ModelSimulator
from trustbo.simulation.protocol import require_path
from trustbo.simulation.replicates import replicated
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Location
from trustbo.workspace.moves import MOVES, by_cell_left, pairs_along


class Truth(Summary):
    """Expected contact and failure of every bound in a simulator, in the world of a mission.

    Attributes:
        workspace: Workspace of the simulator.
        bounds: Dataset with the dims (move, row, col, next_move); the last next move is "end". With
            several sets of posts, the moves are named as in `Workspace.awareness`, unless the
            simulator does not read sets. `contact` is the mean over robots of the expected contact
            rate if the bound does not fail, or 0 if it failed in all replicates, and NaN if it was
            not measured. `passed` is the probability that the bound does not fail. Both are NaN
            where there is no bound.

    Example:
        >>> simulator = tb.simulation.RadioSimulator(workspace)
        >>> truth = tb.simulation.Truth.from_simulator(simulator)
        >>> truth.lost(truth.best((9, 0), (0, 9)))  # bounds of contact
    """

    def __init__(
        self, workspace: Workspace, bounds: xr.Dataset, of: "Callable[[int], Truth] | None" = None
    ) -> None:
        """Store the bounds; `of(mission)` computes the truth of another mission's world."""
        self.workspace = workspace
        self.bounds = fix(bounds)
        self._of = of

    def _rows(self) -> Rows:
        rows, cols = self.workspace.grid.shape
        worlds = "one" if self._of is None else "one for each mission; see at(mission)"
        return [("bounds", f"of {rows} x {cols} cells"), ("worlds", worlds)]

    @classmethod
    def from_simulator(
        cls,
        simulator: Any,
        *,
        mission: int = 0,
        n_replicates: int = 3,
        seed: int = 0,
        folder: FilePath | None = None,
    ) -> Self:
        """Compute the truth of a simulator from replicates of every bound with each next bound.

        If the simulator has a method `expected_contact`, which returns `bounds` in closed form, no
        replicates are needed. Replicates of a `KinematicSimulator` begin where a preceding bound
        ended in the previous replicate, without detection noise if `acquire` = `drop` = 1. For any
        other simulator, a replicate is a mission over both bounds. The random factor of `Fouling`
        is replaced by its mean. Three sets of posts take about eight times as long as one.

        Args:
            simulator: Simulator with a `workspace`.
            mission: Number of the mission, for simulators whose world changes.
            n_replicates: Number of replicates of every bound.
            seed: Seed of the replicates.
            folder: Folder in which truths are cached; None for no cache. The simulator then needs
                the method `describe` or `describe_world`, because its settings name the file.

        Raises:
            TrustboError: The simulator has no workspace, its contact depends on earlier bounds, or
                a cache is given but the settings of the simulator are unknown.
        """
        workspace = getattr(simulator, "workspace", None)
        if not isinstance(workspace, Workspace):
            raise TrustboError(
                f"truth needs a simulator with a workspace; {type(simulator).__name__} has none."
            )
        if isinstance(simulator, ModelSimulator):
            raise TrustboError(
                "in a ModelSimulator, the contact of a bound depends on all earlier bounds; use "
                "Planner.evaluate(path, params) and Planner.plan(params) instead."
            )

        is_described = hasattr(simulator, "describe_world") or hasattr(simulator, "describe")
        if folder is not None and not is_described:
            raise TrustboError(
                f"truths of {type(simulator).__name__} cannot be cached, because it has no method "
                "describe() that returns its settings; add the method, or leave out folder=."
            )

        n_replicates = require_count("n_replicates", n_replicates)
        seed = require_whole("seed", seed, 0)
        found: dict[str, Self] = {}
        known = _known(workspace)

        def of_mission(number: int) -> Self:
            require_whole("mission", number, 0)
            if hasattr(simulator, "describe_world"):
                settings = simulator.describe_world(number)
            else:
                settings = getattr(simulator, "describe", lambda: type(simulator).__name__)()

            world = to_json([settings, known, n_replicates, seed])
            if world not in found:
                make = partial(replicated, simulator, number, n_replicates, seed)
                with announced("Simulating all bounds for their truth (minutes on large grids)."):
                    found[world] = cls(workspace, _cached(folder, world, make), of_mission)
            return found[world]

        return of_mission(mission)

    def at(self, mission: int) -> "Truth":
        """Return the truth for the world of another mission; missions are counted from 0."""
        return self if self._of is None else self._of(mission)

    def lost(self, path: Sequence[Station]) -> float:
        """Compute the contact lost on a path, in bounds, if no bound fails; NaN without a route.

        Give `Plan.stations` to include the sets of posts. In a path of cells, all are standard.

        Raises:
            TrustboError: A cell is off the grid, impassable, or not a neighbour of the previous
                one.
        """
        contact, _ = self._along(path)
        return float((1.0 - contact).sum())

    def lost_or_failed(self, path: Sequence[Station]) -> float:
        """Compute the expected contact lost, in bounds; failed and unreached bounds lose 1 each.

        The result is sum_k (1 - S_k c_k), where c_k is the contact of bound k and S_k is the
        probability that bounds 1 to k are completed. Raises the same errors as `lost`.
        """
        contact, passed = self._along(path)
        return float((1.0 - np.cumprod(passed) * contact).sum())

    def p_arrive(self, path: Sequence[Station]) -> float:
        """Compute the probability that all bounds of a path are completed.

        Raises the same errors as `lost`.
        """
        _, passed = self._along(path)
        return float(passed.prod())

    def best(
        self,
        start: Location,
        goal: Location,
        max_bounds: int | str = "shortest+4",
        *,
        failures: bool = False,
    ) -> tuple[Station, ...]:
        """Find the path that minimises `lost` or, with `failures`, `lost_or_failed`.

        Cells whose set of posts is not the standard one have its name: (row, col, "far").

        Args:
            start: First cell, or a position in that cell; see `Workspace.locate`.
            goal: Last cell, or a position in that cell.
            max_bounds: Maximum number of bounds, as in `Planner`.
            failures: Whether to minimise `lost_or_failed` instead of `lost`.

        Raises:
            TrustboError: A cell is off the grid or impassable, or `max_bounds` is too small.
            NoPathError: The goal cannot be reached, or the contact of all paths is unknown.
        """
        require_switch("failures", failures)
        paths = AdmissiblePaths(self.workspace, start, goal, max_bounds)
        contact = self.bounds["contact"].values
        passed = self.bounds["passed"].values if failures else np.ones(contact.shape)
        return _most_kept(
            contact, passed, paths.start, paths.goal, paths.longest, u_turns=paths.turns
        )

    def regret(self, path: Sequence[Station], max_bounds: int | str = "shortest+4") -> float:
        """Compute the regret of a path, as a percentage of the contact kept on the best path.

        The regret is the additional contact lost compared with the best path of at most
        `max_bounds` bounds between the same cells. It is negative if a longer path is better.
        """
        path = require_path(self.workspace, path)
        best = self.best(path[0][:2], path[-1][:2], max_bounds)

        least = self.lost(best)
        kept = len(best) - 1 - least
        return 100.0 * (self.lost(path) - least) / kept if kept > 0.0 else np.nan

    def _along(self, path: Sequence[Station]) -> tuple[np.ndarray, np.ndarray]:
        """Return the contact and the completion probability of a path's bounds, each (bound,)."""
        stations = require_path(self.workspace, path)
        n_posts = self.bounds.sizes["move"] // len(MOVES)
        if n_posts == 1:  # contact is the same from all sets, or the workspace has no other
            stations = cells_of(stations)
        where = tuple(pairs_along(stations, n_posts).T)
        return self.bounds["contact"].values[where], self.bounds["passed"].values[where]


def _known(workspace: Workspace) -> list[object]:
    """Return what a truth depends on besides the simulator's settings, to name its file."""
    arrays = [workspace.awareness.values, workspace.passable_bounds.values]
    for maps in (workspace.terrain, workspace.pixels):
        if maps is not None:
            arrays += [maps[name].values for name in ("y", "x", *maps.data_vars)]

    version = VERSIONS["trustbo"]
    return [version, fingerprint(arrays), workspace.grid, workspace.team, workspace.sight]


def _cached(folder: FilePath | None, world: str, make: Callable[[], xr.Dataset]) -> xr.Dataset:
    """Read the table of a world's bounds from the cache, or compute and store the table."""
    if folder is None:
        return make()

    file = to_path(folder) / f"truth-{fingerprint(world)}.nc"
    if not file.exists():
        # In memory, because the netCDF library keeps a file open if the disk is full.
        write_file(file, bytes(make().to_netcdf(engine="netcdf4")))
    return xr.load_dataset(file)


def _most_kept(
    contact: np.ndarray, passed: np.ndarray, start: Cell, goal: Cell, longest: int, *, u_turns: bool
) -> tuple[Station, ...]:
    """Find the path of at most `longest` bounds that loses the least contact.

    The maximum contact kept from a bound onwards is V = max p (c + V'). Here c and p are the
    contact and the completion probability of the bound, and V' is the value V of the next bound. V
    is computed backwards for each number of remaining bounds. Without `u_turns`, no bound reverses
    the previous bound.
    """
    n_ways = len(contact)
    move = np.arange(n_ways) % len(MOVES)
    follows = np.ones((n_ways, n_ways), bool)  # (way, next way)
    if not u_turns:
        follows &= move[:, None] != len(MOVES) - 1 - move  # the reverse of move m is move 7 - m

    possible = np.isfinite(contact[..., :n_ways]) & follows[:, None, None]
    last = (passed * contact)[:, *goal, n_ways]
    value = np.full(contact.shape[:3], -np.inf)  # (way, row, col)
    value[:, *goal] = np.where(np.isfinite(last), last, -np.inf)

    # Backward recursion over the number of remaining bounds (Bellman 1957).
    most = []  # contact kept from the start on, for each number of bounds
    first = []  # first way of these paths
    choices = []  # next way after each bound
    for _ in range(longest):
        onward = by_cell_left(value, -np.inf)
        first.append(int(onward[:, *start].argmax()))
        most.append(onward[first[-1], *start])

        after = np.moveaxis(onward, 0, -1)  # (row, col, next way)
        ends = possible & np.isfinite(after)
        to_come = np.where(np.isfinite(after), after, 0.0)
        kept = passed[..., :n_ways] * (contact[..., :n_ways] + to_come)
        kept = np.where(ends, kept, -np.inf)
        choices.append(kept.argmax(-1))
        value = kept.max(-1)
        value[:, *goal] = -np.inf  # a path ends at the goal

    if not np.isfinite(most).any():
        raise NoPathError(
            f"the truth has no contact for any path from {start} to {goal}: the simulator did not "
            "measure the bounds."
        )

    # Choose the number of bounds that loses least, and follow the choices from the start.
    n = int(np.argmin(np.arange(1, longest + 1) - np.array(most)))
    cells = [start]
    post_sets: list[str] = []
    way = first[n]
    for choice in [*choices[:n][::-1], None]:
        number, move = divmod(way, len(MOVES))
        post_sets.append(POST_SETS[number])
        row, col = cells[-1]
        down, right = MOVES[move]
        cells.append((row + down, col + right))
        if choice is not None:
            way = int(choice[way, *cells[-1]])
    return stations_of(cells, post_sets)
