"""What given paths are worth under given dynamics."""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Cell
from trustbo.planning.course import Course
from trustbo.planning.dynamics import Dynamics, roll
from trustbo.planning.objectives import OBJECTIVES, Aim, PathTrust, softplus

Path = Sequence[Cell] | np.ndarray
"""Cells, start first; or an array of them, shape (cell, 2)."""


def path_value(moves: Dynamics, aim: Aim, course: Course, path: Path) -> np.ndarray:
    """The objective of one path, shape (...,) as the leading axes of `moves`."""
    path = np.asarray(path)
    trust = trust_along(moves, path)
    settled = np.full(trust.shape, np.nan)
    if aim.objective == "stationary":
        rows, cols = path[1:].T
        along = moves._replace(drift=moves.drift[..., rows, cols][..., None, :])
        settled = along.settled()[..., 0, :]
    toll = aim.length_weight * path_length(course, path)
    return OBJECTIVES[aim.objective](PathTrust(trust, settled, toll))


def trust_along(moves: Dynamics, path: Path) -> np.ndarray:
    """The team's expected trust after each bound of a path, shape (..., bound)."""
    rows, cols = np.asarray(path)[1:].T
    states = roll(moves.transition, moves.drift[..., rows, cols], moves.start)
    return (states @ moves.views.T).min(-1)


def path_length(course: Course, path: Path) -> float:
    """Metres from cell centre to cell centre."""
    grid = course.workspace.grid
    steps = np.diff(np.asarray(path), axis=0) * (grid.cell_height, grid.cell_width)
    return float(np.hypot(*steps.T).sum())


def entry_cost(passable: np.ndarray, moves: Dynamics) -> np.ndarray:
    """What entering each cell costs a `stationary` path, (..., row, col); inf if impassable."""
    return np.where(passable, softplus(-moves.settled()), np.inf)
