"""Order of the moves in bounding overwatch: which part of the team moves in a bound, and whence."""

from collections.abc import Sequence
from typing import NamedTuple

from trustbo.data import Cell

BOUNDING = ("successive", "alternate")
"""Modes of bounding: T2 closes up to the lead after each bound, or passes it in the next."""


class Leg(NamedTuple):
    """Move of the lead or of T2, watched by the other from its place."""

    of_lead: bool
    start: Cell
    watched_from: Cell
    end: Cell

    @property
    def cells(self) -> tuple[Cell, Cell, Cell]:
        """Cells by which the way leads: any two that follow are neighbours, or one."""
        return self.start, self.watched_from, self.end


def legs(
    bounding: str, k: int, cells: tuple[Cell, Cell], end: Cell, is_last: bool
) -> tuple[Leg, ...]:
    """Moves of bound k in order, into a cell.

    Args:
        bounding: One of `BOUNDING`.
        k: Number of the bound, 1 for the first.
        cells: Cells of the lead and of T2 before the bound.
        end: Cell that the bound enters.
        is_last: Whether it is the last bound, after which all are together.
    """
    lead, t2 = cells
    if bounding == "successive" or k % 2:
        moves = Leg(True, lead, t2, end), Leg(False, t2, end, end)
    else:
        moves = Leg(False, t2, lead, end), Leg(True, lead, end, end)
    return moves if bounding == "successive" or is_last else moves[:1]


def legs_along(bounding: str, path: Sequence[Cell]) -> list[tuple[Leg, ...]]:
    """Moves of each bound of a path, see `legs`."""
    cells, moves = (path[0], path[0]), []
    for k, end in enumerate(path[1:], start=1):
        moves.append(legs(bounding, k, cells, end, k == len(path) - 1))
        cells = after(cells, moves[-1])
    return moves


def t2_cells(bounding: str, path: Sequence[Cell]) -> list[Cell]:
    """Cells in which T2 stands before each bound of a path."""
    cells = [(path[0], path[0])]
    for moves in legs_along(bounding, path)[:-1]:
        cells.append(after(cells[-1], moves))
    return [t2 for _, t2 in cells]


def after(cells: tuple[Cell, Cell], moves: Sequence[Leg]) -> tuple[Cell, Cell]:
    """Cells of the lead and of T2 after moves, from those before."""
    lead, t2 = cells
    for leg in moves:
        lead, t2 = (leg.end, t2) if leg.of_lead else (lead, leg.end)
    return lead, t2
