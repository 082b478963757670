"""A plan's stops, posts and routes are the workspace's, also of one read from a record."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from worlds import hillside

import trustbo as tb
from trustbo.planning.plan import plan_from_record, plan_to_record

PARAMS = tb.models.TrustParams(0.5, np.array([0.1, 0.1, 0.4]), 0.1, 0.1, 0.1, 0.5, 0.5)


@pytest.fixture(scope="module")
def workspace():
    terrain = hillside(90.0, 120.0)
    return tb.Workspace.from_terrain(terrain, (3, 4), tb.Team(n_robots=2))


@pytest.fixture(scope="module")
def plan(workspace):
    return tb.planning.Planner(workspace, (2, 0), (0, 3)).plan(PARAMS)


def assert_is_of_its_path(plan, workspace):
    path = plan.stations
    assert plan.posts.shape == (len(path) - 1, 2, 2)
    for k, (a, c) in enumerate(itertools.pairwise(path)):
        np.testing.assert_array_equal(plan.posts[k], workspace.posts.watching(a, c))
        ahead = path[k + 2] if k + 2 < len(path) else None
        for found, route in zip(
            plan.routes[k], workspace.posts.bound_routes(a, c, ahead), strict=True
        ):
            np.testing.assert_array_equal(found, route)
        np.testing.assert_array_equal(plan.routes[k][0][[0, -1]], plan.stops[k : k + 2])
    assert len(plan.routes) == len(path) - 1


def test_a_plan_has_what_each_robot_is_to_do(plan, workspace):
    assert_is_of_its_path(plan, workspace)
    assert plan.posts is plan.posts  # computed once


def test_a_table_of_a_plan_has_its_stops_and_the_trust_after_each_bound(plan):
    driven = replace(plan, n_driven=1)
    table = driven.to_frame()
    assert table["cell"].tolist() == [f"{row},{col}" for row, col in plan.path]
    np.testing.assert_array_equal(table[["x", "y"]], plan.stops)
    assert table.loc[0, "trust":].isna().all()
    np.testing.assert_array_equal(table.loc[1:, "trust_r2"], plan.trust[:, 1])
    np.testing.assert_array_equal(table.loc[1:, "trust_r2_low"], plan.bands[0, :, 1])
    np.testing.assert_allclose(list(table.loc[1:, "trust_high"]), plan.bands[-1].mean(1))
    assert table["driven"].tolist()[1:] == [True, *[False] * (len(plan.path) - 2)]
    assert "p_fail" not in table


def test_a_record_has_no_ways_and_the_plan_read_from_it_does(plan, workspace):
    assert_is_of_its_path(plan, workspace)  # they are known now
    record = json.loads(json.dumps(plan_to_record(plan)))
    assert not {"stops", "posts", "routes", "workspace"} & set(record)
    assert_is_of_its_path(plan_from_record(record, workspace), workspace)


def test_a_record_without_the_number_of_driven_bounds_is_of_a_whole_mission(plan, workspace):
    record = plan_to_record(plan)
    del record["n_driven"]
    assert plan_from_record(record, workspace).n_driven == 0


def test_plans_of_a_campaign_from_disk_have_them(workspace, tmp_path):
    ends = (2, 0), (0, 3)
    with tb.Campaign(
        workspace, *ends, sampler="importance", directory=tmp_path / "campaign"
    ) as campaign:
        asked = campaign.ask()
    with tb.Campaign.load(tmp_path / "campaign") as again:
        assert again.ask().path == asked.path
        assert_is_of_its_path(again.ask(), workspace)


def test_without_a_terrain_there_are_none():
    bare = tb.Workspace.from_awareness(np.full((2, 3, 3, 3), 0.5))
    plan = tb.planning.Planner(bare, (2, 0), (0, 2)).plan(PARAMS)
    assert (plan.stops, plan.posts, plan.routes) == (None, None, None)


def test_an_unknown_name_of_a_room_is_an_attribute_error():
    with pytest.raises(AttributeError, match=r"'trustbo\.planning' has no attribute 'Plna'"):
        _ = tb.planning.Plna
