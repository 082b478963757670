"""The planner against every admissible path written out."""

from functools import cache

import numpy as np
import pytest
from references import path_value, walks

from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.planning.graph import NoPathError
from trustbo.workspace import Workspace

BETA0 = (-0.8, 0.0, 0.3, 0.7, 1.0, 1.3)


def random_case(seed, n=4, obstacles=0.15):
    """A random map with start and goal in opposite corners, connected or not."""
    rng = np.random.default_rng(seed)
    n_robots = int(rng.integers(1, 4))
    awareness = rng.uniform(size=(n_robots, n, n, 2))
    passable = rng.uniform(size=(n, n)) > obstacles
    passable[n - 1, 0] = passable[0, n - 1] = True
    beta, b = rng.normal(0.0, 1.0, 2), float(rng.normal(-0.3, 0.5))
    return awareness, passable, beta, b


@cache
def paths_of(seed, max_bounds):
    _, passable, _, _ = random_case(seed)
    n = len(passable)
    return list(walks(passable.tolist(), (n - 1, 0), (0, n - 1), max_bounds))


def drifts(awareness, beta, b):
    """u[i][cell], by the definition."""
    return [
        {
            (row, col): sum(w * z for w, z in zip(beta, cell, strict=True)) + b
            for row, line in enumerate(robot)
            for col, cell in enumerate(line)
        }
        for robot in awareness.tolist()
    ]


def best_by_enumeration(objective, beta0, max_bounds, seed):
    awareness, _, beta, b = random_case(seed)
    u = drifts(awareness, beta, b)
    return max(path_value(objective, p, u, beta0, 0.5) for p in paths_of(seed, max_bounds))


def make_planner(objective, connectivity, case, **options):
    awareness, passable, _, _ = case
    n = len(passable)
    workspace = Workspace.from_awareness(awareness, passable)
    return Planner(
        workspace, (n - 1, 0), (0, n - 1), objective, connectivity=connectivity, **options
    )


def make_params(beta0, case):
    return TrustParams(beta0, case[2], case[3], 0.1, 0.1)


@pytest.mark.parametrize("objective", ["terminal", "mean"])
@pytest.mark.parametrize("slack", [0, 2])
def test_additive_objectives_are_exact_over_shortest_paths_and_over_walks(objective, slack):
    for seed in range(6):
        case = random_case(seed)
        for beta0 in BETA0:
            planner = make_planner(objective, 8, case, max_bounds="shortest")
            cap = planner.shortest + slack
            if slack:
                planner = make_planner(objective, 8, case, max_bounds=cap)
            plan = planner.plan(make_params(beta0, case))
            best = best_by_enumeration(objective, beta0, cap, seed)
            np.testing.assert_allclose(plan.value, best, rtol=1e-9)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_paths_of_two_more_bounds_without_u_turns_are_simple(connectivity):
    for seed in range(30):
        case = random_case(seed)
        try:
            planner = make_planner("terminal", connectivity, case, max_bounds="shortest+2")
        except NoPathError:
            continue
        assert planner.plan(make_params(0.95, case)).revisits == 0


def test_the_trust_map_is_the_best_terminal_trust_of_every_cell():
    for seed in range(3):
        case = random_case(seed)
        awareness, passable, beta, b = case
        u = drifts(awareness, beta, b)
        for beta0 in BETA0:
            for slack, max_bounds in ((0, "shortest"), (2, "shortest+2")):
                planner = make_planner("terminal", 8, case, max_bounds=max_bounds)
                trust = planner.trust_map(make_params(beta0, case))
                robots = planner.trust_map(make_params(beta0, case), per_robot=True)
                for goal in planner.graph:
                    if goal == (3, 0):
                        continue
                    fewest = min(
                        len(p) - 1 for p in walks(passable.tolist(), (3, 0), goal, 4, simple=True)
                    )
                    paths = list(
                        walks(passable.tolist(), (3, 0), goal, fewest + slack, u_turns=False)
                    )
                    best = max(path_value("terminal", p, u, beta0, 0.5) for p in paths)
                    value = 1.0 / (1.0 + np.exp(-trust.values[goal]))
                    np.testing.assert_allclose(value, best, rtol=1e-9)
                    alone = max(path_value("terminal", p, u[:1], beta0, 0.5) for p in paths)
                    value = 1.0 / (1.0 + np.exp(-robots.values[0][goal]))
                    np.testing.assert_allclose(value, alone, rtol=1e-9)
        assert np.isnan(trust.values[~passable]).all()
