"""Awareness of cells and of bounds from a user's arrays."""

import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import as_array
from trustbo.errors import ShapeError, TrustboError
from trustbo.workspace.moves import MOVES, existing_bounds

_AXES = "(robot, row, col, feature) or (robot, move, row, col, feature) with 8 moves"


def of_cells(
    awareness: ArrayLike, passable: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Check the arrays of `Workspace.from_awareness`.

    Returns awareness of cells (robot, row, col, feature), passability (row, col), and awareness of
    bounds (robot, move, row, col, feature), or None where it is that of the cells.

    ShapeError: other axes. TrustboError: a value outside [0, 1], NaN in a passable cell or in a
    bound between two.
    """
    z = as_array("awareness", awareness)
    if z.ndim not in (4, 5) or (z.ndim == 5 and z.shape[1] != len(MOVES[8])):
        raise ShapeError(f"awareness must be {_AXES}; got shape {z.shape}.")
    if not z.size:
        raise ShapeError(
            f"awareness has an axis of length 0; got shape {z.shape}. Without features, give one "
            "that is 0 everywhere."
        )
    if (bad := (z < 0.0) | (z > 1.0)).any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise TrustboError(f"awareness{list(index)} = {z[index]:g} is outside [0, 1].")
    finite = np.isfinite(z).all((0, -1))  # ([move], row, col)
    reached = finite if z.ndim == 4 else finite.any(0)
    free = reached if passable is None else np.asarray(passable, dtype=bool)
    if free.shape != z.shape[-3:-1]:
        raise ShapeError(f"passable must be (row, col) = {z.shape[-3:-1]}; got {free.shape}.")
    if (free & ~reached).any():
        cell = tuple(int(i) for i in np.argwhere(free & ~reached)[0])
        raise TrustboError(
            f"awareness of the passable cell {cell} is NaN; fill it, or mark it impassable."
        )
    if z.ndim == 4:
        return z, free, None
    exists = existing_bounds(free)
    if (missing := exists & ~finite).any():
        m, row, col = (int(i) for i in np.argwhere(missing)[0])
        down, right = MOVES[8][m]
        raise TrustboError(
            f"awareness of the bound {(row - down, col - right)} -> {(row, col)} is NaN; fill it, "
            "or mark one of the cells impassable."
        )
    bounds = np.where(exists[..., None], z, np.nan)
    count = np.maximum(exists.sum(0), 1)[..., None]
    cells = np.nansum(bounds, axis=1) / count
    # A passable cell without a passable neighbour is entered by no bound.
    alone = (free & ~exists.any(0))[..., None]
    fallback = np.nanmean(np.where(free[..., None], z, np.nan), axis=1) if alone.any() else cells
    cells = np.where(alone, fallback, cells)
    return np.where(free[..., None], cells, np.nan), free, bounds
