"""Passable bounds: the labelling of regions against the search of routes, and who goes by it."""

import networkx as nx
import numpy as np
import pytest

import trustbo as tb
from trustbo.workspace.moves import MOVES, existing_bounds
from trustbo.workspace.routes import linked_to


def walled(gap=None, side=60, shape=(3, 3)):
    """Workspace of flat ground behind a wall in the middle of column 1, with a gap in some rows."""
    dem = np.zeros((side, side))
    wall = np.ones(side, bool)
    if gap is not None:
        wall[gap] = False
    dem[wall, side // 2] = 30.0
    terrain = tb.terrain.synthetic_terrain((side, side), resolution=1.0, seed=0)
    terrain["dem"].values[:] = dem
    terrain["dsm"].values[:] = dem
    return tb.Workspace.from_terrain(terrain, shape, sight=tb.workspace.Sight(0.0))


def test_a_seam_of_missing_pixels_is_named_where_no_path_exists():
    terrain = tb.terrain.synthetic_terrain((60.0, 60.0), seed=0, relief=1.0)
    for name in ("dem", "dsm"):
        terrain[name].values[:, 30] = np.nan
    seam = tb.Workspace.from_terrain(terrain, (2, 2))
    with pytest.raises(tb.planning.NoPathError, match="missing"):
        tb.planning.Planner(seam, (0, 0), (0, 1))
    with pytest.raises(tb.planning.NoPathError) as caught:
        tb.planning.Planner(walled(shape=(2, 2)), (0, 0), (0, 1))
    assert "missing" not in str(caught.value)


def test_linked_pixels_are_those_of_networkx():
    rng = np.random.default_rng(0)
    for _ in range(40):
        passable = rng.random((12, 14)) < 0.6
        top, left = rng.integers(0, 4, 2)
        window = (int(top), int(top) + 8, int(left), int(left) + 9)
        graph = nx.grid_2d_graph(12, 14)
        closed = [
            (i, j) for i, j in graph if not passable[i, j]
            or not (window[0] <= i < window[1] and window[2] <= j < window[3])
        ]  # fmt: skip
        graph.remove_nodes_from(closed)
        a = int(top + rng.integers(8)), int(left + rng.integers(8))
        mask = linked_to(passable, window, a)
        cells = {(int(i) + top, int(j) + left) for i, j in np.argwhere(mask)}
        assert cells == (nx.node_connected_component(graph, a) if a in graph else set())


def test_a_bound_is_passable_if_and_only_if_all_its_ways_exist():
    workspace = walled(slice(6, 9))
    passable = workspace.passable_bounds.values
    exists = existing_bounds(workspace.passable.values)
    assert (passable <= exists).all()
    assert 0 < passable.sum() < exists.sum()
    posts = workspace.posts
    for m, row, col in np.argwhere(exists).tolist():
        a = row - MOVES[m][0], col - MOVES[m][1]
        ahead = [c for c in np.ndindex(3, 3) if max(abs(c[0] - row), abs(c[1] - col)) == 1]
        ways = [way for c in (None, *ahead) for way in posts.bound_routes(a, (row, col), c)]
        assert {way is not None for way in ways} == {bool(passable[m, row, col])}


def test_a_bound_and_its_reverse_are_both_passable_or_neither():
    passable = walled(slice(6, 9)).passable_bounds.values
    for m, row, col in np.argwhere(passable).tolist():
        assert passable[7 - m, row - MOVES[m][0], col - MOVES[m][1]]


def test_without_a_terrain_every_bound_between_passable_cells_is_passable():
    passable = np.array([[True, True], [False, True]])
    workspace = tb.Workspace.from_awareness(np.full((1, 2, 2, 1), 0.5), passable)
    np.testing.assert_array_equal(workspace.passable_bounds.values, existing_bounds(passable))
