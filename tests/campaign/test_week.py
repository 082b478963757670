"""A week on one ground, in one folder: courses that change, a robot that stays at home, mistakes.

Each test is about what a team could not do while a campaign had one course.
"""

from dataclasses import replace

import numpy as np
import pytest

import trustbo as tb
from trustbo.campaign.campaign import Campaign
from trustbo.planning import Planner
from trustbo.report import bounds_of, facts_of, write_report

TEAM = ("alpha", "bravo", "charlie")
CAMP, HILL, BRIDGE = (4, 0), (0, 4), (0, 0)
PAIR = ("alpha", "bravo")


@pytest.fixture(scope="module")
def ground():
    """Workspace, and a simulator in which bravo detects 60 % of what it should."""
    terrain = tb.terrain.synthetic_terrain(size=(200.0, 200.0), resolution=2.5, seed=4)
    workspace = tb.Workspace.from_terrain(terrain, (5, 5), tb.Team(3, names=TEAM))
    robots = (tb.Robot(), tb.Robot(detection=0.6), tb.Robot())
    team = tb.Team(robots=robots, names=TEAM)
    return workspace, tb.simulation.KinematicSimulator(workspace, team=team)


@pytest.fixture(scope="module")
def week(ground, tmp_path_factory):
    """Folder and campaign after five missions."""
    workspace, robots = ground
    folder = tmp_path_factory.mktemp("week")
    options = {"planner": {"failure_cost": 9.0}, "fit": {"draws": 100}, "progress": False}
    campaign = Campaign(workspace, directory=folder, **options)

    def run(number, start, goal, members=None):
        plan = campaign.ask(start, goal, robots=members)
        mission = robots.run(plan.path, seed=number, mission=number)
        campaign.tell(mission if members is None else mission.of_robots(members))

    run(0, CAMP, HILL)
    run(1, CAMP, BRIDGE)
    run(2, BRIDGE, CAMP, PAIR)

    # The lead is stuck in the second bound; its log ends there.
    plan = campaign.ask(CAMP, HILL)
    mission = robots.run(plan.path, seed=3, mission=3)
    cut = {name: getattr(mission, name)[:2] for name in ("contact_rate", "duration", "n_ticks")}
    cut |= {"awareness": mission.awareness[:2], "starts": mission.starts[:2]}
    stuck = ("ok", "stuck")
    campaign.tell(
        replace(
            mission, path=plan.path[:3], status="stuck", bound_status=stuck, poses=(), contact=(),
            **cut,
        )
    )  # fmt: skip
    run(4, BRIDGE, HILL)
    yield folder, campaign
    campaign.close()


def test_a_week_is_one_folder_and_its_missions_are_numbered_through(week):
    folder, campaign = week
    files = sorted(file.name for file in (folder / "missions").iterdir())
    assert files == [f"{n:04d}.nc" for n in range(1, 6)]
    table = campaign.table()
    assert table.index.tolist() == [1, 2, 3, 4, 5]
    assert table["start"].tolist() == ["4,0", "4,0", "0,0", "4,0", "0,0"]
    assert table["goal"].tolist() == ["0,4", "0,0", "4,0", "0,4", "0,4"]
    assert table["robots"].tolist()[2] == "alpha, bravo"
    assert "4 courses" in repr(campaign)


def test_the_way_back_is_a_course_like_any_other(week):
    _, campaign = week
    back = campaign.plan(HILL, CAMP)
    assert (back.start, back.goal) == (HILL, CAMP)
    assert campaign.suggest(back.path).path == back.path


def test_a_planner_with_a_cost_of_failures_counts_those_of_the_week(week):
    _, campaign = week
    plan = Planner(campaign.workspace, CAMP, HILL, failure_cost=9.0).plan(campaign.posterior)
    assert plan.p_arrive is not None
    assert plan.p_arrive < 1.0
    assert campaign.risk.failures.sum() == 1.0


def test_who_goes_is_said_in_the_plan_and_a_missing_robot_is_named(week, ground):
    _, campaign = week
    workspace, robots = ground
    plan = campaign.ask(BRIDGE, CAMP, robots=PAIR)
    assert plan.robots == PAIR
    assert plan.trust.shape[1] == plan.posts.shape[1] == 2
    whole = workspace.posts.watching(*plan.path[:2])
    np.testing.assert_array_equal(plan.posts[0], whole[:2])

    campaign.ask(BRIDGE, CAMP)
    mission = robots.run(plan.path, seed=9, mission=9).of_robots(PAIR)
    with pytest.raises(tb.TrustboError, match="charlie"):
        campaign.tell(mission)
    assert len(campaign.missions) == 5


def test_what_is_lost_without_a_robot_is_time_with_watchers(week):
    _, campaign = week
    whole = campaign.watchers(CAMP, HILL).mean()
    without = campaign.watchers(CAMP, HILL, robots=("bravo", "charlie")).mean()
    assert whole["rate_bravo"] < whole["rate_alpha"]
    assert without["at_least_two"] < whole["at_least_two"]
    assert without["at_least_one"] <= whole["at_least_one"] + 0.01


def test_a_mission_that_is_corrected_counts_once(ground, tmp_path):
    workspace, robots = ground
    campaign = Campaign(workspace, fit={"draws": 100}, progress=False, directory=tmp_path)
    with campaign:
        path = campaign.ask(CAMP, BRIDGE).path
        right = robots.run(path, seed=1, mission=0)
        wrong = replace(right, contact_rate=0.5 * right.contact_rate, n_ticks=right.n_ticks * 2.0)
        campaign.tell(replace(wrong, contact=()))
        campaign.correct(1, right, "log of another detector")
        table = campaign.table()
        assert table["state"].tolist() == ["excluded", "learned"]
        assert "corrected, see mission 2: log of another detector" in table.loc[1, "reason"]
        assert table["path"].nunique() == 1
        with pytest.raises(tb.TrustboError, match="already excluded"):
            campaign.correct(1, right, "again")
        with pytest.raises(tb.TrustboError, match="same data"):
            campaign.correct(2, right, "twice")

        known = bounds_of(campaign)
        driven = known["begun"].iloc[1:] > 0
        assert set(known["begun"].iloc[1:]) <= {0, 1}
        if tuple(campaign.path) == tuple(path):
            expected = right.contact_rate.mean(1)
            np.testing.assert_allclose(known["measured"].iloc[1:][driven], expected)

        write_report(tmp_path / "report.html", campaign)
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert "after 1 mission<" in page
        assert "excluded" in page


def test_what_was_learned_is_shown_in_a_campaign_that_has_no_mission_of_its_own(week, tmp_path):
    _, campaign = week
    last = Campaign(campaign.workspace, CAMP, HILL, earlier=campaign, progress=False)
    assert last.table().index.tolist() == [-5, -4, -3, -2, -1]
    assert last.history["iteration"].values.tolist() == [-5, -4, -3, -2, -1]
    assert np.isfinite(last.maps()["trust_mean"]).any()
    assert tb.check(last).verdict
    assert len(last.plot_maps()) == 1
    last.plot_history()
    assert facts_of(last)["Path"]
    write_report(tmp_path / "report.html", last)

    files = tb.export.export_result(last, tmp_path, ["geotiff", "geojson", "csv", "nav2"])
    assert all(file.exists() for file in files)
    assert "-5," in (tmp_path / "missions.csv").read_text(encoding="utf-8")


def test_failures_of_the_week_count_for_its_courses_as_in_a_campaign_of_one_course(week):
    _, campaign = week
    alone = Campaign(campaign.workspace, CAMP, HILL, earlier=campaign, progress=False)
    np.testing.assert_array_equal(alone.hazard["trials"], campaign.hazard["trials"])
    np.testing.assert_array_equal(alone.hazard["failures"], campaign.hazard["failures"])


def test_a_week_that_is_loaded_again_is_the_same(week, tmp_path):
    _, campaign = week
    plan = campaign.ask(HILL, BRIDGE, robots=PAIR)
    campaign.save(tmp_path)
    with Campaign.load(tmp_path, progress=False) as again:
        assert again.table().equals(campaign.table())
        assert (again.ask().path, again.ask().robots) == (plan.path, PAIR)
        assert again.missions[2].robots == TEAM
        assert again.state.entries[2].measured.robots == PAIR
        np.testing.assert_array_equal(again.plan(CAMP, HILL).trust, campaign.plan(CAMP, HILL).trust)
