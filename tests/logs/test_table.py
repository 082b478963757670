"""Tables of missions: what is written comes back, and what is amiss is refused."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from missions import assert_same_missions, missions

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.logs.table import read_table, to_frame

PATH = [(2, 0), (1, 1), (0, 2)]


def rows(**columns):
    """A table of one mission of one robot: 0,0 to 0,2 in two bounds."""
    table = {
        "mission": [1, 1, 1],
        "bound": [0, 1, 2],
        "robot": ["r1"] * 3,
        "row": [0, 0, 0],
        "col": [0, 1, 2],
        "contact_rate": [None, 0.5, 0.75],
        "visibility": [None, 0.2, 0.3],
    } | columns
    return pd.DataFrame({name: values for name, values in table.items() if values is not None})


@settings(max_examples=20, deadline=None)
@given(missions(ticks=False))
def test_what_is_written_comes_back_to_the_last_bit(tmp_path_factory, made):
    """Times of the bounds are those of missions without pauses between bounds."""
    made = [
        Mission.from_arrays(
            mission.path or None, mission.awareness, mission.contact_rate, mission.duration,
            mission.status, n_ticks=mission.n_ticks, features=mission.features,
            robots=mission.robots,
        )
        for mission in made
    ]  # fmt: skip
    file, frame = tmp_path_factory.mktemp("table") / "log.csv", to_frame(made)
    assert_same_missions(read_table(frame), made)
    frame.to_csv(file, index=False)
    assert_same_missions(read_table(file), made)
    frame.to_csv(file, index=False, sep=";", decimal=",")
    assert_same_missions(read_table(file), made)


def test_rows_may_come_in_any_order_and_columns_in_any_case():
    shuffled = rows().rename(columns={"contact_rate": "Contact Rate", "visibility": "Visibility"})
    (one,) = read_table(shuffled[::-1])
    assert one.features == ("Visibility",)
    np.testing.assert_array_equal(one.contact_rate, [[0.5], [0.75]])
    np.testing.assert_array_equal(one.awareness[..., 0], [[0.2], [0.3]])


def test_robots_and_features_come_in_the_order_of_a_workspace():
    z = np.full((2, 3, 3, 3), 0.5)
    team = tb.Team(2, names=("a", "b"))
    workspace = tb.Workspace.from_awareness(z, team=team, features=("slope", "visibility", "z3"))
    table = rows(robot=["b", "b", "a"], bound=[0, 1, 1], col=[0, 1, 1], z3=None, slope=[""] * 3)
    (one,) = map(workspace.in_order, read_table(table.assign(z3="")))
    assert (one.robots, one.features) == (("a", "b"), workspace.features)
    np.testing.assert_array_equal(one.contact_rate, [[0.75, 0.5]])
    np.testing.assert_array_equal(one.awareness[0, :, 1], [0.3, 0.2])
    assert np.isnan(one.awareness[..., [0, 2]]).all()


def test_bounds_that_were_planned_and_not_run_are_part_of_the_path():
    table = rows(contact_rate=[None, 0.5, None], visibility=[None, 0.5, None],
                 status=["", "tipped", ""], robot=[None, "r1", None])  # fmt: skip
    (one,) = read_table(table)
    assert (len(one.path), len(one.bounds), one.status) == (3, 1, "tipped")
    with pytest.raises(TrustboError, match="mission 1"):
        read_table(table.drop(columns="status"))


def test_a_logger_may_write_the_status_ok_for_the_start():
    (always,), (blank,) = (read_table(rows(status=[s, "ok", "stuck"])) for s in ("ok", ""))
    assert (always.path, always.status) == (blank.path, "stuck")
    np.testing.assert_array_equal(always.contact_rate, blank.contact_rate)
    with pytest.raises(TrustboError):
        read_table(rows(status=["stuck", "ok", "ok"]))


def test_a_mission_may_go_on_after_a_bound_that_failed():
    table = rows(status=["", "stuck", "ok"])
    (one,) = read_table(table)
    assert ([bound.status for bound in one.bounds], one.status) == (["stuck", "ok"], "ok")
    pd.testing.assert_series_equal(to_frame([one])["status"].iloc[1:], table["status"].iloc[1:])


@pytest.mark.parametrize(
    "columns",
    [
        {"row": None},
        {"contact_rate": None},
        {"bound": [0, 1, 3]},
        {"bound": [0, 1, 1]},
        {"bound": [0, 1, -1]},
        {"bound": [0, 1, 1.5]},
        {"bound": [1, 2, 3]},
        {"col": [0, 1, "east"]},
        {"row": [0, None, 0]},
        {"contact_rate": [None, 5.0, 6.0]},
        {"contact_rate": [0.1, 0.5, 0.5]},
        {"visibility": [None, -0.1, 0.5]},
        {"timestamp": [None, "10:02:33", "10:03:01"]},
        {"duration": [None, "inf", 4.0]},
        {"duration": [None, 0.0, 4.0]},
        {"status": ["", "ok", "fine"]},
        {"n_ticks": [None, 3, 4]},
        {"mission": [1, None, 1]},
        {"robot": ["r1", "r1", "r2"]},
        {"robot": ["r1", "r1", "R1"]},
        {"robot": [None] * 3},
        {"robot": ["r1", "NA", "r1"]},
        {"contact_rate": [None] * 3, "visibility": [None] * 3},
        {"mission": [1] * 4, "bound": [0, 1, 1, 2], "robot": ["r1", "r1", "r2", "r1"],
         "row": [0, 0, 1, 0], "col": [0, 1, 1, 2], "contact_rate": [None, 0.5, 0.5, 0.5],
         "visibility": None},
    ],
)  # fmt: skip
def test_what_is_amiss_is_refused_in_one_line(columns):
    with pytest.raises(TrustboError) as caught:
        read_table(rows(**columns))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("n_ticks", [None, [None, 7, 9]])
def test_rates_in_percent_are_refused_as_such(n_ticks):
    with pytest.raises(TrustboError, match=r"contact_rate = 48.3 is outside \[0, 1\]"):
        read_table(rows(contact_rate=[None, 48.3, 51.2], n_ticks=n_ticks))


@pytest.mark.parametrize(
    "values", [[0.9, 0.8, 0.7], [None, 90.0, 80.0], [None, "full", "low"], [None, -0.1, 0.2]]
)
def test_a_further_column_that_is_no_awareness_is_named(values):
    with pytest.raises(TrustboError, match="battery"):
        read_table(rows(battery=values))


@pytest.mark.parametrize("name", ["contact_rate", "duration", "n_ticks"])
def test_a_measurement_at_the_start_cell_is_named(name):
    with pytest.raises(TrustboError, match=name):
        read_table(rows(**{name: [1, 1, 1]}))


@pytest.mark.parametrize("decimals", [2, 3, 6])
def test_rounded_rates_are_read_as_the_nearest_share_of_their_ticks(decimals, tmp_path):
    n_ticks = np.array([[7, 9], [13, 30]])
    rate = np.array([[3, 5], [4, 30]]) / n_ticks
    z = np.full((2, 2, 2), 0.5)
    frame = to_frame([Mission.from_arrays(PATH, z, rate, n_ticks=n_ticks)])
    frame.to_csv(tmp_path / "log.csv", index=False, float_format=f"%.{decimals}f")
    rounded = frame.assign(contact_rate=frame["contact_rate"].round(decimals))
    for table in (tmp_path / "log.csv", rounded):
        (one,) = read_table(table)
        np.testing.assert_array_equal(one.contact_rate, rate)


@pytest.mark.parametrize("rates", [[None, 0.4, 0.7], [None, 0.431, 0.714], [None, 0.429, 0.7]])
def test_rates_that_are_not_rounded_shares_are_refused(rates):
    with pytest.raises(TrustboError, match="contact_rate"):
        read_table(rows(contact_rate=rates, n_ticks=[None, 7, 7]))


def test_trust_in_an_exported_table_is_not_a_feature():
    (one,) = read_table(rows(trust_mean=[None, 0.5, 0.6], trust_sd=[None, 0.1, 0.1]))
    assert one.features == ("visibility",)


@pytest.mark.parametrize("name", ["x", "Y", "row", "Col", "robot", "Contact Rate", "=1+1"])
def test_features_whose_column_would_not_be_read_back_are_refused(name):
    z, y = np.full((2, 1, 2), 0.5), np.zeros((2, 1))
    with pytest.raises(TrustboError, match="feature"):
        to_frame([Mission.from_arrays(PATH, z, y, features=["near", name])])
    with pytest.raises(TrustboError, match="robot"):
        to_frame([Mission.from_arrays(PATH, z, y, robots=["=cmd|' /C calc'!A0"])])


def test_only_missions_of_one_team_and_kind_make_a_frame():
    z, y = np.full((2, 1, 2), 0.5), np.zeros((2, 1))
    mapped, bare = (Mission.from_arrays(path, z, y) for path in (PATH, None))
    other = Mission.from_arrays(PATH, z, y, robots=["b"])
    taken = Mission.from_arrays(PATH, z, y, features=["status", "near"])
    for made in ([], mapped, [mapped, bare], [mapped, other], [taken]):
        with pytest.raises(TrustboError):
            to_frame(made)


def test_missions_with_a_scale_or_a_map_are_refused():
    """Read back, they would be contact on the map of the workspace."""
    z, y = np.full((2, 1, 2), 0.5), np.zeros((2, 1))
    mission = Mission.from_arrays(PATH, z, y)
    for name, value in (("scale", "likert7"), ("map", "another")):
        with pytest.raises(TrustboError, match=name):
            to_frame([mission, replace(mission, **{name: value})])
