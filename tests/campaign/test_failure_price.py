"""A failure is priced from the first one on that was recorded, or as the user says."""

import numpy as np
import pytest

import trustbo as tb
from trustbo.workspace.moves import moves_along


def price(campaign):
    return campaign.planner_now().problem.failure_cost


@pytest.fixture(scope="module")
def workspace():
    terrain = tb.terrain.synthetic_terrain(size=(150.0, 150.0), resolution=2.0, seed=3)
    return tb.Workspace.from_terrain(terrain, (5, 5))


@pytest.fixture(scope="module")
def steep():
    """Ground of which many bounds are near the limit of 11 degrees."""
    robot = tb.Robot(max_slope=np.deg2rad(11.0))
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    team = tb.Team(robots=(robot,), lead=robot)
    return tb.Workspace.from_terrain(terrain, (5, 5), team, bounds=False)


def test_unpriced_plan_that_may_well_fail_warns_once_a_campaign(steep):
    campaign = tb.Campaign(steep, (4, 0), (0, 4))
    with pytest.warns(UserWarning, match="max_failure or failure_cost"):
        plan = campaign.ask()
    assert plan.p_arrive < 0.9
    campaign.suggest(plan.path)  # warnings are errors


def test_priced_plan_does_not_warn(steep):
    plan = tb.Campaign(steep, (4, 0), (0, 4), failure_cost=0.1).ask()
    assert plan.p_arrive < 0.9
    campaign = tb.Campaign(steep, (4, 0), (0, 4))
    with pytest.warns(UserWarning, match="costs nothing"):
        campaign.ask()
    campaign.fail("stuck", where=plan.path[1])
    campaign.ask()


def test_price_after_a_failure_is_joint_over_strata(steep):
    """F sum_m w_m (1 - prod (1 - p_m)), below that of the product of the means."""
    campaign = tb.Campaign(steep, (4, 0), (0, 4), failure_cost=8.0)
    plan = campaign.ask()
    campaign.fail("stuck", where=plan.path[1])
    problem, path = campaign.planner_now().problem, campaign.ask().path
    p, shares = campaign.risk.strata()
    rows, cols = np.array(path[1:]).T
    joint = 8.0 * shares @ (1.0 - np.prod(1.0 - p[:, moves_along(path), rows, cols], axis=1))
    assert problem.cost_of_failure(path) == pytest.approx(joint, rel=1e-12)
    assert joint < 8.0 * (1.0 - problem.risk.survival(path)) - 1e-3


def test_failure_is_priced_from_the_first_failure_on(workspace):
    campaign = tb.Campaign(workspace, (4, 0), (0, 4))
    assert price(campaign) == 0.0
    plan = campaign.ask()
    campaign.fail("stuck", where=plan.path[1])
    assert price(campaign) == campaign.planner.shortest


def test_lost_mission_without_a_place_counts_as_a_failure(workspace):
    campaign = tb.Campaign(workspace, (4, 0), (0, 4))
    campaign.ask()
    campaign.fail("tipped")
    assert price(campaign) == campaign.planner.shortest


def test_failure_cost_of_the_user_counts_before_any_failure(workspace):
    assert price(tb.Campaign(workspace, (4, 0), (0, 4), failure_cost=3.0)) == 3.0


def test_chance_to_arrive_and_max_failure_go_by_the_hazard_without_a_price(workspace):
    campaign = tb.Campaign(workspace, (4, 0), (0, 4), max_failure=0.5)
    planner = campaign.planner_now()
    plan = campaign.ask()
    assert plan.p_arrive == pytest.approx(planner.problem.risk.along(plan.path).p_arrive)
    assert planner.problem.is_within_risk(plan.path)
    assert planner.problem.risk_table is not None


def test_other_objectives_have_no_price(workspace):
    assert price(tb.Campaign(workspace, (4, 0), (0, 4), objective="mean")) == 0.0


def test_result_prices_failures_as_its_campaign_did(workspace):
    simulator = tb.simulation.KinematicSimulator(workspace)
    campaign = tb.Campaign(workspace, (4, 0), (0, 4), sampler="exact")
    campaign.tell(simulator.run(campaign.ask().path, seed=0))
    before = campaign.result()
    assert price(campaign) == before.planner.problem.failure_cost == 0.0
    assert before.plan.value == before.value

    plan = campaign.ask()
    campaign.fail("stuck", where=plan.path[1])
    campaign.tell(simulator.run(campaign.ask().path, seed=1))
    after = campaign.result()
    assert price(campaign) == after.planner.problem.failure_cost == campaign.planner.shortest
