"""Trust maps against all paths to each cell, and the cost map of the paper."""

import numpy as np
import pytest
from dense_statespace import trust_of_params
from enumeration import paths_of

from trustbo.inference import sample_prior
from trustbo.models import HierarchicalTrust, PooledTrust
from trustbo.planning import Planner
from trustbo.workspace import Workspace

ENDS = (3, 0), (0, 3)


@pytest.fixture
def workspace():
    passable = np.ones((4, 4), bool)
    passable[1, 1] = False
    z = np.random.default_rng(3).uniform(size=(2, 8, 4, 4, 2))
    return Workspace.from_awareness(z, passable)


@pytest.mark.parametrize("model", [PooledTrust(), HierarchicalTrust()])
def test_a_trust_map_is_the_best_of_all_paths_to_each_cell(workspace, model):
    draws = sample_prior(model, 2, 3, seed=4, n_robots=2)
    planner = Planner(workspace, *ENDS)
    maps, by_robot = planner.trust_map(draws), planner.trust_map(draws, per_robot=True)
    assert maps.dims == ("draw", "row", "col")
    assert by_robot.dims == ("draw", "robot", "row", "col")
    for row, col in np.argwhere(workspace.passable.values).tolist():
        if (row, col) == planner.start:
            continue
        nearest = int(planner.problem.paths.to((row, col), 0).longest)
        paths = paths_of(planner, (row, col), longest=nearest + 2)
        last = np.stack(  # (path, draw, robot)
            [trust_of_params(draws, workspace.along(path))[:, -1] for path in paths]
        )
        np.testing.assert_allclose(maps[:, row, col], last.mean(-1).max(0), rtol=1e-12)
        np.testing.assert_allclose(by_robot[:, :, row, col], last.max(0), rtol=1e-12)
    assert np.isnan(maps[:, 1, 1]).all()


@pytest.mark.parametrize("beta0", [0.4, -0.6])
def test_the_trust_of_the_goal_is_that_of_the_terminal_plan(workspace, beta0):
    params = sample_prior(PooledTrust(), 2, 1, seed=1).draw(0).replace(beta0=beta0)
    planner = Planner(workspace, *ENDS, "terminal")
    closed = np.random.default_rng(5).uniform(size=(8, 4, 4)) < 0.2
    planner = planner.avoiding(closed, np.zeros((8, 4, 4)))
    last = planner.plan(params).trust[-1].mean()
    assert float(planner.trust_map(params)[ENDS[1]]) == pytest.approx(last, rel=1e-12)


@pytest.mark.parametrize("model", [PooledTrust(), HierarchicalTrust()])
def test_the_summary_and_the_cost_are_on_the_paths_that_are_best_in_the_mean(workspace, model):
    draws = sample_prior(model, 2, 20, seed=1, n_robots=2)
    planner = Planner(workspace, *ENDS)
    summary = planner.maps(draws)
    for row, col in np.argwhere(workspace.passable.values).tolist():
        if (row, col) == planner.start:
            continue
        nearest = int(planner.problem.paths.to((row, col), 0).longest)
        zs = [workspace.along(path)
              for path in paths_of(planner, (row, col), longest=nearest + 2)]  # fmt: skip
        of_mean = [trust_of_params(draws.mean(), z)[..., -1, :].mean() for z in zs]
        trust = trust_of_params(draws, zs[int(np.argmax(of_mean))])[:, -1].mean(-1)
        assert summary["trust_mean"].values[row, col] == pytest.approx(trust.mean(), rel=1e-9)
        assert summary["trust_sd"].values[row, col] == pytest.approx(trust.std(), rel=1e-7)
        cost = (1.0 / (1.0 + np.exp(trust))).mean()
        assert summary["cost"].values[row, col] == pytest.approx(cost, rel=1e-9)


def test_the_cost_of_a_draw_is_that_of_its_map(workspace):
    draws = sample_prior(PooledTrust(), 2, 50, seed=1)
    planner = Planner(workspace, *ENDS)
    cost = planner.cost_map(draws.draw(0))
    np.testing.assert_allclose(cost, 1.0 / (1.0 + np.exp(planner.trust_map(draws.draw(0)))))


def test_draws_of_several_chains_are_mapped_like_one_axis_of_draws(workspace):
    draws = sample_prior(PooledTrust(), 2, 6, seed=1)
    of_chains = {name: v.reshape(2, 3, *v.shape[1:]) for name, v in draws.values.items()}
    chains = draws.replace(**of_chains)
    planner = Planner(workspace, *ENDS)
    np.testing.assert_array_equal(planner.trust_map(chains), planner.trust_map(draws))
