"""Robots, bounds and missions: refused early, with the value and the remedy."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.models import Priors
from trustbo.team import Robot, Team
from trustbo.workspace import Workspace

PATH = [(2, 0), (1, 1), (0, 2)]


def arrays(n_bounds=2, n_robots=3, n_features=2):
    return np.full((n_bounds, n_robots, n_features), 0.5), np.full((n_bounds, n_robots), 0.4)


def with_ticks(poses, contact):
    """A mission of two robots and one bound with poses and contact at its ticks."""
    unknown = np.full((1, 2, 1), np.nan)
    mission = Mission.from_arrays([(0, 0), (0, 1)], unknown, unknown[..., 0])
    return replace(mission, poses=(poses,), contact=(contact,))


def test_a_user_s_log_becomes_a_mission():
    z, y = arrays()
    mission = Mission.from_arrays(PATH, z, y, duration=[10.0, 20.0])
    assert mission.path == ((2, 0), (1, 1), (0, 2))
    assert mission.features == ("traversability", "visibility")
    assert mission.robots == ("r1", "r2", "r3")
    np.testing.assert_array_equal(mission.contact_rate, y)
    np.testing.assert_array_equal(mission.awareness, z)
    assert [bound.cell for bound in mission.bounds] == PATH[1:]
    assert [bound.t0 for bound in mission.bounds] == [0.0, 10.0]
    assert mission.bounds[1].t1 == 30.0


def test_a_log_without_durations_has_none():
    mission = Mission.from_arrays(PATH, *arrays())
    assert np.isnan(mission.duration).all()


def test_a_failed_mission_keeps_its_bounds():
    z, y = arrays(1)
    mission = Mission.from_arrays(PATH, z, y, status="stuck")
    assert mission.status == mission.bounds[-1].status == "stuck"
    with pytest.raises(TrustboError, match="status"):
        Mission.from_arrays(PATH, z, y)


def test_a_mission_without_durations_does_not_take_0_s():
    assert "takes         not measured" in repr(Mission.from_arrays(PATH, *arrays()))
    assert "takes         2 s" in repr(Mission.from_arrays(PATH, *arrays(), np.ones(2)))


@pytest.mark.parametrize(("value", "shown"), [(1.5, "1.5"), (-0.1, "-0.1")])
def test_contact_rates_outside_the_unit_interval_are_named(value, shown):
    z, y = arrays()
    y[1, 2] = value
    with pytest.raises(
        TrustboError, match=rf"contact_rate of the bound into cell \(0, 2\): \[2\] = {shown}"
    ):
        Mission.from_arrays(PATH, z, y)


def test_values_that_rounding_moved_out_of_the_unit_interval_are_moved_back():
    z, y = arrays()
    z[0, 0] = [-1e-17, np.float32(1.0) + np.float32(1.2e-7)]
    y[0, :2] = [1.0000000000000002, -1e-7]
    mission = Mission.from_arrays(PATH, z, y, n_ticks=[[1, 5, 5], [5, 5, 5]])
    np.testing.assert_array_equal(mission.contact_rate[0], [1.0, 0.0, 0.4])
    np.testing.assert_array_equal(mission.awareness[0, 0], [0.0, 1.0])

    y[0, 0] = 1.00001
    with pytest.raises(TrustboError, match="outside"):
        Mission.from_arrays(PATH, z, y)


def test_no_ticks_without_a_rate_mean_that_nothing_was_measured():
    z, y = arrays()
    y[0, 1] = np.nan
    mission = Mission.from_arrays(PATH, z, y, n_ticks=[[5, 0, 5], [5, 5, 5]])
    np.testing.assert_array_equal(mission.n_ticks, [[5, np.nan, 5], [5, 5, 5]])
    with pytest.raises(TrustboError, match="n_ticks"):
        Mission.from_arrays(PATH, z, y, n_ticks=[[0, 0, 5], [5, 5, 5]])


def test_one_name_may_be_composed_of_letters_and_accents():
    team = Team(2, names=("\u00e9clair", "b"))
    assert Team(2, names=("e\u0301clair", "b")).names == team.names
    rates = pd.DataFrame([[0.1, 0.2], [0.3, 0.4]], columns=["b", "e\u0301clair"])
    mission = Mission.from_arrays(PATH, np.full((2, 2, 2), 0.5), rates, robots=team.names)
    np.testing.assert_array_equal(mission.contact_rate, [[0.2, 0.1], [0.4, 0.3]])


def test_awareness_outside_the_unit_interval_is_named():
    z, y = arrays()
    z[0, 1, 1] = 2.0
    with pytest.raises(TrustboError, match=r"awareness .* cell \(1, 1\): \[1, 1\] = 2 is outside"):
        Mission.from_arrays(PATH, z, y)


def test_axes_that_do_not_fit_are_shown():
    z, y = arrays()
    with pytest.raises(TrustboError, match=r"got \(2, 3, 2\) and \(2, 2\)"):
        Mission.from_arrays(PATH, z, y[:, :2])
    with pytest.raises(TrustboError, match="path"):
        Mission.from_arrays(PATH[:2], z, y)
    with pytest.raises(TrustboError, match="duration must be"):
        Mission.from_arrays(PATH, z, y, duration=[1.0, 2.0, 3.0])
    with pytest.raises(TrustboError, match="features must be 2 names"):
        Mission.from_arrays(PATH, z, y, features=["one"])
    with pytest.raises(TrustboError, match="at least one"):
        Mission.from_arrays(PATH, z[:0], y[:0], status="aborted")


def test_unknown_statuses_are_refused_with_the_known_ones():
    z, y = arrays()
    with pytest.raises(TrustboError, match="unknown status 'lost'; choose one of ok, stuck"):
        Mission.from_arrays(PATH, z, y, status="lost")


def test_a_duration_of_zero_is_named_with_its_bound():
    z, y = arrays(n_robots=2)
    with pytest.raises(
        TrustboError,
        match=r"duration of the bound into cell \(0, 2\): \[1\] = 0 s must be positive",
    ):
        Mission.from_arrays(PATH, z, y, duration=[[1.0, 1.0], [1.0, 0.0]])
    with pytest.raises(TrustboError, match=r"duration of bound 1: \[0\] = -1 s"):
        Mission.from_arrays(None, z, y, duration=[-1.0, 1.0])


def test_the_bound_of_a_rate_that_is_no_share_of_ticks_is_named():
    z, y = arrays()
    with pytest.raises(TrustboError, match=r"contact_rate of .* \(0, 2\): \[2\] = 0.4 .* 1 / 3"):
        Mission.from_arrays(PATH, z, y, n_ticks=[[5, 5, 5], [5, 5, 3]])
    with pytest.raises(TrustboError, match=r"n_ticks of .* \(1, 1\): \[0\] = 2.5"):
        Mission.from_arrays(PATH, z, y, n_ticks=[2.5, 5.0])


def test_a_path_must_be_cells_and_arrays_numbers():
    z, y = arrays()
    with pytest.raises(
        TrustboError, match=r"path\[1\] must be two whole numbers .* got \(1, 1, 0\)"
    ):
        Mission.from_arrays([(2, 0), (1, 1, 0), (0, 2)], z, y)
    with pytest.raises(TrustboError, match=r"path\[0\] must be two whole numbers .* \(2.5, 0\)"):
        Mission.from_arrays([(2.5, 0), (1, 1), (0, 2)], z, y)
    with pytest.raises(TrustboError, match="awareness must be an array of numbers; got 'abc'"):
        Mission.from_arrays(PATH, "abc", y)


def test_a_missing_duration_does_not_stop_the_clock():
    z, y = arrays(n_robots=2)
    mission = Mission.from_arrays(PATH, z, y, duration=[[10.0, np.nan], [20.0, 5.0]])
    assert [(b.t0, b.t1) for b in mission.bounds] == [(0.0, 10.0), (10.0, 30.0)]


def test_masked_rates_and_rates_that_pandas_calls_missing_are_not_measured():
    z, y = arrays()
    missing = np.zeros(y.shape, bool)
    missing[1, 0] = True
    masked = np.ma.masked_array(
        np.where(missing, 0.0, y), missing
    )  # rasterio and netCDF4 make them
    frame = pd.DataFrame(y).rename(columns=str).astype("Float64").mask(missing)
    frame.columns = [f"r{i + 1}" for i in range(y.shape[1])]
    for rates in (masked, frame):
        found = Mission.from_arrays(PATH, z, rates).contact_rate
        np.testing.assert_array_equal(found, np.where(missing, np.nan, y))


def test_a_mission_takes_another_awareness_and_keeps_its_rates():
    z, y = arrays()
    other = np.random.default_rng(0).uniform(size=z.shape)
    found = Mission.from_arrays(PATH, z, y).with_awareness(other)
    np.testing.assert_array_equal(found.awareness, other)
    np.testing.assert_array_equal(found.contact_rate, y)


def test_a_mission_with_another_awareness_shares_its_ticks():
    mission = with_ticks(np.zeros((5, 3, 3)), np.ones((5, 2)))
    [bound] = mission.bounds
    [changed] = mission.with_awareness(mission.awareness / 2.0).bounds
    np.testing.assert_array_equal(changed.awareness, bound.awareness / 2.0)
    assert changed.poses is bound.poses
    assert changed.contact is bound.contact


def test_a_scale_of_reports_is_checked():
    mission = Mission.from_arrays(None, *arrays())
    assert replace(mission, scale="likert5").scale == "likert5"
    with pytest.raises(TrustboError, match="scale"):
        replace(mission, scale="stars")


def test_robots_and_teams_are_checked():
    assert Team(n_robots=4).names == ("r1", "r2", "r3", "r4")
    assert Team(robots=[Robot(), Robot(speed=1.0)]).n_robots == 2
    with pytest.raises(TrustboError, match=r"Robot.speed must be positive and finite; got -1"):
        Robot(speed=-1.0)
    with pytest.raises(TrustboError, match=r"below pi/2; got 30 \(degrees\?"):
        Robot(max_slope=30.0)
    with pytest.raises(TrustboError, match="n_robots must be a whole number"):
        Team(n_robots=0)
    with pytest.raises(TrustboError, match="sequence of Robot"):
        Team(robots=Robot())
    with pytest.raises(TrustboError, match="3 different names"):
        Team(n_robots=3, names=("a", "b", "c", "a"))
    with pytest.raises(TrustboError, match="2 different names"):
        Team(n_robots=2, names=("a", "a"))


def test_arrays_of_odd_shapes_are_shown():
    z, y = arrays()
    with pytest.raises(TrustboError, match="awareness"):
        Mission.from_arrays(PATH, z[0], y)
    with pytest.raises(TrustboError, match=r"n_ticks must be \(2, 3\); got \(2, 2\)"):
        Mission.from_arrays(PATH, z, y, n_ticks=np.full((2, 2), 5.0))
    for name, values in (("duration", np.ones((2, 2))), ("n_ticks", np.ones(2))):
        with pytest.raises(TrustboError, match=r"\(2, 3, 2\)"):
            replace(Mission.from_arrays(PATH, z, y), **{name: values})


def test_durations_and_ticks_are_read_by_name_as_rates_are():
    z, y = arrays(n_robots=2)
    rates = pd.DataFrame(y * [1.0, 2.0], columns=["b", "a"])
    seconds = pd.DataFrame([[11.0, 71.0], [12.0, 72.0]], columns=["b", "a"])
    ticks = {"a": 10, "b": 5}
    found = Mission.from_arrays(PATH, z, rates, seconds, n_ticks=ticks, robots=("a", "b"))
    np.testing.assert_array_equal(found.contact_rate, y * [2.0, 1.0])
    np.testing.assert_array_equal(found.duration, [[71.0, 11.0], [72.0, 12.0]])
    np.testing.assert_array_equal(found.n_ticks, [[10.0, 5.0]] * 2)


def test_robots_and_features_are_those_of_the_labels():
    z, y = arrays(n_robots=2)
    rates = pd.DataFrame(y * [1.0, 2.0], columns=["husky", "spot"])
    labelled = xr.DataArray(
        z * [0.5, 1.0], {"feature": ["slope", "canopy"]}, ("bound", "robot", "feature")
    )
    found = Mission.from_arrays(PATH, labelled, rates)
    assert found.robots == ("husky", "spot")
    assert found.features == ("slope", "canopy")
    turned = labelled.isel(feature=[1, 0])
    again = Mission.from_arrays(PATH, turned, rates, features=("slope", "canopy"))
    np.testing.assert_array_equal(again.awareness, found.awareness)
    other = found.with_awareness(turned)
    np.testing.assert_array_equal(other.awareness, found.awareness)


def test_what_cannot_carry_the_labels_is_refused():
    z, y = arrays(1, 1, 1)
    for awareness in (pd.DataFrame({"a": [0.1]}), xr.Dataset({"awareness": ("bound", [0.1])})):
        with pytest.raises(TrustboError, match="awareness"):
            Mission.from_arrays(PATH[:2], awareness, y)
    with pytest.raises(TrustboError, match="awareness"):
        Mission.from_arrays(PATH[:2], 0.5, y)
    with pytest.raises(TrustboError, match="contact_rate"):
        Mission.from_arrays(PATH[:2], z, pd.Series({"husky": 0.5}))


def test_negative_cells_are_refused():
    z, y = arrays(3)
    with pytest.raises(TrustboError, match=r"\(-1, -1\)"):
        Mission.from_arrays([(1, 1), (0, 0), (-1, -1), (-2, -2)], z, y)


@pytest.mark.parametrize("value", ["3", b"3", 1j, np.nan, np.inf, None, [1.0], 10**400])
def test_a_robot_s_speed_is_a_number(value):
    with pytest.raises(TrustboError, match="speed"):
        Robot(speed=value)


def test_numbers_of_numpy_become_python_s():
    robot = Robot(speed=np.float32(1.5), acquire=np.int64(2))
    assert (type(robot.speed), type(robot.acquire)) == (float, int)
    assert robot == Robot(speed=1.5, acquire=2)


@pytest.mark.parametrize("lead", ["boss", None, Robot])
def test_the_lead_of_a_team_is_a_robot(lead):
    with pytest.raises(TrustboError, match="lead"):
        Team(2, lead=lead)


@pytest.mark.parametrize("status", [None, 5, {"ok", "stuck"}, ["ok", None]])
def test_statuses_are_one_text_or_a_list_of_texts(status):
    with pytest.raises(TrustboError, match="status"):
        Mission.from_arrays(PATH, np.full((2, 2, 2), 0.5), np.ones((2, 2)), status=status)


def test_names_in_a_set_have_no_order():
    z, rates = np.full((2, 2, 2), 0.5), np.ones((2, 2))
    for make in (
        lambda: Team(2, names={"kea", "tui"}),
        lambda: Mission.from_arrays(PATH, z, rates, robots={"kea", "tui"}),
        lambda: Mission.from_arrays(PATH, z, rates, features=frozenset({"a", "b"})),
        lambda: Workspace.from_awareness(np.full((2, 3, 3, 2), 0.5), features={"a", "b"}),
        lambda: Priors.from_features({"line_of_sight", "b"}),
    ):
        with pytest.raises(TrustboError, match="order"):
            make()
    assert Team(2, names={"kea": 1, "tui": 2}.keys()).names == ("kea", "tui")


@pytest.mark.parametrize("names", [(1, 2, 3), (None, 1.5, "c"), "abc", ("lead", "b", "c")])
def test_names_of_a_team_are_texts_other_than_lead(names):
    with pytest.raises(TrustboError, match="names"):
        Team(3, names=names)


def test_a_mission_keeps_its_data_when_the_arrays_of_a_log_are_used_again():
    z, y = arrays()
    duration = np.full(y.shape, 20.0)
    mission = Mission.from_arrays(PATH, z, y, duration)
    expected = Mission.from_arrays(PATH, z.copy(), y.copy(), duration.copy())
    for array in (z, y, duration):
        array[...] = 0.25
    assert mission.has_same_data(expected)
    np.testing.assert_array_equal(mission.bounds[0].duration, 20.0)


def test_lists_of_cells_and_statuses_are_the_same_mission_as_tuples():
    """A mission that is told again must be recognised."""
    mission = Mission.from_arrays(PATH, *arrays())
    listed = replace(
        mission,
        path=[list(cell) for cell in mission.path],
        bound_status=list(mission.bound_status),
        robots=list(mission.robots),
    )
    assert listed.has_same_data(mission)
    assert listed.path == mission.path


def test_bounds_are_views_of_the_arrays_of_their_mission():
    z, y = arrays()
    mission = Mission.from_arrays(PATH, z, y, duration=[10.0, 20.0], n_ticks=[5, 10])
    for name in ("awareness", "contact_rate", "duration", "n_ticks"):
        whole = getattr(mission, name)
        for k, bound in enumerate(mission.bounds):
            np.testing.assert_array_equal(getattr(bound, name), whole[k])
            assert np.shares_memory(getattr(bound, name), whole)
        with pytest.raises(ValueError, match="read-only"):
            whole[...] = 0.0


def test_a_failure_in_the_last_bound_is_not_lost():
    z, y = arrays()
    with pytest.raises(TrustboError, match="stuck"):
        replace(Mission.from_arrays(PATH, z, y, status="stuck"), status="ok")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("duration", np.array([[np.inf, 1.0]])),
        ("n_ticks", np.array([[np.inf, 2.0]])),
        ("poses", (np.zeros((5, 2, 3)),)),  # without the lead
        ("contact", (np.zeros((5, 3), bool),)),
        ("starts", (np.nan,)),
        ("path", ((0, 0), (0.5, 1))),
    ],
)
def test_what_is_no_measurement_of_a_bound_is_refused(name, values):
    mission = with_ticks(None, None)
    with pytest.raises(TrustboError, match=name):
        replace(mission, **{name: values})


def test_a_log_without_bounds_is_refused():
    with pytest.raises(TrustboError, match="at least one bound"):
        Mission.from_arrays(PATH, np.zeros((0, 2, 2)), np.zeros((0, 2)))


@pytest.mark.parametrize(
    ("n_poses", "contact", "match"),
    [
        (4, np.ones((3, 2), bool), "contact has 3"),
        (4, np.ones((4, 3), bool), "contact"),
        (4, np.ones(4, bool), "contact"),
        (4, np.array([[1.0, 0.0], [np.nan, 1.0], [1.0, 1.0], [0.0, 1.0]]), "contact"),
        (None, np.full((3, 2), 0.5), "contact"),
        (0, None, "poses"),
    ],
)
def test_poses_and_contact_of_a_bound_have_the_same_ticks(n_poses, contact, match):
    poses = None if n_poses is None else np.zeros((n_poses, 3 if n_poses else 2, 3))
    with pytest.raises(TrustboError, match=match):
        with_ticks(poses, contact)


def test_contact_at_ticks_may_be_numbers():
    contact = np.array([[1, 0], [1, 1], [0, 0]])
    poses = np.zeros((3, 3, 3))
    [bound] = with_ticks(poses, contact).bounds
    np.testing.assert_array_equal(bound.contact, contact)
    poses[...] = contact[...] = 1
    assert not bound.poses.any()
    assert not bound.contact[2].any()
