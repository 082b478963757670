"""Index of the places visited by missions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trustbo.data import Mission, require_map
from trustbo.errors import TrustboError
from trustbo.stacking import padded
from trustbo.workspace.moves import MOVES, bounds_along

_MOST = 4000  # maximum number of visited bounds, because the cost grows with its cube


class Visited(NamedTuple):
    """Cells that missions entered and directed bounds that they took, without duplicates.

    A bound that was watched from several sets of posts is listed for each of its ways. Places are
    sorted by map, row and column. Map 0 is that of the workspace.
    """

    shape: tuple[int, int]  # rows and columns of the workspace's grid
    cells: np.ndarray  # (cell, 2): row, col
    bounds: np.ndarray  # (bound, 3): way, row, col
    cell_of: np.ndarray  # (bound,), index of the cell entered
    at: np.ndarray  # (mission, bound), index of the visited bound, -1 in the padding
    cell_map: np.ndarray  # (cell,), number of the map
    bound_map: np.ndarray  # (bound,), number of the map
    squares: tuple[np.ndarray, ...]  # of each map (cell, cell): squared distances, whole numbers
    n_posts: int  # number of sets of posts of the workspace

    def first(self, n: int) -> "Visited":
        """Return the places that the first n missions visited."""
        at = self.at[:n, :, None]
        bounds = np.where(at >= 0, self.bounds[at[..., 0]], -1)
        return visited(bounds, self.shape, self.bound_map[at[:, 0, 0]], self.n_posts)


def bounds_of(missions: Sequence[Mission]) -> np.ndarray:
    """Return an array (mission, bound, 3) of ways, rows and columns, with -1 in the padding.

    Raises TrustboError if a path skips cells or a mission has no map.
    """
    require_map("a model with place effects", missions)
    bounds = []
    for j, mission in enumerate(missions):
        try:
            bounds.append(bounds_along(mission.driven_stations))
        except TrustboError as error:
            raise TrustboError(
                f"mission {j}: {error} A model with place effects needs paths without jumps; omit "
                "PlaceEffect(), or split the mission at the jump."
            ) from None

    return padded(bounds, -1)


def has_places(missions: Sequence[Mission]) -> bool:
    """Return whether all missions have a map and paths without jumps."""
    try:
        bounds_of(missions)
    except TrustboError:
        return False
    return True


def maps_of(missions: Sequence[Mission]) -> np.ndarray:
    """Return the number (mission,) of the map of each mission, 0 for the workspace."""
    numbers = {"": 0}
    return np.array([numbers.setdefault(mission.map, len(numbers)) for mission in missions])


def visited(
    bounds: np.ndarray,
    shape: tuple[int, int] | None = None,
    maps: np.ndarray | None = None,
    n_posts: int | None = None,
) -> Visited:
    """Index the places of bounds (mission, bound, 3); see `bounds_of`.

    `shape` is the shape of the workspace's grid; by default, the grid ends at the last row and
    column visited. `maps` (mission,) contains the numbers of the maps, by default 0. `n_posts` is
    the workspace's number of sets of posts; by default, the last set is the last one used. Raises
    TrustboError if a cell is outside the grid, or if the missions visited more than 4000 bounds.
    """
    if maps is None:
        maps = np.zeros(len(bounds), dtype=int)
    there = bounds[..., 0] >= 0
    on = np.broadcast_to(maps[:, None], there.shape)
    placed, index_of = np.unique(
        np.column_stack([on[there], bounds[there]]), axis=0, return_inverse=True
    )
    bound_map = placed[:, 0]
    found = placed[:, 1:]
    if shape is None:
        rows, cols = (found[bound_map == 0, 1:].max(0, initial=0) + 1).tolist()
        shape = rows, cols
    if n_posts is None:
        n_posts = int(found[:, 0].max(initial=0)) // len(MOVES) + 1

    outside = there & (on == 0) & (bounds[..., 1:] >= shape).any(-1)
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

    entered, cell_of = np.unique(placed[:, [0, 2, 3]], axis=0, return_inverse=True)
    cell_map = entered[:, 0]
    cells = entered[:, 1:]
    at = np.full(there.shape, -1)
    at[there] = index_of.ravel()

    squares = []
    for number in np.unique(cell_map):
        here = cells[cell_map == number]
        squares.append(((here[:, None] - here) ** 2).sum(-1))

    return Visited(
        shape, cells, found, cell_of.ravel(), at, cell_map, bound_map, tuple(squares), n_posts
    )
