"""Closed cells and bounds, which no path takes."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from trustbo.data import Cell, path_text
from trustbo.errors import TrustboError, one_line, require_list
from trustbo.workspace.moves import MOVES, bounds_along

Closed = Mapping[tuple[Cell, ...], str]
"""Reason for each closed cell, (cell,), and for each closed bound, (cell, cell) in either order."""
_REMEDY = "give cells and pairs of neighbouring cells, such as [(3, 4), ((2, 1), (1, 1))]"


def require_closed(
    where: Any, reason: str, locate: Callable[[Any, str], Cell]
) -> dict[tuple[Cell, ...], str]:
    """Return the cells and bounds that a user closes.

    Args:
        where: Locations, and bounds as pairs of locations.
        reason: Reason of all of them.
        locate: Finds the cell of a location, given its name in messages.

    Raises:
        TrustboError: There is none, one is not a passable cell, or the cells of a bound are not
            neighbours.
    """
    if not isinstance(reason, str):
        raise TrustboError(f"reason must be a text such as 'wreck'; got {one_line(reason)}.")
    found = {}
    for k, one in enumerate(require_list("where", where, remedy=_REMEDY)):
        what = f"where[{k}]"
        if _is_pair(one):
            ends = tuple(sorted(locate(end, what) for end in one))
            bounds_along(ends)  # raises if they are not neighbours
            found[ends] = reason
        elif isinstance(one, int):
            raise TrustboError(f"where must be a list; got {one_line(where)}; {_REMEDY}.")
        else:
            found[(locate(one, what),)] = reason
    if not found:
        raise TrustboError(f"where is empty; {_REMEDY}.")
    return found


def _is_pair(one: Any) -> bool:
    """Return whether an entry is a pair of locations, not a cell (row, col)."""
    if not isinstance(one, tuple | list) or len(one) != 2:
        return False
    return all(isinstance(end, str | Mapping | tuple | list) for end in one)


def closed_mask(closed: Closed, shape: tuple[int, ...]) -> np.ndarray:
    """Return whether each bound, shape (move, row, col), is closed or enters a closed cell."""
    mask = np.zeros((len(MOVES), *shape[-2:]), bool)
    for cells in closed:
        if len(cells) == 1:
            mask[:, *cells[0]] = True
        else:
            there_and_back = bounds_along([*cells, cells[0]])
            mask[*there_and_back.T] = True
    return mask


def closed_text(closed: Closed, name_of: Callable[[Cell], str] | None = None) -> str:
    """Describe closed cells and bounds, such as "3,4 (wreck); 1,1 to 2,1 (mud)"."""
    texts = []
    for cells, reason in closed.items():
        ends = [path_text([cell]) if name_of is None else name_of(cell) for cell in cells]
        texts.append(" to ".join(ends) + (f" ({reason})" if reason else ""))
    return "; ".join(texts)


def closed_along(closed: Closed, path: Sequence[Any]) -> dict[tuple[Cell, ...], str]:
    """Return the closed cells that a path enters, and the closed bounds that it takes."""
    cells = [(cell[0], cell[1]) for cell in path]
    taken = {(cell,) for cell in cells[1:]}
    taken |= {tuple(sorted(ends)) for ends in pairwise(cells)}
    return {where: reason for where, reason in closed.items() if where in taken}
