"""Admissible paths from one start to one goal."""

import itertools
import operator
import re
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import networkx as nx
import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_cells, require_kind, require_whole
from trustbo.parallel import plain
from trustbo.planning.graph import NoPathError, cell_graph, fewest_bounds, move_lengths
from trustbo.planning.search.graph import Graph, grid_graph
from trustbo.planning.search.layers import build_layers
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location
from trustbo.workspace.moves import (
    MOVES,
    existing_bounds,
    move_indices,
    moves_along,
    require_connectivity,
    require_on_grid,
)

DEFAULT_EXTRA = 8
"""Bounds beyond the fewest possible that `success` and `bottleneck` may take by default."""

SIMPLE_EXTRA = 2
"""Bounds beyond the fewest possible up to which a path without U-turns enters no cell twice."""
_SHORTEST = re.compile(r"shortest(?:\+(\d+))?")
_MOST_STATES = 20_000_000
"""Most nodes of the layered DAG, whose tables take some 3 GB."""


class PathClass(NamedTuple):
    """Paths that are admissible between two cells; the fields are explained at `Planner`."""

    connectivity: int = 8
    max_bounds: int | str | None = None
    """None: shortest + `DEFAULT_EXTRA`."""

    def longest(self, shortest: int) -> int:
        """Largest number of bounds where the fewest are `shortest`.

        TrustboError: an unknown name, or no whole number.
        """
        if self.max_bounds is None:
            return shortest + DEFAULT_EXTRA
        if isinstance(self.max_bounds, str):
            if (named := _SHORTEST.fullmatch(self.max_bounds)) is None:
                raise TrustboError(
                    f"unknown max_bounds {self.max_bounds!r}; choose shortest, shortest+n for n "
                    "bounds more without U-turns, such as shortest+2, or a number of bounds."
                )
            return shortest + int(named[1] or 0)
        return int(require_whole("max_bounds", self.max_bounds, 1))


class AdmissiblePaths:
    """Start, goal and the admissible paths between them, with the tables that engines need.

    A path ends on entering the goal, and has `shortest` to `longest` bounds; `connectivity` and
    `max_bounds` are those of its `path_class`. With `u_turns`, where `max_bounds` is a number, a
    bound may lead back to the cell that the last one left. `steps` are the moves to
    neighbouring cells, shape (move, 2), `lengths` theirs in metres, shape (move,), and `bounds`
    those that a path may take, (move, row, col): the workspace's, less the `avoided`.
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location,
        goal: Location,
        path_class: PathClass,
        avoided: np.ndarray | None = None,
    ) -> None:
        """Prepare the tables; see `Planner`, and `avoiding` for bounds (8 moves, row, col)."""
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        self.workspace, connectivity = workspace, require_connectivity(path_class.connectivity)
        self.connectivity = connectivity
        self.start = workspace.require_cell("start", start)
        self.goal = workspace.require_cell("goal", goal)
        if self.start == self.goal:
            raise TrustboError(f"start and goal are the same cell {self.start}; choose two.")
        self.passable = workspace.passable.values
        self.steps = np.array(MOVES[connectivity])
        self.lengths = move_lengths(workspace, connectivity)
        open_, self.avoided = workspace.passable_bounds.values, avoided
        open_ = open_ if avoided is None else open_ & ~avoided
        self.bounds = open_[move_indices(connectivity)]
        self.bounds_to_goal = fewest_bounds(self.bounds, self.goal, connectivity, back=True)
        self._require_way()
        self.shortest = int(self.bounds_to_goal[self.start])
        self.longest = path_class.longest(self.shortest)
        if self.longest < self.shortest:
            raise TrustboError(
                f"max_bounds = {self.longest} is below the fewest possible from {self.start} to "
                f"{self.goal}, which is {self.shortest}."
            )
        self.u_turns = not isinstance(path_class.max_bounds, str)
        if self.u_turns:
            path_class = path_class._replace(max_bounds=self.longest)
        self.path_class = path_class
        self.max_bounds = path_class.max_bounds

    def _require_way(self) -> None:
        """Refuse ends that are not connected: NoPathError, which counts the cells in reach."""
        if self.bounds_to_goal[self.start] < 0:
            n_reached = int((self.bounds_from_start >= 0).sum())
            n_goal = int((self.bounds_to_goal >= 0).sum())
            raise NoPathError(
                f"no path from {self.start} to {self.goal}: {n_reached} of "
                f"{int(self.passable.sum())} passable cells can be reached from the start, and the "
                f"goal from {n_goal}. Choose ends in one part, or a team with a larger max_slope."
            )

    @cached_property
    def graph(self) -> nx.DiGraph:
        """Graph of passable cells (see `cell_graph`)."""
        return cell_graph(self.workspace, self.connectivity, self.bounds)

    @cached_property
    def to_goal(self) -> dict[Cell, int]:
        """Fewest bounds to the goal by cell, for cells that can reach it."""
        fewest = self.bounds_to_goal
        return {(r, c): int(fewest[r, c]) for r, c in np.argwhere(fewest >= 0).tolist()}

    @cached_property
    def bounds_from_start(self) -> np.ndarray:
        """Fewest bounds from the start, shape (row, col); -1 where there is no way."""
        return fewest_bounds(self.bounds, self.start, self.connectivity)

    @cached_property
    def n_states(self) -> int:
        """Number of nodes of the layered DAG."""
        near, far = self.bounds_from_start, self.bounds_to_goal
        reached = (near >= 0) & (far >= 0)
        return int(np.maximum(self.longest - near[reached] - far[reached] + 1, 0).sum())

    @property
    def can_unroll(self) -> bool:
        """Whether the layered DAG is small enough to be held."""
        return self.n_states <= _MOST_STATES

    @cached_property
    def layers(self) -> Graph:
        """Layered DAG: the grid unrolled over the bounds that are left.

        TrustboError: it is too large to be held.
        """
        if not self.can_unroll:
            raise TrustboError(
                f"max_bounds = {self.max_bounds!r} admits paths of up to {self.longest} bounds, "
                f"whose search has {self.n_states:.3g} states, more than {_MOST_STATES:.3g}; give "
                "less."
            )
        ends = plain(self.bounds_to_goal), plain(self.bounds_from_start)
        layers = build_layers(*ends, self.steps, self.longest, self.u_turns)
        if self.all_alike:
            return layers
        kept = self.bounds.ravel()[layers.bound]
        return layers._replace(
            first=np.concatenate([[0], np.cumsum(kept)])[layers.first],
            head=layers.head[kept],
            move=layers.move[kept],
            bound=layers.bound[kept],
        )

    @cached_property
    def grid(self) -> Graph:
        """Graph of the cells from which the goal can be reached, for costs without a history."""
        return grid_graph(self.neighbours, self.bounds_to_goal.ravel(), self.flat(self.start))

    @cached_property
    def all_alike(self) -> bool:
        """Whether a path may take every bound between passable cells."""
        exists = existing_bounds(self.passable)[move_indices(self.connectivity)]
        return bool((self.bounds == exists).all())

    @cached_property
    def unseen(self) -> np.ndarray:
        """`Workspace.unseen_bounds` of the moves, (move, row, col); 0 for bounds that are none.

        TrustboError: the workspace has no line of sight.
        """
        if (shares := self.workspace.unseen_bounds) is None:
            raise TrustboError(
                "unseen_cost needs the line of sight of a map, and the workspace has no terrain in "
                "memory, or no assumed sight; make it by Workspace.from_terrain, or leave "
                "unseen_cost = 0."
            )
        return np.nan_to_num(shares.values[move_indices(self.connectivity)])

    def length_of(self, path: Sequence[Cell] | np.ndarray) -> float:
        """Length of a path from cell centre to cell centre, m."""
        grid = self.workspace.grid
        steps = np.diff(np.asarray(path), axis=0) * (grid.cell_height, grid.cell_width)
        return float(np.hypot(*steps.T).sum())

    def masked(self, values: np.ndarray) -> np.ndarray:
        """Values of bounds (..., move, row, col), NaN for those that no path may take.

        They are unchanged, and may be of one move, where a path may take every bound.
        """
        return values if self.all_alike else np.where(self.bounds, values, np.nan)

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Cells that can be entered from each, flat indices, shape (cell, move); -1 where none."""
        rows, cols = self.passable.shape
        row, col = np.divmod(np.arange(rows * cols)[:, None], cols)
        i, j = row + self.steps[:, 0], col + self.steps[:, 1]
        inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
        other = np.where(inside, i * cols + j, 0)
        open_ = self.bounds.reshape(len(self.steps), -1)[np.arange(len(self.steps)), other]
        return np.where(inside & open_, other, -1)

    def avoiding(self, bounds: np.ndarray, risk: np.ndarray) -> "AdmissiblePaths":
        """Restrict to paths that take none of some bounds.

        Where there is none, the bounds of least risk are admitted again one by one until there is.

        Args:
            bounds: Bounds to avoid, (move, row, col) of the eight `MOVES`.
            risk: Chance to fail of each bound, (move, row, col).
        """
        avoided = bounds & self.workspace.passable_bounds.values
        if self.avoided is not None:
            avoided |= self.avoided
        order = np.argwhere(avoided)
        order = order[np.argsort(risk[avoided], kind="stable")]
        for least in (None, *order.tolist()):
            if least is not None:
                avoided[*least] = False
            try:
                ends = self.workspace, self.start, self.goal
                return AdmissiblePaths(*ends, self.path_class, avoided.copy())
            except TrustboError:  # the goal is out of reach, or of the bounds that are allowed
                continue
        return self

    def to(self, cell: Cell, extra: int) -> "AdmissiblePaths":
        """Return the paths to another cell, of so many bounds more than the fewest."""
        admitted = PathClass(self.connectivity, f"shortest+{extra}")
        return AdmissiblePaths(self.workspace, self.start, cell, admitted, self.avoided)

    def onward(self, done: Sequence[Cell]) -> "AdmissiblePaths":
        """Restrict to the rest of a mission that entered the cells `done` so far, start first.

        Extra bounds that were not used are left, and U-turns stay forbidden; but the first bound of
        the rest may lead anywhere.

        TrustboError: there are none, they jump, or begin at another cell. NoPathError: too few
        bounds are left to reach the goal.
        """
        done = require_on_grid(done, self.passable.shape)
        if not done:
            raise TrustboError(f"give the cells so far, the start first: [{self.start}, ...].")
        moves_along(done)
        here = self.workspace.require_cell("done[-1]", done[-1])
        if done[0] != self.start:
            raise TrustboError(f"the mission began at {done[0]}; the paths at {self.start}.")
        left = self.longest - (len(done) - 1)
        fewest = int(self.bounds_to_goal[here])
        if here != self.goal and not 0 < fewest <= left:
            raise NoPathError(
                f"from {here} to {self.goal} it takes {fewest} bounds, but {left} are left."
            )
        max_bounds = left if self.u_turns else f"shortest+{left - fewest}"
        admitted = self.path_class._replace(max_bounds=max_bounds)
        return AdmissiblePaths(self.workspace, here, self.goal, admitted, self.avoided)

    def flat(self, cell: Cell) -> int:
        """Index of a cell in row-major order."""
        return cell[0] * self.passable.shape[1] + cell[1]

    def cells(self, flat: np.ndarray) -> tuple[Cell, ...]:
        """Cells of flat indices, up to the first that is negative."""
        rows, cols = np.divmod(flat[flat >= 0], self.passable.shape[1])
        return tuple(zip(rows.tolist(), cols.tolist(), strict=True))

    def require_path(self, path: Sequence[Cell]) -> tuple[Cell, ...]:
        """Return a path as a tuple of cells if every bound is possible.

        TrustboError: it is broken, or does not lead from start to goal.
        """
        try:
            flat = list(map(operator.index, itertools.chain.from_iterable(path)))
            where = np.array(flat).reshape(len(path), 2)
            cells = tuple(zip(flat[::2], flat[1::2], strict=True))
        except (TypeError, ValueError):  # find the faulty cell
            cells = require_cells("path", path)
            where = np.array(cells)
        if len(cells) < 2 or cells[0] != self.start or cells[-1] != self.goal:
            raise TrustboError(
                f"a path must lead from {self.start} to {self.goal}; got {_shortened(cells)}."
            )
        step = np.diff(where, axis=0)
        inside = ((where[1:] >= 0) & (where[1:] < self.passable.shape)).all(1)
        far = np.abs(step).sum(1) if self.connectivity == 4 else np.abs(step).max(1)
        there = np.where(inside[:, None], where[1:], 0)
        broken = (far != 1) | ~inside | ~self.passable[*there.T]
        if not broken.any():
            broken = ~self.workspace.passable_bounds.values[moves_along(where), *there.T]
        if broken.any():
            k = int(np.argmax(broken))
            raise TrustboError(
                f"the path is broken: no bound leads from {cells[k]} to {cells[k + 1]}."
            )
        return cells


def _shortened(cells: tuple[Cell, ...]) -> str:
    return str(cells) if len(cells) <= 10 else f"{len(cells)} cells from {cells[0]} to {cells[-1]}"
