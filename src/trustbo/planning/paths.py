"""Admissible paths from a start to a goal."""

import re
from collections.abc import Sequence
from functools import cached_property

import networkx as nx
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from trustbo.data import POST_SETS, Cell, Station, path_text, require_path
from trustbo.errors import TrustboError, one_line, require_kind, require_whole
from trustbo.fixed import Uncached
from trustbo.planning.unrolled import Committed, Unrolled, committed
from trustbo.workspace import Workspace
from trustbo.workspace.closed import closed_along, closed_text
from trustbo.workspace.grid import Location
from trustbo.workspace.moves import (
    MOVES,
    cells_along,
    moves_along,
    possible_next,
    require_on_grid,
)

SIMPLE_EXTRA = 2
"""Largest number of bounds beyond the fewest for which all paths without U-turns are simple.

A simple path contains no cell twice.
"""
STEPS = np.array(MOVES)
"""Row and column step of each move, shape (move, 2)."""
_MOST_STATES = 20_000_000
"""Maximum number of states of the graph to be searched.

A graph of this size needs about 6 GB, or 17 GB with a risk, where each state also knows the
bound that led to it.
"""
_MOST_EXTRA = 10_000
"""Maximum number of bounds beyond the fewest; longer walks would only go round in circles."""
_SHORTEST = re.compile(r"shortest(?:\+(\d+))?")


class NoPathError(TrustboError, nx.NetworkXNoPath):
    """The goal cannot be reached from the start.

    Example:
        >>> passable = np.array([[True, False, True]])
        >>> split = tb.Workspace.from_awareness(np.full((3, 1, 3, 2), 0.5), passable)
        >>> try:
        ...     tb.Planner(split, (0, 0), (0, 2))
        ... except tb.NoPathError as error:
        ...     print(error)
    """


class AdmissiblePaths(Uncached):
    """Admissible paths from a start to a goal.

    A path ends when it enters the goal, and has at least `shortest` and at most `longest` bounds.

    Attributes:
        workspace: Workspace of the paths.
        start: First cell.
        goal: Last cell.
        max_bounds: Limit on the number of bounds (see `Planner`).
        turns: Whether U-turns are allowed; True if `max_bounds` is a number.
        avoided: Mask (move, row, col) of the bounds that paths must avoid, or None.
        blocked: Mask of the bounds that cannot be driven, or None; `avoiding` never allows these
            bounds.
        bounds: Mask (move, row, col) of bounds that a path may take, indexed by the cell entered.
        bounds_to_goal: Fewest bounds from each cell to the goal, (row, col); -1 if unreachable.
        shortest: Smallest number of bounds of a path.
        longest: Largest number of bounds of a path.
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location,
        goal: Location,
        max_bounds: int | str = "shortest+2",
        avoided: np.ndarray | None = None,
        blocked: np.ndarray | None = None,
    ) -> None:
        """Check the arguments and find the shortest path; see `Planner` for the errors."""
        self.workspace = require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        self.start = workspace.locate(start, "start")
        self.goal = workspace.locate(goal, "goal")
        if self.start == self.goal:
            raise TrustboError(f"start and goal are both the cell {self.start}; choose two cells.")

        self.avoided = avoided
        self.blocked = blocked
        self.bounds = workspace.open_bounds
        for closed in (avoided, blocked):
            if closed is not None:
                self.bounds = self.bounds & ~closed

        self.bounds_to_goal = fewest_bounds(self.bounds, self.goal, back=True)
        self.shortest = int(self.bounds_to_goal[self.start])
        if self.shortest < 0:
            n_cells = int(workspace.passable.sum())
            n_reached = int((self.bounds_from_start >= 0).sum())
            n_goal = int((self.bounds_to_goal >= 0).sum())
            raise NoPathError(
                f"no path leads from {self.start} to {self.goal}. Of {n_cells} passable cells, "
                f"{n_reached} can be reached from the start, and the goal can be reached from "
                f"{n_goal}. {self._remedy()}"
            )

        self.turns = not isinstance(max_bounds, str)
        self.max_bounds = max_bounds
        if not isinstance(max_bounds, str):
            self.max_bounds = require_whole("max_bounds", max_bounds, 1)
            self.longest = self.max_bounds
        elif named := _SHORTEST.fullmatch(max_bounds):
            self.longest = self.shortest + int(named[1] or 0)
        else:
            raise TrustboError(
                f"unknown max_bounds {max_bounds!r}; give 'shortest', an int, or 'shortest+n', "
                "such as 'shortest+2', to allow up to n more bounds without U-turns."
            )

        if self.longest - self.shortest > _MOST_EXTRA:
            raise TrustboError(
                f"max_bounds = {one_line(max_bounds)} is too large: at most {_MOST_EXTRA} bounds "
                f"more than the shortest path, of {self.shortest} bounds, are allowed."
            )
        if self.longest < self.shortest:
            raise TrustboError(
                f"max_bounds = {self.longest} is too small: a path from {self.start} to "
                f"{self.goal} needs at least {self.shortest} bounds."
            )

    def _remedy(self) -> str:
        """Return a sentence with advice if no path leads to the goal."""
        if self.blocked is not None:
            return f"{int(self.blocked.sum())} bounds are blocked."

        drivable = self.workspace.passable_bounds.values
        if self.workspace.closed and fewest_bounds(drivable, self.goal, back=True)[self.start] > 0:
            closed = closed_text(self.workspace.closed, self.workspace.name_of)
            return f"All ways are closed: {closed}. Reopen one of them, or choose another goal."

        posts = self.workspace.posts
        terrain = self.workspace.terrain
        if posts is not None and terrain is not None:
            missing = float(terrain["dem"].isnull().mean())
            if missing and posts.are_parted_by_missing(self.start, self.goal):
                return (
                    f"They are parted by pixels with missing heights ({missing:.2%} of the "
                    "terrain), which robots do not cross; fill them, e.g. with gdal_fillnodata.py."
                )
        return "Choose another start or goal, or a team with a larger max_slope."

    @cached_property
    def bounds_from_start(self) -> np.ndarray:
        """Fewest bounds from the start to each cell, shape (row, col); -1 if there is no path."""
        return fewest_bounds(self.bounds, self.start)

    @cached_property
    def graph(self) -> Unrolled:
        """Unrolled graph of the paths; a graph that is too large raises TrustboError."""
        n_moves, rows, cols = self.bounds.shape
        bounds = self.bounds.reshape(n_moves, -1)
        far = self.bounds_to_goal.ravel()
        near = self.bounds_from_start.ravel()

        # Count the possible numbers of bounds left in each cell: `far` or more, except for 0 at the
        # goal.
        n_left = np.maximum(np.where(far == 0, 1, self.longest - near - far + 1), 0)
        n_left[(far < 0) | (near < 0)] = 0
        n_states = int(n_left.sum())
        self._require_size(n_states)

        # List the states by cell, where the states of a cell begin at `base`, then sort by
        # `n_bounds_left`.
        cell = np.repeat(np.arange(rows * cols, dtype=np.int32), n_left)
        base = np.concatenate([[0], np.cumsum(n_left)])
        n_bounds_left = (np.arange(n_states) - base[cell] + far[cell]).astype(np.int32)
        order = np.argsort(n_bounds_left, kind="stable")
        rank = np.empty(n_states, np.int32)
        rank[order] = np.arange(n_states)
        cell = cell[order]
        n_bounds_left = n_bounds_left[order]

        # Find the state to which each move leads from each state; -1 if there is no such state.
        head = np.full((n_states, n_moves), -1, np.int32)
        for m, step in enumerate(STEPS @ (cols, 1)):  # no bound crosses the border of the grid
            is_inside = (cell + step >= 0) & (cell + step < rows * cols)
            tail = np.flatnonzero(is_inside & (n_bounds_left > 0))
            other = cell[tail] + step
            more = n_bounds_left[tail] - 1 - far[other]  # bounds left, minus the fewest
            fits = bounds[m, other] & (more >= 0) & (more < n_left[other])
            head[tail[fits], m] = rank[base[other[fits]] + more[fits]]

        # Keep the edges that exist, sorted by the states that they leave; one for each set of
        # posts.
        n_posts = self.workspace.n_posts
        tail, move = (np.repeat(index, n_posts) for index in np.nonzero(head >= 0))
        head = head[tail, move]
        first = np.searchsorted(tail, np.arange(n_states + 1))

        posts = np.arange(len(tail)) % n_posts
        bound = ((posts * n_moves + move) * rows * cols + cell[head]).astype(np.int32)
        station = (posts * rows * cols + cell[tail]).astype(np.int32)

        start = np.flatnonzero(near == 0)[0]
        starts = rank[base[start] : base[start + 1]]
        return Unrolled(cell, n_bounds_left, first, head, bound, station, starts, self.turns)

    @cached_property
    def committed(self) -> Committed:
        """Unrolled graph whose edges know the next way, for risks and posts; see `graph`."""
        graph = self.graph
        self._require_size(len(graph.head))  # every edge becomes a state
        n_cells = self.bounds[0].size
        n_ways = len(self.bounds) * self.workspace.n_posts
        if self.workspace.n_posts == 1:
            return committed(graph, n_cells, n_ways, None)

        number = np.full((n_ways, n_cells, n_ways + 1), -1, np.int32)
        way, row, col, after = self.pairs.T
        number[way, row * self.bounds.shape[2] + col, after] = np.arange(len(way))
        return committed(graph, n_cells, n_ways, number)

    @cached_property
    def pairs(self) -> np.ndarray:
        """Way, row and column of each bound, with each next way, shape (pair, 4).

        The next way is the number of ways at the end of a path.
        """
        return np.argwhere(possible_next(self.bounds, self.workspace.n_posts))

    @cached_property
    def awareness_of_pairs(self) -> np.ndarray:
        """Awareness of `pairs`, shape (robot, pair, feature)."""
        return np.ascontiguousarray(self.workspace.of_pairs(self.pairs))

    def _require_size(self, n_states: int) -> None:
        """Raise TrustboError if a graph with this number of states is too large."""
        if n_states > _MOST_STATES:
            raise TrustboError(
                f"max_bounds = {self.max_bounds!r} (up to {self.longest} bounds) is too large: the "
                f"search has {n_states:.3g} states, but at most {_MOST_STATES:.3g} are allowed. "
                "Give a smaller max_bounds."
            )

    def avoiding(self, bounds: np.ndarray, risk: np.ndarray) -> "AdmissiblePaths":
        """Return the paths that avoid the given bounds.

        If no such path exists, bounds are allowed again, safest first, until a path exists.

        Args:
            bounds: Mask of the bounds to avoid, shape (move, row, col).
            risk: Failure probability of each bound, shape (move, row, col).
        """
        avoided = bounds & self.workspace.open_bounds
        if self.avoided is not None:
            avoided |= self.avoided

        safest_first = np.argwhere(avoided)[np.argsort(risk[avoided], kind="stable")]
        for allowed in (None, *safest_first.tolist()):
            if allowed is not None:
                avoided[*allowed] = False
            try:
                return AdmissiblePaths(
                    self.workspace,
                    self.start,
                    self.goal,
                    self.max_bounds,
                    avoided.copy(),
                    self.blocked,
                )
            except TrustboError:  # the goal cannot be reached within max_bounds
                continue

        return self

    def to(self, cell: Cell, extra: int) -> "AdmissiblePaths":
        """Return the paths from the start to another cell, with up to `extra` additional bounds."""
        admitted = f"shortest+{extra}"
        return AdmissiblePaths(
            self.workspace, self.start, cell, admitted, self.avoided, self.blocked
        )

    def cells(self, flat: np.ndarray) -> tuple[Station, ...]:
        """Convert flat indices of `Unrolled.station` to a path; negative indices are padding."""
        posts, rows, cols = np.unravel_index(
            flat[flat >= 0], (self.workspace.n_posts, *self.bounds.shape[1:])
        )
        stations = zip(rows.tolist(), cols.tolist(), posts.tolist(), strict=True)
        return require_path("path", [(row, col, POST_SETS[k]) for row, col, k in stations])

    def require_path(self, path: Sequence[Station]) -> tuple[Station, ...]:
        """Check that a path leads from start to goal and return it as a tuple of cells.

        Raises:
            TrustboError: If the robots cannot drive a bound, or the path does not lead from start
                to goal.
        """
        cells = require_on_grid(path, self.bounds.shape[1:])
        if len(cells) < 2 or (cells[0][:2], cells[-1][:2]) != (self.start, self.goal):
            raise TrustboError(
                f"a path must lead from {self.start} to {self.goal}; got {one_line(list(cells))}."
            )

        closed = closed_along(self.workspace.closed, cells)
        if closed:
            raise TrustboError(
                f"the path {path_text(cells)} takes what is closed: "
                f"{closed_text(closed, self.workspace.name_of)}. Give another path, or reopen it."
            )

        drivable = self.workspace.passable_bounds.values
        if self.blocked is not None:
            drivable = drivable & ~self.blocked

        self.workspace.along(cells, anywhere=True)  # refuses sets of posts that are not offered
        entered = cells_along(cells)[1:].T
        broken = ~drivable[moves_along(cells), *entered]
        if broken.any():
            k = int(np.argmax(broken))
            raise TrustboError(
                f"no bound leads from {cells[k][:2]} to {cells[k + 1][:2]}: a cell is impassable, "
                "no route connects the cells, or the bound is blocked. Give another path."
            )

        return cells


def fewest_bounds(bounds: np.ndarray, cell: Cell, *, back: bool = False) -> np.ndarray:
    """Count the fewest bounds from one cell to each cell, (row, col); -1 if there is no path.

    Args:
        bounds: Mask of the bounds that may be taken, shape (move, row, col).
        cell: Cell at which all paths start.
        back: If True, count the bounds from each cell to `cell` instead.
    """
    rows, cols = bounds.shape[1:]
    move, entered = np.nonzero(bounds.reshape(len(bounds), -1))
    origin = entered - (STEPS @ (cols, 1))[move]
    ends = (entered, origin) if back else (origin, entered)
    graph = csr_array((np.ones(len(move)), ends), shape=(rows * cols, rows * cols))

    fewest = dijkstra(graph, indices=cell[0] * cols + cell[1], unweighted=True)
    return np.where(np.isfinite(fewest), fewest, -1).astype(np.int32).reshape(rows, cols)
