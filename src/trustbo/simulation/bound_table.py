"""Table of the expected contact of every bound, by the bound that follows it, and best paths on it.

In a simulator whose robots stop and drive at the workspace's posts and routes, the expected contact
of a bound is a function of three cells: left, entered, and next. The best path is then found by
dynamic programming over bounds (cell left, cell entered) with the number of bounds that are left,
which is exact, as the loss of a bound depends on the state and the decision only.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from tqdm import tqdm

from trustbo.data import STATUSES, Cell
from trustbo.planning.paths import AdmissiblePaths
from trustbo.simulation.replicates import END, Edge, KinematicReplicates, PlainReplicates, edges_of
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVE_NAMES, MOVES, move_indices, moves_along

_DIMS = ("move", "row", "col", "next_move")
_LEAST = 3
"""Replicates of every bound."""
_FAILURE_ERROR = 0.1
"""Standard error of the share of failures above which a bound that has failed is repeated."""


@dataclass(frozen=True, eq=False)
class BoundTable:
    """Expected contact and failures of every bound.

    Attributes:
        data: Dataset with dims robot, status, move, row, col and next_move (the eight moves, and
            "end"): `contact` (robot, move, row, col, next_move), the expected rate given that the
            bound does not fail, 0 where it always did; `outcome` (status, move, row, col,
            next_move), shares; `standard_error` of the mean contact over robots (move, row, col,
            next_move) and the number of replicates, `n` (move, row, col). NaN where there is no
            such bound.
    """

    data: xr.Dataset

    def contact(self, path: Sequence[Cell]) -> np.ndarray:
        """Expected contact rates of the bounds of a path, shape (bound, robot)."""
        return self.data["contact"].values[:, *_along(path)].T

    def failure(self, path: Sequence[Cell]) -> np.ndarray:
        """Chance to fail of the bounds of a path, shape (bound,)."""
        return 1.0 - self.data["outcome"].sel(status="ok").values[_along(path)]

    @property
    def standard_error(self) -> float:
        """Standard error of the contact of a bound: root mean square over all."""
        return _root_mean_square(self.data["standard_error"].values)

    def best(self, paths: AdmissiblePaths, objective: str) -> tuple[Cell, ...]:
        """Best admissible path: least contact lost, or for "mean" the largest mean contact."""
        loss = 1.0 - self.data["contact"].values.mean(0)
        loss = np.where(np.isfinite(loss), loss, np.inf)
        moves = move_indices(paths.connectivity)
        allowed = np.zeros((END, END), bool)  # (move, next move)
        allowed[np.ix_(moves, moves)] = True
        if not paths.u_turns:
            allowed &= ~np.eye(END, dtype=bool)[::-1]  # the reverse is the m-th from last
        # Loss of the bound that enters each cell by each move and of n bounds after it.
        rest = np.full(loss.shape[:3], np.inf)
        rest[moves, *paths.goal] = loss[moves, *paths.goal, END]
        least, first, choices = [], [], [np.zeros(rest.shape, int)]
        for _ in range(paths.longest):
            onward = np.stack([_ahead(rest[m], m) for m in range(END)])  # by the cell that is left
            first.append(int(onward[:, *paths.start].argmin()))
            least.append(onward[first[-1], *paths.start])
            total = loss[..., :END] + np.moveaxis(onward, 0, -1)  # (move, row, col, next move)
            total = np.where(allowed[:, None, None], total, np.inf)
            total[:, *paths.goal] = np.inf  # a path ends on entering the goal
            choices.append(total.argmin(-1))
            rest = total.min(-1)
        bounds = np.arange(1, paths.longest + 1) if objective == "mean" else 1.0
        n = int(np.argmin(np.array(least) / bounds))
        path, move = [paths.start], first[n]
        while True:
            path.append((path[-1][0] + MOVES[8][move][0], path[-1][1] + MOVES[8][move][1]))
            if n == 0:
                return tuple(path)
            move = int(choices[n][move, *path[-1]])
            n -= 1


def tabulate(
    workspace: Workspace,
    replicates: KinematicReplicates | PlainReplicates,
    *,
    standard_error: float,
    progress: bool = False,
) -> BoundTable:
    """Replicate bounds until the standard error of their contact, mean over robots, is small.

    The root mean square over all bounds meets the target, and no bound exceeds twice the target.
    The variance of a bound is estimated from its replicates, shrunk to the mean over all.
    """
    edges, tally = edges_of(workspace), _Tally(workspace)
    todo, number = edges, 0
    silent = not progress or not sys.stderr.isatty()  # carriage returns are for a terminal
    with tqdm(desc="truth", unit=" bounds", disable=silent) as bar:
        while todo:
            number += 1
            for edge, outcomes in zip(todo, replicates.run(todo, number), strict=True):
                tally.add(edge, outcomes)
                bar.update()
            if number >= replicates.most:
                break
            if number >= _LEAST:
                open_ = tally.is_open(standard_error)
                todo = [edge for edge in edges if open_[edge.move, *edge.cell]]
    return tally.table()


class _Tally:
    """Sums over replicates of bounds, arrays (..., move, row, col, next_move)."""

    def __init__(self, workspace: Workspace) -> None:
        shape = (END, *workspace.passable.shape, END + 1)
        self._workspace = workspace
        n_robots = workspace.awareness.sizes["robot"]
        self._sum, self._squares = np.zeros((n_robots, *shape)), np.zeros(shape)
        self._status = np.zeros((len(STATUSES), *shape))

    def add(self, edge: Edge, outcomes: Sequence[tuple[np.ndarray, str]]) -> None:
        """Add a replicate of a bound, followed by each that can."""
        for n, (rate, status) in zip(edge.next_moves, outcomes, strict=True):
            where = edge.move, *edge.cell, n
            self._status[STATUSES.index(status), *where] += 1.0
            if status == "ok":
                self._sum[:, *where] += rate
                self._squares[where] += np.mean(rate) ** 2

    def is_open(self, standard_error: float) -> np.ndarray:
        """Whether a bound needs more replicates, (move, row, col)."""
        n, n_ok = self._status.sum(0), self._status[STATUSES.index("ok")]
        share = (n - n_ok + 1.0) / (n + 2.0)
        unsure = (n > n_ok) & (np.sqrt(share * (1.0 - share) / np.maximum(n, 1)) > _FAILURE_ERROR)
        error = self._standard_error()
        enough = not _root_mean_square(error) > standard_error
        return (unsure | (error > (2.0 if enough else 1.0) * standard_error)).any(-1)

    def _standard_error(self) -> np.ndarray:
        n = self._status[STATUSES.index("ok")]
        with np.errstate(invalid="ignore", divide="ignore"):
            squares = np.maximum(0.0, self._squares - n * (self._sum.mean(0) / n) ** 2)
            counted = n >= 2
            pooled = squares[counted].sum() / max(1.0, (n[counted] - 1.0).sum())
            variance = (np.where(counted, squares, 0.0) + _LEAST * pooled) / (_LEAST + n - 1.0)
            return np.where(n > 0, np.sqrt(variance / n), np.nan)

    def table(self) -> BoundTable:
        """Means over replicates."""
        n, n_ok = self._status.sum(0), self._status[STATUSES.index("ok")]
        with np.errstate(invalid="ignore", divide="ignore"):
            outcome = self._status / n
            contact = np.where(n_ok > 0, self._sum / n_ok, np.where(n > 0, 0.0, np.nan))
        table = table_of(self._workspace, contact, outcome, self._standard_error())
        return BoundTable(table.data.assign(n=(_DIMS[:3], n.max(-1))))


def table_of(
    workspace: Workspace, contact: np.ndarray, outcome: np.ndarray, standard_error: np.ndarray
) -> BoundTable:
    """Table of arrays, see `BoundTable.data`; `outcome` may have the first of the statuses only."""
    variables = {
        "contact": (("robot", *_DIMS), contact),
        "outcome": (("status", *_DIMS), outcome),
        "standard_error": (_DIMS, standard_error),
    }
    coords = {
        "robot": list(workspace.team.names),
        "status": list(STATUSES[: len(outcome)]),
        "move": list(MOVE_NAMES),
        "next_move": [*MOVE_NAMES, "end"],
    }
    return BoundTable(xr.Dataset(variables, coords))


def _root_mean_square(values: np.ndarray) -> float:
    """Root mean square of finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else np.nan


def _along(path: Sequence[Cell]) -> tuple[np.ndarray, ...]:
    """Indices (move, row, col, next move) of the bounds of a path."""
    rows, cols = np.asarray(path)[1:].T
    moves = moves_along(path)
    return moves, rows, cols, np.append(moves[1:], END)


def _ahead(values: np.ndarray, move: int) -> np.ndarray:
    """Value at the cell that a move enters, by the cell that it leaves, (row, col); else inf."""
    (down, right), (rows, cols) = MOVES[8][move], values.shape
    framed = np.pad(values, 1, constant_values=np.inf)
    return framed[1 + down :, 1 + right :][:rows, :cols]
