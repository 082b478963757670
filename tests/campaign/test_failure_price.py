"""A failure is priced from the first one on that was recorded, or as the user says."""

import pytest

import trustbo as tb


def price(campaign):
    return campaign.planner_now().problem.failure_cost


@pytest.fixture(scope="module")
def workspace():
    terrain = tb.terrain.synthetic_terrain(size=(150.0, 150.0), resolution=2.0, seed=3)
    return tb.Workspace.from_terrain(terrain, (5, 5))


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
