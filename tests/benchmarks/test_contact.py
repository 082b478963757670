"""The benchmark of contact lost: its courses, and its runs that are resumed."""

from dataclasses import replace

import contact
import pandas as pd
import pytest
from world_set import worlds

import trustbo as tb

APART = 4
METHODS = ("running mean", "line of sight")


@pytest.fixture(scope="module")
def world():
    return replace(worlds()["synthetic-0"], name="synthetic-0-small", shape=(8, 8), cell=40.0)


def test_changing_courses_are_deterministic_and_can_be_driven(world):
    drawn = contact.changing_courses(world, "0", 8, APART)
    assert contact.changing_courses(world, "0", 5, APART) == drawn[:5]
    assert contact.changing_courses(world, "1", 8, APART) != drawn

    for start, goal in drawn:
        assert max(abs(start[0] - goal[0]), abs(start[1] - goal[1])) >= APART
        assert tb.Planner(world.workspace(), start, goal).problem.paths.shortest >= APART


def test_worlds_on_one_terrain_have_the_same_courses_where_they_can_be_driven(world):
    """The robots of the other world cannot drive everywhere."""
    other = replace(worlds()["synthetic-0-slopes"], shape=(8, 8), cell=40.0)
    of_both = [contact.changing_courses(one, "0", 8, APART) for one in (world, other)]
    can_drive = [course for course in of_both[0] if contact.has_path(other.workspace(), course)]
    assert of_both[1][: len(can_drive)] == can_drive


def test_a_run_that_was_stopped_continues_with_the_same_rows(world, tmp_path, monkeypatch):
    monkeypatch.setattr(contact, "SETTINGS", {"changing": ("0", "1"), "one": ("sw-ne",)})

    def run(folder, methods):
        return contact.run_world(world, methods, folder, ("changing", "one"), 2)

    def rows_in(folder):
        found = [
            contact.rows_in(folder, setting, method, [world.name])
            for setting in ("changing", "one")
            for method in METHODS
        ]
        return pd.concat(found, ignore_index=True)

    assert run(tmp_path / "whole", METHODS) == 6
    assert run(tmp_path / "stopped", METHODS[:1]) == 3
    contact.file_of(tmp_path / "stopped", world.name, "changing", "1", METHODS[0]).unlink()
    assert run(tmp_path / "stopped", METHODS) == 4
    assert run(tmp_path / "stopped", METHODS) == 0

    rows = rows_in(tmp_path / "whole")
    pd.testing.assert_frame_equal(rows, rows_in(tmp_path / "stopped"))
    assert len(rows) == 6
    assert rows["status"].str.len().eq(2).all()
    assert rows[["lost_1", "lost_2"]].ge(0.0).all(axis=None)


def test_bounds_that_are_not_completed_are_lost(world):
    workspace = world.workspace()
    path = tb.Campaign(workspace, (7, 0), (0, 7), progress=False).ask().stations
    mission = world.simulator(workspace).run(path, seed=0)
    n_bounds = len(mission.path) - 1
    whole = n_bounds - mission.contact_rate.mean(1).sum()
    assert contact.lost_in(mission) == pytest.approx(whole)

    failed = ("ok",) * (n_bounds - 1) + ("tipped",)
    failed = replace(mission, bound_status=failed, status="tipped")
    expected = n_bounds - mission.contact_rate[:-1].mean(1).sum()
    assert contact.lost_in(failed) == pytest.approx(expected)
