"""Cheapest paths by buckets: against SciPy's Dijkstra, and networkx."""

import networkx as nx
import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from trustbo.inference import sample_prior
from trustbo.models import PooledTrust
from trustbo.planning import Planner
from trustbo.planning.search.buckets import best_stationary
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES


def grid_matrix(cost, tolls=None):
    """Edges of an 8-connected grid: what it costs to enter their heads, and tolls (move, cell)."""
    tolls = np.zeros((8, cost.size)) if tolls is None else tolls
    rows, cols = cost.shape
    edges = []
    for r in range(rows):
        for c in range(cols):
            for m, (down, right) in enumerate(MOVES[8]):
                i, j = r + down, c + right
                if 0 <= i < rows and 0 <= j < cols and np.isfinite(cost[i, j] + cost[r, c]):
                    other = i * cols + j
                    edges.append((r * cols + c, other, cost[i, j] + tolls[m, other]))
    tail, head, weight = np.array(edges).T
    return csr_matrix((weight, (tail.astype(int), head.astype(int))), shape=(rows * cols,) * 2)


@pytest.mark.parametrize("spread", [0.1, 1.0, 6.0, 20.0])
def test_cheapest_paths_equal_scipy_s_however_uneven_the_costs(spread):
    # With a spread of 20 most cells cost less than 1e-6 of the dearest: the heap's share of work.
    for seed in range(4):
        rng = np.random.default_rng(seed)
        level = rng.normal(3.0, spread, (1, 1, 30, 40))
        passable = rng.uniform(size=(30, 40)) > 0.15
        passable[0, 0] = passable[29, 39] = True
        totals, paths = best_stationary(
            level.__getitem__, 1, passable, np.zeros((8, 1)), np.array(MOVES[8]), 0, 30 * 40 - 1
        )
        cost = np.where(passable, np.logaddexp(0.0, -level[0, 0]), np.inf)
        best = dijkstra(grid_matrix(cost), indices=0)[-1]
        np.testing.assert_allclose(totals[0], best, rtol=1e-12)
        if np.isfinite(best):
            np.testing.assert_allclose(cost.ravel()[paths[0, 1:]].sum(), best, rtol=1e-9)


@pytest.mark.parametrize("by_cell", [False, True])
def test_tolls_of_moves_and_of_bounds_are_paid_by_every_draw(by_cell):
    rng, passable = np.random.default_rng(5), np.ones((12, 15), bool)
    level = rng.normal(1.0, 1.0, (3, 1, *passable.shape))
    tolls = rng.uniform(size=(8, passable.size if by_cell else 1))
    totals, paths = best_stationary(
        level.__getitem__, 3, passable, tolls, np.array(MOVES[8]), 0, passable.size - 1
    )
    of_bounds = np.broadcast_to(tolls, (8, passable.size))
    for d in range(3):
        matrix = grid_matrix(np.logaddexp(0.0, -level[d, 0]), of_bounds)
        np.testing.assert_allclose(totals[d], dijkstra(matrix, indices=0)[-1], rtol=1e-12)
        path = paths[d][paths[d] >= 0]
        np.testing.assert_allclose(matrix[path[:-1], path[1:]].sum(), totals[d], rtol=1e-12)


def test_a_maze_s_path_is_found_by_many_draws_too():
    passable = np.ones((21, 9), bool)
    passable[1::4, :-1] = passable[3::4, 1:] = False
    workspace = Workspace.from_awareness(np.full((1, 21, 9, 2), 0.5), passable)
    planner = Planner(workspace, (0, 0), (20, 0), "stationary")
    drawn = planner.plan_draws(sample_prior(PooledTrust(), 2, 3, seed=0))
    fewest = nx.shortest_path_length(planner.graph, (0, 0), (20, 0))
    assert [len(path) - 1 for path in drawn.candidates] == [fewest]


def test_a_goal_behind_a_wall_has_no_path_and_costs_infinitely_much():
    passable = np.ones((4, 5), bool)
    passable[:, 2] = False
    totals, paths = best_stationary(
        np.zeros((2, 1, 4, 5)).__getitem__, 2, passable, np.zeros((8, 1)), np.array(MOVES[8]), 0, 19
    )
    assert totals.tolist() == [np.inf, np.inf]
    assert (paths == -1).all()
