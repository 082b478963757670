"""Bounds that no path may take: every engine against every path that takes none, written out."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from references import of_bounds, path_values, walks

from trustbo.errors import TrustboError
from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.planning.path_sampling import path_sampler
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, existing_bounds, moves_along

OBJECTIVES = ("lost_contact", "terminal", "mean", "success", "bottleneck", "stationary")
N, ENDS = 4, ((3, 0), (0, 3))


def closed_map(seed, connectivity):
    """A workspace, bounds that are closed, each direction for itself, and a way all the same."""
    rng = np.random.default_rng([seed, connectivity])
    z = rng.uniform(size=(1, 8, N, N, 2))
    workspace = Workspace.from_awareness(z)
    while True:
        closed = (rng.random((8, N, N)) < 0.35) & workspace.passable_bounds.values
        planner = Planner(workspace, *ENDS, connectivity=connectivity)
        if planner.avoiding(closed, np.zeros(closed.shape)).paths.avoided.sum() == closed.sum():
            return workspace, closed, rng


def open_paths(closed, longest, connectivity, **kind):
    paths = walks(np.ones((N, N), bool).tolist(), *ENDS, longest, connectivity, **kind)
    return [p for p in paths if not closed[moves_along(p), *np.array(p)[1:].T].any()]


def best_value(objective, paths, u, params):
    n_cells = np.array([len(path) for path in paths])
    flat = np.zeros((len(paths), n_cells.max()), int)
    for i, path in enumerate(paths):
        flat[i, : len(path)] = np.array(path) @ (N, 1)
    transition = np.array([[params.beta0]])
    return path_values(objective, flat, n_cells, of_bounds(u), transition, params.x0_mean).max()


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_every_engine_finds_the_best_of_the_paths_that_are_left(objective):
    for seed, connectivity in itertools.product(range(5), (4, 8)):
        workspace, closed, rng = closed_map(seed, connectivity)
        beta, b = rng.normal(size=2), rng.normal(-0.3, 0.5)
        params = TrustParams(0.6, beta, b, 0.1, 0.1)
        u = (workspace.bound_maps[0] @ beta + b)[None]
        exact_number = objective in ("success", "bottleneck")
        some = Planner(workspace, *ENDS, connectivity=connectivity)
        shortest = some.avoiding(closed, np.zeros(closed.shape)).shortest
        options = {"max_bounds": shortest + 1 if exact_number else "shortest+1"}
        kind = {"u_turns": exact_number}
        if objective == "stationary":
            options, kind = {}, {"simple": True}
        longest = 6 if objective == "stationary" else shortest + 1
        paths = open_paths(closed, longest, connectivity, **kind)
        expected = best_value(objective, paths, u, params)
        for engine in ("networkx", "numba"):
            planner = Planner(
                workspace, *ENDS, objective, connectivity=connectivity, engine=engine, **options
            ).avoiding(closed, np.zeros(closed.shape))
            plan = planner.plan(params)
            assert not closed[moves_along(plan.path), *np.array(plan.path)[1:].T].any()
            if objective == "stationary" and len(plan.path) > longest + 1:
                continue  # longer than what was written out, hence better
            np.testing.assert_allclose(plan.value, expected, rtol=1e-9)


def test_the_trust_map_goes_by_the_paths_that_are_left():
    workspace, closed, rng = closed_map(3, 8)
    params = TrustParams(0.6, rng.normal(size=2), -0.2, 0.1, 0.1)
    planner = Planner(workspace, *ENDS, "terminal", max_bounds="shortest+1")
    planner = planner.avoiding(closed, np.zeros(closed.shape))
    found = planner.trust_map(params)
    assert float(found[ENDS[1]]) == pytest.approx(planner.plan(params).trust[-1, 0], rel=1e-12)


def test_random_paths_take_none_of_the_closed_bounds():
    workspace, closed, rng = closed_map(1, 8)
    paths = Planner(workspace, *ENDS).avoiding(closed, np.zeros(closed.shape)).paths
    draw = path_sampler(paths).draw
    for _ in range(50):
        path = draw(rng)
        assert not closed[moves_along(path), *np.array(path)[1:].T].any()


def test_a_planner_takes_only_bounds_that_are_passable():
    """A wall between columns 1 and 2 that closes no cell, with one bound through it."""
    workspace = Workspace.from_awareness(np.full((1, 3, 4, 1), 0.5))
    passable = existing_bounds(np.ones((3, 4), bool))
    for m, (_, right) in enumerate(MOVES[8]):
        for row in range(3):
            if right and (m, row) not in ((4, 2), (3, 2)):
                passable[m, row, 2 if right > 0 else 1] = False
    held = replace(workspace)
    held.__dict__["passable_bounds"] = xr.DataArray(passable, dims=("move", "row", "col"))
    plan = Planner(held, (0, 0), (0, 3)).plan(TrustParams(0.5, np.array([1.0]), 0.0, 0.1, 0.1))
    assert ((2, 1), (2, 2)) in itertools.pairwise(plan.path)
    with pytest.raises(TrustboError, match=r"no bound leads from \(0, 1\) to \(0, 2\)"):
        Planner(held, (0, 0), (0, 3)).require_path(((0, 0), (0, 1), (0, 2), (0, 3)))


def test_bounds_of_the_least_risk_are_taken_back_where_there_is_no_other_way():
    workspace = Workspace.from_awareness(np.full((1, 1, 3, 1), 0.5))
    planner = Planner(workspace, (0, 0), (0, 2))
    closed, risk = np.zeros((8, 1, 3), bool), np.zeros((8, 1, 3))
    closed[4] = True
    risk[4, 0] = 0.0, 0.4, 0.9
    kept = planner.avoiding(closed, risk).paths
    assert kept.avoided.sum() == 0  # both are needed
    closed[3] = True  # not needed, and stays away
    risk[3] = 0.95
    assert planner.avoiding(closed, risk).paths.bounds[3].sum() == 0
