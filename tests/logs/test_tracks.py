"""Logs of poses and detections as missions, and tables in other units."""

import numpy as np
import pandas as pd
import pytest
from worlds import hillside

import trustbo as tb
from trustbo.data import NOWHERE
from trustbo.errors import TrustboError
from trustbo.hazard.trials import Trials
from trustbo.logs import read_tracks

pytestmark = pytest.mark.filterwarnings("ignore:[0-9]+ detections by the lead")  # of `SEEN`
POSES = {"t": [0.0, 4.0, 8.0, 0.0, 4.0, 8.0], "robot": [*"aaabbb"], "x": [0.0, 4.0, 8.0] * 2,
         "y": [0.0] * 3 + [3.0] * 3, "heading": [0.0] * 6}  # fmt: skip
SEEN = {"t": [0.5, 0.7, 6.2], "watcher": [*"aab"], "seen": [*"bba"]}


def features_of(poses, watcher, lead):
    """Features near and ahead of one robot at each tick, (feature, tick)."""
    (one,) = read_tracks(poses, SEEN, lead=lead, window=1.0)
    return one.awareness[:, one.robots.index(watcher)].T


@pytest.mark.filterwarnings("ignore:no detection names c")
def test_geometry_is_that_of_the_plane():
    poses = {"t": [0.0, 5.0, 10.0] * 3, "robot": [*"aaabbbccc"], "x": [0] * 3 + [4] * 3 + [2] * 3,
             "y": [0] * 6 + [-2, 3, 8], "heading": [0.0] * 6 + [0, 0.5, 1.0]}  # fmt: skip
    near, ahead = features_of(poses, "a", "b")
    np.testing.assert_array_equal(ahead, features_of(poses, "b", "a")[1] == 0.0)  # b faces east
    away = np.hypot(2.0, np.arange(10) - 1.5)  # of a and of b from c
    usual = np.median([*away, *away, *[4.0] * 10])
    np.testing.assert_allclose(near, usual / (usual + 4.0))
    np.testing.assert_allclose(features_of(poses, "a", "c")[0], usual / (usual + away))
    (one,) = read_tracks(poses, SEEN, lead="b", window=1.0)
    np.testing.assert_array_equal(one.contact_rate[:, 0], [1.0] + [0.0] * 9)


def test_unix_times_say_when_a_mission_began():
    start = 1.7e9
    poses = {**POSES, "t": [start + t for t in POSES["t"]]}
    seen = {**SEEN, "t": [start + t for t in SEEN["t"]]}
    assert [one.began for one in read_tracks(poses, seen, lead="b", window=1.0)] == [start]
    assert np.isnan([one.began for one in read_tracks(POSES, SEEN, lead="b", window=1.0)]).all()


def test_robot_without_detections_is_warned_of():
    seen = {"t": [0.5, 0.7, 2.2], "watcher": [*"aac"], "seen": [*"cca"]}
    with pytest.warns(UserWarning, match="no detection names b"):
        read_tracks(POSES | {"robot": [*"aabbcc"], "t": [0.0, 4.0] * 3}, seen, window=4.0)


def test_windows_are_bounds_and_rates_are_shares_of_their_ticks():
    (one,) = read_tracks(POSES, SEEN, lead="a", window=4.0)
    assert one.robots == ("a", "b")
    assert {bound.cell for bound in one.bounds} == {NOWHERE}
    np.testing.assert_array_equal(one.contact_rate, [[np.nan, 0.0], [np.nan, 0.25]])
    np.testing.assert_array_equal(one.n_ticks[:, 1], [4.0, 4.0])
    np.testing.assert_allclose(one.awareness[:, 1], [[0.5, 0.0]] * 2)
    assert [bound.t0 for bound in one.bounds] == [0.0, 4.0]
    made = read_tracks(POSES, SEEN, window=2.0)
    assert np.isnan([made[0].contact_rate[:, 0], made[1].contact_rate[:, 1]]).all()
    with pytest.raises(TrustboError, match="lead"):
        read_tracks(POSES, SEEN, lead="c")


def test_crossings_of_the_lead_are_bounds_of_a_map():
    team = tb.Team(1, names=("b",))
    z = np.full((1, 2, 4, 2), 0.5)
    workspace = tb.Workspace.from_awareness(z, cell_size=2.0, team=team)
    poses = POSES | {"y": [1.0] * 3 + [3.0] * 3}
    with pytest.warns(UserWarning, match="fewer than 5 readings: 1 into"):
        (one,) = read_tracks(poses, SEEN, workspace, lead="a")
    assert one.path == ((1, 0), (1, 1), (1, 2), (1, 3))
    assert (one.robots, one.features) == (("b",), workspace.features)
    np.testing.assert_array_equal(one.contact_rate[:, 0], [0.0, 0.0, 0.5])
    assert np.isnan(one.awareness).all()
    with pytest.warns(UserWarning, match="fewer than 5 readings: 1 into"):
        (out,) = read_tracks(poses | {"x": [0.0, 4.0, 12.0] * 2}, SEEN, workspace, lead="a")
    assert out.path == one.path  # and not the cell that is off the grid
    with pytest.raises(TrustboError, match="r1"):
        read_tracks(poses, SEEN, tb.Workspace.from_awareness(z), lead="a")


def test_cells_whose_corner_is_cut_are_no_bounds_of_a_planned_path():
    workspace = tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5), cell_size=10.0,
                                            team=tb.Team(1, names=("b",)))  # fmt: skip
    t = np.arange(30.0)
    lead = {
        "t": t,
        "robot": "a",
        "x": 0.5 + t,
        "y": t + 0.2 * (t > 5),
    }  # enters (1, 0) before (1, 1)
    poses = pd.concat([pd.DataFrame(lead), pd.DataFrame(lead | {"robot": "b", "y": 1.0})])
    seen = {"t": t, "watcher": ["b"] * 30, "seen": ["a"] * 30}
    planned = ((2, 0), (1, 1), (0, 2))
    for path in (planned, None):  # the lead is the robot that is not in the team
        (one,) = read_tracks(poses, seen, workspace, path=path)
        assert (one.path, len(one.bounds), one.status) == (planned, 2, "ok")
    (one,) = read_tracks(
        poses[poses.t < 20], {n: v[:19] for n, v in seen.items()}, workspace, path=planned
    )
    assert (one.path, len(one.bounds), one.status) == (planned, 1, "aborted")
    with pytest.warns(UserWarning, match="pass tick=2"):
        read_tracks(poses, {n: v[::2] for n, v in seen.items()}, workspace)
    for where, path in ((None, planned), (workspace, ((2, 0, 0),))):
        with pytest.raises(TrustboError, match="path"):
            read_tracks(poses, seen, where, path=path, lead="a")
    more = pd.concat([poses, poses[poses.robot == "b"].assign(robot="c")])
    seen |= {"t": np.repeat(t[:15], 2), "watcher": [*"bc"] * 15}
    with pytest.raises(TrustboError, match="lead"):
        read_tracks(more, seen, workspace)


@pytest.mark.parametrize(
    ("poses", "seen"),
    [
        ({"x": [0, 1, np.nan, 2, 3, 4]}, {}),
        ({"t": [0, 1, 1, 0, 1, 2]}, {}),
        ({"heading": [0, np.nan, 0, 0, 0, 0]}, {}),
        ({"robot": ["a"] * 6}, {}),
        ({"robot": ["a"] * 5 + ["b"]}, {}),
        ({}, {"seen": ["c", "d", "e"]}),
        ({}, {"seen": ["B", "b", "a"]}),
        ({}, {"t": [1e9] * 3}),
        ({"t": [0, 1e6, 2e6] * 2}, {}),
        ({"heading": [0.0, 90.0, 350.0, 0.0, 0.0, 0.0]}, {}),
        ({"x": [2e-5, 3e-5, 4e-5] * 2, "y": [0.0] * 6}, {}),
        ({"t": [0, 4e5, 5e5] * 2, "heading": [np.nan] * 6}, {}),
        ({"x": [0.0, 4.0, 5e5] * 2}, {}),  # a pose without a fix
        ({"t": [86396, 86399, 3, 86396, 86399, 3]}, {"t": [86397, 86398, 4]}),
        ({"heading": [90.0] * 6}, {}),  # a compass, along a straight line
        ({"x": [0.0] * 6, "y": [0.0] * 3 + [3.0] * 3, "heading": [90.0] * 6}, {}),
    ],
)
def test_tables_in_other_units_or_names_are_refused_in_one_line(poses, seen):
    with pytest.raises(TrustboError) as caught:
        read_tracks(pd.DataFrame(POSES | poses), SEEN | seen, window=4.0)
    assert "\n" not in str(caught.value)


def circling(heading):
    """Poses of two robots on a circle, with a heading made from the true one."""
    t = np.arange(60.0)
    angle = np.concatenate([t / 10.0, 2.0 + t / 10.0])
    x, y = 10.0 * np.cos(angle), 10.0 * np.sin(angle)
    robots = np.repeat(["a", "b"], len(t))
    return {"t": [*t, *t], "robot": robots, "x": x, "y": y, "heading": heading(angle + np.pi / 2)}


@pytest.mark.parametrize(
    "right", [lambda h: h, lambda h: h + 8 * np.pi, lambda h: h + np.pi, lambda h: h % (2 * np.pi)]
)
def test_headings_in_radians_from_east_are_read_even_of_robots_that_reverse(right):
    (one,) = read_tracks(circling(right), SEEN, lead="a")
    assert one.robots == ("a", "b")


@pytest.mark.parametrize(
    "wrong",
    [np.degrees, lambda h: np.degrees(h) % 360, lambda h: np.pi / 2 - h,
     lambda h: (np.pi / 2 - h) % (2 * np.pi), lambda h: np.degrees(np.pi / 2 - h) % 360],
)  # fmt: skip
def test_headings_in_degrees_or_of_a_compass_are_refused(wrong):
    with pytest.raises(TrustboError, match="headings of robot 'a'"):
        read_tracks(circling(wrong), SEEN, lead="a")


def test_poses_off_the_map_are_refused_with_both_places():
    workspace = tb.Workspace.from_awareness(
        np.full((1, 2, 4, 2), 0.5), cell_size=2.0, team=tb.Team(1, names=("b",))
    )
    with pytest.raises(TrustboError, match="never on the grid"):
        read_tracks(POSES | {"x": [50.0, 54.0, 58.0] * 2}, SEEN, workspace, lead="a")


NAMES = ("a", "b")
PLANNED = [(3, 0), (2, 1), (1, 2), (0, 3)]


@pytest.fixture(scope="module")
def field():
    """A map of 4 by 4 cells of 20 m, with a team of two robots."""
    z = np.full((2, 4, 4, 2), 0.5)
    return tb.Workspace.from_awareness(z, cell_size=20.0, team=tb.Team(2, names=NAMES))


def driven(field, cells, *, hz=1, rate=0.6, seed=0):
    """Poses of a lead L and two robots along cells, 20 s for each, and detections of the lead."""
    rng = np.random.default_rng(seed)
    n = 20 * (len(cells) - 1)
    t = np.arange(n * hz + 1) / hz
    centres = np.array([field.grid.center(cell) for cell in cells])
    x, y = (np.interp(t / 20.0, np.arange(len(cells)), axis) for axis in centres.T)
    poses = pd.concat(
        [pd.DataFrame({"t": t, "robot": name, "x": x - behind, "y": y - behind})
         for name, behind in (("L", 0.0), ("a", 3.0), ("b", 6.0))]
    )  # fmt: skip
    seen = pd.concat(
        [pd.DataFrame({"t": t[rng.random(len(t)) < rate], "watcher": name}) for name in NAMES]
    )
    return poses, seen.assign(seen="L")


def read_driven(field, poses, seen, **options):
    (one,) = read_tracks(poses, seen, field, lead="L", **{"path": PLANNED} | options)
    return one


def test_a_watcher_without_poses_is_warned_of(field):
    poses, seen = driven(field, PLANNED)
    renamed = seen.assign(watcher=seen.watcher.where((seen.watcher == "a") | (seen.t < 25), "b2"))
    with pytest.warns(UserWarning, match="b2"):
        read_driven(field, poses, renamed)

    tree = seen.iloc[:-1].assign(seen="tree")
    read_driven(field, poses, pd.concat([seen, tree]))  # what is only seen need not be a robot


def test_a_robot_that_is_neither_lead_nor_in_the_team_is_warned_of(field):
    poses, seen = driven(field, PLANNED)

    def renamed(table, column):
        return table.assign(
            **{column: table[column].where((table[column] != "b") | (table.t < 25), "b2")}
        )

    with pytest.warns(UserWarning, match="b2"):
        read_driven(field, renamed(poses, "robot"), renamed(seen, "watcher"))


def test_a_lead_that_is_seen_under_another_name_from_some_time_on_is_warned_of(field):
    poses, seen = driven(field, PLANNED)
    with pytest.warns(UserWarning, match="L2"):
        read_driven(field, poses, seen.assign(seen=seen.seen.where(seen.t < 25, "L2")))


def test_cells_that_the_lead_drives_through_instead_of_planned_ones_are_read_and_named(field):
    round_it = [(3, 0), (2, 1), (2, 2), (1, 3), (0, 3)]
    poses, seen = driven(field, round_it)
    with pytest.warns(UserWarning, match=r"through \(2, 1\), .* \(0, 3\) and not \(1, 2\)"):
        one = read_driven(field, poses, seen)
    assert (one.path, one.status) == (tuple(round_it), "ok")

    planned = read_driven(field, poses, seen, path=round_it)
    np.testing.assert_array_equal(one.contact_rate, planned.contact_rate)


def test_a_planned_path_from_which_the_lead_jumps_is_refused_with_the_cell(field):
    poses, seen = driven(field, [(3, 0), (2, 1), (0, 3)])
    jumps = poses[(poses.t < 22) | (poses.t > 34)]
    with pytest.raises(TrustboError, match=r"never enters cell \(1, 2\)"):
        read_driven(field, jumps, seen)


@pytest.mark.parametrize(
    ("cells", "named"),
    [
        (PLANNED[1:], r"\(3, 0\)"),  # recorded late
        ([(0, 0), (1, 1), (2, 2), (3, 3)], r"\(3, 0\)"),  # of another day
        ([(3, 0), (3, 1), (3, 2)], r"\(2, 1\)"),
        ([(3, 0), (3, 1)], r"\(2, 1\)"),
    ],
)
def test_a_log_that_does_not_begin_with_the_path_is_refused_with_the_cell(field, cells, named):
    with pytest.raises(TrustboError, match=named):
        read_driven(field, *driven(field, cells))


def test_a_mission_that_leaves_its_path_ends_in_the_last_cell_of_it(field):
    poses, seen = driven(field, [(3, 0), (2, 1), (3, 2), (3, 3)])
    with pytest.warns(UserWarning, match=r"\(1, 2\)"):
        one = read_driven(field, poses, seen)
    assert (len(one.bounds), one.status) == (1, "aborted")
    assert one.duration[0, 0] == pytest.approx(20.0, abs=1.0)  # from stop to stop


def test_the_drive_back_from_the_goal_is_not_part_of_the_mission(field):
    alone = read_driven(field, *driven(field, PLANNED))
    back = read_driven(field, *driven(field, [*PLANNED, *PLANNED[-2::-1]]))
    np.testing.assert_allclose(back.duration, alone.duration, atol=1.0)
    assert back.status == "ok"


def test_a_second_mission_in_the_same_log_is_not_read_as_a_part_of_the_first(field):
    other = [(3, 0), (2, 0), (1, 1), (0, 2), (0, 3)]
    twice = driven(field, [*PLANNED, *PLANNED[-2::-1], *other[1:]])
    with pytest.warns(UserWarning, match=r"returns to cell \(3, 0\).* 11\d s after .*only"):
        one = read_driven(field, *twice)
    assert (one.path, one.status) == (tuple(PLANNED), "ok")
    np.testing.assert_allclose(one.duration[:, 0], 20.0, atol=1.0)

    with pytest.raises(TrustboError, match=r"returns to cell \(3, 0\).* 11\d s after .*Cut"):
        read_driven(field, *twice, path=None)
    half = driven(field, [*PLANNED[:2], *PLANNED])  # given up, and begun again
    with pytest.raises(TrustboError, match=r"returns to cell \(3, 0\)"):
        read_driven(field, *half)


def test_a_planned_path_may_lead_through_its_start_again(field):
    loop = [(3, 0), (2, 0), (2, 1), (3, 0), (3, 1)]
    assert read_driven(field, *driven(field, loop), path=loop).path == tuple(loop)


@pytest.mark.parametrize("shift", [25.0, -25.0, 5.0])
def test_detections_outside_the_time_of_the_poses_are_warned_of(field, shift):
    poses, seen = driven(field, PLANNED)
    of_a = seen.watcher == "a"
    for late in (seen.assign(t=seen.t + shift), seen.assign(t=seen.t + shift * of_a)):
        with pytest.warns(UserWarning, match="by a.* lie outside"):
            read_driven(field, poses, late)


@pytest.mark.parametrize(("hz", "rate"), [(10, 0.15), (10, 0.9), (20, 0.05), (5, 0.3)])
def test_a_detector_faster_than_the_tick_is_warned_of_with_its_interval(field, hz, rate):
    poses, seen = driven(field, PLANNED, hz=hz, rate=rate)
    with pytest.warns(UserWarning, match=f"tick={1.0 / hz:g}"):
        read_driven(field, poses, seen)
    one = read_driven(field, poses, seen, tick=1.0 / hz)
    assert np.nanmean(one.contact_rate) == pytest.approx(rate, abs=0.05)


def test_a_log_without_detections_is_contact_zero(field):
    poses, seen = driven(field, PLANNED)
    for table in (seen.iloc[:0], {"t": [], "watcher": [], "seen": []}):
        with pytest.warns(UserWarning, match="no detection names a, b, L"):
            one = read_driven(field, poses, table)
        assert one.contact_rate.max() == 0.0
        assert one.n_ticks.min() > 0.0
    with pytest.raises(TrustboError, match="tree"):
        read_driven(field, poses, seen.assign(seen="tree"))


@pytest.mark.filterwarnings("ignore:robot .* usually moves")
@pytest.mark.parametrize("unit", [60.0, 3600.0, 86400.0, 1e-3, 1e-6])
def test_times_in_other_units_are_refused_with_the_unit(field, unit):
    poses, seen = driven(field, PLANNED)
    for start in (0.0, 738_000.0):
        with pytest.raises(TrustboError, match="seconds"):
            read_driven(field, *(table.assign(t=start + table.t / unit) for table in (poses, seen)))


def test_a_long_log_in_minutes_is_warned_of(field):
    poses, seen = driven(field, PLANNED)
    fast = [table.assign(t=table.t / 40.0) for table in (poses.iloc[::1], seen)]
    with pytest.warns(UserWarning, match="seconds|tick="):
        read_tracks(*fast, window=1.0, tick=0.1)


def test_exact_copies_of_poses_are_refused_with_the_remedy(field):
    poses, seen = driven(field, PLANNED)
    with pytest.raises(TrustboError, match="drop_duplicates"):
        read_driven(field, pd.concat([poses, poses.iloc[:1]]), seen)
    assert read_driven(field, pd.concat([poses, poses.iloc[:1]]).drop_duplicates(), seen).path


def test_tables_of_xarray_are_read_as_frames_are(field):
    poses, seen = driven(field, PLANNED)
    tables = [table.reset_index(drop=True) for table in (poses, seen)]
    one, other = (
        read_driven(field, *of) for of in (tables, [table.to_xarray() for table in tables])
    )
    np.testing.assert_array_equal(one.contact_rate, other.contact_rate)


def unbroken(times, start=0.0, hz=10):
    """Poses of 60 s along the planned cells, and detections of the lead by both robots."""
    n = 60 * hz + 1
    t = np.arange(n) / hz
    poses = pd.concat([pd.DataFrame({"t": start + t, "robot": name}) for name in ("L", *NAMES)])
    poses["x"] = np.tile(10.0 + t, 3)
    poses["y"] = np.tile(10.0 + t, 3)
    seen = [pd.DataFrame({"t": start + times, "watcher": name, "seen": "L"}) for name in NAMES]
    return poses, pd.concat(seen)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize("phase", [0.0, 0.3, 0.95])
@pytest.mark.parametrize("hz", [1, 5, 10, 20, 30])
def test_a_detection_at_each_reading_is_contact_in_all_ticks(field, hz, phase, start):
    times = (np.arange(60 * hz) + phase) / hz
    one = read_driven(field, *unbroken(times, start, hz), tick=1.0 / hz)
    assert one.contact_rate.min() == 1.0
    assert one.n_ticks.sum(0).max() == pytest.approx(60 * hz, abs=1)


@pytest.mark.parametrize("interval", [1.0, 1.01, 0.99])
@pytest.mark.parametrize("phase", [0.0, 0.5, 0.98])
def test_errors_of_times_at_the_edges_of_ticks_are_no_lost_contact(field, interval, phase):
    rng = np.random.default_rng(0)
    times = np.arange(phase, 60.0, interval)
    times = np.abs(times + rng.normal(0.0, 0.05, len(times)))
    one = read_driven(field, *unbroken(times))
    assert one.contact_rate.mean() > 0.96


@pytest.mark.parametrize("interval", [1.05, 1.2, 1.3, 1.45, 2.0])
@pytest.mark.parametrize("of", [("a", "b"), ("b",)])
def test_readings_further_apart_than_a_tick_are_warned_of_with_the_remedy(field, interval, of):
    poses, seen = unbroken(np.arange(0.5, 60.0))
    _, rare = unbroken(np.arange(0.03, 60.0, interval))
    seen = pd.concat([seen[~seen.watcher.isin(of)], rare[rare.watcher.isin(of)]])
    with pytest.warns(UserWarning, match=f"pass tick={interval:g}"):
        read_driven(field, poses, seen)

    one = read_driven(field, poses, seen, tick=interval)
    assert one.contact_rate.min() == 1.0


@pytest.mark.parametrize("interval", [0.9, 0.7, 0.5, 0.3])
@pytest.mark.parametrize("jitter", [0.0, 0.05])
def test_readings_closer_together_than_a_tick_are_warned_of_with_the_remedy(
    field, interval, jitter
):
    rng = np.random.default_rng(0)
    times = np.arange(0.1, 60.0, interval)
    times = times + rng.uniform(-jitter, jitter, len(times)) * interval
    poses, seen = unbroken(times)
    is_found = rng.random(len(times)) < 0.7
    found = seen[np.tile(is_found, 2)]
    with pytest.warns(UserWarning, match="only .* apart.* pass .* tick=") as caught:
        high = read_driven(field, poses, found)

    advised = float(str(caught[0].message).partition("tick=")[2].split(",")[0])
    assert advised == pytest.approx(interval, rel=0.05)
    one = read_driven(field, poses, found, tick=advised)
    assert abs(one.contact_rate.mean() - is_found.mean()) < 0.05
    assert high.contact_rate.mean() > one.contact_rate.mean()


def test_irregular_readings_of_about_a_tick_are_not_warned_of(field):
    rng = np.random.default_rng(0)
    times = np.arange(0.5, 60.0) + rng.uniform(-0.25, 0.25, 60)
    poses, seen = unbroken(times)
    read_driven(field, poses, seen[np.tile(rng.random(60) < 0.7, 2)])


def test_a_robot_without_poses_did_not_take_part(field):
    poses, seen = driven(field, PLANNED)
    there = poses[poses.robot != "b"]
    with pytest.warns(UserWarning, match="no poses of b of the team") as caught:
        one = read_driven(field, there, seen[seen.watcher != "b"])
    assert len(caught) == 1  # it is not also said that no detection names b
    assert np.isnan(one.contact_rate[:, 1]).all()
    np.testing.assert_array_equal(
        one.contact_rate[:, 0], read_driven(field, poses, seen).contact_rate[:, 0]
    )


def test_the_message_about_a_missed_cell_names_a_gap_between_poses(field):
    poses, seen = driven(field, PLANNED)
    gap = poses[~poses.t.between(8.0, 32.0)]
    with pytest.raises(TrustboError, match=r"never enters .* unknown for up to 2"):
        read_driven(field, gap, seen)


@pytest.mark.parametrize(
    "column",
    [lambda t: t % 2 < 1, lambda t: (t % 2 < 1) * 1, lambda t: np.where(t % 2 < 1, "yes", "no"),
     lambda t: np.where(t % 2 < 1, 3.0, np.nan), lambda t: t % 2 / 2.5],
)  # fmt: skip
def test_columns_that_may_mark_rows_without_detections_are_refused(field, column, tmp_path):
    poses, seen = unbroken(np.arange(0.5, 60.0))
    scans = seen.assign(detected=column(seen.t))
    scans.to_csv(tmp_path / "scans.csv", index=False)
    for table in (scans, tmp_path / "scans.csv"):
        with pytest.raises(TrustboError, match="detected"):
            read_driven(field, poses, table)


def test_numbers_of_rows_are_no_further_column(field, tmp_path):
    poses, seen = unbroken(np.arange(0.5, 60.0))
    numbered = seen.reset_index(drop=True).rename_axis("scan")
    numbered.to_csv(tmp_path / "seen.csv")
    for table in (numbered, numbered.to_xarray(), tmp_path / "seen.csv"):
        assert read_driven(field, poses, table).contact_rate.min() == 1.0


def test_robots_that_only_the_lead_detects_are_warned_of(field):
    poses, seen = unbroken(np.arange(0.5, 60.0))
    swapped = seen.rename(columns={"watcher": "seen", "seen": "watcher"})
    with pytest.warns(UserWarning, match="a, b never .* 120 detections"):
        assert read_driven(field, poses, swapped).contact_rate.max() == 0.0
    with pytest.warns(UserWarning, match="120 detections"):
        both = read_driven(field, poses, pd.concat([seen, swapped]))
    np.testing.assert_array_equal(both.contact_rate, read_driven(field, poses, seen).contact_rate)


@pytest.mark.parametrize("heading", [None, np.nan, [0.0, *[np.nan] * 600] * 3])
def test_robots_that_stand_still_need_no_heading_on_a_map(field, heading):
    poses, seen = unbroken(np.arange(0.5, 60.0))
    poses.loc[poses.robot == "b", ["x", "y"]] = 15.0
    table = poses if heading is None else poses.assign(heading=heading)
    assert read_driven(field, table, seen).contact_rate.min() == 1.0
    with pytest.raises(TrustboError, match="heading"):
        read_tracks(table, seen)


@pytest.mark.parametrize("sparse", ["a", "L"])
def test_detections_that_gaps_of_poses_cost_are_warned_of(field, sparse):
    poses, seen = unbroken(np.arange(0.5, 60.0))
    kept = (poses.robot != sparse) | np.isin(poses.t, [*range(13), *range(18, 33), *range(38, 61)])
    with pytest.warns(UserWarning, match=f"% of the detections by a.* poses of {sparse} .* 6 s"):
        read_driven(field, poses[kept], seen)

    kept = (poses.robot != sparse) | (poses.t % 5.0 == 0.0)
    assert read_driven(field, poses[kept], seen).contact_rate.min() == 1.0


@pytest.mark.parametrize("path", [None, [(3, 0), (3, 1), (3, 2), (3, 3)]])
@pytest.mark.parametrize("edge", [0.0, 1.0])
def test_inexact_positions_at_an_edge_do_not_begin_a_bound(field, edge, path):
    """The lead waits 60 s, 1 m before the edge of its cell or on it, and drives on at 1 m/s."""
    t = np.arange(0.0, 120.5, 0.5)
    x = 19.0 + edge + np.maximum(t - 60.0, 0.0)
    error = np.where((t < 60.0) & ((t + 3.0) % 9.0 < 2.0), 1.5, -0.1)
    poses = pd.DataFrame({"t": t, "robot": "L", "x": x + error, "y": 10.0})
    poses = pd.concat([poses.assign(x=x, robot=name) for name in NAMES] + [poses])
    seen = [pd.DataFrame({"t": np.arange(60.5, 120.0), "watcher": name}) for name in NAMES]

    one = read_driven(field, poses[poses.x < 79.0], pd.concat(seen).assign(seen="L"), path=path)
    assert one.path == ((3, 0), (3, 1), (3, 2), (3, 3))
    np.testing.assert_allclose(one.duration[:2, 0], [30.0 - 19.0 - edge, 20.0], atol=2.0)
    assert one.contact_rate.min() == 1.0


def test_short_visits_to_cells_that_the_lead_drives_through_are_bounds(field):
    poses, seen = driven(field, PLANNED)
    fast = [table.assign(t=table.t / 6.0) for table in (poses, seen)]  # 3.3 s in each cell
    one = read_driven(field, *fast, tick=1.0 / 6.0)
    assert (len(one.bounds), one.status) == (3, "ok")


def test_a_planned_path_with_sets_of_posts_is_that_of_the_mission(field):
    poses, seen = driven(field, PLANNED)
    path = ((3, 0, "far"), (2, 1), (1, 2, "route"), (0, 3))
    one = read_driven(field, poses, seen, path=path)
    assert (one.stations, one.status) == (path, "ok")
    plain = read_driven(field, poses, seen)
    np.testing.assert_array_equal(one.contact_rate, plain.contact_rate)
    with pytest.raises(TrustboError, match="path"):
        read_driven(field, poses, seen, path=[(3, 0, "near"), *PLANNED[1:]])


def test_the_bound_in_which_a_log_ends_failed_and_keeps_its_readings(field):
    """The mission is that of a table in which the last leg has a status."""
    tables = [table[table.t < 50.0] for table in driven(field, PLANNED)]
    aborted = read_driven(field, *tables)  # before the lead enters (0, 3)
    assert (len(aborted.bounds), aborted.status) == (2, "aborted")

    one = read_driven(field, *tables, status="stuck")
    assert (one.driven, one.statuses) == (tuple(PLANNED), ["ok", "ok", "stuck"])
    np.testing.assert_array_equal(one.contact_rate[0], aborted.contact_rate[0])
    seen = tables[1]
    share = np.mean(np.isin(np.arange(41, 49), np.floor(seen.t[seen.watcher == "a"])))
    assert one.contact_rate[2, 0] == pytest.approx(share, abs=0.15)

    (read,) = tb.logs.read_table(tb.logs.to_frame([one]))
    assert one.has_same_data(read)


def test_a_lead_that_enters_a_cell_but_not_its_stop_fails_the_bound_into_it(field):
    tables = [table[table.t < 32.0] for table in driven(field, PLANNED)]  # is 8 m before (1, 2)
    one = read_driven(field, *tables, status="stuck")
    assert (one.driven, one.statuses) == (tuple(PLANNED[:3]), ["ok", "stuck"])


@pytest.mark.parametrize("n", [2, 3])
def test_a_subteam_that_fails_to_close_up_fails_the_bound_at_whose_stop_the_lead_is(field, n):
    poses, seen = driven(field, PLANNED[: n + 1])
    waits = poses.loc[poses.t == poses.t.max()]
    poses = pd.concat([poses, *(waits.assign(t=waits.t + k) for k in range(1, 30))])
    one = read_driven(field, poses, seen, status="tipped")
    assert (one.driven, one.status) == (tuple(PLANNED[: n + 1]), "tipped")
    np.testing.assert_allclose(one.duration[:, 0], [20.0] * (n - 1) + [49.0], atol=1.0)


@pytest.mark.parametrize("sd", [0.0, 0.5])
def test_a_lead_that_waits_where_it_is_stuck_does_not_prolong_its_bound(field, sd):
    poses, seen = (table[table.t < 50.0] for table in driven(field, PLANNED))
    stands = poses.loc[poses.t == poses.t.max()]
    poses = pd.concat([poses, *(stands.assign(t=stands.t + k) for k in range(1, 300))])
    poses[["x", "y"]] += sd * np.random.default_rng(0).normal(size=(len(poses), 2))
    with pytest.warns(UserWarning, match=r"detections by a, b end 30\d s before the poses"):
        one = read_driven(field, poses, seen, status="stuck")
    assert one.statuses == ["ok", "ok", "stuck"]
    assert one.duration[2, 0] == pytest.approx(17.0, abs=2.0)  # 7 s of driving, and 10 s more


def test_what_a_stuck_lead_does_after_it_left_its_way_is_not_measured(field):
    tables = driven(field, [(3, 0), (2, 1), (3, 2), (3, 3)])  # is towed away from (2, 1)
    with pytest.warns(UserWarning, match=r"\(1, 2\)"):
        one = read_driven(field, *tables, status="stuck")
    assert one.statuses == ["ok", "stuck"]
    assert one.duration[1, 0] < 12.0  # of 40


def test_a_lead_that_stops_short_of_the_edge_is_at_the_stop_behind_it(ground_with_sets):
    """Stops lie close to edges. The lead stops 0.5 m before the goal's cell, and goes round it."""
    grid, posts = ground_with_sets.grid, ground_with_sets.posts
    cell = min(np.ndindex(grid.shape), key=lambda cell: edge_distance(grid, posts.stop(cell)))
    stop = posts.stop(cell)
    assert edge_distance(grid, stop) < 3.0
    row, col = grid.to_cell(*stop)
    out = np.array([round(col) - col, row - round(row)]) * (grid.cell_width, grid.cell_height)
    out[np.argmax(np.abs(out))] = 0.0
    beyond = stop + out * (1.0 + 0.5 / np.linalg.norm(out))
    other = tuple(map(int, np.ravel(grid.cells_at(*np.transpose([beyond]))[:2])))
    assert other != cell

    begin = posts.stop(other)
    t = np.arange(0.0, 81.0)
    way = np.clip((t - 10.0) / 20.0, 0.0, 1.0)[:, None]
    lead = pd.DataFrame((1.0 - way) * begin + way * beyond, columns=["x", "y"]).assign(t=t)
    poses = pd.concat([lead.assign(robot=name) for name in ("lead", *ground_with_sets.team.names)])
    seen = pd.concat(
        [lead[["t"]].assign(watcher=n, seen="lead") for n in ground_with_sets.team.names]
    )
    [one] = tb.logs.read_tracks(poses, seen, ground_with_sets, path=[(*other, "far"), cell])
    assert one.status == "ok"
    assert one.duration[0, 0] > 60.0


def edge_distance(grid, xy):
    """Distance of a position from the nearest edge of its cell, m."""
    row, col = grid.to_cell(*xy)
    return min(abs(row - round(row)) * grid.cell_height, abs(col - round(col)) * grid.cell_width)


def test_bounds_of_few_readings_are_named(field):
    poses, seen = driven(field, PLANNED)
    seen = seen[seen.t % 5.0 == 0.0]
    with pytest.warns(UserWarning, match=r"fewer than 5 readings: 1 into \(2, 1\), 2 into"):
        read_driven(field, poses, seen, tick=5.0)


def test_a_failed_bound_of_tracks_is_charged_and_no_other(field):
    tables = [table[table.t < 50.0] for table in driven(field, PLANNED)]
    one = read_driven(field, *tables, status="stuck")
    trials = Trials.from_missions([one])
    np.testing.assert_array_equal(trials.bounds[:, 1:3], sorted(PLANNED[1:]))
    np.testing.assert_array_equal(trials.failed, [1.0, 0.0, 0.0])  # into (0, 3)


@pytest.mark.parametrize(
    ("options", "cells"),
    [
        ({"status": "stuck"}, [*PLANNED, (1, 2), (2, 1)]),  # goes back from the goal
        ({"status": "ok"}, PLANNED),
        ({"status": "lost"}, PLANNED),
        ({"status": "stuck", "path": None}, PLANNED),
    ],
)
def test_a_status_that_does_not_fit_the_log_is_refused(field, options, cells):
    with pytest.raises(TrustboError, match="status"):
        read_driven(field, *driven(field, cells), **options)


def test_a_robot_of_the_team_without_poses_is_refused_with_the_names_of_the_log(field):
    poses, seen = driven(field, PLANNED)
    renamed = poses.assign(robot=poses.robot.replace("b", "b2"))
    with pytest.raises(TrustboError, match="robots L, a, b2, but no poses of b of the team"):
        read_driven(field, renamed, seen)


def test_a_clock_that_was_set_back_is_named_with_the_speed(field):
    poses, seen = driven(field, PLANNED * 3, hz=2)
    late = poses.robot.eq("a") & poses.t.gt(100.2)
    with pytest.raises(TrustboError, match=r"robot 'a' moves at .* clock"):
        read_driven(field, poses.assign(t=poses.t - 60.2 * late), seen)


def test_ticks_of_a_gap_in_which_a_robot_has_no_poses_are_not_counted(field):
    poses, seen = unbroken(np.arange(0.5, 60.0))
    seen = seen[(seen.watcher != "a") | ~seen.t.between(25.0, 35.0)]  # a recorder that stopped
    assert read_driven(field, poses, seen).contact_rate[:, 0].min() < 1.0
    kept = poses[~(poses.robot.eq("a") & poses.t.between(25.0, 35.0))]
    assert read_driven(field, kept, seen).contact_rate.min() == 1.0


@pytest.fixture(scope="module")
def ground_with_sets():
    return tb.Workspace.from_terrain(hillside(), (3, 3))


def test_tracks_show_at_the_posts_of_which_sets_the_robots_stood(ground_with_sets):
    path, sets = ((2, 0), (1, 1), (1, 2), (0, 2)), ("far", "standard", "route")
    simulator = tb.simulation.KinematicSimulator(ground_with_sets, tick=0.5)
    mission = simulator.run(path, post_sets=sets, seed=1)
    poses, detections = tables_of(mission, ground_with_sets.team.names)
    options = {"path": path, "tick": 0.5}
    [read] = tb.logs.read_tracks(poses, detections, ground_with_sets, **options)
    assert read.post_sets == sets

    # A bound lasts from stop to stop, as in the simulator.
    assert read.statuses == mission.statuses
    np.testing.assert_allclose(read.duration, mission.duration, atol=4.0)
    np.testing.assert_allclose(read.contact_rate, mission.contact_rate, atol=0.05)

    named = {**options, "path": [(2, 0, "route"), (1, 1), (1, 2), (0, 2)]}
    [told] = tb.logs.read_tracks(poses, detections, ground_with_sets, **named)
    assert told.post_sets == ("route", "standard", "standard")

    away = poses.assign(x=poses["x"] + 40.0 * (poses["robot"] == "r2"))
    with pytest.warns(UserWarning, match="did not stand at their posts"):
        [other] = tb.logs.read_tracks(away, detections, ground_with_sets, **options)
    assert other.post_sets == ()


def tables_of(mission, robots):
    """Poses and detections of a simulated mission."""
    poses, looks = [], []
    members = "lead", *robots
    for bound in mission.bounds:
        times = np.linspace(bound.t0, bound.t1, len(bound.poses), endpoint=False) + 0.1
        for t, places, seen in zip(times, bound.poses, bound.contact, strict=True):
            poses += [(t, name, *xy[:2]) for name, xy in zip(members, places, strict=True)]
            looks += [(t, name, "lead") for name, there in zip(robots, seen, strict=True) if there]
    return (
        pd.DataFrame(poses, columns=["t", "robot", "x", "y"]),
        pd.DataFrame(looks, columns=["t", "watcher", "seen"]),
    )
