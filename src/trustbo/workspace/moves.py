"""Moves between neighbouring cells. A bound is identified by its way and the cell it enters.

A way is a move together with the set of posts from which T2 watches the lead: the number of a way
is move + 8 set, where set 0 is the standard one. With a single set, ways are moves.

An option of a move into a cell is the set of posts together with the next way: the number of an
option is next way + (number of ways + 1) set. With a single set, options are next moves. Maps by
way, (way, row, col, next_way), have the same values as maps by option, (move, row, col, option).
"""

from collections.abc import Sequence

import numpy as np

from trustbo.data import POST_SETS, Cell, Station, require_path
from trustbo.errors import TrustboError

MOVES = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
"""Steps (down, right) to the neighbouring cells; the reverse of move m is move 7 - m."""
MOVE_NAMES = ("nw", "n", "ne", "w", "e", "sw", "s", "se")
"""Compass directions of `MOVES`, with row 0 in the north."""
END = len(MOVES)
"""Index used instead of the next move for a bound that ends the path, with a single set of posts;
in general, this index is the number of ways."""


def require_on_grid(
    path: Sequence[Station] | np.ndarray, shape: tuple[int, ...]
) -> tuple[Station, ...]:
    """Return the cells of a path.

    Raises TrustboError if a cell is invalid or is outside a grid with the shape (row, col).
    """
    cells = require_path("path", path)

    rows, cols = shape
    for row, col, *_ in cells:
        if not (0 <= row < rows and 0 <= col < cols):
            raise TrustboError(
                f"cell {(row, col)} is outside the grid of {rows} rows and {cols} columns; rows "
                "and columns are counted from 0, with row 0 at the top."
            )
    return cells


def way_names(n_posts: int) -> list[str]:
    """Return the names of the ways with the first `n_posts` sets of posts: "ne", ..., "ne far"."""
    others = [f"{move} {name}" for name in POST_SETS[1:n_posts] for move in MOVE_NAMES]
    return [*MOVE_NAMES, *others]


def for_sets(of_moves: np.ndarray, n_posts: int, *, axis: int = -3) -> np.ndarray:
    """Repeat values by move for each set of posts, so that `axis` becomes that of the ways."""
    return np.concatenate([of_moves] * n_posts, axis=axis)


def next_names(n_posts: int) -> list[str]:
    """Return the names of the ways that can follow a bound, and `"end"`."""
    return [*way_names(n_posts), "end"]


def cells_along(path: Sequence[Station] | np.ndarray) -> np.ndarray:
    """Return the rows and columns of the cells of a path, shape (cell, 2)."""
    return np.array([cell[:2] for cell in path])


def posts_along(path: Sequence[Station] | np.ndarray) -> np.ndarray:
    """Return the number of the set of posts of each bound of a path, shape (bound,)."""
    names = [cell[2] if len(cell) > 2 else POST_SETS[0] for cell in path[:-1]]
    return np.array([POST_SETS.index(name) for name in names], int)


def moves_along(path: Sequence[Station] | np.ndarray) -> np.ndarray:
    """Return the index in `MOVES` of each bound of a path, shape (bound,).

    Raises TrustboError if two successive cells are not neighbours.
    """
    cells = cells_along(path)
    steps = np.diff(cells, axis=0)

    if (far := np.abs(steps).max(1) != 1).any():
        k = int(np.argmax(far))
        a, c = (tuple(cells[i].tolist()) for i in (k, k + 1))
        raise TrustboError(f"no bound leads from {a} to {c}: the cells are not neighbours.")

    index = 3 * (steps[:, 0] + 1) + steps[:, 1] + 1  # 0..8, where 4 is no move
    return index - (index > 4)


def bounds_along(path: Sequence[Station] | np.ndarray) -> np.ndarray:
    """Return the way, row and column of each bound of a path, (bound, 3); see `moves_along`."""
    ways = moves_along(path) + len(MOVES) * posts_along(path)
    return np.column_stack([ways, cells_along(path)[1:]])


def pairs_along(path: Sequence[Station] | np.ndarray, n_posts: int) -> np.ndarray:
    """Return the way, row, column and next way of each bound of a path, shape (bound, 4).

    The next way of the last bound is the number of ways.
    """
    bounds = bounds_along(path)
    after = np.append(bounds[:, 0], len(MOVES) * n_posts)[1:]
    return np.column_stack([bounds, after])


def possible_next(bounds: np.ndarray, n_posts: int = 1) -> np.ndarray:
    """Return whether each bound can be followed by each next way, (way, row, col, next_way).

    Args:
        bounds: Whether each bound exists, shape (move, row, col).
        n_posts: Number of sets of posts, from each of which each bound can be watched.
    """
    onward = for_sets(by_cell_left(bounds, False), n_posts)
    anything = np.ones(bounds.shape[1:], bool)  # a path can end in any cell
    follows = bounds[..., None] & np.stack([*onward, anything], axis=-1)
    return for_sets(follows, n_posts, axis=0)


def by_option(maps: np.ndarray) -> np.ndarray:
    """Convert maps by way, (..., way, row, col, next_way), to (..., move, row, col, option)."""
    *leading, n_ways, rows, cols, n_next = maps.shape
    n_posts = n_ways // len(MOVES)
    of_sets = maps.reshape(*leading, n_posts, len(MOVES), rows, cols, n_next)
    return np.moveaxis(of_sets, -5, -2).reshape(*leading, len(MOVES), rows, cols, n_posts * n_next)


def by_way(maps: np.ndarray, n_posts: int) -> np.ndarray:
    """Convert maps by option, (..., move, row, col, option), to (..., way, row, col, next_way)."""
    *leading, n_moves, rows, cols, n_options = maps.shape
    n_next = n_options // n_posts
    of_sets = maps.reshape(*leading, n_moves, rows, cols, n_posts, n_next)
    return np.moveaxis(of_sets, -2, -5).reshape(*leading, n_posts * n_moves, rows, cols, n_next)


def options_of(pairs: np.ndarray, n_posts: int) -> np.ndarray:
    """Convert ways and next ways, (bound, 4) as in `pairs_along`, to move, row, col and option."""
    way, row, col, after = pairs.T
    number, move = np.divmod(way, len(MOVES))
    return np.column_stack([move, row, col, number * (len(MOVES) * n_posts + 1) + after])


def by_cell_left(values: np.ndarray, nowhere: float) -> np.ndarray:
    """Index values (way, row, col) of bounds by the cell left instead of the cell entered.

    Ways that leave the grid have the value `nowhere`.
    """
    n_ways, rows, cols = values.shape
    framed = np.pad(values, ((0, 0), (1, 1), (1, 1)), constant_values=nowhere)
    steps = MOVES * (n_ways // len(MOVES))
    return np.stack(
        [
            one[1 + down :, 1 + right :][:rows, :cols]
            for one, (down, right) in zip(framed, steps, strict=True)
        ]
    )


def existing_bounds(passable: np.ndarray) -> np.ndarray:
    """Return whether each move into each cell is a bound, as a mask (move, row, col).

    A bound leads from one passable cell to another; `passable` has the shape (row, col).
    """
    rows, cols = passable.shape
    framed = np.pad(passable, 1)
    left = [framed[1 - down :, 1 - right :][:rows, :cols] for down, right in MOVES]
    return np.stack(left) & passable


def along(maps: np.ndarray, path: Sequence[Station] | np.ndarray) -> np.ndarray:
    """Select the values of maps for the bounds of a path, shape (..., bound, feature).

    The maps have the shape (..., way, row, col, feature).
    """
    ways, rows, cols = bounds_along(path).T
    return maps[..., ways, rows, cols, :]


def cells_ahead(bounds: np.ndarray) -> dict[Cell, list[Cell]]:
    """Return the cells to which bounds (move, row, col) lead, by the cell that they leave."""
    ahead: dict[Cell, list[Cell]] = {}
    for move, row, col in np.argwhere(bounds).tolist():
        down, right = MOVES[move]
        ahead.setdefault((row - down, col - right), []).append((row, col))
    return ahead
