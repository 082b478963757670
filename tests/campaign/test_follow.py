"""A mission that is followed tick by tick: its trust, what is ahead, and what it becomes."""

import json
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from worlds import random_cells

import trustbo as tb
from trustbo.campaign.learning import as_learned
from trustbo.inference import TrustFilter
from trustbo.inference.prior_draws import sample_prior_ahead
from trustbo.models import PooledTrust

ROOT = Path(__file__).resolve().parents[2]
ENDS = ((3, 0), (0, 3))
DETOUR = ((3, 0), (3, 1), (2, 2), (1, 3), (0, 3))
TICK = 0.25  # s, which sums up without rounding


def looks(n_bounds, seed=0):
    """Contact of three robots at ticks, (bound, tick, robot); one in ten was not measured."""
    rng = np.random.default_rng(seed)
    seen = (rng.uniform(size=(n_bounds, 20, 3)) < rng.uniform(0.2, 1.0, 3)).astype(float)
    return np.where(rng.uniform(size=seen.shape) < 0.1, np.nan, seen)


def whole(path, seen):
    """The mission of these looks, made at once."""
    n_ticks = (~np.isnan(seen)).sum(1)
    seconds = np.full(len(seen), TICK * seen.shape[1])
    unknown = np.full((*n_ticks.shape, 2), np.nan)
    rates = np.nansum(seen, 1) / n_ticks
    return tb.Mission.from_arrays(path, unknown, rates, seconds, n_ticks=n_ticks)


def follow(follower, seen, start=1000.0):
    """Feed a follower tick by tick; gives the number of each bound that has ended."""
    t = start
    for k, bound in enumerate(seen):
        follower.begin(t)
        for tick in bound:
            t += TICK
            follower.tick(t, tick)
        follower.end(t)
        yield k


def begun(model=None, n_missions=1, **options):
    campaign = tb.Campaign(random_cells(), *ENDS, model=model, sampler="importance", **options)
    for seed in range(n_missions):
        path = campaign.ask().path
        campaign.tell(whole(path, looks(len(path) - 1, seed + 10)))
    return campaign


def filter_of(campaign):
    """Filter of the campaign's posterior, or of its prior."""
    if campaign.state.last is not None:
        return TrustFilter(campaign.posterior)
    model = campaign.model.for_features(campaign.workspace.features)
    seed = campaign.state.seed_of("prior")
    draws = sample_prior_ahead(model, campaign.workspace, 250, seed).drawn
    return TrustFilter(draws, 3, workspace=campaign.workspace)


@pytest.mark.parametrize(
    ("model", "n_missions"),
    [
        pytest.param(None, 0, id="prior"),
        pytest.param(None, 2, id="default"),
        pytest.param(tb.models.PooledTrust(family="beta_binomial"), 0, id="prior of counts"),
        pytest.param(tb.models.PooledTrust(family="beta_binomial"), 1, id="counts"),
    ],
)
def test_trust_tick_by_tick_is_that_of_a_filter_of_whole_bounds(model, n_missions):
    campaign = begun(model, n_missions)
    reference, follower = filter_of(campaign), tb.Follower(campaign)
    path = follower.path
    mission = as_learned(whole(path, looks(len(path) - 1)), campaign.workspace, "map")
    z, y, n = mission.awareness, mission.contact_rate, mission.n_ticks
    np.testing.assert_allclose(follower.trust, reference.state, rtol=1e-10)
    for k in follow(follower, looks(len(path) - 1)):
        now = reference.update(z[k], y[k], path[k : k + 2], n_ticks=n[k])
        np.testing.assert_allclose(follower.trust, now, rtol=1e-10)
        if k + 2 < len(path):
            ahead = reference.predict(z[k + 1 :], path[k + 1 :])
            for found, expected in zip(follower.ahead(), ahead, strict=True):
                np.testing.assert_allclose(found, expected, rtol=1e-10)
    assert k == len(path) - 2


def test_trust_within_a_bound_and_what_is_ahead_are_as_if_it_ended_now():
    campaign = begun()
    reference, follower = filter_of(campaign), tb.Follower(campaign)
    path = follower.path
    z = campaign.workspace.along(path)
    follower.begin(0.0)
    predicted = follower.trust
    expected = [values[0] for values in reference.predict(z, path)[:2]]
    np.testing.assert_allclose(predicted, expected, rtol=1e-10)
    seen = looks(1)[0]
    for j, tick in enumerate(seen):
        follower.tick(j + 1.0, tick)
    assert follower.rest == path[1:]
    ahead, trust = follower.ahead(), follower.trust
    mission = whole(path[:2], seen[None])
    now = reference.update(z[0], mission.contact_rate[0], path[:2], n_ticks=mission.n_ticks[0])
    np.testing.assert_allclose(trust, now, rtol=1e-10)
    for found, expected in zip(ahead, reference.predict(z[1:], path[1:]), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-10)
    follower.end(21.0)
    np.testing.assert_array_equal(follower.trust, trust)  # `ahead` changed nothing
    assert not np.allclose(trust, predicted)


@pytest.mark.parametrize("path", [None, DETOUR])
def test_a_mission_that_was_followed_is_the_mission_made_at_once(path):
    campaign = begun()
    if path is not None:
        campaign.suggest(path)
    follower = tb.Follower(campaign)
    seen = looks(len(follower.path) - 1)
    for _ in follow(follower, seen):
        pass
    found, expected = follower.to_mission(), whole(follower.path, seen)
    assert found.path == expected.path == (path or campaign.ask().path)
    assert (found.status, found.robots) == ("ok", ("r1", "r2", "r3"))
    for name in ("awareness", "contact_rate", "duration", "n_ticks"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert [b.t0 for b in found.bounds] == [b.t0 for b in expected.bounds]
    assert [b.status for b in found.bounds] == [b.status for b in expected.bounds]


def test_a_campaign_learns_the_same_from_it():
    one, other = begun(), begun()
    follower = tb.Follower(one)
    seen = looks(len(follower.path) - 1)
    for _ in follow(follower, seen):
        pass
    one.tell(follower.to_mission())
    other.tell(whole(other.ask().path, seen))
    for name, draws in one.posterior["posterior"].data_vars.items():
        np.testing.assert_array_equal(draws, other.posterior["posterior"][name])
    assert one.ask().path == other.ask().path
    start = tb.Follower(one).trust.mean  # the next mission goes by the new posterior
    np.testing.assert_array_equal(start, filter_of(other).state.mean)


def test_a_mission_that_fails_keeps_its_last_bound_and_one_that_stops_is_aborted():
    campaign = begun(n_missions=0)
    stopped, failed = (tb.Follower(campaign) for _ in range(2))
    for follower, status in ((stopped, "ok"), (failed, "stuck")):
        follower.begin(0.0)
        for t in range(9):
            follower.tick(t, [t < 3, np.nan, t < 2])
        follower.end(10.0, status)
    assert stopped.to_mission().status == "aborted"
    mission = failed.to_mission()
    assert (mission.status, mission.bounds[0].status, mission.path) == (
        "stuck",
        "stuck",
        failed.path,
    )
    np.testing.assert_array_equal(mission.n_ticks, [[9, np.nan, 9]])
    np.testing.assert_array_equal(mission.contact_rate, [[3 / 9, np.nan, 2 / 9]])
    with pytest.raises(tb.TrustboError, match="over"):
        failed.begin(11.0)
    campaign.tell(mission)
    assert campaign.table()["status"].tolist() == ["stuck"]


def test_robots_that_leave_the_path_are_followed_where_they_go():
    campaign = begun()
    follower, reference = tb.Follower(campaign), filter_of(campaign)
    z, seen = campaign.workspace.along(DETOUR), looks(4)
    made = whole(DETOUR, seen)
    for k, cell in enumerate(DETOUR[1:]):
        follower.begin(10.0 * k, cell)
        for tick in seen[k]:
            follower.tick(10.0 * k + 5.0, tick)
        follower.end(10.0 * k + 8.0)
        now = reference.update(z[k], made.contact_rate[k], DETOUR[k : k + 2])
        np.testing.assert_allclose(follower.trust, now, rtol=1e-10)
    mission = follower.to_mission()
    assert (mission.path, mission.status) == (DETOUR, "ok")
    assert [bound.t0 for bound in mission.bounds] == [0.0, 10.0, 20.0, 30.0]
    np.testing.assert_array_equal(mission.duration, np.full((4, 3), 8.0))
    campaign.tell(mission)
    assert len(campaign.missions) == 2


@pytest.mark.parametrize(
    ("act", "named"),
    [
        (lambda f: f.begin(5.0), "a bound is"),
        (lambda f: f.to_mission(), "a bound is"),
        (lambda f: f.tick(6.0, [1, 0]), "in_contact"),
        (lambda f: f.tick(6.0, [1, 0, 0.5]), "in_contact"),
        (lambda f: f.tick(6.0, [1, 0, 2]), "in_contact"),
        (lambda f: f.tick(4.0, [1, 0, 1]), "t = 4.0"),
        (lambda f: f.tick(np.nan, [1, 0, 1]), "t must"),
        (lambda f: f.end(4.0), "t = 4.0"),
        (lambda f: f.end(6.0, "tired"), "status"),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(act, named):
    follower = tb.Follower(begun(n_missions=0))
    follower.begin(0.0)
    follower.tick(5.0, [1, 0, np.nan])
    trust = follower.trust
    with pytest.raises(tb.TrustboError, match=named):
        act(follower)
    np.testing.assert_array_equal(follower.trust, trust)
    follower.end(5.0)
    np.testing.assert_array_equal(follower.bounds[0].n_ticks, [1, 1, np.nan])
    np.testing.assert_array_equal(follower.bounds[0].contact_rate, [1.0, 0.0, np.nan])
    np.testing.assert_array_equal(follower.trust, trust)


def test_before_and_after_its_bounds_a_mission_takes_nothing():
    campaign = begun(n_missions=0)
    follower = tb.Follower(campaign)
    for act in (
        lambda: follower.tick(0.0, [1, 1, 1]),
        lambda: follower.end(0.0),
        lambda: follower.to_mission(),
        lambda: follower.begin(0.0, (0, 3)),  # not a neighbour
        lambda: follower.begin(np.inf),
        lambda: follower.begin(0.0, (4, 0)),  # off the grid
    ):
        with pytest.raises(tb.TrustboError):
            act()
    assert follower.path == campaign.ask().path
    for _ in follow(follower, looks(len(follower.path) - 1)):
        pass
    with pytest.raises(tb.TrustboError, match="no cell is planned"):
        follower.begin(5000.0)
    with pytest.raises(tb.TrustboError, match="no cell is planned"):
        follower.ahead()


def example(name):
    spec = spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


ROBOTS = ("r1", "r2", "r3")


def ros_node(campaign=None):
    """The function `take` of the example of a ROS node, for one mission, and its follower."""
    follower = tb.Follower(begun(n_missions=0) if campaign is None else campaign)
    return partial(example("ros2_node").take, follower, ROBOTS, held=[]), follower


def test_the_example_of_a_ros_node_makes_the_mission_of_its_messages():
    take, follower = ros_node()
    seen, path = looks(len(follower.path) - 1), follower.path
    t, over = 0.0, take("bound", json.dumps({"bound": 0, "cell": path[0]}), 0.0)
    for k, (cell, bound) in enumerate(zip(path[1:], seen, strict=True), start=1):
        assert not over
        take("bound", json.dumps({"bound": k, "cell": cell}), t)
        for tick in bound:
            t += TICK
            for name, value in zip(ROBOTS, tick, strict=True):
                if not np.isnan(value):
                    take(name, bool(value), t)
        if k != 2:  # the next bound ends the second one
            over = take("status", "ok", t)
            take("r1", True, t)  # counts for no bound
    assert over
    found, expected = follower.to_mission(), whole(path, seen)
    for name in ("contact_rate", "n_ticks", "duration"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_the_example_of_a_ros_node_replans_after_a_bound_that_failed():
    campaign = begun(n_missions=0)
    take, follower = ros_node(campaign)
    start, blocked, *_ = planned = follower.path
    take("bound", '{"bound": 1}', 0.0)
    assert not take("status", "stuck", 5.0)
    assert follower.path[:3] == (start, blocked, start)
    assert follower.path[3] != blocked
    assert follower.path[-1] == planned[-1]
    assert campaign.ask().path == follower.path

    t = 5.0
    for k in range(2, len(follower.path)):
        marker = {"bound": k, "cell": follower.path[k]}
        take("bound", json.dumps(marker), t)
        over = take("status", "ok", t := t + 5.0)
    assert over
    mission = follower.to_mission()
    assert (mission.bounds[0].status, mission.status) == ("stuck", "ok")


@pytest.mark.parametrize("status", ["tipped", "aborted"])
def test_the_example_of_a_ros_node_ends_a_mission_that_cannot_go_on(status):
    take, follower = ros_node()
    path = follower.path
    take("bound", '{"bound": 1}', 0.0)
    assert take("status", status, 5.0)
    assert follower.path == path
    assert follower.to_mission().status == status


def test_the_example_of_a_ros_node_is_told_between_bounds_that_the_mission_ends():
    take, follower = ros_node()
    take("bound", '{"bound": 1}', 0.0)
    assert not take("status", "stuck", 5.0)
    assert take("status", "aborted", 6.0)
    assert follower.to_mission().status == "stuck"


def test_the_example_of_a_ros_node_ends_a_mission_whose_goal_cannot_be_reached(monkeypatch):
    def unreachable(self, *args, **options):
        raise tb.NoPathError("no path")

    take, _ = ros_node()
    monkeypatch.setattr(tb.Follower, "replan", unreachable)
    take("bound", '{"bound": 1}', 0.0)
    assert take("status", "stuck", 5.0)


@pytest.mark.parametrize("status", ["ok", "stuck"])
def test_the_example_of_a_ros_node_accepts_a_status_just_after_the_next_marker(status):
    take, follower = ros_node()
    path = follower.path
    take("bound", '{"bound": 1}', 0.0)
    take("r1", True, 1.0)
    take("bound", json.dumps({"bound": 2, "cell": path[2]}), 20.0)
    take("r1", True, 20.004)
    assert not take("status", status, 20.005)

    assert follower.running
    assert [(bound.status, bound.duration[0]) for bound in follower.bounds] == [(status, 20.0)]
    take("r1", False, 21.0)
    take("status", "ok", 40.0)
    assert follower.bounds[1].contact_rate[0] == 0.5
    assert follower.bounds[1].duration[0] == 20.0


def test_the_example_of_a_ros_node_leaves_later_statuses_to_the_new_bound():
    take, follower = ros_node()
    for k, t in ((1, 0.0), (2, 20.0), (3, 40.0)):
        take("bound", json.dumps({"bound": k, "cell": follower.path[k]}), t)
        take("r1", True, t + 0.2)
        take("r1", True, t + 0.4)
    take("status", "stuck", 40.5)
    assert [bound.status for bound in follower.bounds] == ["ok", "ok", "stuck"]
    assert [bound.n_ticks[0] for bound in follower.bounds] == [2.0, 2.0, 2.0]


def test_the_example_for_foxglove_sends_trust_by_robot():
    live, campaign = example("live_foxglove"), begun(n_missions=0)
    follower, robots = tb.Follower(campaign), ("r1", "r2", "r3")
    before = live.state_of(follower, robots)
    assert (before["bound"], len(before["r2"]["ahead"])) == (0, len(follower.path) - 1)
    for k in follow(follower, looks(len(follower.path) - 1)):
        state = live.state_of(follower, robots)
        assert state["bound"] == k + 1
        assert [state[r]["mean"] for r in robots] == follower.trust.mean.tolist()
    assert state["r1"]["ahead"] == []


def test_a_tick_that_names_its_robots_is_read_by_name():
    follower = tb.Follower(begun(PooledTrust(), 0))
    seen = {"r3": True, "r2": False, "r1": False}
    array = xr.DataArray([1.0, 0.0, np.nan], {"robot": ["r3", "r2", "r1"]}, "robot")
    follower.begin(0.0)
    for t, tick in enumerate((seen, pd.Series(seen), array), start=1):
        follower.tick(t, tick)
    with pytest.raises(tb.TrustboError, match="in_contact"):
        follower.tick(4.0, {"r3": True, "r2": False, "r4": False})
    follower.end(5.0)
    np.testing.assert_array_equal(follower.bounds[0].contact_rate, [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(follower.bounds[0].n_ticks, [2.0, 3.0, 3.0])


def test_a_follower_says_if_trust_rests_on_few_draws():
    campaign = begun(n_missions=2)
    follower = tb.Follower(campaign)
    assert "effective" not in str(follower)

    n_bounds = len(follower.path) - 1
    lost = np.zeros((n_bounds, 400, 3))  # no contact, of which the posterior knows nothing
    for _ in follow(follower, lost):
        pass
    kept = follower._now.weights
    assert follower._now.kish == pytest.approx(1.0 / np.sum(kept**2))
    assert ("effective" in str(follower)) == (follower._now.kish < 20.0)
    assert follower._now.kish < 20.0
