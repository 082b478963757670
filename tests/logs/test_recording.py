"""Robots' own logs: bags of standard messages become missions, and whatever is amiss is named."""

import json

import numpy as np
import pytest
from bags import Log

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.logs.bag import Topics, read_bag

rosbags = pytest.importorskip("rosbags", reason="needs the extra ros")


def markers(log, ends=(10.0, 14.0, 20.0)):
    """Two bounds into (0, 1) and (0, 2), from (0, 0)."""
    for k, seconds in enumerate(ends):
        log.bound(seconds, k, 0, k)
    return log


@pytest.mark.parametrize("version", [1, 2])
def test_a_robot_s_own_log_is_read(version, tmp_path):
    log = markers(Log(version))
    log.contact("b", (14.5, True), (15.0, False), (20.0, True), (21.0, True), (22.0, True))
    log.contact("a", (14.6, 1.0), (21.5, 0.4), (25.0, 0.6), kind="std_msgs/msg/Float32")
    log.awareness(19.0, "a", [0.25, 0.5], "visibility,slope")
    log.awareness(19.5, "a", [0.75, 0.5], "visibility,slope")
    log.odometry(5.0, "lead", 1.0, 2.0)
    log.odometry(16.0, "lead", 3.0, 4.0, (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    log.odometry(14.9, "b", 5.0, 6.0, (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0))
    log.odometry(30.0, "a", 7.0, 8.0)
    (one,) = read_bag(log.save(tmp_path / ("log.bag" if version == 1 else "log")))
    assert (one.robots, one.features) == (("a", "b"), ("visibility", "slope"))
    assert (one.path, one.status) == (((0, 0), (0, 1), (0, 2)), "ok")
    first, second = one.bounds
    # Without a status, a bound ends with its last look; one at a marker is of the bound before.
    np.testing.assert_array_equal(first.n_ticks, [1, 3])
    np.testing.assert_allclose(one.contact_rate, [[1.0, 2 / 3], [0.5, 1.0]])
    np.testing.assert_array_equal(one.duration, [[6.0, 6.0], [5.0, 5.0]])
    assert (first.t0, second.t0) == (4.0, 10.0)
    np.testing.assert_array_equal(first.awareness, [[0.75, 0.5], [np.nan, np.nan]])
    assert np.isnan(second.awareness).all()
    # Ticks are those of b, which looked most often; a's last look stands until its next.
    np.testing.assert_array_equal(first.contact, [[True, True], [True, False], [True, True]])
    np.testing.assert_allclose(first.poses[:, 0], [[1, 2, 0], [1, 2, 0], [3, 4, np.pi / 2]])
    assert np.isnan(first.poses[:, 1]).all()  # not known yet
    assert np.isnan(first.poses[0, 2]).all()
    np.testing.assert_allclose(
        first.poses[1, 2], [5.0, 6.0, np.pi / 2]
    )  # upside down, heading north


def test_a_status_ends_a_bound_and_what_comes_after_it_does_not_count(tmp_path):
    log = markers(Log())
    log.contact("a", (12.0, True), (15.0, True), (16.0, False), (19.0, False), (21.0, True))
    log.text(17.0, "/mission/status", "ok")
    log.text(23.0, "/mission/status", "collision")
    log.text(24.0, "/mission/status", "aborted")
    (one,) = read_bag(log.save(tmp_path / "log"))
    np.testing.assert_array_equal(one.duration, [[3.0], [3.0]])
    np.testing.assert_array_equal(one.contact_rate, [[0.5], [1.0]])
    assert [bound.status for bound in one.bounds] == ["ok", "collision"]
    assert one.status == "aborted"
    assert one.bounds[0].poses is None


def test_a_mission_whose_end_nobody_reported_is_aborted(tmp_path):
    log = Log()
    plan = {"bound": 0, "cell": [0, 0], "path": [[0, 0], [0, 1], [0, 2]]}
    log.text(1.0, "/mission/bound", json.dumps(plan))
    log.text(2.0, "/mission/bound", '{"bound": 1, "cell": [0, 1]}')
    log.contact("a", (3.0, True))
    log.text(8.0, "/mission/bound", json.dumps(plan))  # begun again, and given up at once
    (one,) = read_bag(log.save(tmp_path / "log"))
    assert (one.status, len(one.path), len(one.bounds)) == ("aborted", 3, 1)


def test_a_robot_that_did_not_look_has_no_rate(tmp_path):
    log = markers(Log())
    log.contact("a", (15.0, True), (21.0, True))
    log.contact("b", (16.0, True))
    (one,) = read_bag(log.save(tmp_path / "log"))
    np.testing.assert_array_equal(one.contact_rate, [[1.0, 1.0], [1.0, np.nan]])
    np.testing.assert_array_equal(one.n_ticks, [[1.0, 1.0], [1.0, np.nan]])
    assert one.bounds[1].contact is None


@pytest.mark.parametrize("kind", ["std_msgs/msg/Float32", "std_msgs/msg/Float64"])
def test_a_contact_of_nan_is_no_look(kind, tmp_path):
    log, nan = markers(Log()), np.nan
    log.contact("a", (14.5, 1.0), (15.0, nan), (16.0, 0.0), (21.0, 1.0), (23.0, nan), kind=kind)
    log.contact("b", (14.5, nan), (15.0, 1.0), (21.0, nan), (22.0, nan), kind=kind)
    (one,) = read_bag(log.save(tmp_path / "log"))
    np.testing.assert_array_equal(one.contact_rate, [[0.5, 1.0], [1.0, nan]])
    np.testing.assert_array_equal(one.n_ticks, [[2.0, 1.0], [1.0, nan]])
    np.testing.assert_array_equal(one.bounds[0].contact, [[True, True], [False, True]])
    assert one.duration[1, 0] == 3.0  # the robot was there until its last message


@pytest.mark.parametrize("value", [85.0, -1.0, np.inf])
def test_a_contact_that_is_no_share_is_refused(value, tmp_path):
    log = markers(Log())
    log.contact("a", (15.0, value), (21.0, 1.0), kind="std_msgs/msg/Float32")
    refuse(log, tmp_path, rf"/a/contact: contact {value:g} is outside \[0, 1\]; .* by 100")


def refuse(log, tmp_path, message, **options):
    with pytest.raises(TrustboError, match=message):
        read_bag(log.save(tmp_path / "log"), **options)


def test_missing_topics_are_named_with_those_that_are_there(tmp_path):
    log = markers(Log())
    log.contact("r1", (15.0, True), (21.0, True))
    message = r"lacks /r2/contact, /r3/contact; it has /mission/bound \(std_msgs/msg/Int32MultiA"
    team = tb.Workspace.from_awareness(np.full((3, 3, 3, 2), 0.5))
    refuse(log, tmp_path, message, workspace=team)
    with pytest.raises(TrustboError, match=r"lacks /\{robot\}/seen; it has .*Topics\("):
        read_bag(tmp_path / "log", topics=Topics(contact="/{robot}/seen"))
    log.odometry(12.0, "r1", 0.0, 0.0)
    with pytest.raises(TrustboError, match="lacks /lead/odom; it has"):
        read_bag(log.save(tmp_path / "more"))


def test_clocks_that_go_backwards_are_refused(tmp_path):
    log = markers(Log())
    log.contact("a", (15.0, True), (21.0, True))
    for seconds, stamp in ((11.0, 11.0), (12.0, 12.0), (13.0, 3.5)):
        log.odometry(seconds, "lead", 0.0, 0.0, stamp=stamp)
    log.odometry(12.0, "a", 0.0, 0.0)
    message = (
        r"clock of /lead/odom goes backwards: its message 2 is of 3\.500000000 s, the one before "
        r"of 12\.000000000 s"
    )
    refuse(log, tmp_path, message)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ([(1, 0, 1)], r"begins with the marker of bound 0, the start cell; .* bounds \[1\]"),
        ([(0, 0, 0), (2, 0, 1)], "mission 0: bound 2 follows bound 0"),
        ([(0, 0)], r"/mission/bound: a marker must be JSON with .*, or \[bound, row, col\]; got"),
        ([], "lacks /mission/bound"),
    ],
)
def test_markers_out_of_turn_are_refused(bounds, message, tmp_path):
    log = Log()
    log.contact("a", (30.0, True))
    for seconds, values in enumerate(bounds, start=1):
        log.bound(seconds, *values)
    refuse(log, tmp_path, message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("go", "/mission/bound: a marker must be JSON with a bound and a cell"),
        ('{"bound": "0", "cell": [0, 0]}', "a marker must be JSON"),
        ('{"bound": 0, "cell": [0.5, 0]}', "a marker must be JSON"),
        ("[0, 0, 0]", "a marker must be JSON"),
        (
            '{"bound": 0, "cell": [0, 0], "path": [[1, 1], [0, 1]]}',
            r"mission 0: it starts in \(0, 0\), but its path in \(1, 1\)",
        ),
        (
            '{"bound": 0, "cell": [0, 0], "path": [[0, 0], [1, 1]]}',
            r"mission 0: bound 1 enters \(0, 1\), but the path has \(1, 1\) there",
        ),
    ],
)
def test_markers_that_make_no_sense_are_refused(text, message, tmp_path):
    log = Log()
    log.text(1.0, "/mission/bound", text)
    log.text(2.0, "/mission/bound", '{"bound": 1, "cell": [0, 1]}')
    log.contact("a", (3.0, True))
    refuse(log, tmp_path, message)


def test_values_that_make_no_sense_are_refused(tmp_path):
    def log():
        one = markers(Log())
        one.contact("a", (15.0, True), (21.0, True))
        return one

    cases = [
        (lambda one: one.text(15.0, "/mission/status", "fine"), "bound 1: unknown status 'fine'"),
        (
            lambda one: one.awareness(15.0, "a", [0.5, 1.5]),
            r"bound 1: awareness .* 1\.5 is outside",
        ),
        (
            lambda one: (one.awareness(15.0, "a", [0.5]), one.awareness(16.0, "a", [0.5] * 3)),
            r"/a/awareness has 3 unnamed values; the features are traversability\.",
        ),
        (lambda one: one.awareness(15.0, "a", [0.5], "a,b"), "/a/awareness: it has 1 values named"),
        (
            lambda one: one.contact("b", (15.0, "yes"), kind="std_msgs/msg/String"),
            "/b/contact is std",
        ),
    ]
    for i, (spoil, message) in enumerate(cases):
        one = log()
        spoil(one)
        with pytest.raises(TrustboError, match=message):
            read_bag(one.save(tmp_path / str(i)))
    one = log()
    one.awareness(15.0, "a", [0.5, 0.5], "traversability,traversibility")
    team = tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5), team=tb.Team(1, names=("a",)))
    with pytest.raises(TrustboError, match="/a/awareness has traversibility; the features are tra"):
        read_bag(one.save(tmp_path / "typo"), team)
