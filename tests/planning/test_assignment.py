"""Robots that differ at the posts of a path: beside enumeration, driven, and learned from."""

import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest

from trustbo import Campaign, Team, Workspace
from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.logs import read_missions, write_missions
from trustbo.planning import assignment
from trustbo.planning.assignment import assign
from trustbo.simulation import KinematicSimulator, Truth
from trustbo.team import Robot
from trustbo.terrain import synthetic_terrain
from trustbo.workspace.sight import Sight
from trustbo.workspace.watch import Watch

UNLIKE = Team(robots=(Robot(sensor_height=3.0), Robot(), Robot(detection=0.6, lidar_range=40.0)))
START, GOAL = (3, 0), (0, 3)


@pytest.fixture(scope="module")
def wooded():
    return synthetic_terrain((200.0, 200.0), seed=5, relief=10.0)


@pytest.fixture(scope="module")
def unlike(wooded):
    workspace = Workspace.from_terrain(wooded, (4, 4), UNLIKE)
    plan = Campaign(workspace, START, GOAL, seed=0).recommend()
    return workspace, KinematicSimulator(workspace), plan


def drawn(rng, n_robots, n_posts, n_next):
    shapes = (n_robots, n_posts), (n_robots, n_posts, n_next), (n_robots, n_next)
    watched, closing, waiting = (rng.uniform(size=shape) for shape in shapes)
    return Watch(watched, closing, waiting, rng.uniform(20, 60), rng.uniform(5, 60, shapes[1]))


def loss_of(watches, weights, choice):
    """Contact lost by one sequence of choices, robot by robot."""
    total = 0.0
    for watch, here, then in zip(watches, choice[:-1], choice[1:], strict=True):
        ways = [watch.times[i, s, e] for i, (s, e) in enumerate(zip(here, then, strict=True))]
        for i, (s, e) in enumerate(zip(here, then, strict=True)):
            first, second = watch.lead_time, max(ways)
            seen = first * watch.watched[i, s] + ways[i] * watch.closing[i, s, e]
            seen += (second - ways[i]) * watch.waiting[i, e]
            total += (1.0 - weights[i] * seen / (first + second)) / len(weights)
    return total


@pytest.mark.parametrize(("n_robots", "n_posts"), [(2, 4), (3, 4), (1, 3)])
@pytest.mark.parametrize("seed", range(5))
def test_no_other_choice_of_posts_loses_less(n_robots, n_posts, seed):
    rng = np.random.default_rng(seed)
    sizes = itertools.pairwise([n_posts, n_posts, n_robots])
    watches = [drawn(rng, n_robots, n, then) for n, then in sizes]
    weights = rng.uniform(0.2, 1.0, n_robots)
    chosen, loss = assign(watches, weights)
    choices = list(itertools.permutations(range(n_posts), n_robots))
    at_goal = tuple(range(n_robots))
    losses = {
        (*choice, at_goal): loss_of(watches, weights, (*choice, at_goal))
        for choice in itertools.product(choices, repeat=2)
    }
    least = min(losses, key=losses.__getitem__)
    assert tuple(map(tuple, chosen.tolist())) == least[:-1]
    assert loss == pytest.approx(losses[least], abs=1e-12)


def test_the_poor_watcher_gets_the_post_that_matters_least():
    watched = np.array([[0.9, 0.2]] * 2)
    still = Watch(watched, np.ones((2, 2, 2)), np.ones((2, 2)), 30.0, np.full((2, 2, 2), 10.0))
    for poor in (0, 1):
        weights = np.where(np.arange(2) == poor, 0.3, 1.0)
        chosen, _ = assign([still], weights)
        assert chosen[0, poor] == 1


def test_robots_alike_stand_by_the_workspace_s_rule(wooded):
    plan = Campaign(Workspace.from_terrain(wooded, (4, 4)), START, GOAL, seed=0).recommend()
    assert plan.robots is None
    assert plan.own_posts is None
    bounds = itertools.pairwise(plan.path)
    np.testing.assert_array_equal(plan.posts, [plan.workspace.posts(*bound) for bound in bounds])


def test_a_robot_expected_to_be_poor_is_assigned(wooded):
    plan = Campaign(Workspace.from_terrain(wooded, (4, 4)), START, GOAL, seed=0).recommend()
    trust = plan.trust.copy()
    trust[:, 1] *= 1.0 - 0.5 * assignment.DIFFERENT
    assert replace(plan, trust=trust).robots is None
    trust[:, 1] *= 0.5
    assert replace(plan, trust=trust).robots is not None


def test_large_teams_and_cells_alone_are_not_assigned(wooded, monkeypatch):
    cells = Workspace.from_terrain(wooded, (4, 4), UNLIKE, bounds=False)
    assert Campaign(cells, START, GOAL, seed=0).recommend().robots is None
    monkeypatch.setattr(assignment, "MAX_ROBOTS", 2)
    of_bounds = Workspace.from_terrain(wooded, (4, 4), UNLIKE)
    assert Campaign(of_bounds, START, GOAL, seed=0).recommend().robots is None


def test_what_is_assigned_is_exported_driven_and_seen(unlike):
    _, simulator, plan = unlike
    assert plan.robots.shape == (len(plan.path) - 1, 3)
    assert all(len(set(row)) == 3 for row in plan.robots.tolist())
    mission = simulator.run(plan, seed=0)
    np.testing.assert_array_equal(mission.posts, plan.posts)
    for k, bound in enumerate(mission.bounds):
        at_start = bound.poses[0, 1:, :2]
        assert np.linalg.norm(at_start - plan.posts[k], axis=1).max() < 1.5  # m: slip, a tick
        ends = np.stack([way[-1] for way in plan.ways[k][1:]])
        if k + 1 < len(plan.posts):
            np.testing.assert_array_equal(ends, plan.posts[k + 1])
    by_rule, assigned = (
        np.mean([m.contact_rate.mean() for m in simulator.run_batch(way, range(20))])
        for way in (plan.path, plan)
    )
    assert assigned > by_rule


def test_missions_keep_posts_that_are_not_the_rule_s(unlike, tmp_path):
    _, simulator, plan = unlike
    missions = [simulator.run(plan, seed=0), simulator.run(plan.path, seed=0)]
    write_missions(tmp_path / "missions.nc", missions)
    own, ruled = read_missions(tmp_path / "missions.nc")
    np.testing.assert_array_equal(own.posts, plan.posts)
    assert ruled.posts is None
    swapped = own.in_order(("r3", "r1", "r2"), own.features)
    np.testing.assert_array_equal(swapped.posts, plan.posts[:, [2, 0, 1]])
    with pytest.raises(ShapeError, match=r"posts must be \(\d, 3, 2\), \(bound, robot, x and y\)"):
        replace(own, posts=plan.posts[1:])


def test_line_of_sight_under_every_sight_is_that_of_the_posts(wooded):
    sights = [Sight(), "wall", "bare"]
    workspace = Workspace.from_terrain(wooded, (4, 4), UNLIKE, sight=sights)
    path = [START, (2, 1), (1, 2), GOAL]
    rule = np.stack([workspace.posts(*bound) for bound in itertools.pairwise(path)])
    swapped = rule[:, [1, 2, 0]]
    gain = workspace.gain_of(path, swapped)
    for n, sight in enumerate(sights):
        alone = Workspace.from_terrain(wooded, (4, 4), UNLIKE, sight=["transmittance", sight])
        np.testing.assert_array_equal(gain[..., n - 3], alone.gain_of(path, swapped)[..., -1])
    assert np.abs(gain[..., -3:]).max() > 0.0


def test_line_of_sight_is_that_of_the_posts_driven(unlike):
    workspace, simulator, plan = unlike
    own, ruled = simulator.run(plan, seed=0), simulator.run(plan.path, seed=0)
    filled, usual = (workspace.fill(m).awareness[..., -1] for m in (own, ruled))
    np.testing.assert_array_equal(usual, workspace.along(plan.path)[..., -1])
    assert filled.mean() > usual.mean()  # posts are chosen by it
    by_rule = [workspace.posts(*bound) for bound in itertools.pairwise(plan.path)]
    np.testing.assert_allclose(workspace.gain_of(plan.path, np.stack(by_rule)), 0.0, atol=1e-15)


def test_a_campaign_drives_and_learns_from_its_own_posts(unlike, tmp_path):
    workspace, simulator, _ = unlike
    campaign = Campaign(workspace, START, GOAL, sampler="exact", seed=0, directory=tmp_path / "c")
    with campaign:
        plan, mission = next(iter(campaign.run(simulator, 1)))
        learned = campaign.missions[0]
    np.testing.assert_array_equal(mission.posts, plan.posts)
    np.testing.assert_allclose(learned.awareness, workspace.along(plan.path, plan.posts))
    with Campaign.load(tmp_path / "c") as again:
        np.testing.assert_array_equal(again.missions[0].posts, plan.posts)
        np.testing.assert_array_equal(again.missions[0].awareness, learned.awareness)


def test_the_truth_of_a_plan_is_that_of_its_posts(unlike, tmp_path):
    _, simulator, plan = unlike
    truth = Truth.of(simulator, standard_error=0.02, folder=tmp_path)
    by_rule, assigned = truth.value(plan.path), truth.value(plan)
    driven = [m.contact_rate.mean() for m in simulator.run_batch(plan, range(100, 140))]
    error = np.std(driven) * np.sqrt(1 / 40 + 1 / 64)
    assert abs(assigned.mean - np.mean(driven)) < 4.0 * error
    assert assigned.lost < by_rule.lost
    assert truth.regret(plan) == truth.regret(plan.path)  # which holds posts fixed


def test_posts_that_cannot_be_driven_to_are_refused(unlike):
    _, simulator, plan = unlike
    with pytest.raises(ShapeError, match=r"posts must be .*, \(bound, robot, x and y\); got"):
        simulator.run(plan.path, seed=0, posts=plan.posts[:, :2])
    off = plan.posts.copy()
    off[1, 2] += 1000.0
    with pytest.raises(TrustboError, match=r"posts\[1, 2\] = .* cannot be reached from the lead's"):
        simulator.run(plan.path, seed=0, posts=off)


def test_a_workspace_that_has_planned_can_be_pickled(unlike):
    workspace, _, plan = unlike
    assert plan.posts is not None
    again = pickle.loads(pickle.dumps(plan))
    np.testing.assert_array_equal(again.posts, plan.posts)
    assert pickle.loads(pickle.dumps(workspace)).watch is not None


def test_a_campaign_drives_by_the_rule_where_its_posts_cannot_be_reached():
    steep = synthetic_terrain((200.0, 200.0), seed=5, relief=25.0)
    planned = Workspace.from_terrain(steep, (4, 4), UNLIKE)
    less = Team(robots=tuple(replace(r, max_slope=0.3) for r in UNLIKE.robots), names=UNLIKE.names)
    simulator = KinematicSimulator(Workspace.from_terrain(steep, (4, 4), less))
    campaign = Campaign(planned, START, GOAL, sampler="exact", seed=0)
    plan, mission = next(iter(campaign.run(simulator, 1)))
    reached = simulator.workspace.ground.posts.are_reached(plan.path, plan.own_posts)
    assert not reached.all()
    assert mission.posts is None


def test_posts_that_no_one_can_have_stood_at_are_refused(unlike):
    workspace, simulator, plan = unlike
    mission = simulator.run(plan, seed=0)
    unknown = plan.posts.copy()
    unknown[0, 1, 0] = np.nan
    with pytest.raises(TrustboError, match=r"posts\[0, 1\] = \[nan, .* must be finite"):
        replace(mission, posts=unknown)
    swapped = replace(mission, posts=mission.posts[..., ::-1])
    campaign = Campaign(workspace, START, GOAL, sampler="exact", seed=0)
    campaign.suggest(plan.path)
    with pytest.raises(TrustboError, match=r"posts\[0, 0\] = .* is not near cell \(3, 0\)"):
        campaign.tell(swapped)
    assert not campaign.missions
    told = Mission.from_arrays(
        plan.path, mission.awareness, mission.contact_rate, features=mission.features,
        robots=mission.robots, posts=plan.own_posts,
    )  # fmt: skip
    np.testing.assert_array_equal(
        campaign.as_learned(told).awareness, campaign.as_learned(mission).awareness
    )
