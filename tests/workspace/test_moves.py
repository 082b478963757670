"""Moves and bounds of a grid, beside plain loops."""

import numpy as np
import pytest

from trustbo import Workspace
from trustbo.errors import TrustboError
from trustbo.workspace.moves import MOVE_NAMES, MOVES, along, existing_bounds, moves_along

RNG = np.random.default_rng(0)


def test_existing_bounds_and_moves_agree_with_loops():
    passable = RNG.random((4, 5)) < 0.7
    exists = existing_bounds(passable)
    for m, (down, right) in enumerate(MOVES):
        for row, col in np.ndindex(4, 5):
            a = row - down, col - right
            inside = 0 <= a[0] < 4 and 0 <= a[1] < 5
            assert exists[m, row, col] == (inside and passable[a] and passable[row, col])
            assert moves_along([a, (row, col)]) == m
    assert MOVES[MOVE_NAMES.index("se")] == (1, 1)  # rows go south


def test_bounds_of_a_path():
    maps, path = RNG.random((3, 8, 4, 5, 2)), [(3, 0), (2, 1), (2, 2), (3, 2)]
    found = along(maps, path)
    for k, (move, cell) in enumerate(zip(("ne", "e", "s"), path[1:], strict=True)):
        np.testing.assert_array_equal(found[:, k], maps[:, MOVE_NAMES.index(move), *cell])
    with pytest.raises(TrustboError, match=r"no bound leads from \(0, 0\) to \(0, 2\)"):
        moves_along([(0, 0), (0, 2)])


@pytest.mark.parametrize("of_bounds", [False, True])
def test_a_workspace_of_arrays_has_awareness_of_the_bounds_that_exist(of_bounds):
    z = RNG.random((2, 8, 3, 4, 2) if of_bounds else (2, 3, 4, 2))
    passable = np.ones((3, 4), bool)
    passable[0, 0] = False
    ws = Workspace.from_awareness(z, passable)
    assert ws.awareness.dims == ("robot", "move", "row", "col", "feature")
    exists = existing_bounds(passable)
    for m, row, col in np.ndindex(8, 3, 4):
        expected = z[:, m, row, col] if of_bounds else z[:, row, col]
        found = ws.awareness.values[:, m, row, col]
        np.testing.assert_array_equal(found, expected if exists[m, row, col] else np.nan)


def test_a_bound_without_awareness_is_named():
    z = RNG.random((2, 8, 3, 4, 2))
    z[1, MOVE_NAMES.index("n"), 1, 2, 0] = np.nan
    with pytest.raises(TrustboError, match=r"bound \(2, 2\) -> \(1, 2\) is NaN"):
        Workspace.from_awareness(z)
