"""Bounds of a log on a map: the ticks in which the lead enters and leaves the cells of its path."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import pandas as pd

from trustbo.data import Cell, Station, cells_of, require_path
from trustbo.errors import TrustboError, warn
from trustbo.logs.poses import GAP, UNITS
from trustbo.workspace.grid import Grid

_SHORT = 10.0
"""Length of a log below which its unit of time is doubted, s."""


def crossings_of(
    places: pd.DataFrame,
    n: int,
    tick: float,
    grid: Grid,
    planned: Sequence[Station] | None,
) -> tuple[Sequence[Station], np.ndarray]:
    """Return the path of the lead (by default, all cells that it enters) and its bounds' edges.

    Entering and leaving follow one rule: a cell is left if the lead does not return within 5 s.
    """
    located = zip(*grid.cells_at(places["x"].to_numpy(), places["y"].to_numpy()), strict=True)
    cells = [(int(row), int(col)) if is_on_grid else None for row, col, is_on_grid in located]
    ticks = places["tick"].tolist()
    visits = [*zip(ticks, _without_excursions(ticks, cells, GAP / tick), strict=True)]

    entered = [(k, cell) for k, cell in visits if cell is not None]
    if not entered:
        x, y = places[["x", "y"]].median()
        raise TrustboError(
            f"the lead is never on the grid: its poses are around ({x:.8g}, {y:.8g}). Give x and y "
            f"in {grid.crs_name}, in which the lower left is {grid.corner}."
        )

    driven = [cell for cell, _ in groupby(cell for _, cell in entered)]
    stations = require_path("path", driven if planned is None else planned)
    path = cells_of(stations)
    if planned is not None and len(path) < 2:
        raise TrustboError(f"path must have at least two cells; got {path}.")

    edges: list[int] = []
    for k, cell in entered:
        if len(edges) < len(path) and cell == path[len(edges)]:
            edges.append(k)

    _require_route(path, edges, entered, _doubts_of(ticks, n, tick))
    if planned is None or path[0] not in path[1:]:
        is_complete = planned is not None and len(edges) == len(path)
        _require_one_mission(path[0], edges, entered, tick, is_complete=is_complete)

    end = _end_of_visit(visits, edges[-1], path[len(edges) - 1], GAP / tick, n)
    if len(edges) < len(path) and end < n:
        warn(
            f"the lead leaves cell {path[len(edges) - 1]} {end * tick:g} s after the start of the "
            f"log and never enters the next cell of the path, {path[len(edges)]}; the mission is "
            "read as ended there."
        )
    return stations, np.array([*edges[1:], end])


def _doubts_of(ticks: Sequence[int], n: int, tick: float) -> str:
    """Return the end of messages: why the poses of the lead, known at `ticks`, may be wrong."""
    if n * tick < _SHORT:
        return f" The log lasts {n * tick:g} s; give {UNITS}."

    gap = float(np.diff([-1, *ticks, n]).max() - 1) * tick
    if gap <= GAP:
        return ""

    return (
        f" The poses of the lead are unknown for up to {gap:.3g} s, because only times of at most "
        f"{GAP:g} s between poses are interpolated; add interpolated poses, and give {UNITS}."
    )


def _without_excursions(
    ticks: Sequence[int], cells: Sequence[Cell | None], most: float
) -> list[Cell | None]:
    """Return the cell of the lead at each tick, in which it stays until it leaves for good.

    A cell is left for good if the lead is elsewhere for more than `most` ticks. Shorter excursions
    from which it returns are often errors of positions close to the edge of a cell.
    """
    steady = [*cells]
    first = 0
    while first < len(cells):
        last = first  # index of the last tick in the cell
        for i in range(first + 1, len(cells)):
            if cells[i] == cells[first]:
                last = i
            elif ticks[i] - ticks[last + 1] > most:
                break

        if cells[first] is not None:
            steady[first : last + 1] = [cells[first]] * (last + 1 - first)
            first = last
        first += 1
    return steady


def _require_route(
    path: Sequence[Cell], edges: Sequence[int], entered: Sequence[tuple[int, Cell]], hint: str
) -> None:
    """Raise TrustboError if the lead misses a cell of the path, or has no complete bound.

    Args:
        path: Planned or driven cells.
        edges: First tick in each cell of the path that is reached in order.
        entered: Tick and cell of each pose of the lead on the grid.
        hint: End of the message.
    """
    n = len(edges)
    if n == len(path) > 1:
        return

    first = entered[0][1]
    last = entered[-1][1]
    if n == len(path):
        raise TrustboError(
            f"the lead stays in cell {path[0]} of the path, so there is no complete bound; use "
            f"`Campaign.fail` if no bound was run.{hint}"
        )

    since = edges[-1] if edges else 0
    later = [cell for k, cell in entered if k > since and cell in {*path[n + 1 :]} - {*path[:n]}]
    if later:
        raise TrustboError(
            f"the lead never enters cell {path[n]}, number {n} of the path (0 is the start), but "
            f"enters {later[0]}, which is further along. Pass the path that was driven, or leave "
            f"path= out to take it from the poses.{hint}"
        )

    if n < 2:
        raise TrustboError(
            f"the lead never enters cell {path[n]}, number {n} of the path (0 is the start), so "
            f"there is no complete bound; the log begins in cell {first} and ends in {last}. Pass "
            f"the path of this mission, or use `Campaign.fail` if no bound was run.{hint}"
        )


def _require_one_mission(
    start: Cell,
    edges: Sequence[int],
    entered: Sequence[tuple[int, Cell]],
    tick: float,
    *,
    is_complete: bool,
) -> None:
    """Raise TrustboError if the lead returns to the start and leaves it again.

    If the planned path is complete before (`is_complete`), what follows is not read, with a
    warning.
    """
    again = [k for k, cell in entered if k > edges[1] and cell == start]
    if not again or entered[-1][1] == start:
        return

    text = (
        f"the lead returns to cell {start}, where the path begins, {again[0] * tick:g} s after the "
        "start of the log, and leaves it again"
    )
    if not is_complete or again[0] < edges[-1]:
        raise TrustboError(
            f"{text}. Cut the log if it has several missions, or pass the path that was driven if "
            "it leads through its start again."
        )
    warn(f"{text}; only the mission before is read. Cut the log if it has several missions.")


def _end_of_visit(
    visits: Sequence[tuple[int, Cell | None]], begin: int, cell: Cell, most: float, n: int
) -> int:
    """Return the tick in which the lead leaves a cell for more than `most` ticks, or else `n`."""
    left = None  # tick at which the lead left the cell, until it returns
    for k, at in visits:
        if k < begin or at == cell:
            left = None
        elif left is None:
            left = k
        if left is not None and k - left > most:
            return left
    return n
