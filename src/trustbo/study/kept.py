"""Contact and failures in one unit: a bound that fails, or is not reached, keeps no contact."""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Cell
from trustbo.planning.paths import AdmissiblePaths
from trustbo.simulation import Truth
from trustbo.simulation.bound_table import BoundTable
from trustbo.simulation.replicates import END
from trustbo.workspace.moves import MOVES, move_indices


def expected_loss(truth: Truth, path: Sequence[Cell]) -> float:
    """Bounds of a path that are expected to keep no contact: sum_k (1 - S_k c_k).

    c_k is the true contact of bound k, mean over robots, and S_k the chance to complete it and all
    bounds before. Where nothing fails, it is the contact lost, `Truth.value(path).lost`.
    """
    bounds = truth.bounds
    reached = np.cumprod(1.0 - bounds.failure(path))
    return float((1.0 - reached * bounds.contact(path).mean(1)).sum())


def least_loss(truth: Truth, paths: AdmissiblePaths) -> float:
    """Smallest `expected_loss` of an admissible path.

    In closed form, where contact depends on the whole path, that of the path that loses least
    contact, which is the same where nothing fails.
    """
    if not isinstance(truth.bounds, BoundTable):
        return expected_loss(truth, truth.bounds.best(paths, "lost_contact"))
    data = truth.bounds.data
    passed = data["outcome"].sel(status="ok").values
    most = most_kept(data["contact"].values.mean(0), passed, paths)
    return float((np.arange(1, len(most) + 1) - most).min())


def most_kept(contact: np.ndarray, passed: np.ndarray, paths: AdmissiblePaths) -> np.ndarray:
    """Most contact that a path of 1, 2, ... bounds keeps, sum_k S_k c_k, shape (bound,).

    The value of what is left of a path, V, is found backward over the bound that is driven and the
    number of bounds after it: V = max (1 - f) (c + V'). It is exact, as 1 - f is not negative.

    Args:
        contact: Contact of each bound by the one that follows, (move, row, col, next_move), as in
            `BoundTable.data`; NaN where there is no such bound.
        passed: Chance to complete it, 1 - f, of the same shape.
        paths: Admissible paths.

    Returns:
        -inf for numbers of bounds that no admissible path has.
    """
    moves = move_indices(paths.connectivity)
    follows = np.zeros((END, END), bool)  # (move, next move)
    follows[np.ix_(moves, moves)] = True
    if not paths.u_turns:
        follows &= ~np.eye(END, dtype=bool)[::-1]
    possible = np.isfinite(contact[..., :END]) & follows[:, None, None]
    last = (passed * contact)[moves, *paths.goal, END]
    # Kept on the bound that enters each cell by each move and on n bounds after it.
    value = np.full(contact.shape[:3], -np.inf)
    value[moves, *paths.goal] = np.where(np.isfinite(last), last, -np.inf)
    most = []
    for _ in range(paths.longest):
        onward = np.stack([_by_cell_left(value[move], move) for move in range(END)])
        most.append(onward[:, *paths.start].max())
        after = np.moveaxis(onward, 0, -1)  # (row, col, next move)
        ends = possible & np.isfinite(after)
        kept = passed[..., :END] * (contact[..., :END] + np.where(np.isfinite(after), after, 0.0))
        value = np.where(ends, kept, -np.inf).max(-1)
        value[:, *paths.goal] = -np.inf  # a path ends on entering the goal
    return np.array(most)


def _by_cell_left(values: np.ndarray, move: int) -> np.ndarray:
    """Values of the cells that a move enters, (row, col), by the cell that it leaves."""
    (down, right), (rows, cols) = MOVES[8][move], values.shape
    framed = np.pad(values, 1, constant_values=-np.inf)
    return framed[1 + down :, 1 + right :][:rows, :cols]
