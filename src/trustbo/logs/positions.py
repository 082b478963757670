"""Positions and times of a user's table, as cells, metres and durations."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.logs.columns import Columns
from trustbo.terrain.place import converted
from trustbo.workspace import Workspace
from trustbo.workspace.grid import WGS84, Grid

_POSITIONS = (("x", "y"), ("lon", "lat"), ("place",))
"""Columns that say where a bound ends, in the order in which they are looked for."""
_INTERVAL = ("begin", "end")
_AT_STOP = 5.0
"""Largest distance of a robot that is at a stop, m."""
_OF_SIDE = 0.25
"""The same in small cells, as a part of the shorter side of a cell."""


def with_cells(columns: Columns, workspace: Workspace | None) -> None:
    """Replace the positions in a table by the cells in which they lie, columns row and col.

    A position near the stop in a cell is in this cell; see `cells_near`. A table with cells, or any
    table without a workspace, stays as it is. Raises TrustboError if a position is blank or outside
    the workspace.
    """
    if workspace is None or columns.find("row") or columns.find("col"):
        return

    names = next((names for names in _POSITIONS if all(map(columns.find, names))), None)
    if names is None:
        return

    is_place = names == ("place",)
    values: Any = [
        columns.texts(name, blank=False) if is_place else columns.numbers(name, blank=False)
        for name in names
    ]
    cells = {}
    for row, value in zip(columns.frame.index, zip(*values, strict=True), strict=True):
        if value not in cells:
            where = value[0] if is_place else dict(zip(names, value, strict=True))
            if not is_place:
                (near,) = cells_near(workspace, [workspace.grid.position(where)]).tolist()
                where = where if min(near) < 0 else tuple(near)
            cells[value] = workspace.locate(where, f"row {row} of {columns.what}:")
    located = np.array([cells[value] for value in zip(*values, strict=True)])

    frame = columns.frame.drop(columns=[columns.find(name) for name in names])
    columns.frame = frame.assign(row=located[:, 0], col=located[:, 1])


def stops_of(workspace: Workspace) -> Callable[[Cell], Any]:
    """Return the function that gives the stop in a cell, in metres; without a map, its centre."""
    return workspace.grid.center if workspace.posts is None else workspace.posts.stop


def reach_of_stops(workspace: Workspace) -> float:
    """Return the largest distance from a stop of a robot that is at the stop, m."""
    grid = workspace.grid
    return min(_AT_STOP, _OF_SIDE * min(grid.cell_height, grid.cell_width))


def cells_near(workspace: Workspace, xy: ArrayLike) -> np.ndarray:
    """Return the cell of the nearest stop of each position at a stop, or else the cell around it.

    Args:
        workspace: Map of the cells.
        xy: Positions in CRS metres, shape (position, 2).

    Returns:
        Cells, shape (position, 2); -1 for positions off the grid.
    """
    grid, stop_in = workspace.grid, stops_of(workspace)
    reach = reach_of_stops(workspace)
    places = np.asarray(xy, dtype=float)
    row, col, is_on_grid = grid.cells_at(*places.T)
    around = np.stack([row, col], axis=1)
    cells = np.where(is_on_grid[:, None], around, -1)

    for r, c in np.unique(around, axis=0).tolist():
        first = max(r - 1, 0), max(c - 1, 0)
        block = np.ones(grid.shape)[first[0] : r + 2, first[1] : c + 2]
        near = np.argwhere(block) + first
        stops = [stop_in((i, j)) for i, j in near.tolist()]

        in_cell = np.flatnonzero((around == (r, c)).all(axis=1))
        away = cdist(places[in_cell], stops)
        at_stop = away.min(axis=1) <= reach
        cells[in_cell[at_stop]] = near[away.argmin(axis=1)[at_stop]]
    return cells


def with_durations(columns: Columns) -> None:
    """Replace the times at which bounds begin and end, in s, by the columns begin and duration.

    A column duration that is there stays. Raises TrustboError if a bound ends before it begins.
    """
    named = [name for name in map(columns.find, _INTERVAL) if name is not None]
    begin, end = (columns.numbers(name, required=False) for name in _INTERVAL)
    columns.refuse("end", end < begin, "is before the begin of its row; check both clocks")

    frame = columns.frame.drop(columns=named)
    if columns.find("begin"):
        frame = frame.assign(begin=begin)
    if len(named) == len(_INTERVAL) and not columns.find("duration"):
        frame = frame.assign(duration=end - begin)
    columns.frame = frame


def with_metres(columns: Columns, grid: Grid | None) -> None:
    """Add columns x and y, in CRS metres, to a table that has lon and lat in degrees instead.

    Raises TrustboError if the grid has no CRS, or there is no grid.
    """
    if columns.find("x") or not (columns.find("lon") and columns.find("lat")):
        return
    if grid is None:
        raise TrustboError(
            f"{columns.what} has lon and lat; pass the workspace, or give x and y in metres."
        )

    degrees = [columns.numbers(name, blank=False) for name in ("lon", "lat")]
    x, y = converted(WGS84, grid.require_crs(), *degrees)
    columns.frame = columns.frame.assign(x=x, y=y)
