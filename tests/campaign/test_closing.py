"""Closings of a campaign, and failures that say nothing about the slope."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from folders import begin
from worlds import ModelSimulator, hillside, random_cells

import trustbo as tb
from trustbo.campaign import closing

ENDS = (3, 0), (0, 3)
OPTIONS = {"sampler": "importance", "fit": {"draws": 50}, "progress": False}


@pytest.fixture
def ground():
    return random_cells()


@pytest.fixture
def campaign(ground):
    return tb.Campaign(ground, *ENDS, **OPTIONS)


def closed_in(plan):
    return set(plan.workspace.closed)


def test_plans_and_ways_go_around_until_it_is_reopened(campaign):
    usual = campaign.ask()
    assert campaign.close_off([usual.path[2]], "wreck", by="lead") == 1
    detour = campaign.ask()
    plans = [detour, campaign.plan(), *campaign.ways().plans, campaign.recommend()]
    assert all(usual.path[2] not in plan.path for plan in plans)
    assert campaign.ask() is detour
    with pytest.raises(tb.TrustboError, match="wreck"):
        campaign.suggest(usual.path)
    table = campaign.closings()
    assert table.loc[1, ["reason", "by", "over", "until"]].tolist() == ["wreck", "lead", "", ""]

    campaign.reopen(1, "towed away")
    assert campaign.closings()["over"].tolist() == ["towed away"]
    assert campaign.ask().path == usual.path == campaign.plan().path
    with pytest.raises(tb.TrustboError, match="towed away"):
        campaign.reopen(1, "again")


def test_a_plan_that_does_not_use_what_is_closed_remains(campaign):
    campaign.suggest([(3, 0), (2, 0), (1, 0), (0, 1), (0, 2), (0, 3)])
    plan = campaign.ask()
    campaign.close_off([(3, 3)], "mud")
    assert campaign.ask() is plan
    campaign.close_off([((1, 0), (2, 0))], "mud")  # against the direction of the plan
    assert campaign.ask().path != plan.path


def test_closings_end_at_a_time_or_with_a_mission(campaign, monkeypatch):
    path = campaign.ask().path
    begins = closing.now()
    campaign.close_off([path[2]], "wreck", until=begins + timedelta(hours=2))
    campaign.close_off([path[1]], "flood", until=2)
    assert {(path[1],), (path[2],)} == closed_in(campaign.ask())

    monkeypatch.setattr(closing, "now", lambda: begins + timedelta(hours=2, seconds=1))
    assert {(path[1],)} == closed_in(campaign.ask())
    simulator = ModelSimulator(campaign.workspace)
    campaign.tell(simulator.run(campaign.ask().path, seed=0))
    assert closed_in(campaign.ask()) == set()
    assert campaign.closings()["over"].ne("").all()
    assert closed_in(campaign.state.entries[0].plan) == {(path[1],)}


@pytest.mark.parametrize("until", ["2001-01-01", "Thursday", 1, 0, -3, 2.5, True, "3"])
def test_an_end_that_has_passed_or_is_none_is_refused(campaign, until):
    with pytest.raises(tb.TrustboError, match="until"):
        campaign.close_off([(1, 1)], "wreck", until=until)
    for where, reason in [([(9, 9)], "wreck"), ([(1, 1)], " "), ([], "wreck")]:
        with pytest.raises(tb.TrustboError):
            campaign.close_off(where, reason)
    for n, reason in [(1, "open"), (0, "open")]:
        with pytest.raises(tb.TrustboError):
            campaign.reopen(n, reason)
    assert campaign.state.closings == ()


def test_missions_that_drove_through_a_closing_are_told(campaign, ground):
    simulator = ModelSimulator(ground)
    plan = campaign.ask()
    first = simulator.run(plan.path, seed=1)
    other = simulator.run([(3, 3), (2, 2), (1, 1), (0, 0)], seed=2)
    campaign.close_off([plan.path[1], (2, 2), (0, 0), (0, 3)], "flood")
    campaign.tell(first)
    assert campaign.state.entries[0].plan is plan
    with pytest.warns(UserWarning, match="not from"):
        campaign.tell(other)  # from elsewhere
    with pytest.raises(tb.NoPathError, match="flood"):
        campaign.ask()
    campaign.tell(simulator.run(plan.path, seed=3))  # not asked for
    assert campaign.state.used == (0, 1, 2)


def test_a_mission_on_its_way_is_planned_around_what_was_closed_since(campaign, ground):
    plan = campaign.suggest([(3, 0), (2, 1), (1, 2), (0, 3)])
    campaign.close_off([plan.path[2]], "tree")
    rest = campaign.replan(plan.path[1])
    assert rest.path[:2] == plan.path[:2]
    assert plan.path[2] not in rest.path
    assert campaign.ask() is rest


def test_closings_are_loaded_and_saved(ground, tmp_path):
    with begin(ground, tmp_path / "one") as one:
        one.close_off([(1, 1), ((2, 0), (1, 0))], "mud", until=7, by="me")
        one.close_off([(2, 2)], "tree", until="2099-01-01")
        one.reopen(1, "dry")
        plan, state = one.ask(), one.state
    with tb.Campaign.load(tmp_path / "one") as again:
        assert again.state.closings == state.closings
        assert again.ask().path == plan.path
        assert again.ask().workspace.closed == {((2, 2),): "tree"}
        again.save(tmp_path / "two")
    assert tb.Campaign.load(tmp_path / "two").state.closings == state.closings


def test_a_later_campaign_on_the_same_map_keeps_what_is_still_closed(ground):
    first = tb.Campaign(ground, *ENDS, **OPTIONS)
    first.close_off([(1, 1)], "wreck")
    first.close_off([(2, 1)], "flood", until=4)
    first.close_off([(2, 2)], "tree", until=2)
    first.tell(ModelSimulator(ground).run(first.ask().path, seed=0))
    second = tb.Campaign(ground, *ENDS, earlier=first, **OPTIONS)
    assert [(one.reason, one.until) for one in second.state.closings] == [
        ("wreck", None), ("flood", 3)]  # fmt: skip
    other = tb.Workspace.from_awareness(np.full((3, 4, 4, 2), 0.5))
    assert tb.Campaign(other, *ENDS, earlier=first, **OPTIONS).state.closings == ()


# --- mud, not slope ---


@pytest.fixture(scope="module")
def hill():
    return tb.Workspace.from_terrain(hillside(), (3, 3), bounds=False)


def stuck(workspace, path):
    """Mission that fails in its second bound."""
    mission = ModelSimulator(workspace, fail_at=2, blind=True).run(path, seed=0)
    assert mission.status == "stuck"
    return mission


def test_a_failure_with_a_cause_teaches_no_slope(hill):
    path = [(2, 0), (1, 0), (1, 1), (0, 2)]
    told = {}
    for name in ("stuck", "mud", "aborted"):
        campaign = tb.Campaign(hill, path[0], path[-1], **OPTIONS)
        campaign.suggest(path)
        mission = stuck(hill, path)
        if name == "aborted":
            mission = replace(mission, status="aborted",
                              bound_status=(*mission.bound_status[:-1], "aborted"))  # fmt: skip
        campaign.tell(mission, cause="mud" if name == "mud" else "")
        told[name] = campaign
    np.testing.assert_array_equal(told["mud"].risk.mean, told["aborted"].risk.mean)
    assert told["mud"].hazard["failures"].sum() == 0
    assert told["stuck"].hazard["failures"].sum() == 1
    assert np.nanmean(told["stuck"].risk.mean) > np.nanmean(told["mud"].risk.mean)
    assert told["mud"].table().loc[1, ["status", "reason"]].tolist() == ["aborted", "mud (stuck)"]


def test_causes_are_stored_and_can_be_found_out_later(hill, tmp_path):
    path = [(2, 0), (1, 0), (1, 1), (0, 2)]
    with tb.Campaign(hill, path[0], path[-1], directory=tmp_path / "a", **OPTIONS) as campaign:
        campaign.suggest(path)
        campaign.tell(stuck(hill, path))
        before = campaign.table()
        with pytest.raises(tb.TrustboError, match="cause"):
            campaign.tell(ModelSimulator(hill, blind=True).run(path, seed=4), cause="mud")
        with pytest.raises(tb.TrustboError, match="cause"):
            campaign.tell(ModelSimulator(hill, blind=True).run(path, seed=4), cause=4)
        assert campaign.table().equals(before)
        campaign.correct(1, stuck(hill, path), "it was mud", cause="mud")
        table = campaign.table()
    with tb.Campaign.load(tmp_path / "a") as again:
        assert again.table().loc[2, "reason"] == table.loc[2, "reason"] == "mud (stuck)"
        assert again.hazard["failures"].sum() == 0


def test_a_report_without_measurements_may_name_the_cell_and_another_cause(hill):
    campaign, other = (tb.Campaign(hill, (2, 0), (0, 2), **OPTIONS) for _ in range(2))
    other.fail("rain")  # random numbers depend on the number of reports
    cell = campaign.ask().path[1]
    campaign.fail("mud", where=cell)
    row = campaign.table().iloc[0]
    assert (row["status"], row["reason"], row["n_bounds"]) == ("aborted", "mud", 1)
    np.testing.assert_array_equal(campaign.risk.mean, other.risk.mean)
    with pytest.raises(tb.TrustboError, match="ask"):
        campaign.fail("mud", where=cell)  # no path is planned
