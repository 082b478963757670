"""Failures count in plans for a posterior, or the planner says that they do not."""

import numpy as np
import pytest
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.planning import Planner

ENDS = ((3, 0), (0, 3))


@pytest.fixture(scope="module")
def campaign():
    workspace = random_cells()
    campaign = tb.Campaign(workspace, *ENDS, fit={"draws": 100}, progress=False)
    path = campaign.ask().path
    campaign.tell(ModelSimulator(workspace, fail_at=2).run(path, seed=0))
    return campaign


def test_a_planner_with_a_cost_of_failures_takes_the_risk_of_the_posterior(campaign):
    planner = Planner(campaign.workspace, *ENDS, failure_cost=9.0)
    plan = planner.plan(campaign.posterior)
    expected = planner.with_risk(campaign.risk).plan(campaign.posterior)
    assert plan.path == expected.path
    assert (plan.value, plan.p_arrive) == (expected.value, expected.p_arrive)
    assert plan.p_arrive < 1.0

    by_path = planner.evaluate(plan.path, campaign.posterior)
    np.testing.assert_array_equal(by_path.p_fail, expected.p_fail)


def test_a_limit_of_failure_takes_the_risk_of_the_posterior(campaign):
    plan = Planner(campaign.workspace, *ENDS, max_failure=0.99).plan(campaign.posterior)
    assert plan.p_arrive is not None


def test_a_planner_says_that_a_cost_of_failures_has_no_effect(campaign):
    posterior = campaign.posterior.copy()
    del posterior["hazard"]
    planner = Planner(campaign.workspace, *ENDS, failure_cost=9.0)
    with pytest.warns(UserWarning, match="failure_cost"):
        assert planner.plan(posterior).p_arrive is None


def test_failures_that_cost_nothing_are_not_read(campaign):
    planner = Planner(campaign.workspace, *ENDS, failure_cost=0.0)
    assert planner.plan(campaign.posterior).p_arrive is None
