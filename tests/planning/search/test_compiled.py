"""The compiled engines on maps too large to enumerate, and what they say of their exactness."""

import networkx as nx
import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from trustbo.errors import TrustboError
from trustbo.inference import sample_prior
from trustbo.models import CoupledParams, PooledTrust, RobotParams, TrustParams
from trustbo.planning import Planner
from trustbo.planning.search.buckets import best_stationary
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES

OBJECTIVES = ("lost_contact", "terminal", "mean", "success", "bottleneck", "stationary")


def random_workspace(seed, n=9, n_robots=2):
    rng = np.random.default_rng(seed)
    passable = rng.uniform(size=(n, n)) > 0.12
    passable[-1, 0] = passable[0, -1] = True
    return Workspace.from_awareness(rng.uniform(size=(n_robots, n, n, 2)), passable)


def random_params(model, seed, n_robots=2):
    rng = np.random.default_rng(seed)
    if model == "pooled":
        return TrustParams(rng.uniform(0.1, 0.95), rng.normal(size=2), -0.2, 0.1, 0.1)
    beta = rng.normal(size=(n_robots, 2))
    b, sd = rng.normal(-0.3, 0.3, n_robots), np.full(n_robots, 0.1)
    if model == "hierarchical":
        return RobotParams(rng.uniform(0.3, 0.9, n_robots), beta, b, sd, sd)
    B0 = np.diag(rng.uniform(0.3, 0.9, n_robots)) + rng.normal(0.0, 0.08, (n_robots, n_robots))
    return CoupledParams(B0, rng.normal(size=(2, n_robots, n_robots)), b, *[np.eye(n_robots)] * 2)


def planners(objective, seed, **options):
    workspace = random_workspace(seed)
    n = len(workspace.passable)
    ends = (workspace, (n - 1, 0), (0, n - 1), objective)
    return [Planner(*ends, engine=engine, **options) for engine in ("networkx", "numba")]


@pytest.mark.parametrize("model", ["pooled", "hierarchical", "coupled"])
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_engines_agree_cell_by_cell_on_larger_maps(objective, model):
    for seed in range(3):
        params = random_params(model, seed)
        cap = {"max_bounds": 11} if objective in ("success", "bottleneck") else {}
        plans = [planner.plan(params) for planner in planners(objective, seed, **cap)]
        assert [plan.engine for plan in plans] == ["networkx", "numba"]
        assert plans[0].exact
        assert plans[1].exact
        np.testing.assert_allclose(plans[0].value, plans[1].value, rtol=1e-12)
        assert plans[0].path == plans[1].path or objective == "bottleneck"


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_all_draws_at_once_are_each_draw_by_itself(objective):
    draws = sample_prior(PooledTrust(), 2, 30, seed=1)
    one, many = planners(objective, 5, max_bounds=None)
    drawn = many.plan_draws(draws)
    assert drawn.paths.dtype.kind == "i"
    for d in range(30):
        alone = one.plan(draws.draw(d))
        np.testing.assert_allclose(drawn.values[d], alone.value, rtol=1e-9)
    reference = one.plan_draws(draws, n_draws=6, seed=3)
    compiled = many.plan_draws(draws, n_draws=6, seed=3)
    assert reference.chosen.tolist() == compiled.chosen.tolist()
    np.testing.assert_allclose(reference.values, compiled.values, rtol=1e-9)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_plans_are_compiled_unless_networkx_is_asked_for(objective):
    for n in (5, 11):
        planner = Planner(random_workspace(0, n), (n - 1, 0), (0, n - 1), objective)
        assert planner.plan(random_params("pooled", 0)).engine == "numba"
    ends = random_workspace(0, 5), (4, 0), (0, 4), objective
    plan = Planner(*ends, engine="networkx").plan(random_params("pooled", 0))
    assert plan.engine == "networkx"


def test_an_unknown_engine_is_refused():
    with pytest.raises(TrustboError, match="unknown engine 'gpu'; choose one of auto, networkx"):
        Planner(random_workspace(0), (8, 0), (0, 8), engine="gpu")


def grid_matrix(cost):
    """Edges of an 8-connected grid that cost what it costs to enter their heads."""
    rows, cols = cost.shape
    edges = []
    for r in range(rows):
        for c in range(cols):
            for down, right in MOVES[8]:
                i, j = r + down, c + right
                if 0 <= i < rows and 0 <= j < cols and np.isfinite(cost[i, j] + cost[r, c]):
                    edges.append((r * cols + c, i * cols + j, cost[i, j]))
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
            level.__getitem__, 1, passable, np.zeros(8), np.array(MOVES[8]), 0, 30 * 40 - 1
        )
        cost = np.where(passable, np.logaddexp(0.0, -level[0, 0]), np.inf)
        best = dijkstra(grid_matrix(cost), indices=0)[-1]
        np.testing.assert_allclose(totals[0], best, rtol=1e-12)
        if np.isfinite(best):
            np.testing.assert_allclose(cost.ravel()[paths[0, 1:]].sum(), best, rtol=1e-9)


def test_a_maze_s_path_is_found_by_many_draws_too():
    passable = np.ones((21, 9), bool)
    passable[1::4, :-1] = passable[3::4, 1:] = False
    workspace = Workspace.from_awareness(np.full((1, 21, 9, 2), 0.5), passable)
    planner = Planner(workspace, (0, 0), (20, 0), "stationary")
    drawn = planner.plan_draws(sample_prior(PooledTrust(), 2, 3, seed=0))
    fewest = nx.shortest_path_length(planner.graph, (0, 0), (20, 0))
    assert [len(path) - 1 for path in drawn.candidates] == [fewest]


def test_length_weights_are_for_additive_objectives_only():
    ends = (random_workspace(0), (8, 0), (0, 8))
    with pytest.raises(
        TrustboError, match="length_weight is for lost_contact, terminal, mean, stationary"
    ):
        Planner(*ends, "success", length_weight=0.01)
    with pytest.raises(TrustboError, match=r"length_weight must be finite and >= 0; got -1"):
        Planner(*ends, length_weight=-1.0)
