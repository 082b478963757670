"""Dominance holds under every continuation, and the heuristic limits all of them: enumerated."""

import itertools

import numpy as np
import pytest

from trustbo.planning.dynamics import Dynamics
from trustbo.planning.search.dominance import build_heuristic, dominance_tests

LONGEST, N_CELLS, GOAL = 4, 5, 4


def random_dynamics(seed, n_states, *, mixed):
    """Trust of robots in five cells, all of which can follow each other; or of signs that mix."""
    rng = np.random.default_rng(seed)
    transition = rng.uniform(-0.5 if mixed else 0.0, 0.6, (n_states, n_states))
    drift = rng.normal(0.0, 0.5, (n_states, 1, 1, N_CELLS))
    drift[:, 0, 0, 2] = np.nan  # a cell that no path may enter
    views = rng.uniform(0.0, 1.0, (2, n_states))
    return Dynamics(transition, drift, rng.normal(size=n_states), views, np.array(0.1))


def least_views(dynamics, x, cells):
    """Trust of the team after each bound of a continuation."""
    trust = []
    for cell in cells:
        x = dynamics.transition @ x + dynamics.drift[:, 0, 0, cell]
        trust.append(float((dynamics.views @ x).min()))
    return trust


def continuations(longest):
    """All sequences of cells that end at the goal when they first enter it."""
    for n in range(longest):
        for cells in itertools.product((0, 1, 3), repeat=n):
            yield (*cells, GOAL)


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("n_states", [1, 2, 3])
def test_a_state_that_dominates_has_as_much_trust_on_every_continuation(n_states, mixed):
    n_dominating = 0
    for seed in range(20):
        dynamics = random_dynamics(seed, n_states, mixed=mixed)
        tests = dominance_tests(dynamics, LONGEST)
        a, b = np.random.default_rng(100 + seed).normal(size=(2, n_states))
        if not (tests @ (a - b) >= 0.0).all():
            continue
        n_dominating += 1
        for cells in continuations(LONGEST):
            better, worse = (least_views(dynamics, x, cells) for x in (a, b))
            assert all(x >= y - 1e-12 for x, y in zip(better, worse, strict=True))
    assert n_dominating >= 1


@pytest.mark.parametrize("at_goal", [False, True])
@pytest.mark.parametrize("mixed", [False, True])
def test_the_heuristic_limits_trust_after_every_number_of_bounds(mixed, at_goal):
    neighbours = np.array([[c for c in range(N_CELLS) if c != cell] for cell in range(N_CELLS)])
    neighbours[2] = -1
    for seed in range(5):
        dynamics = random_dynamics(seed, 2, mixed=mixed)
        limits = build_heuristic(dynamics, LONGEST, neighbours, GOAL, at_goal=at_goal)
        x, start = np.array([0.3, -0.2]), 0
        for cells in continuations(LONGEST):
            steps = (start, *cells)
            if any(a == b for a, b in itertools.pairwise(steps)):
                continue  # no cell is its neighbour
            trust = least_views(dynamics, x, cells)[-1]
            j = len(cells)
            upper = (limits.powers[:, j] @ x + limits.gains[:, j, start]).min()
            assert trust <= upper + 1e-12
