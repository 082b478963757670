"""Components of a posterior: optimal groups, and the chance that a path fails under them."""

import itertools

import numpy as np
import pytest

import trustbo as tb
from trustbo.hazard import Hazard
from trustbo.hazard.components import partition
from trustbo.hazard.given import GivenRisk
from trustbo.hazard.model import fit_hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import LostMission
from trustbo.workspace.moves import pairs_along


def squares(values, ends):
    groups = np.split(values, ends[:-1])
    return sum(((group - group.mean()) ** 2).sum() for group in groups)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_partition_has_the_least_squares_of_all_partitions(n):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        values = np.sort(rng.lognormal(0.0, 1.5, 11))
        ends = partition(values, n)
        assert len(ends) == n
        assert ends[-1] == 11
        cuts = itertools.combinations(range(1, 11), n - 1)
        least = min(squares(values, [*cut, 11]) for cut in cuts)
        np.testing.assert_allclose(squares(values, ends), least, rtol=1e-9, atol=1e-12)


def test_partition_of_equal_values_is_one_group():
    assert partition(np.full(7, 0.3), 5).tolist() == [7]


@pytest.fixture(scope="module")
def workspace():
    """Steep ground."""
    robot = tb.Robot(max_slope=np.deg2rad(11.0))
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    team = tb.Team(robots=(robot,), lead=robot)
    return tb.Workspace.from_terrain(terrain, (5, 5), team, bounds=False)


@pytest.fixture(scope="module")
def risk(workspace):
    """Risk after a failure, and a path."""
    path = [(4, 0), (3, 1), (2, 2), (1, 3), (0, 4)]
    lost = [LostMission(((4, 0), (3, 0), (2, 0)))]
    prior = Hazard(limit=(0.1, 4.0), log_width=(-1.2, 0.5))
    return BoundRisk(fit_hazard([], workspace, prior, lost=lost), workspace), path


def test_mean_over_strata_is_that_over_all_draws(risk):
    risk, _ = risk
    components = risk.components()
    assert len(components.weights) == 5
    np.testing.assert_allclose(components.weights.sum(), 1.0, rtol=1e-12)
    mean = np.tensordot(components.weights, components.p_fail, 1)
    np.testing.assert_allclose(mean, risk.mean, rtol=1e-9)
    severity = np.nanmean(components.p_fail.reshape(5, -1), axis=1)
    assert (np.diff(severity) > 0.0).all()


def test_few_strata_have_the_chance_to_fail_that_all_draws_have(risk):
    """Against 10 000 draws of the chances themselves; the product of means is far above."""
    risk, path = risk
    planner_risks = [GivenRisk(risk.mean, components=risk.components(n)) for n in (1, 5)]
    product, five = (of_path.failure(path) for of_path in planner_risks)
    index = pairs_along(path, 1).T
    drawn = 1.0 - np.prod(1.0 - risk.draw(10_000, seed=1)[:, *index], axis=1)
    assert abs(five - drawn.mean()) < 0.02
    assert product > drawn.mean() + 0.04
    of_bounds = planner_risks[0].along(path).p_fail
    np.testing.assert_allclose(product, 1.0 - np.prod(1.0 - of_bounds), rtol=1e-9)


def test_the_arrival_probability_is_that_of_many_draws(risk):
    """Also of a path that enters a bound twice, whose first pass is evidence for the second."""
    risk, path = risk
    for driven in (path, [*path[:3], *path[1:3], *path[3:]]):
        along = risk.along(driven)
        index = pairs_along(driven, 1).T
        drawn = np.prod(1.0 - risk.draw(10_000, seed=1)[:, *index], axis=1)
        # 5 standard errors; there are 1000 distinct hyperparameters.
        assert abs(along.p_arrive - drawn.mean()) < 5.0 * drawn.std() / np.sqrt(1000)
        np.testing.assert_allclose(along.p_arrive_band, np.quantile(drawn, (0.05, 0.95)), atol=0.06)
        np.testing.assert_allclose(along.p_fail, risk.mean[*index], rtol=1e-12)
    assert along.p_arrive > np.prod(1.0 - along.p_fail) + 0.01


def test_a_planner_searches_with_the_components_of_a_risk(workspace, risk):
    risk, path = risk
    planner = tb.Planner(workspace, path[0], path[-1], max_failure=0.9)
    own = planner.with_risk(risk).problem
    given = planner.with_risk(risk.mean, components=risk.components()).problem
    assert own.risk.failure(path) == given.risk.failure(path)
    np.testing.assert_array_equal(own.edge_risks.of_edges, given.edge_risks.of_edges)
