"""ROS bags: what is written comes back, and what cannot be kept or read is refused."""

import math
import struct
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from worlds import hillside

import trustbo as tb
from trustbo.data import Bound, Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.logs.bag import Topics, read_bag, write_bag
from trustbo.logs.netcdf import STATES
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.replay import ReplaySimulator

rosbags = pytest.importorskip("rosbags", reason="needs the extra ros")
PATH = ((2, 0), (1, 1), (0, 2))
FORMATS = [("log.bag", {}), ("log", {}), ("log", {"storage": "mcap"})]
S = 1_000_000_000  # ns


@pytest.fixture(scope="module")
def workspace():
    terrain = hillside()
    return tb.Workspace.from_terrain(terrain, (3, 3))


@pytest.fixture(scope="module")
def simulated(workspace):
    """Two missions that reached the goal, and one that ran out of time on its way."""
    simulator = KinematicSimulator(workspace, record_states=True)
    hasty = KinematicSimulator(workspace, bound_timeout=20.0)
    return [*(simulator.run(PATH, seed=seed) for seed in range(2)), hasty.run(PATH, seed=2)]


def mission(n_bounds=2, path=PATH, status="ok", **change):
    """A mission of two robots, made up."""
    rng, bounds = np.random.default_rng(0), []
    for k in range(n_bounds):
        contact = rng.random((5, 2)) < 0.6
        bound = {
            "cell": path[k + 1],
            "awareness": np.array([[0.2, np.nan], [0.3, 0.4]]),
            "contact_rate": contact.mean(0),
            "duration": np.full(2, 2.5),
            "status": status if k == n_bounds - 1 else "ok",
            "t0": 2.5 * k,
            "poses": np.cumsum(rng.normal(size=(5, 3, 3)), axis=0),
            "contact": contact,
            "n_ticks": np.full(2, 5),
        }
        bounds.append(Bound(**bound | change))
    return Mission(path, tuple(bounds), status)


def assert_same(got, expected):
    assert len(got) == len(expected)
    for mine, other in zip(got, expected, strict=True):
        for name in ("path", "status", "features", "robots"):
            assert getattr(mine, name) == getattr(other, name)
        for a, b in zip(mine.bounds, other.bounds, strict=True):
            assert (a.cell, a.status, a.t0) == (b.cell, b.status, b.t0)
            for name in ("awareness", "contact_rate", "duration", "n_ticks", "contact"):
                np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
            assert a.contact.dtype == bool
            np.testing.assert_array_equal(a.poses[..., :2], b.poses[..., :2])
            np.testing.assert_array_equal(a.states, b.states)
            # A quaternion keeps a heading but for the rounding of a sine and an arctangent.
            np.testing.assert_allclose(a.poses[..., 2], b.poses[..., 2], rtol=0.0, atol=1e-13)


@pytest.mark.parametrize(("name", "options"), FORMATS)
def test_simulated_missions_come_back_as_they_were(name, options, workspace, simulated, tmp_path):
    path = tmp_path / "new" / name
    write_bag(simulated, path, **options)
    assert_same(read_bag(path), simulated)
    assert_same(read_bag(path, workspace), simulated)
    assert [file.name for file in path.parent.iterdir()] == [name]


@pytest.mark.parametrize(("name", "options"), FORMATS)
def test_a_run_from_a_replayed_bag_gives_the_posterior_of_the_run_that_wrote_it(
    name, options, workspace, tmp_path
):
    """To the last bit: rates are the same counts, awareness the same float64, seeds the same."""
    settings = {
        "n_iterations": 2, "sampler": "exact", "seed": 1, "policy": "random", "progress": False,
    }  # fmt: skip
    recorded = tb.iterate(workspace, PATH[0], PATH[-1], **settings)
    assert recorded.missions[0].path != recorded.missions[1].path  # it did replan
    write_bag(recorded.missions, tmp_path / name, **options)
    replay = ReplaySimulator(read_bag(tmp_path / name, workspace))
    again = tb.iterate(workspace, PATH[0], PATH[-1], simulator=replay, **settings)
    for a, b in zip(again.posteriors, recorded.posteriors, strict=True):
        xr.testing.assert_identical(a["posterior"].to_dataset(), b["posterior"].to_dataset())
    assert again.path == recorded.path
    assert replay.remaining == ()


def test_missions_that_end_early_say_how(tmp_path):
    stuck = mission(n_bounds=1, status="stuck")
    given_up = Mission(PATH, mission(n_bounds=1, path=PATH[:2]).bounds, "lost_contact")
    write_bag([stuck, given_up, mission()], tmp_path / "log.bag")
    back = read_bag(tmp_path / "log.bag")
    assert_same(back, [stuck, given_up, mission()])
    assert [m.bounds[-1].status for m in back] == ["stuck", "ok", "ok"]


def test_headings_that_turn_round_and_round_go_on_without_jumps(tmp_path):
    turning = np.zeros((200, 3, 3))
    turning[..., 2] = np.linspace(0.0, 60.0, 200)[:, None]
    contact = np.ones((200, 2), bool)
    change = {"poses": turning, "contact": contact, "n_ticks": np.full(2, 200)}
    one = mission(1, PATH[:2], **change, contact_rate=np.ones(2))
    write_bag([one, one], tmp_path / "log")
    for back in read_bag(tmp_path / "log"):
        np.testing.assert_allclose(back.bounds[0].poses[..., 2], turning[..., 2], atol=1e-12)


def test_times_are_kept_to_the_nanosecond(tmp_path):
    one = mission(duration=np.full(2, 1 / 3), path=PATH[:2], n_bounds=1, t0=0.123456789)
    write_bag([one], tmp_path / "log")
    bound = read_bag(tmp_path / "log")[0].bounds[0]
    assert bound.t0 == 0.123456789
    np.testing.assert_allclose(bound.duration, 1 / 3, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(bound.contact, one.bounds[0].contact)


def test_topics_may_have_other_names(tmp_path):
    topics = Topics(bound="/b", status="/s", contact="/see/{robot}", lead="husky", pose="/{robot}")
    write_bag([mission()], tmp_path / "log", topics=topics)
    assert_same(read_bag(tmp_path / "log", topics=topics), [mission()])
    with pytest.raises(
        TrustboError, match=r"lacks /mission/bound; it has /b \(std_msgs/msg/String"
    ):
        read_bag(tmp_path / "log")
    with pytest.raises(TrustboError, match=r"Topics\.contact must name the robot's place, e\.g\."):
        Topics(contact="/contact")


@pytest.mark.parametrize("name", ["log.bag", "log"])
def test_other_programs_read_what_was_measured(name, tmp_path):
    """Bytes of the messages: a fault of both the writer and our own reader would come back."""
    from rosbags.highlevel import AnyReader

    one = mission()
    write_bag([one], tmp_path / name, start=1.0)
    found = {}
    with AnyReader([tmp_path / name]) as reader:
        for connection, time, raw in reader.messages():
            body = raw if name == "log.bag" else raw[4:]  # CDR begins with its byte order
            found.setdefault(connection.topic, []).append((time - S, bytes(body)))
    ticks = [2.5 * k + 0.5 * (i + 1) for k in range(2) for i in range(5)]
    for i, robot in enumerate(one.robots):
        times, bodies = zip(*found[f"/{robot}/contact"], strict=True)
        np.testing.assert_allclose(np.divide(times, S), ticks, rtol=0.0, atol=1e-9)
        contact = np.concatenate([bound.contact[:, i] for bound in one.bounds])
        assert bodies == tuple(b"\1" if seen else b"\0" for seen in contact)
        awareness = [struct.unpack("<2d", body[-16:]) for _, body in found[f"/{robot}/awareness"]]
        np.testing.assert_array_equal(awareness, one.awareness[:, i])


def test_states_that_some_bounds_lack_stay_unknown(tmp_path):
    states = np.random.default_rng(1).normal(size=(5, 2, len(STATES)))
    bounds = [replace(b, states=s) for b, s in zip(mission().bounds, (None, states), strict=True)]
    one = replace(mission(), bounds=tuple(bounds))
    write_bag([one], tmp_path / "log")
    back = read_bag(tmp_path / "log")[0]
    assert back.bounds[0].states is None
    np.testing.assert_array_equal(back.bounds[1].states, states)
    short = replace(one, bounds=(bounds[0], replace(bounds[1], states=states[:3])))
    with pytest.raises(TrustboError, match=r"bound 2 has states .*: \(3, 2, 5\)"):
        write_bag([short], tmp_path / "other")


def test_without_awareness_that_of_the_map_is_learned_from(workspace, simulated, tmp_path):
    write_bag(simulated[:1], tmp_path / "log")
    blind = read_bag(tmp_path / "log", workspace, topics=Topics(awareness="/{robot}/none"))
    assert np.isnan(blind[0].awareness).all()
    campaign = tb.Campaign(workspace, PATH[0], PATH[-1], sampler="exact")
    campaign.tell(blind[0])
    np.testing.assert_array_equal(
        campaign.missions[0].awareness, workspace.along(campaign.missions[0].path)
    )
    # Likewise a feature that the workspace has, and the robots did not measure.
    write_bag([mission()], tmp_path / "one.bag")
    three = tb.Workspace.from_awareness(
        np.full((2, 3, 3, 3), 0.5), features=["z3", "visibility", "traversability"]
    )
    z = read_bag(tmp_path / "one.bag", three)[0].awareness
    np.testing.assert_array_equal(z[0], [[np.nan, np.nan, 0.2], [np.nan, 0.4, 0.3]])


def test_what_is_no_bag_is_refused(tmp_path):
    write_bag([mission()], tmp_path / "log")
    write_bag([mission()], tmp_path / "whole.bag")
    (tmp_path / "text.bag").write_text("text")
    (tmp_path / "cut.bag").write_bytes((tmp_path / "whole.bag").read_bytes()[:-100])
    database = tmp_path / "log" / "log.db3"
    database.write_bytes(database.read_bytes()[:5000])
    for name in ("text.bag", "cut.bag", "log", ""):
        with pytest.raises(TrustboError, match="cannot be read as a ROS bag"):
            read_bag(tmp_path / name)
    with pytest.raises(TrustboError, match=r"there is no bag '.*none\.bag'; check its path"):
        read_bag(tmp_path / "none.bag")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"contact": None}, "mission 0, bound 1 has no contact of each tick"),
        ({"poses": np.zeros((4, 3, 3))}, "or other ticks than poses; a table keeps it"),
        ({"contact_rate": np.ones(2)}, "contact rates that are not those of its ticks"),
        ({"n_ticks": np.full(2, 10)}, "an n_ticks that is not the number of its ticks"),
        ({"duration": np.array([2.0, 3.0])}, "no duration, or not one for all robots"),
        ({"duration": np.full(2, np.nan)}, "no duration"),
        ({"t0": 1.0}, r"bound 2 has a start at 1 s, before the last ends at 3\.5 s"),
    ],
)
def test_what_a_bag_cannot_keep_is_refused(change, message, tmp_path):
    with pytest.raises(TrustboError, match=message):
        write_bag([mission(**change)], tmp_path / "log")
    assert list(tmp_path.iterdir()) == []


def test_bags_are_not_written_over_others(tmp_path):
    write_bag([mission(poses=None)], tmp_path / "log")
    assert read_bag(tmp_path / "log")[0].bounds[0].poses is None
    with pytest.raises(TrustboError, match=r"log' exists; bags are not overwritten"):
        write_bag([mission()], tmp_path / "log")
    with pytest.raises(TrustboError, match="unknown storage 'zip'; choose one of sqlite3, mcap"):
        write_bag([mission()], tmp_path / "new", storage="zip")
    with pytest.raises(ShapeError, match="there are no missions; give at least one"):
        write_bag([], tmp_path / "new")
    for robots, message in (
        (("r 1", "r2"), "robot 'r 1' cannot be in a topic"),
        (("r1", "lead"), "a robot is called as the lead, 'lead'"),
    ):
        named = Mission(PATH, mission().bounds, robots=robots)
        with pytest.raises(TrustboError, match=message):
            write_bag([named], tmp_path / "new")
    named = Mission(PATH, mission().bounds, features=("slope", "seen, or not"))
    with pytest.raises(TrustboError, match="feature 'seen, or not' cannot be in a label"):
        write_bag([named], tmp_path / "new")
    assert [file.name for file in tmp_path.iterdir()] == ["log"]


def test_a_bag_that_fails_half_way_leaves_nothing(tmp_path, monkeypatch):
    def fail(self, *_):
        raise OSError("disk full")

    monkeypatch.setattr("trustbo.logs.messages.Messages.numbers", fail)
    for name in ("log", "log.bag"):
        with pytest.raises(OSError, match="disk full"):
            write_bag([mission()], tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_messages_are_in_the_order_of_time(tmp_path):
    from rosbags.highlevel import AnyReader

    write_bag([mission(), mission()], tmp_path / "log", start=1.0)
    with AnyReader([tmp_path / "log"]) as reader:
        times = [time for _, time, _ in reader.messages()]
    assert len(times) == 2 * (3 + 2 * (5 * 5 + 2 + 1))
    assert all(a <= b for a, b in pairwise(times))
    assert times[0] == S


def test_stamps_begin_now_or_when_they_are_told_to(tmp_path):
    from rosbags.highlevel import AnyReader

    given = datetime(2024, 5, 1, 12, tzinfo=UTC)
    before = time.time()
    for name, start in (("now", None), ("date.bag", given), ("posix", 1714564800.25)):
        write_bag([mission()], tmp_path / name, start=start)
        with AnyReader([tmp_path / name]) as reader:
            stamp = reader.start_time
        if start is None:
            assert before * S <= stamp <= time.time() * S
        else:  # 12:00 UTC of that day in POSIX seconds, by `date -u -d ... +%s`
            assert stamp == 1714564800 * S + (S // 4 if name == "posix" else 0)
        assert_same(read_bag(tmp_path / name), [mission()])  # t0 counts from the first stamp
    for start in (0, math.nan, "now", 2.0**31):
        with pytest.raises(TrustboError, match=f"start must be .*; got {start!r}"):
            write_bag([mission()], tmp_path / "refused", start=start)


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    message = r"ROS bags need rosbags: .* pip install rosbags$"
    with pytest.raises(TrustboError, match=message):
        read_bag(tmp_path / "log")
    with pytest.raises(TrustboError, match=message):
        write_bag([mission()], tmp_path / "log")
