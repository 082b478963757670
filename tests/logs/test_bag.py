"""ROS bags of missions, written by rosbags alone, are read as they were driven."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from bags import record
from worlds import hillside

import trustbo as tb
from trustbo.data import Bound, Mission
from trustbo.errors import TrustboError
from trustbo.logs.bag import Topics, read_bag
from trustbo.logs.netcdf import STATES
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.replay import ReplaySimulator

rosbags = pytest.importorskip("rosbags", reason="needs the extra ros")
PATH = ((2, 0), (1, 1), (0, 2))
FORMATS = [("log.bag", {}), ("log", {}), ("log", {"storage": "mcap"})]


@pytest.fixture(scope="module")
def workspace():
    terrain = hillside()
    return tb.Workspace.from_terrain(terrain, (3, 3))


@pytest.fixture(scope="module")
def simulated(workspace):
    """Two missions that reached the goal, and one that ran out of time on its way."""
    simulator = KinematicSimulator(workspace)
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
    path = record(simulated, tmp_path / name, **options)
    assert_same(read_bag(path), simulated)
    assert_same(read_bag(path, workspace), simulated)


def test_a_run_from_a_replayed_bag_gives_the_posterior_of_the_run_that_wrote_it(
    workspace, tmp_path
):
    """To the last bit: rates are the same counts, awareness the same float64, seeds the same."""
    settings = {
        "n_iterations": 2, "sampler": "exact", "seed": 1, "policy": "random", "progress": False,
    }  # fmt: skip
    recorded = tb.iterate(workspace, PATH[0], PATH[-1], **settings)
    assert recorded.missions[0].path != recorded.missions[1].path  # it did replan
    bag = record(recorded.missions, tmp_path / "log")
    replay = ReplaySimulator(read_bag(bag, workspace))
    again = tb.iterate(workspace, PATH[0], PATH[-1], simulator=replay, **settings)
    for a, b in zip(again.posteriors, recorded.posteriors, strict=True):
        xr.testing.assert_identical(a["posterior"].to_dataset(), b["posterior"].to_dataset())
    assert again.path == recorded.path


def test_missions_that_end_early_say_how(tmp_path):
    stuck = mission(n_bounds=1, status="stuck")
    given_up = Mission(PATH, mission(n_bounds=1, path=PATH[:2]).bounds, "lost_contact")
    record([stuck, given_up, mission()], tmp_path / "log.bag")
    back = read_bag(tmp_path / "log.bag")
    assert_same(back, [stuck, given_up, mission()])
    assert [m.bounds[-1].status for m in back] == ["stuck", "ok", "ok"]


def test_headings_that_turn_round_and_round_go_on_without_jumps(tmp_path):
    turning = np.zeros((200, 3, 3))
    turning[..., 2] = np.linspace(0.0, 60.0, 200)[:, None]
    contact = np.ones((200, 2), bool)
    change = {"poses": turning, "contact": contact, "n_ticks": np.full(2, 200)}
    one = mission(1, PATH[:2], **change, contact_rate=np.ones(2))
    record([one, one], tmp_path / "log")
    for back in read_bag(tmp_path / "log"):
        np.testing.assert_allclose(back.bounds[0].poses[..., 2], turning[..., 2], atol=1e-12)


def test_times_are_kept_to_the_nanosecond(tmp_path):
    one = mission(duration=np.full(2, 1 / 3), path=PATH[:2], n_bounds=1, t0=0.123456789)
    record([one], tmp_path / "log")
    bound = read_bag(tmp_path / "log")[0].bounds[0]
    assert bound.t0 == 0.123456789
    np.testing.assert_allclose(bound.duration, 1 / 3, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(bound.contact, one.bounds[0].contact)


def test_topics_may_have_other_names(tmp_path):
    topics = Topics(bound="/b", status="/s", contact="/see/{robot}", lead="husky", pose="/{robot}")
    names = {"/mission/bound": "/b", "/mission/status": "/s", "/lead/odom": "/husky"}
    for robot in ("r1", "r2"):
        names |= {f"/{robot}/contact": f"/see/{robot}", f"/{robot}/odom": f"/{robot}"}
    record([mission()], tmp_path / "log", names=names)
    assert_same(read_bag(tmp_path / "log", topics=topics), [mission()])
    with pytest.raises(
        TrustboError, match=r"lacks /mission/bound; it has /b \(std_msgs/msg/String"
    ):
        read_bag(tmp_path / "log")
    with pytest.raises(TrustboError, match=r"Topics\.contact must name the robot's place, e\.g\."):
        Topics(contact="/contact")


def test_states_that_some_bounds_lack_stay_unknown(tmp_path):
    states = np.random.default_rng(1).normal(size=(5, 2, len(STATES)))
    bounds = [replace(b, states=s) for b, s in zip(mission().bounds, (None, states), strict=True)]
    one = replace(mission(), bounds=tuple(bounds))
    record([one], tmp_path / "log")
    back = read_bag(tmp_path / "log")[0]
    assert back.bounds[0].states is None
    np.testing.assert_array_equal(back.bounds[1].states, states)


def test_without_awareness_that_of_the_map_is_learned_from(workspace, simulated, tmp_path):
    record(simulated[:1], tmp_path / "log")
    blind = read_bag(tmp_path / "log", workspace, topics=Topics(awareness="/{robot}/none"))
    assert np.isnan(blind[0].awareness).all()
    campaign = tb.Campaign(workspace, PATH[0], PATH[-1], sampler="exact")
    campaign.tell(blind[0])
    np.testing.assert_array_equal(
        campaign.missions[0].awareness, workspace.along(campaign.missions[0].path)
    )
    # Likewise a feature that the workspace has, and the robots did not measure.
    record([mission()], tmp_path / "one.bag")
    three = tb.Workspace.from_awareness(
        np.full((2, 3, 3, 3), 0.5), features=["z3", "visibility", "traversability"]
    )
    z = read_bag(tmp_path / "one.bag", three)[0].awareness
    np.testing.assert_array_equal(z[0], [[np.nan, np.nan, 0.2], [np.nan, 0.4, 0.3]])


def test_what_is_no_bag_is_refused(tmp_path):
    record([mission()], tmp_path / "log")
    record([mission()], tmp_path / "whole.bag")
    (tmp_path / "text.bag").write_text("text")
    (tmp_path / "cut.bag").write_bytes((tmp_path / "whole.bag").read_bytes()[:-100])
    database = tmp_path / "log" / "log.db3"
    database.write_bytes(database.read_bytes()[:5000])
    for name in ("text.bag", "cut.bag", "log", ""):
        with pytest.raises(TrustboError, match="cannot be read as a ROS bag"):
            read_bag(tmp_path / name)
    with pytest.raises(TrustboError, match=r"there is no bag '.*none\.bag'; check its path"):
        read_bag(tmp_path / "none.bag")


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    message = r"ROS bags need rosbags: .* pip install rosbags$"
    with pytest.raises(TrustboError, match=message):
        read_bag(tmp_path / "log")
