"""ROS bags, written by rosbags alone, as missions."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bags import Log, record
from worlds import hillside

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.logs import read_bag

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def workspace():
    return tb.Workspace.from_terrain(hillside(), (3, 3), tb.Team(n_robots=2))


@pytest.fixture(scope="module")
def driven(workspace):
    simulator = tb.simulation.KinematicSimulator(workspace)
    first = simulator.run([(2, 0), (1, 1), (0, 2)], seed=0)
    names = ("awareness", "contact_rate", "duration", "n_ticks", "starts", "poses", "contact")
    of_bound = {name: getattr(first, name)[:1] for name in names}
    return [first, replace(first, **of_bound, bound_status=("aborted",), status="aborted")]


@pytest.mark.parametrize("kind", ["log.bag", "sqlite3", "mcap"])
def test_bags_of_all_kinds_give_the_missions_back(kind, driven, workspace, tmp_path):
    storage = {} if kind == "log.bag" else {"storage": kind}
    path = record(
        driven,
        tmp_path / kind,
        names={f"/{robot}/contact": f"/{robot}/sees" for robot in ("r1", "r2")},
        **storage,
    )
    with pytest.raises(TrustboError, match="/r1/contact"):
        read_bag(path, workspace)
    assert len(read_bag(path, workspace, contact="/{robot}/sees")) == 2
    path = record(driven, tmp_path / f"again-{kind}", **storage)
    found = read_bag(path, workspace)
    assert [m.status for m in found] == ["ok", "aborted"]
    for one, other in zip(found, driven, strict=True):
        assert one.path == other.path
        np.testing.assert_array_equal(one.contact_rate, other.contact_rate)
        np.testing.assert_array_equal(one.n_ticks, other.n_ticks)
        np.testing.assert_allclose(one.duration, other.duration, atol=1e-8)
        assert np.isnan(one.awareness).all()
        for a, b in zip(one.bounds, other.bounds, strict=True):
            assert a.t0 == pytest.approx(b.t0, abs=1e-8)
            assert (a.status, a.poses, a.contact) == (b.status, None, None)


def test_looks_that_failed_are_no_ticks_and_a_bound_ends_with_its_last_contact(workspace, tmp_path):
    log = Log()
    for seconds, *marker in ((1.0, 0, 2, 0), (1.0, 1, 1, 1), (4.0, 2, 0, 2)):
        log.bound(seconds, *marker)
    of_1 = (1.5, 1.0), (2.0, np.nan), (2.5, 0.2), (5.0, 1.0)
    log.contact("r1", *of_1, kind="std_msgs/msg/Float32")
    log.contact("r2", (2.0, True), (6.0, False))
    log.messages.sort(key=lambda message: message[0])
    (one,) = read_bag(log.save(tmp_path / "bag"), workspace)
    np.testing.assert_array_equal(one.contact_rate, [[0.5, 1.0], [1.0, 0.0]])
    np.testing.assert_array_equal(one.n_ticks, [[2, 1], [1, 1]])
    np.testing.assert_allclose(one.duration[:, 0], [1.5, 2.0])


@pytest.mark.parametrize("kind", ["log.bag", "sqlite3", "mcap"])
def test_messages_that_are_stored_out_of_order_are_put_in_order(kind, workspace, tmp_path):
    log = Log(1 if kind == "log.bag" else 2)
    log.contact("r1", (4.0, True), (2.0, False), (3.0, True))
    log.contact("r2", (3.5, True))
    for seconds, *marker in ((1.5, 1, 1, 1), (1.0, 0, 2, 0), (3.2, 2, 0, 2)):
        log.bound(seconds, *marker)
    (one,) = read_bag(log.save(tmp_path / kind, kind), workspace)
    np.testing.assert_array_equal(one.contact_rate, [[0.5, np.nan], [1.0, 1.0]])
    np.testing.assert_allclose(one.duration[:, 0], [1.5, 0.8])


@pytest.mark.parametrize(
    "markers", [((1, 1, 1),), ((0, 2, 0), (2, 1, 1)), ((0, 2, 0), (1, 1)), ((0, 2, 0), (-1, 1, 1))]
)
def test_markers_out_of_order_are_refused(markers, workspace, tmp_path):
    log = Log()
    for k, marker in enumerate(markers):
        log.bound(1.0 + k, *marker)
    for robot in ("r1", "r2"):
        log.contact(robot, (3.0, True))
    with pytest.raises(TrustboError):
        read_bag(log.save(tmp_path / "bag"), workspace)
    with pytest.raises(TrustboError):
        read_bag(tmp_path / "none.bag", workspace)


def test_topics_in_a_namespace_are_read_with_their_prefix(driven, workspace, tmp_path):
    topics = ("/mission/bound", "/mission/status")
    path = record(driven, tmp_path / "log.bag", names={name: f"/ugv{name}" for name in topics})
    with pytest.raises(TrustboError, match='prefix="/ugv"') as caught:
        read_bag(path, workspace)
    assert "contact=" not in str(caught.value)

    for prefix in ("/ugv", "ugv/"):
        found = read_bag(path, workspace, prefix=prefix)
        assert [mission.status for mission in found] == ["ok", "aborted"]


def test_the_message_about_a_missing_contact_topic_names_its_namespace(driven, workspace, tmp_path):
    names = {f"/{robot}/contact": f"/ugv/{robot}/contact" for robot in ("r1", "r2")}
    path = record(driven, tmp_path / "log.bag", names=names)
    with pytest.raises(TrustboError, match="contact=") as caught:
        read_bag(path, workspace)
    assert "prefix=" not in str(caught.value)
    assert 'contact="/ugv/{robot}/contact"' in str(caught.value)
    assert len(read_bag(path, workspace, contact="/ugv/{robot}/contact")) == 2


def bound_of_both(*looks):
    """A bag of one bound of 60 s; `looks` are the contact messages of r1, r2 always has contact."""
    log = Log()
    log.bound(1.0, 0, 2, 0)
    log.bound(1.0, 1, 1, 1)
    log.contact("r1", *looks)
    log.contact("r2", *((k + 1.5, True) for k in range(60)))
    log.text(61.0, "/mission/status", "ok")
    log.messages.sort(key=lambda message: message[0])
    return log


SEEN = np.random.default_rng(0).random(60) < 0.6


def test_a_robot_without_a_topic_of_contact_is_unknown_with_a_warning(workspace, tmp_path):
    log = bound_of_both()
    with pytest.warns(UserWarning, match="lacks /r1/contact, so"):
        (one,) = read_bag(log.save(tmp_path / "bag"), workspace)
    np.testing.assert_array_equal(one.contact_rate, [[np.nan, 1.0]])


def test_a_robot_that_sends_only_during_contact_is_warned_of(workspace, tmp_path):
    log = bound_of_both(*((k + 1.5, True) for k in range(60) if SEEN[k]))
    with pytest.warns(UserWarning, match="all contact messages of r1 say"):
        read_bag(log.save(tmp_path / "bag"), workspace)

    log = bound_of_both(*((k + 1.5, bool(SEEN[k])) for k in range(60)))
    (one,) = read_bag(log.save(tmp_path / "whole"), workspace)
    np.testing.assert_array_equal(one.contact_rate, [[SEEN.mean(), 1.0]])


def test_a_robot_whose_messages_lie_outside_the_bounds_is_warned_of(workspace, tmp_path):
    log = bound_of_both(*((k + 3601.5, bool(SEEN[k])) for k in range(60)))
    with pytest.warns(UserWarning, match="all contact messages of r1 lie outside"):
        (one,) = read_bag(log.save(tmp_path / "bag"), workspace)
    np.testing.assert_array_equal(one.contact_rate, [[np.nan, 1.0]])


@pytest.mark.parametrize("kind", ["log.bag", "sqlite3"])
def test_a_bag_that_was_split_is_read_as_one(kind, workspace, tmp_path):
    whole = Log(1 if kind == "log.bag" else 2)
    for k, marker in enumerate([(2, 0), (1, 1), (0, 2)]):
        whole.bound(10.0 * k + 1.0, k, *marker)
        for i in range(4 if k else 0):
            for robot in ("r1", "r2"):
                whole.contact(robot, (10.0 * k + 2.0 + i, i % 2 == 0))
    first, second = Log(whole.version), Log(whole.version)
    first.messages, second.messages = whole.messages[:6], whole.messages[6:]
    paths = [one.save(tmp_path / f"{i}-{kind}") for i, one in enumerate((first, second))]

    (one,) = read_bag(whole.save(tmp_path / kind), workspace)
    (other,) = read_bag(paths, workspace)
    np.testing.assert_array_equal(one.n_ticks, [[4, 4], [4, 4]])
    np.testing.assert_array_equal(one.n_ticks, other.n_ticks)
    np.testing.assert_array_equal(one.contact_rate, other.contact_rate)


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("geometry_msgs/msg/Point", {"x": 1.0, "y": 0.0, "z": 0.0}),
        ("std_msgs/msg/String", {"data": "yes"}),
    ],
)
def test_contact_of_another_type_is_refused_with_its_topic_and_type(
    kind, fields, workspace, tmp_path
):
    log = Log()
    log.bound(1.0, 0, 2, 0)
    log.bound(2.0, 1, 1, 1)
    log.contact("r1", (3.0, True))
    log.say(3.0, "/r2/contact", kind, **fields)
    with pytest.raises(TrustboError, match=f"/r2/contact.*{kind}"):
        read_bag(log.save(tmp_path / "bag"), workspace)


def test_a_bound_of_another_type_is_refused_with_its_topic_and_type(workspace, tmp_path):
    log = Log()
    log.say(1.0, "/mission/bound", "std_msgs/msg/Bool", data=True)
    for robot in ("r1", "r2"):
        log.contact(robot, (3.0, True))
    with pytest.raises(TrustboError, match=r"/mission/bound.*std_msgs/msg/Bool"):
        read_bag(log.save(tmp_path / "bag"), workspace)


@pytest.mark.parametrize(("end", "status"), [((0, 2), "ok"), ((1, 2), "aborted")])
def test_a_mission_may_leave_the_planned_path(end, status, workspace, tmp_path):
    """As after `Campaign.replan`: the second bound fails, and the lead drives back."""
    log = Log()
    plan = {"bound": 0, "cell": [2, 0], "path": [[2, 0], [1, 1], [0, 2]]}
    log.text(1.0, "/mission/bound", json.dumps(plan))
    driven = [(1, 1), (0, 2), (1, 1), (1, 2), (0, 2)]
    driven = driven[: driven.index(end, 2) + 1]
    for k, cell in enumerate(driven, start=1):
        log.bound(10.0 * k, k, *cell)
        log.contact("r1", (10.0 * k + 5.0, k % 2 == 0))
        log.contact("r2", (10.0 * k + 5.0, True))
        log.text(10.0 * k + 6.0, "/mission/status", "stuck" if k == 2 else "ok")

    (one,) = read_bag(log.save(tmp_path / "bag"), workspace)
    assert one.path == ((2, 0), *driven)
    assert [bound.status for bound in one.bounds[:3]] == ["ok", "stuck", "ok"]
    assert one.status == status
    np.testing.assert_array_equal(one.contact_rate[:, 0], [k % 2 for k in range(len(driven))])


def test_a_bag_may_lie_in_the_home_folder(driven, workspace, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    record(driven, tmp_path / "log.bag")
    assert len(read_bag("~/log.bag", workspace)) == 2


ROBOTS = ("r1", "r2")


def said(*statuses, hz=2.0, seconds=60.0, version=2):
    """A log of three bounds of 20 s with contact all the time, and statuses (seconds, text)."""
    log = Log(version)
    log.bound(1.0, 0, 2, 0)
    for k, cell in enumerate([(1, 0), (1, 1), (0, 2)], start=1):
        log.bound(20.0 * k - 18.0, k, *cell)
    for robot in ROBOTS:
        log.contact(robot, *((2.25 + i / hz, True) for i in range(int(seconds * hz))))
    for time, text in statuses:
        log.text(time, "/mission/status", text)
    log.messages.sort(key=lambda message: message[0])
    return log


@pytest.mark.parametrize("lag", [-0.005, 0.0, 0.005, 0.2])
@pytest.mark.parametrize("hz", [2.0, 10.0])
@pytest.mark.parametrize("status", ["ok", "stuck"])
def test_a_status_just_after_the_next_marker_is_that_of_the_bound_before(
    status, hz, lag, workspace, tmp_path
):
    if (status, hz, lag) == ("stuck", 10.0, 0.2):
        lag = 0.1
    log = said((22.0 + lag, "ok"), (42.0 + lag, status), (62.0 + lag, "ok"), hz=hz)
    (one,) = read_bag(log.save(tmp_path / "bag"), workspace)
    assert one.statuses == ["ok", status, "ok"]
    np.testing.assert_array_equal(one.contact_rate, 1.0)
    np.testing.assert_allclose(one.n_ticks, 20.0 * hz, atol=3.0)
    np.testing.assert_allclose(one.duration, 20.0, atol=0.25)


def test_a_failure_after_contact_messages_of_a_bound_is_its_own(workspace, tmp_path):
    log = said((42.8, "stuck"), hz=10.0, seconds=42.0)
    (one,) = read_bag(log.save(tmp_path / "bag"), workspace)
    assert one.statuses == ["ok", "ok", "stuck"]


def test_a_status_may_follow_the_marker_of_the_next_mission(workspace, tmp_path):
    log = said((22.0, "ok"), (42.0, "ok"), (62.01, "stuck"))
    log.bound(62.0, 0, 2, 0)
    log.bound(62.0, 1, 1, 0)
    log.contact("r1", (63.0, True))
    log.messages.sort(key=lambda message: message[0])
    first, second = read_bag(log.save(tmp_path / "bag"), workspace)
    assert first.statuses == ["ok", "ok", "stuck"]
    assert second.statuses == ["ok"]


def test_different_statuses_of_a_bound_are_refused(workspace, tmp_path):
    log = said((21.0, "ok"), (30.0, "ok"), (41.0, "stuck"), (61.0, "ok"))
    with pytest.raises(TrustboError, match="bound 2"):
        read_bag(log.save(tmp_path / "bag"), workspace)

    log = said((21.0, "ok"), (41.0, "stuck"), (61.0, "stuck"), (61.5, "aborted"))
    (one,) = read_bag(log.save(tmp_path / "aborted"), workspace)
    assert one.statuses == ["ok", "stuck", "stuck"]


@pytest.mark.parametrize(
    "statuses",
    [
        [(t + 0.4, "ok") for t in range(2, 62)],  # at 1 Hz
        [(25.5, "ok"), (45.5, "ok"), (61.0, "ok")],  # 3.5 s late
        [(3.0, "ok"), (41.0, "ok"), (61.0, "ok")],
    ],
)
def test_a_status_that_ends_a_bound_during_contact_messages_is_warned_of(
    statuses, workspace, tmp_path
):
    path = said(*statuses, hz=10.0).save(tmp_path / "bag")
    with pytest.warns(UserWarning, match="contact messages continue"):
        read_bag(path, workspace)


def test_pauses_after_a_status_are_not_warned_of(workspace, tmp_path):
    log = said((14.0, "ok"), (35.0, "ok"), (50.0, "ok"), (50.1, "ok"), seconds=200.0)
    (one,) = read_bag(log.save(tmp_path / "bag"), workspace)
    np.testing.assert_allclose(one.duration[:, 0], [12.0, 13.0, 8.0])


def test_a_bound_without_contact_messages_is_warned_of(workspace, tmp_path):
    path = said((61.0, "ok"), seconds=38.0).save(tmp_path / "bag")
    with pytest.warns(UserWarning, match="no contact message.*bound 3 of mission 1"):
        (one,) = read_bag(path, workspace)
    assert np.isnan(one.contact_rate[2]).all()


@pytest.mark.parametrize("kind", ["log.bag", "sqlite3"])
def test_messages_that_are_in_two_parts_of_a_bag_count_once(kind, workspace, tmp_path):
    whole = said((61.0, "ok"), version=1 if kind == "log.bag" else 2)
    first, second = Log(whole.version), Log(whole.version)
    first.messages, second.messages = whole.messages[:90], whole.messages[60:]
    paths = [one.save(tmp_path / f"{i}-{kind}") for i, one in enumerate((first, second))]

    (one,) = read_bag(whole.save(tmp_path / kind), workspace)
    (other,) = read_bag(paths, workspace)
    np.testing.assert_array_equal(one.n_ticks, other.n_ticks)
    np.testing.assert_array_equal(one.contact_rate, other.contact_rate)


KINDS = ["log.bag", "sqlite3", "mcap"]
PATH = [(2, 0), (1, 1), (0, 2)]


def of_mission(version=2, *, begin=1.0, seed=0, length=10.0):
    """A log of a mission of two bounds, whose robots have contact at random."""
    rng = np.random.default_rng(seed)
    log = Log(version)
    for k, cell in enumerate(PATH):
        start = begin + length * k
        log.bound(start, k, *cell)
        for i in range(8 if k else 0):
            for robot in ("r1", "r2"):
                log.contact(robot, (start + i + 0.5, bool(rng.random() < 0.6)))
        if k:
            log.text(start + length - 1.0, "/mission/status", "ok")
    return log


def part_of(log, first, last=None, *, delay=0.0, again=(), only=""):
    """Messages as another recorder receives them, with latched ones that it has missed."""
    part = Log(log.version)
    part.messages = log.messages[first:last]
    if again:
        latched = [max(i for i in range(first) if log.messages[i][1] == topic) for topic in again]
        begin = part.messages[0][0] - 10_000_000
        part.messages[:0] = [(begin, *log.messages[i][1:]) for i in latched]
    part.messages = [
        (time + round(1e9 * delay), topic, *rest)
        for time, topic, *rest in part.messages
        if only in topic
    ]
    return part


def read_parts(logs, workspace, folder, kind="sqlite3"):
    paths = []
    for i, log in enumerate(logs):
        log.messages.sort(key=lambda message: message[0])
        storage = {} if kind == "log.bag" else {"storage": kind}
        paths.append(log.save(folder / f"{i}-{kind}", **storage))
    return read_bag(paths, workspace)


def assert_same_bounds(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert (one.path, one.status) == (other.path, other.status)
        np.testing.assert_array_equal(one.contact_rate, other.contact_rate)
        np.testing.assert_array_equal(one.n_ticks, other.n_ticks)
        np.testing.assert_allclose(one.duration, other.duration, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "again", [("/mission/bound",), ("/mission/bound", "/mission/status")], ids=["markers", "all"]
)
def test_messages_that_a_latched_topic_repeats_in_a_part_count_once(
    kind, again, workspace, tmp_path
):
    whole = of_mission(1 if kind == "log.bag" else 2)
    at = 27  # in bound 2, after the status of bound 1
    parts = [part_of(whole, 0, at), part_of(whole, at, again=again)]
    expected = read_parts([whole], workspace, tmp_path, kind)
    (tmp_path / "parts").mkdir()
    assert_same_bounds(read_parts(parts, workspace, tmp_path / "parts", kind), expected)


@pytest.mark.parametrize(
    "parts",
    [
        lambda log: [part_of(log, 27), part_of(log, 0, 27)],
        lambda log: [part_of(log, 0), part_of(log, 12, delay=0.02, again=("/mission/bound",))],
        lambda log: [part_of(log, 5, delay=0.02, again=("/mission/bound",)), part_of(log, 0)],
        lambda log: [part_of(log, 0, only="mission"), part_of(log, 0, only="contact")],
        lambda log: [part_of(log, 0, only="mission"), part_of(log, 0, delay=0.05)],
    ],
    ids=["order", "late recorder", "late recorder first", "topics", "some topics"],
)
def test_bags_of_several_recorders_are_read_as_one(parts, workspace, tmp_path):
    whole = of_mission()
    expected = read_parts([whole], workspace, tmp_path)
    (tmp_path / "parts").mkdir()
    assert_same_bounds(read_parts(parts(whole), workspace, tmp_path / "parts"), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_markers_at_a_constant_rate_mark_each_bound_once(kind, workspace, tmp_path):
    whole = of_mission(1 if kind == "log.bag" else 2)
    expected = read_parts([whole], workspace, tmp_path, kind)
    for k, cell in enumerate(PATH):
        for i in range(1, 10):
            whole.bound(1.0 + 10.0 * k + i, k, *cell)
    (tmp_path / "again").mkdir()
    assert_same_bounds(read_parts([whole], workspace, tmp_path / "again", kind), expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("begin", [1.0, 12.5], ids=["at once", "later"])
def test_a_clock_that_starts_again_is_named(kind, begin, workspace, tmp_path):
    """The messages of two runs are mixed, in the order of their times."""
    log = of_mission(1 if kind == "log.bag" else 2)
    log.messages += of_mission(log.version, begin=begin, seed=1).messages
    with pytest.raises(TrustboError, match="clock"):
        read_parts([log], workspace, tmp_path, kind)


def test_bags_of_two_runs_with_one_clock_are_refused(workspace, tmp_path):
    with pytest.raises(TrustboError, match="clock"):
        read_parts([of_mission(), of_mission(seed=1)], workspace, tmp_path)


@pytest.mark.parametrize("delay", [3.0, -40.0])
def test_recorders_whose_clocks_differ_are_named(delay, workspace, tmp_path):
    log = of_mission()
    second = of_mission(begin=60.0, seed=1)
    log.messages += second.messages
    with pytest.raises(TrustboError, match="clock"):
        read_parts([log, part_of(log, 0, delay=delay)], workspace, tmp_path)


def test_a_bound_that_is_marked_with_two_cells_is_refused(workspace, tmp_path):
    log = of_mission()
    log.bound(12.0, 1, 2, 1)
    with pytest.raises(TrustboError, match="cells"):
        read_parts([log], workspace, tmp_path)


def test_a_path_planned_again_before_the_start_is_that_of_the_mission(workspace, tmp_path):
    log = of_mission()
    first = {"bound": 0, "cell": PATH[0], "path": [PATH[0], (1, 0), (0, 0)]}
    for seconds, path in ((0.5, first["path"]), (1.5, PATH)):
        log.text(seconds, "/mission/bound", json.dumps({**first, "path": path}))
    (one,) = read_parts([log], workspace, tmp_path)
    assert (one.path, one.status) == (tuple(PATH), "ok")
