"""Bounds of a log on a map: when the lead leaves its stop in each cell of its path.

A bound begins when the lead leaves its stop in a cell, and ends when it leaves the next one; the
subteam closes up in between. Where the lead halts, it is in the cell of the stop that is near, even
if its position lies beyond the edge of the cell.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from operator import itemgetter

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trustbo.data import Cell, Station, cells_of, require_path
from trustbo.errors import TrustboError, warn
from trustbo.logs.poses import GAP, UNITS
from trustbo.logs.positions import cells_near, reach_of_stops, stops_of
from trustbo.workspace import Workspace

_SHORT = 10.0
"""Length of a log below which its unit of time is doubted, s."""
_THROUGH = 0.5
"""Length of a visit, as a part of this side, from which it is not only a corner that is cut."""
_SLOW = 2.0
"""Time in which the lead drives out of a circle, at most, as a multiple of that at full speed."""
_STILL = 2.0
"""Distance within which the positions of a lead that stands still lie, m."""
_NOTICED = 10.0
"""Time after which a team has noticed that the lead is stuck, s."""
_FEW = 5
"""Number of readings below which a rate is hardly known."""


@dataclass(frozen=True)
class Crossings:
    """The path of the lead, and when it reached its cells and left its stops.

    Attributes:
        stations: The planned path, or the driven one.
        reached: First tick in each cell that was reached, in the order of the path.
        edges: Tick at which each bound begins, and the end of the last one.
        is_complete: Whether the last cell was reached, and no bound failed.
    """

    stations: Sequence[Station]
    reached: Sequence[int]
    edges: np.ndarray
    is_complete: bool


def crossings_of(
    places: pd.DataFrame,
    n: int,
    tick: float,
    workspace: Workspace,
    planned: Sequence[Station] | None,
    *,
    is_failed: bool,
) -> Crossings:
    """Return the path of the lead (by default, the cells that it drives through) and its bounds.

    Args:
        places: Known poses of the lead, with columns tick, x and y.
        n: Number of ticks of the log.
        tick: Length of a tick, s.
        workspace: Map of cells and stops.
        planned: Planned path. If the lead drives round some of its cells, the result has the cells
            that it drove through instead.
        is_failed: Whether the bound in which the log ends failed. If the lead is at its stop, this
            is the bound into its cell, in which T2 closes up, or else the bound out of this cell.
    """
    lead = _Lead(places, tick, workspace)
    if not any(lead.cells):
        x, y = places[["x", "y"]].median()
        raise TrustboError(
            f"the lead is never on the grid: its poses are around ({x:.8g}, {y:.8g}). Give x and y "
            f"in {workspace.grid.crs_name}, in which the lower left is {workspace.grid.corner}."
        )

    stations = require_path("path", lead.driven(0, n) if planned is None else planned)
    if planned is not None and len(stations) < 2:
        raise TrustboError(f"path must have at least two cells; got {cells_of(stations)}.")

    hint = _doubts_of(lead.ticks.tolist(), n, tick)
    if planned is not None:
        stations = _with_detours(stations, lead)
    path = cells_of(stations)
    reached = lead.reached(path)
    is_complete = len(reached) == len(path)
    _require_bound(path, reached, lead, hint, is_failed=is_failed)
    if planned is None or path[0] not in path[1:]:
        is_read = planned is not None and is_complete
        _require_one_mission(path[0], reached, lead, tick, is_complete=is_read)

    last = path[len(reached) - 1]
    end = lead.end_of_visit([last], reached[-1], n)  # of the visit of the last cell
    if end < n and len(reached) < len(path):
        warn(
            f"the lead leaves cell {last} {end * tick:g} s after the start of the log and never "
            f"enters the next cell of the path, {path[len(reached)]}; the mission is read as ended "
            "there."
        )

    ends = [*reached[1:], end]
    edges = [lead.departure(*each) for each in zip(path, reached, ends, strict=False)]
    if is_failed and (len(reached) == 1 or lead.has_left(last, reached[-1])):
        if is_complete:
            raise TrustboError(
                f"a status is given, but the lead leaves {last}, the last cell of the path, "
                f"{end * tick:g} s after the start of the log; leave status= out, or end the poses "
                "where the bound failed."
            )
        left = lead.end_of_visit(path[len(reached) - 1 :][:2], reached[-1], n)
        edges.append(lead.still_since(edges[-1], left, round(_NOTICED / tick)))
    elif is_failed or end == n:
        edges[-1] = n  # it is still there

    edges = np.maximum.accumulate(edges)
    n_ticks = np.diff(edges).tolist()
    _warn_of_few(path, n_ticks[:-1] if is_failed else n_ticks, tick)
    return Crossings(stations, reached, edges, is_complete and not is_failed)


class _Lead:
    """Where the lead is, in each tick with a known pose.

    Attributes:
        ticks: Numbers of these ticks, (pose,).
        xy: Positions, (pose, 2), m.
        cells: Cell of each pose, or None off the grid; see `cells_near` and `_without_excursions`.
    """

    def __init__(self, places: pd.DataFrame, tick: float, workspace: Workspace) -> None:
        grid = self._grid = workspace.grid
        self._side = min(grid.cell_height, grid.cell_width)
        self._radius = reach_of_stops(workspace)
        self._most = GAP / tick  # number of ticks of an excursion
        self._drive_out = self._radius / (workspace.team.lead.speed * tick)  # at full speed, ticks
        self._stop = stops_of(workspace)

        self.ticks = places["tick"].to_numpy()
        self.xy = places[["x", "y"]].to_numpy()
        located = [None if i < 0 else (i, j) for i, j in cells_near(workspace, self.xy).tolist()]
        self.cells = _without_excursions(self.ticks.tolist(), located, self._most)

    def entered(self, since: int = 0) -> list[tuple[int, Cell]]:
        """Return the tick and the cell of each pose on the grid from a tick on."""
        visits = zip(self.ticks.tolist(), self.cells, strict=True)
        return [(k, cell) for k, cell in visits if cell is not None and k >= since]

    def reached(self, path: Sequence[Cell]) -> list[int]:
        """Return the first tick in each cell of a path that is reached, in order."""
        reached: list[int] = []
        for k, cell in self.entered():
            if len(reached) < len(path) and cell == path[len(reached)]:
                reached.append(k)
        return reached

    def further_along(
        self, path: Sequence[Cell], reached: Sequence[int]
    ) -> tuple[int, Cell] | None:
        """Return the first tick and cell after a missed cell of a path; None if there is none."""
        n = len(reached)
        further = {*path[n + 1 :]} - {*path[:n]}
        entered = self.entered(reached[-1] if reached else 0)
        return next(((k, cell) for k, cell in entered if cell in further), None)

    def driven(self, begin: int, end: int) -> list[Cell]:
        """Return the cells that the lead drives through between two ticks.

        A cell of which it only cuts a corner, on the way between two neighbours, is left out.
        """
        poses = self._between(begin, end + 1).tolist()
        steps = [(cell, i) for i in poses if (cell := self.cells[i]) is not None]
        visits = [(cell, [i for _, i in of]) for cell, of in groupby(steps, itemgetter(0))]

        k = 1
        while k < len(visits) - 1:
            (before, _), (cell, poses_in), (after, _) = visits[k - 1 : k + 2]
            length = np.linalg.norm(np.ptp(self.xy[poses_in], axis=0))
            is_cut = (
                length < _THROUGH * self._side
                and not self._is_near(self._stop(cell), poses_in).any()
            )
            if is_cut and _are_close(before, after):
                del visits[k]
            else:
                k += 1
        return [cell for cell, _ in groupby(cell for cell, _ in visits)]

    def halts_at(self, cell: Cell, begin: int) -> list[int]:
        """Return the ticks, from one on, in which the lead is in a cell, and also at its stop."""
        row, col, _ = self._grid.cells_at(*self.xy.T)
        poses = np.flatnonzero((row == cell[0]) & (col == cell[1]) & (self.ticks >= begin))
        return self.ticks[poses[self._is_near(self._stop(cell), poses)]].tolist()

    def has_left(self, cell: Cell, begin: int) -> bool:
        """Return whether the lead was at the stop of a cell after a tick, and is not in the end."""
        poses = np.flatnonzero(self.ticks >= begin)
        is_near = self._is_near(self._stop(cell), poses)
        return bool(is_near.any() and not is_near[-1])

    def departure(self, cell: Cell, begin: int, end: int) -> int:
        """Return the tick in which the lead leaves its stop in a cell between two ticks.

        If it does not halt at the stop, it leaves the median of its positions in the cell. It needs
        as much time to drive out of the circle around the stop as for as many metres beyond it.
        """
        place = self._stop(cell)
        in_cell = self._between(begin, end)
        if not self._is_near(place, in_cell).any():
            halts = [i for i in in_cell.tolist() if self.cells[i] == cell]
            place = np.median(self.xy[halts], axis=0)

        ticks = self.ticks[in_cell[0] :]
        away = np.linalg.norm(self.xy[in_cell[0] :] - place, axis=1)
        is_near = away <= self._radius
        out = np.flatnonzero(~is_near & (ticks >= end))  # after the visit
        inside = np.flatnonzero(is_near[: out[0] if len(out) else None])
        if not len(inside):
            return begin

        left = int(ticks[inside[-1]]) + 1
        beyond = ticks[(ticks >= left) & (away > 2.0 * self._radius)]
        drive = beyond[0] - left if len(beyond) else self._drive_out
        return max(begin, round(left - min(drive, _SLOW * self._drive_out)))

    def end_of_visit(self, cells: Iterable[Cell], begin: int, n: int) -> int:
        """Return the tick in which the lead leaves some cells for good, or else `n`."""
        left = None  # tick at which the lead left the cells, until it returns
        for i in self._between(begin, n).tolist():
            k = int(self.ticks[i])
            if self.cells[i] in cells:
                left = None
            elif left is None:
                left = k
            if left is not None and k - left > self._most:
                return left
        return n

    def still_since(self, begin: int, end: int, noticed: int) -> int:
        """Return the tick until which a lead that got stuck counts as on its way, at most `end`.

        These are so many ticks after it has moved for the last time.
        """
        poses = self._between(begin, end)
        if not len(poses):
            return end

        xy = self.xy[poses]
        place = np.median(xy[-max(noticed, 1) :], axis=0)
        moves = np.flatnonzero(np.linalg.norm(xy - place, axis=1) > _STILL)
        stopped = self.ticks[poses[moves[-1]]] + 1 if len(moves) else begin
        return min(end, int(stopped) + max(noticed, _FEW))

    def _between(self, begin: int, end: int) -> np.ndarray:
        """Return the positions of the poses from one tick until before another, (pose,)."""
        return np.flatnonzero((self.ticks >= begin) & (self.ticks < end))

    def _is_near(self, place: ArrayLike, poses: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return whether the lead is in the circle around a place, (pose,)."""
        return np.linalg.norm(self.xy[poses] - place, axis=1) <= self._radius


def _are_close(a: Cell, b: Cell) -> bool:
    """Return whether two cells are neighbours, or the same."""
    return max(abs(a[0] - b[0]), abs(a[1] - b[1])) <= 1


def _with_detours(stations: Sequence[Station], lead: _Lead) -> Sequence[Station]:
    """Return a planned path in which cells that the lead drove round are replaced, with a warning.

    If the lead does not return to the path, or does not begin it, the path is as planned.
    """
    detours: list[str] = []
    while True:
        path = cells_of(stations)
        reached = lead.reached(path)
        n = len(reached)
        if not 0 < n < len(path):
            break

        back = lead.further_along(path, reached)
        if back is None:
            break

        way = lead.driven(reached[-1], back[0])
        if not all(_are_close(a, b) for a, b in pairwise(way)):
            break

        m = path.index(back[1], n)
        detours.append(f"{', '.join(map(str, way))} and not {', '.join(map(str, path[n:m]))}")
        stations = (*path[:n], *way[1:-1], *path[m:])

    if detours:
        warn(
            f"the lead leaves the planned path: it drives through {'; then '.join(detours)}. The "
            "mission is read with the cells that it drove through."
        )
    return stations


def _warn_of_few(path: Sequence[Cell], n_ticks: Sequence[int], tick: float) -> None:
    """Warn if bounds have so few readings that a rate is hardly known."""
    few = [k for k, n in enumerate(n_ticks, start=1) if n < _FEW]
    if few:
        named = ", ".join(f"{k} into {path[k]}" for k in few if k < len(path))
        warn(
            f"bounds of fewer than {_FEW} readings: {named}. A rate of so few is hardly known; "
            f"check the path, and that the readings are {tick:g} s apart."
        )


def _require_bound(
    path: Sequence[Cell], reached: Sequence[int], lead: _Lead, hint: str, *, is_failed: bool
) -> None:
    """Raise TrustboError if the lead misses a cell of the path, or has no complete bound.

    Args:
        path: Planned or driven cells.
        reached: First tick in each cell of the path that is reached in order.
        lead: Track of the lead.
        hint: End of the message.
        is_failed: Whether the last bound, which need not be complete, failed.
    """
    n = len(reached)
    if n == len(path) > 1:
        return

    entered = lead.entered()
    if n == len(path):
        raise TrustboError(
            f"the lead stays in cell {path[0]} of the path, so there is no complete bound; use "
            f"`Campaign.fail` if no bound was run.{hint}"
        )

    later = lead.further_along(path, reached)
    if later is not None:
        raise TrustboError(
            f"the lead never enters cell {path[n]}, number {n} of the path (0 is the start), but "
            f"enters {later[1]}, which is further along. Pass the path that was driven, or leave "
            f"path= out to take it from the poses.{hint}"
        )

    if n < (1 if is_failed else 2):
        raise TrustboError(
            f"the lead never enters cell {path[n]}, number {n} of the path (0 is the start), so "
            f"there is no complete bound; the log begins in cell {entered[0][1]} and ends in "
            f"{entered[-1][1]}. Pass the path of this mission, or use `Campaign.fail` if no bound "
            f"was run.{hint}"
        )


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


def _require_one_mission(
    start: Cell,
    reached: Sequence[int],
    lead: _Lead,
    tick: float,
    *,
    is_complete: bool,
) -> None:
    """Raise TrustboError if the lead returns to the start and leaves it again.

    If the planned path is complete before (`is_complete`), what follows is not read, with a
    warning.
    """
    if len(reached) < 2:
        return

    again = lead.halts_at(start, reached[1])
    if not again or lead.entered()[-1][1] == start:
        return

    text = (
        f"the lead returns to cell {start}, where the path begins, {again[0] * tick:g} s after the "
        "start of the log, and leaves it again"
    )
    if not is_complete or again[0] < reached[-1]:
        raise TrustboError(
            f"{text}. Cut the log if it has several missions, or pass the path that was driven if "
            "it leads through its start again."
        )
    warn(f"{text}; only the mission before is read. Cut the log if it has several missions.")
