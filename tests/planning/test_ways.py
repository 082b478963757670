"""Ways: none is beaten, and none is missing that is the best in one respect; by enumeration."""

import numpy as np
import pytest
from enumeration import paths_of
from worlds import hillside

import trustbo as tb
from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.planning.ways import MOST, ways_of
from trustbo.workspace.moves import possible_next

ENDS = (2, 0), (0, 3)


def random_problem(rng):
    """Planner and parameters; each bound has a random awareness and failure probability."""
    z = rng.uniform(size=(2, 8, 3, 4, 2))
    workspace = tb.Workspace.from_awareness(z, cell_size=float(rng.choice([10.0, 50.0])))
    beta = rng.uniform(0.0, 0.5, 2)
    params = TrustParams(beta0=rng.uniform(0.1, 0.6), beta=beta, b=0.1, delta_w=0.02, delta_v=0.05)
    planner = Planner(workspace, *ENDS, max_bounds="shortest+2")
    exists = possible_next(workspace.passable_bounds.values)
    p_fail = np.where(exists, rng.beta(0.4, 6.0, exists.shape), np.nan)
    return planner.with_risk(p_fail), params


def numbers_of(planner, params, path):
    """Contact lost, failure probability and length of a path."""
    free = planner.with_failure_cost(0.0).evaluate(path, params)
    return -free.value, 1.0 - free.risk.p_arrive, free.length


@pytest.mark.parametrize("seed", range(100))
def test_no_path_beats_a_way_and_the_best_in_each_respect_are_listed(seed):
    planner, params = random_problem(np.random.default_rng(seed))
    ways = ways_of(planner, params)
    assert 1 <= len(ways) <= MOST
    every = np.array([numbers_of(planner, params, path) for path in paths_of(planner)])
    for plan, numbers in zip(ways.plans, ways.numbers, strict=True):
        np.testing.assert_allclose(numbers, numbers_of(planner, params, plan.stations), atol=1e-9)
        beats = (every <= numbers + 1e-9).all(1) & (every < numbers - 1e-6).any(1)
        assert not beats.any(), every[beats]
    np.testing.assert_allclose(ways.numbers.min(0), every.min(0), atol=1e-4)
    assert (np.diff(ways.numbers[:, 0]) >= 0.0).all()


def test_a_campaign_lists_ways_with_their_parts_and_names():
    workspace = tb.Workspace.from_terrain(hillside(90.0, 120.0), (3, 4))
    campaign = tb.Campaign(workspace, progress=False)
    ways = campaign.ways((2, 0), (0, 3))
    table = ways.to_frame()
    named = ", ".join(table["name"])
    assert all(name in named for name in ("best contact", "safest", "shortest"))
    recommended = campaign.recommend((2, 0), (0, 3))
    assert table["price"].min() == pytest.approx(-recommended.value)
    assert "way 0" in repr(ways)
    assert campaign.suggest(ways[0].stations).path == ways[0].path


def test_ways_of_another_objective_are_refused():
    planner, params = random_problem(np.random.default_rng(0))
    other = Planner(planner.workspace, *ENDS, "mean")
    with pytest.raises(tb.TrustboError, match="lost_contact"):
        ways_of(other, params)


def test_the_value_of_a_plan_is_the_sum_of_its_parts():
    planner, params = random_problem(np.random.default_rng(3))
    plan = planner.with_failure_cost(4.0).plan(params)
    lost, p_fail, _ = numbers_of(planner, params, plan.stations)
    assert plan.contact_lost == pytest.approx(lost)
    assert plan.price_of_failure == pytest.approx(4.0 * p_fail)
    assert "price of failure" in repr(plan)
    terminal = Planner(planner.workspace, *ENDS, objective="terminal").plan(params)
    assert terminal.contact_lost is None
    assert "parts" not in repr(terminal)


def test_the_recommended_way_is_listed_with_any_cost_of_failure_and_any_number_of_ways():
    planner, params = random_problem(np.random.default_rng(8))
    for cost in (0.0, 2.7, 40.0):
        priced = planner.with_failure_cost(cost)
        table = ways_of(priced, params, most=1).to_frame()
        (named,) = table[table["name"].str.contains("recommended")]["price"]
        assert named == pytest.approx(-priced.plan(params).value, abs=1e-4)


def test_a_slope_limit_two_degrees_lower_is_that_of_a_margin_two_degrees_larger():
    """A way that is as steep as the stated limit gains most from two degrees more."""
    workspace = tb.Workspace.from_terrain(hillside(90.0, 120.0), (3, 4))
    campaign = tb.Campaign(workspace, progress=False)
    table = campaign.limits((2, 0), (0, 3))
    assert table.index.tolist() == [-2.0, 0.0, 2.0]
    assert (np.diff(table["value"]) >= 0.0).all()

    hazard = campaign.hazard
    shifted = hazard.assign(margin=hazard["margin"] + 2.0)
    risk = tb.hazard.BoundRisk(shifted, workspace)
    plan = Planner(workspace, (2, 0), (0, 3)).with_risk(risk).plan(campaign.belief.mean())
    assert table.loc[-2.0, "value"] == pytest.approx(plan.value)
    assert table.loc[-2.0, "contact_lost"] == pytest.approx(plan.contact_lost)
    with pytest.raises(tb.TrustboError, match="degrees"):
        campaign.limits((2, 0), (0, 3), degrees=0.0)
