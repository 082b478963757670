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
    for m, (down, right) in enumerate(MOVES[8]):
        for row, col in np.ndindex(4, 5):
            a = row - down, col - right
            inside = 0 <= a[0] < 4 and 0 <= a[1] < 5
            assert exists[m, row, col] == (inside and passable[a] and passable[row, col])
            assert moves_along([a, (row, col)]) == m
    assert MOVES[8][MOVE_NAMES.index("se")] == (1, 1)  # rows go south


def test_bounds_of_a_path():
    maps, path = RNG.random((3, 8, 4, 5, 2)), [(3, 0), (2, 1), (2, 2), (3, 2)]
    found = along(maps, path)
    for k, (move, cell) in enumerate(zip(("ne", "e", "s"), path[1:], strict=True)):
        np.testing.assert_array_equal(found[:, k], maps[:, MOVE_NAMES.index(move), *cell])
    np.testing.assert_array_equal(along(maps[:, :1], path)[:, 0], maps[:, 0, 2, 1])
    with pytest.raises(TrustboError, match=r"no bound leads from \(0, 0\) to \(0, 2\)"):
        moves_along([(0, 0), (0, 2)])


def test_a_workspace_of_bounds():
    z = RNG.random((2, 8, 3, 4, 2))
    passable = np.ones((3, 4), bool)
    passable[0, 0] = False
    ws = Workspace.from_awareness(z, passable)
    exists = existing_bounds(passable)
    inside = ws.bound_awareness.sel(move="w").values[:, exists[MOVE_NAMES.index("w")]]
    np.testing.assert_array_equal(inside, z[:, MOVE_NAMES.index("w"), exists[3]])
    assert np.isnan(ws.bound_awareness.values[:, ~exists]).all()
    into = [z[1, m, 2, 3] for m in range(8) if exists[m, 2, 3]]
    np.testing.assert_allclose(ws.awareness.values[1, 2, 3], np.mean(into, axis=0), rtol=1e-15)
    assert np.isnan(ws.awareness.values[:, 0, 0]).all()
    assert ws.bound_maps.shape == (2, 8, 3, 4, 2)


def test_awareness_of_cells_is_met_by_every_move():
    z = RNG.random((2, 3, 4, 2))
    ws = Workspace.from_awareness(z)
    assert ws.bound_awareness.dims == ("robot", "move", "row", "col", "feature")
    np.testing.assert_array_equal(ws.bound_awareness.sel(move="n"), z)
    assert ws.bound_maps.shape == (2, 1, 3, 4, 2)


def test_a_bound_without_awareness_is_named():
    z = RNG.random((2, 8, 3, 4, 2))
    z[1, MOVE_NAMES.index("n"), 1, 2, 0] = np.nan
    with pytest.raises(TrustboError, match=r"bound \(2, 2\) -> \(1, 2\) is NaN"):
        Workspace.from_awareness(z)
