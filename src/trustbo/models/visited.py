"""Index of the places visited by missions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trustbo.data import Mission, require_map
from trustbo.errors import TrustboError
from trustbo.workspace.moves import bounds_along

_MOST = 4000  # maximum number of visited bounds; the cost grows with the cube of the number


class Visited(NamedTuple):
    """Cells entered and directed bounds driven in missions, sorted and without duplicates."""

    shape: tuple[int, int]  # rows and columns of the grid
    cells: np.ndarray  # (cell, 2): row, col
    bounds: np.ndarray  # (bound, 3): move, row, col
    cell_of: np.ndarray  # (bound,), index of the cell entered
    at: np.ndarray  # (mission, bound), index of the visited bound, -1 in the padding
    square: np.ndarray  # (cell, cell), squared distances, which are whole numbers

    def first(self, n: int) -> "Visited":
        """Return the places that the first n missions visited."""
        at = self.at[:n, :, None]
        return visited(np.where(at >= 0, self.bounds[at[..., 0]], -1), self.shape)


def bounds_of(missions: Sequence[Mission], shape: tuple[int, int] | None = None) -> np.ndarray:
    """Return an array (mission, bound, 3) of moves, rows and columns, with -1 in the padding.

    `shape` contains the numbers of missions and bounds, by default those of `missions`. Raises
    TrustboError if a path skips cells or a mission has no map.
    """
    require_map("a model with place effects", missions)
    if shape is None:
        shape = len(missions), max(len(mission.bounds) for mission in missions)

    bounds = np.full((*shape, 3), -1)
    for j, mission in enumerate(missions):
        path = mission.path[: len(mission.bounds) + 1]  # failed missions do not complete the path
        try:
            bounds[j, : len(mission.bounds)] = bounds_along(path)
        except TrustboError as error:
            raise TrustboError(
                f"mission {j}: {error} A model with place effects needs paths without jumps; omit "
                "PlaceEffect(), or split the mission at the jump."
            ) from None

    return bounds


def has_places(missions: Sequence[Mission]) -> bool:
    """Return whether all missions have a map and paths without jumps."""
    try:
        bounds_of(missions)
    except TrustboError:
        return False
    return True


def visited(bounds: np.ndarray, shape: tuple[int, int] | None = None) -> Visited:
    """Index the places of bounds (mission, bound, 3); see `bounds_of`.

    `shape` is the shape of the grid, by default ending at the last row and column visited. Raises
    TrustboError if a cell is outside the grid, or if the missions visited more than 4000 bounds.
    """
    there = bounds[..., 0] >= 0
    found, index_of = np.unique(bounds[there], axis=0, return_inverse=True)
    if shape is None:
        rows, cols = (found[:, 1:].max(0, initial=0) + 1).tolist()
        shape = rows, cols

    outside = there & (bounds[..., 1:] >= shape).any(-1)
    if outside.any():
        j, k = np.argwhere(outside)[0]
        raise TrustboError(
            f"mission {j} enters cell {tuple(bounds[j, k, 1:].tolist())}, outside the grid of "
            f"{shape[0]} rows and {shape[1]} columns; give the workspace of the missions."
        )

    if len(found) > _MOST:
        raise TrustboError(
            f"the missions visited {len(found)} bounds, but place effects support at most {_MOST}. "
            "Use larger cells, or omit PlaceEffect()."
        )

    cells, cell_of = np.unique(found[:, 1:], axis=0, return_inverse=True)
    at = np.full(there.shape, -1)
    at[there] = index_of.ravel()
    square = ((cells[:, None] - cells) ** 2).sum(-1)
    return Visited(shape, cells, found, cell_of.ravel(), at, square)
