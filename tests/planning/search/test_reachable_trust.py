"""The compiled trust map equals the best of all admissible paths, written out."""

import itertools

import numpy as np
import pytest

from trustbo.planning.graph import fewest_bounds
from trustbo.planning.search.reachable_trust import best_trust
from trustbo.workspace.moves import MOVES, existing_bounds, move_indices


def walks(shape, passable, start, moves, most):
    """All walks of at most `most` bounds without U-turns, as lists of cells."""
    stack = [[start]]
    while stack:
        walk = stack.pop()
        yield walk
        if len(walk) > most:
            continue
        for down, right in moves:
            cell = walk[-1][0] + down, walk[-1][1] + right
            inside = 0 <= cell[0] < shape[0] and 0 <= cell[1] < shape[1]
            if inside and passable[cell] and cell != start and cell != (walk[-2:] or [None])[0]:
                stack.append([*walk, cell])


@pytest.mark.parametrize(
    ("seed", "connectivity", "slack"), list(itertools.product(range(4), (4, 8), (0, 1, 2)))
)
def test_it_is_the_best_of_all_paths(seed, connectivity, slack):
    rng, shape = np.random.default_rng(seed), (3, 3)
    passable = rng.uniform(size=shape) < 0.85
    passable[start := (2, 0)] = True
    # Seed 0 has a drift for each cell, others for each bound.
    drift, x0 = (
        rng.normal(size=(3, len(MOVES[connectivity]) if seed else 1, *shape)),
        rng.normal(size=3),
    )
    beta0 = np.array([0.7, -0.9, 1.1])
    fewest = fewest_bounds(
        existing_bounds(passable)[move_indices(connectivity)], start, connectivity
    )
    moves = MOVES[connectivity]
    expected = np.full((3, *shape), np.nan)
    for walk in walks(shape, passable, start, moves, int(fewest.max()) + slack):
        cell, n = walk[-1], len(walk) - 1
        if n > fewest[cell] + slack:
            continue
        for d in range(3):
            trust = x0[d]
            for left, entered in itertools.pairwise(walk):
                step = entered[0] - left[0], entered[1] - left[1]
                m = moves.index(step) if seed else 0
                trust = beta0[d] * trust + drift[d, m, *entered]
            expected[d][cell] = np.fmax(expected[d][cell], trust)
    found = best_trust(drift, beta0, x0, fewest, np.array(moves), slack)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_many_draws_are_as_each_by_itself():
    rng, shape = np.random.default_rng(5), (6, 7)
    passable = rng.uniform(size=shape) < 0.8
    passable[5, 0] = True
    fewest, steps = fewest_bounds(existing_bounds(passable), (5, 0), 8), np.array(MOVES[8])
    drift, beta0, x0 = (
        rng.normal(size=(150, 1, *shape)),
        rng.uniform(-1, 1, 150),
        rng.normal(size=150),
    )
    together = best_trust(drift, beta0, x0, fewest, steps, 2)
    alone = [
        best_trust(drift[d : d + 1], beta0[d : d + 1], x0[d : d + 1], fewest, steps, 2)[0]
        for d in range(150)
    ]
    np.testing.assert_array_equal(together, alone)
