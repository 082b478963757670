"""Positions and times of a user's table, as cells, metres and durations."""

from typing import Any

import numpy as np

from trustbo.errors import TrustboError
from trustbo.logs.columns import Columns
from trustbo.terrain.place import converted
from trustbo.workspace import Workspace
from trustbo.workspace.grid import WGS84, Grid

_POSITIONS = (("x", "y"), ("lon", "lat"), ("place",))
"""Columns that say where a bound ends, in the order in which they are looked for."""
_INTERVAL = ("begin", "end")


def with_cells(columns: Columns, workspace: Workspace | None) -> None:
    """Replace the positions in a table by the cells in which they lie, columns row and col.

    A table with cells, or any table without a workspace, stays as it is. Raises TrustboError if a
    position is blank or outside the workspace.
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
            cells[value] = workspace.locate(where, f"row {row} of {columns.what}:")
    located = np.array([cells[value] for value in zip(*values, strict=True)])

    frame = columns.frame.drop(columns=[columns.find(name) for name in names])
    columns.frame = frame.assign(row=located[:, 0], col=located[:, 1])


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
