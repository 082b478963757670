"""Grids unrolled over the bounds left, and sums along them, against every walk written out."""

import numpy as np
import pytest
from references import walks
from scipy.sparse.csgraph import shortest_path

from trustbo.planning.search.layers import Weights, best_additive, build_layers
from trustbo.workspace.moves import MOVES

STEPS = np.array(MOVES[8])
N_ROWS, N_COLS, LONGEST = 3, 4, 5
START, GOAL = (2, 0), (0, 3)


def fewest_bounds(passable, end):
    """Fewest bounds between a cell and all others, (row, col), -1 where there is no way."""
    cells = np.argwhere(passable)
    near = np.abs(cells[:, None] - cells).max(2) == 1
    fewest = np.full(passable.shape, -1)
    lengths = shortest_path(near, unweighted=True)[cells.tolist().index(list(end))]
    fewest[tuple(cells.T)] = np.where(np.isfinite(lengths), lengths, -1)
    return fewest


@pytest.mark.parametrize("u_turns", [True, False])
def test_the_best_sum_of_every_draw_is_that_of_all_walks(u_turns):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        passable = rng.uniform(size=(N_ROWS, N_COLS)) > 0.15
        passable[START] = passable[GOAL] = True
        to_goal, from_start = fewest_bounds(passable, GOAL), fewest_bounds(passable, START)
        paths = list(walks(passable.tolist(), START, GOAL, LONGEST, u_turns=u_turns))
        if not paths:
            continue
        layers = build_layers(to_goal, from_start, STEPS, LONGEST, u_turns)
        drift = rng.normal(size=(3, 2, 8 if seed % 2 else 1, N_ROWS * N_COLS))
        weights = Weights(
            rng.normal(size=(3, LONGEST + 1, 2)),
            rng.normal(size=(3, LONGEST + 1)),
            np.maximum(1.0, np.arange(LONGEST + 1.0)),
        )
        # Tolls of moves, or of moves into cells.
        tolls = rng.uniform(size=(8, (1, N_ROWS * N_COLS)[seed // 2 % 2]))
        scores, found = best_additive(layers, drift, weights, tolls, np.arange(1, LONGEST + 1))
        for d in range(3):
            values = {path: score(path, drift[d], weights, d, tolls) for path in paths}
            best = max(values.values())
            np.testing.assert_allclose(scores[d], best, rtol=1e-12)
            cells = found[d][found[d] >= 0]
            path = tuple(zip(*(i.tolist() for i in np.divmod(cells, N_COLS)), strict=True))
            np.testing.assert_allclose(values[path], best, rtol=1e-12)


def score(path, drift, weights, d, tolls):
    """(constant + sum of weights times u less tolls) / scale, bound by bound."""
    n, total = len(path) - 1, weights.constant[d, len(path) - 1]
    for k in range(n):
        m = STEPS.tolist().index([path[k + 1][0] - path[k][0], path[k + 1][1] - path[k][1]])
        entered = path[k + 1][0] * N_COLS + path[k + 1][1]
        u = drift[:, m if drift.shape[1] > 1 else 0, entered]
        toll = tolls[m, entered if tolls.shape[1] > 1 else 0]
        total += weights.per_bound[d, n - 1 - k] @ u - toll
    return total / weights.scale[n]


def test_every_node_of_the_layers_is_on_a_path_and_edges_leave_one_bound_less():
    passable = np.ones((N_ROWS, N_COLS), bool)
    layers = build_layers(
        fewest_bounds(passable, GOAL), fewest_bounds(passable, START), STEPS, LONGEST, False
    )
    tail = np.repeat(np.arange(len(layers.rank)), np.diff(layers.first))
    assert (layers.rank[tail] - 1 == layers.rank[layers.head]).all()
    assert set(layers.head.tolist()) | set(layers.starts[layers.starts >= 0].tolist()) == set(
        range(len(layers.rank))
    )
    assert (np.diff(layers.rank) >= 0).all()
    assert layers.cell[0] == GOAL[0] * N_COLS + GOAL[1]
