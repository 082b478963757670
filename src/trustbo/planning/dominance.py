"""When one partial path makes another pointless, and how good either can still become.

Two partial paths that stand in one cell go on alike: their states then differ by B0^j times what
they differ by now, whatever cells follow. So A is at least as good as B for ever if it took no more
bounds, has no higher cost, and view . B0^j (x_A - x_B) >= 0 for every view and number of bounds
still to come. Where B0 has no negative entry, x_A >= x_B suffices.
"""

from typing import NamedTuple

import numpy as np

from trustbo.planning.dynamics import Dynamics

_MOST_ENTRIES = 20_000_000  # of the tables of `Outlook`


def tests(moves: Dynamics, longest: int) -> np.ndarray:
    """Rows q such that A dominates B if q . (x_A - x_B) >= 0 for all; shape (test, state).

    Args:
        moves: Of one draw.
        longest: Most bounds a path may have.
    """
    n_states, rows = len(moves.start), []
    if (moves.transition >= 0.0).all() and (moves.views >= 0.0).all():
        rows = [np.eye(n_states)]
        if len(moves.views) == n_states or n_states == 1:
            return rows[0]
    view = moves.views
    rows_of_powers = []
    for _ in range(longest):
        view = view @ moves.transition
        rows_of_powers.append(view)
    powers = np.concatenate(rows_of_powers)
    # Fewer tests make a quicker comparison, and a stricter one; both are right.
    return rows[0] if rows and len(powers) > 8 * n_states else powers


class Outlook(NamedTuple):
    """Upper bounds on the team's trust to come, for every cell and number of bounds.

    After j more bounds it is at most the least over views of powers[view, j] . x + gains[view, j,
    cell]. Empty tables (no views) where the grid is too large for them.
    """

    powers: np.ndarray  # (view, bound, state)
    gains: np.ndarray  # (view, bound, cell)


def outlook(
    moves: Dynamics, longest: int, neighbours: np.ndarray, goal: int, *, at_goal: bool
) -> Outlook:
    """Compute them by dynamic programming over the bounds.

    Args:
        moves: Of one draw.
        longest: Most bounds a path may have.
        neighbours: Cells that can be entered from each, shape (cell, move), -1 where none.
        goal: Flat index.
        at_goal: Whether the last of the bounds must enter the goal, and no other.
    """
    n_states, n_cells = len(moves.start), len(neighbours)
    # The mean of the views bounds their least too, and sees that they share a path.
    views = moves.views
    if len(views) > 1:
        views = np.concatenate([views, views.mean(0, keepdims=True)])
    if len(views) * (longest + 1) * n_cells > _MOST_ENTRIES:
        return Outlook(np.empty((0, longest + 1, n_states)), np.empty((0, longest + 1, n_cells)))
    powers = np.empty((len(views), longest + 1, n_states))
    gains = np.full((len(views), longest + 1, n_cells), -np.inf)
    powers[:, 0] = views
    gains[:, 0] = np.where(np.arange(n_cells) == goal, 0.0, -np.inf) if at_goal else 0.0
    u = np.nan_to_num(moves.drift.reshape(n_states, n_cells), nan=-np.inf)
    open_cell = np.isfinite(u).all(0)
    u = np.where(open_cell, u, 0.0)
    for j in range(1, longest + 1):
        powers[:, j] = powers[:, j - 1] @ moves.transition
        entered = np.where(open_cell, powers[:, j - 1] @ u + gains[:, j - 1], -np.inf)
        if j > 1:  # the goal ends a path
            entered[:, goal] = -np.inf
        padded = np.concatenate([entered, np.full((len(views), 1), -np.inf)], axis=1)
        gains[:, j] = padded[:, neighbours].max(2)
    return Outlook(powers, gains)
