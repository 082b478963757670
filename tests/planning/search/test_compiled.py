"""The compiled engines on maps too large to enumerate, and what they say of their exactness."""

import numpy as np
import pytest

from trustbo.errors import TrustboError
from trustbo.inference import sample_prior
from trustbo.models import CoupledParams, PooledTrust, RobotParams, TrustParams
from trustbo.planning import Planner
from trustbo.workspace import Workspace

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
    for seed in range(2):
        params = random_params(model, seed)
        cap = {"max_bounds": 10} if objective in ("success", "bottleneck") else {}
        plans = [planner.plan(params) for planner in planners(objective, seed, **cap)]
        assert [plan.engine for plan in plans] == ["networkx", "numba"]
        assert plans[0].exact
        assert plans[1].exact
        np.testing.assert_allclose(plans[0].value, plans[1].value, rtol=1e-12)
        assert plans[0].path == plans[1].path or objective == "bottleneck"


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_all_draws_at_once_are_each_draw_by_itself(objective):
    draws = sample_prior(PooledTrust(), 2, 12, seed=1)
    one, many = planners(objective, 5, max_bounds=None)
    drawn = many.plan_draws(draws)
    assert drawn.paths.dtype.kind == "i"
    for d in range(12):
        alone = one.plan(draws.draw(d))
        np.testing.assert_allclose(drawn.values[d], alone.value, rtol=1e-9)
    reference = one.plan_draws(draws, n_draws=3, seed=3)
    compiled = many.plan_draws(draws, n_draws=3, seed=3)
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


@pytest.mark.parametrize("weight", ["length_weight", "unseen_cost"])
def test_a_toll_is_for_sums_over_bounds_only(weight):
    ends = (random_workspace(0), (8, 0), (0, 8))
    names = "lost_contact, terminal, mean, stationary, success; the objective is 'bottleneck'"
    with pytest.raises(TrustboError, match=f"{weight} is for {names}"):
        Planner(*ends, "bottleneck", **{weight: 0.01})
    with pytest.raises(TrustboError, match=rf"{weight} must be 0 or more, and finite; got -1"):
        Planner(*ends, **{weight: -1.0})


def test_the_time_unseen_costs_nothing_where_no_map_tells_it():
    workspace = random_workspace(0)
    with pytest.raises(TrustboError, match="unseen_cost needs the line of sight of a map"):
        Planner(workspace, (8, 0), (0, 8), unseen_cost=2.0)
    assert Planner(workspace, (8, 0), (0, 8), unseen_cost=0.0).problem.objective.unseen_cost == 0.0
