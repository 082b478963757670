"""The index of the places that missions visited, and the correlation of places."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Mission, require_map
from trustbo.errors import TrustboError
from trustbo.models.backend import namespace
from trustbo.workspace.moves import MOVES, bounds_along

if TYPE_CHECKING:
    from trustbo.models.effects.place import PlaceEffect
    from trustbo.workspace import Workspace

N_MOVES = len(MOVES[8])
MAX_VISITED = 4000
"""Largest number of visited bounds: the effort grows with its cube."""


class Visited(NamedTuple):
    """Cells entered and directed bounds made by some missions.

    A place is a robot, a cell, and for bounds the move into it; the robot is 0 where all share the
    effects. A unit is a visited bound, or a visited cell where bounds have no effect.
    """

    shape: tuple[int, int]  # rows and columns of the grid
    cells: np.ndarray  # (cell, 3): robot, row, col, in order
    units: np.ndarray  # (unit, 4): robot, move, row, col, in order; move -1 where units are cells
    cell_of: np.ndarray  # (unit,), index among the visited cells
    unit: np.ndarray  # (mission, bound, robot), -1 in the padding

    @property
    def n_effects(self) -> int:
        """Number of robots with separate effects, 1 where all share them."""
        return 1 if self.unit.shape[2] == 1 else int(self.unit.shape[2])


def bounds_of(missions: Sequence[Mission], shape: tuple[int, int] | None = None) -> np.ndarray:
    """Move, row and column of each mission's bounds, (mission, bound, 3), -1 in the padding.

    `shape`, missions and bounds, is that with the padding, by default without. TrustboError: a path
    jumps, so that it has no directed bounds, or a mission has no map.
    """
    require_map("a model with effects of places", missions)
    if shape is None:
        shape = len(missions), max(len(mission.bounds) for mission in missions)
    bounds = np.full((*shape, 3), -1)
    for j, mission in enumerate(missions):
        path = mission.path[: len(mission.bounds) + 1]  # a failed mission did not run the rest
        try:
            bounds[j, : len(mission.bounds)] = bounds_along(path)
        except TrustboError as error:
            raise TrustboError(
                f"mission {j}: {error} A model with place effects needs whole paths; leave "
                "PlaceEffect() out, or split the mission there."
            ) from None
    return bounds


def has_places(missions: Sequence[Mission]) -> bool:
    """Whether bounds of missions have places: there is a map, and no path jumps."""
    try:
        bounds_of(missions)
    except TrustboError:
        return False
    return True


def places_of(
    missions: Sequence[Mission],
    place: "PlaceEffect | None",
    shape: tuple[int, ...],
    workspace: "Workspace | None" = None,
) -> Visited | None:
    """Places of missions, see `visited`, of a workspace over its whole grid; None without effects.

    `shape` is that of the rates, (mission, bound, robot), with the padding.
    """
    if place is None:
        return None
    grid = None if workspace is None else workspace.passable.shape
    return visited(bounds_of(missions, shape[:2]), place, shape[2], grid)  # pyright: ignore


def visited(
    bounds: np.ndarray,
    place: "PlaceEffect",
    n_robots: int,
    shape: tuple[int, int] | None = None,
) -> Visited:
    """Index the places of bounds (mission, bound, 3), see `bounds_of`.

    Args:
        bounds: Move, row and column, -1 in the padding.
        place: Effects in the model.
        n_robots: Number of robots.
        shape: Rows and columns of the grid; by default the fewest that hold all cells.

    Raises:
        TrustboError: A cell lies outside the grid, or there are too many bounds for one dense
            factor.
    """
    there = bounds[..., 0] >= 0
    least = tuple((bounds[there].max(0)[1:] + 1).tolist()) if there.any() else (1, 1)
    shape = least if shape is None else shape
    if any(have > rows for have, rows in zip(least, shape, strict=True)):
        j, k = np.argwhere(there & (bounds[..., 1:] >= shape).any(-1))[0]
        raise TrustboError(
            f"mission {j} enters the cell {tuple(bounds[j, k, 1:].tolist())}, outside the grid of "
            f"{shape[0]} rows and {shape[1]} columns; give the workspace the missions were run on."
        )
    n_effects = 1 if place.shared else n_robots
    robot = np.broadcast_to(np.arange(n_effects), (*there.shape, n_effects))
    move = bounds[..., 0] if place.bounds else np.where(there, -1, -2)
    four = np.stack(np.broadcast_arrays(robot, *(column[..., None] for column in (
        move, bounds[..., 1], bounds[..., 2]))), axis=-1)  # fmt: skip
    units, index = np.unique(four[there].reshape(-1, 4), axis=0, return_inverse=True)
    if len(units) > MAX_VISITED:
        raise TrustboError(
            f"{len(units)} visited places are more than {MAX_VISITED}, the most that one dense "
            "factor takes. Give coarser cells, PlaceEffect(bounds=False) or shared=True."
        )
    cells, cell_of = np.unique(units[:, [0, 2, 3]], axis=0, return_inverse=True)
    unit = np.full((*there.shape, n_effects), -1)
    unit[there] = index.reshape(-1, n_effects)
    return Visited(shape, cells, units, cell_of.ravel(), unit)


def matern(distance: ArrayLike, length_scale: ArrayLike) -> np.ndarray:
    """Matern 3/2 correlation at a distance, both in cells."""
    xp: Any = namespace(length_scale)
    h = np.sqrt(3.0) * xp.asarray(distance) / xp.asarray(length_scale)
    return (1.0 + h) * xp.exp(-h)


def correlation(cells: np.ndarray, others: np.ndarray, length_scale: float) -> np.ndarray:
    """Correlation of s between cells (cell, 3) and others (other, 3): robot, row, col."""
    gap = cells[:, None].astype(float) - others[None]
    return matern(np.hypot(gap[..., 1], gap[..., 2]), length_scale) * (gap[..., 0] == 0)
