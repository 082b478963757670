"""Dominance tests and the heuristic of the label search.

Two partial paths that end in one cell have the same continuations, and their states then differ by
B0^j times their difference now. A is at least as good as B under every continuation if it took no
more bounds, costs no more, and view . B0^j (x_A - x_B) >= 0 for every view and number j of bounds
still to come. If B0 and the views have no negative entry, x_A >= x_B suffices.
"""

from typing import NamedTuple

import numpy as np

from trustbo.planning.dynamics import Dynamics

_MAX_ENTRIES = 20_000_000  # of the tables of `Heuristic`


def dominance_tests(dynamics: Dynamics, longest: int) -> np.ndarray:
    """Rows q such that A dominates B if q . (x_A - x_B) >= 0 for all; shape (test, state).

    For one draw, and paths of at most `longest` bounds.
    """
    n_states, rows = len(dynamics.start), []
    if (dynamics.transition >= 0.0).all() and (dynamics.views >= 0.0).all():
        rows = [np.eye(n_states)]
        if len(dynamics.views) == n_states or n_states == 1:
            return rows[0]
    view = dynamics.views
    rows_of_powers = []
    for _ in range(longest):
        view = view @ dynamics.transition
        rows_of_powers.append(view)
    powers = np.concatenate(rows_of_powers)
    # Fewer tests are faster and stricter; both sets are valid.
    return rows[0] if rows and len(powers) > 8 * n_states else powers


class Heuristic(NamedTuple):
    """Upper limits on the team's trust to come, for every cell and number of bounds.

    After j more bounds it is at most the least over views of powers[view, j] . x + gains[view, j,
    cell]. Empty tables (no views) where the grid is too large for them.
    """

    powers: np.ndarray  # (view, bound, state)
    gains: np.ndarray  # (view, bound, cell)


def build_heuristic(
    dynamics: Dynamics, longest: int, neighbours: np.ndarray, goal: int, *, at_goal: bool
) -> Heuristic:
    """Compute the heuristic of one draw by dynamic programming over up to `longest` bounds.

    `neighbours` (cell, move) are flat indices of cells, -1 where none; `at_goal`: the last bound,
    and no other, must enter the goal.
    """
    n_states, n_cells = len(dynamics.start), len(neighbours)
    # The mean of the views limits their least too, and keeps to one path for all of them.
    views = dynamics.views
    if len(views) > 1:
        views = np.concatenate([views, views.mean(0, keepdims=True)])
    if len(views) * (longest + 1) * n_cells > _MAX_ENTRIES:
        return Heuristic(np.empty((0, longest + 1, n_states)), np.empty((0, longest + 1, n_cells)))
    powers = np.empty((len(views), longest + 1, n_states))
    gains = np.full((len(views), longest + 1, n_cells), -np.inf)
    powers[:, 0] = views
    gains[:, 0] = np.where(np.arange(n_cells) == goal, 0.0, -np.inf) if at_goal else 0.0
    n_drifts = dynamics.drift.shape[1]  # 1 where all moves into a cell are alike
    by_move = np.arange(n_drifts)  # with length 1 the same for all moves
    u = np.nan_to_num(dynamics.drift.reshape(n_states, n_drifts * n_cells), nan=-np.inf)
    is_open = np.isfinite(u).all(0)
    u = np.where(is_open, u, 0.0)
    padded = np.full((len(views), n_drifts, n_cells + 1), -np.inf)  # the last: no cell
    for j in range(1, longest + 1):
        powers[:, j] = powers[:, j - 1] @ dynamics.transition
        gained = np.where(is_open, powers[:, j - 1] @ u, -np.inf).reshape(-1, n_drifts, n_cells)
        padded[..., :-1] = gained + gains[:, j - 1, None]
        if j > 1:  # the goal ends a path
            padded[..., goal] = -np.inf
        gains[:, j] = padded[:, by_move, neighbours].max(2)
    return Heuristic(powers, gains)
