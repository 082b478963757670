"""Alternate bounding: order of moves by hand, and what is planned beside what is driven."""

import itertools

import numpy as np
import pytest
from worlds import hillside, terrain_of

from trustbo.campaign.campaign import Campaign
from trustbo.errors import TrustboError
from trustbo.simulation import KinematicSimulator, Truth
from trustbo.team import Robot, Team
from trustbo.workspace import Workspace
from trustbo.workspace.bounding import Leg, legs_along, t2_cells
from trustbo.workspace.sight import detection_between, optics

A, B, C, D = ((0, col) for col in range(4))
PATHS = [(2, 0), (2, 1), (1, 2), (1, 3), (0, 2)], [(2, 0), (2, 1), (1, 2), (1, 3)]


@pytest.fixture(scope="module")
def by_turns():
    terrain = hillside(90.0, 120.0)
    return Workspace.from_terrain(terrain, (3, 4), bounding="alternate")


def test_the_lead_and_t2_pass_each_other_by_turns():
    lead, t2 = True, False
    assert legs_along("alternate", [A, B, C, D]) == [
        (Leg(lead, A, A, B),),
        (Leg(t2, A, B, C),),  # past the lead in B
        (Leg(lead, B, C, D), Leg(t2, C, D, D)),  # and at the goal the one behind closes up
    ]
    assert legs_along("alternate", [A, B, C])[1] == (Leg(t2, A, B, C), Leg(lead, B, C, C))
    assert t2_cells("alternate", [A, B, C, D]) == [A, A, C]
    assert legs_along("successive", [A, B, C])[1] == (Leg(lead, B, B, C), Leg(t2, B, C, C))
    assert t2_cells("successive", [A, B, C, D]) == [A, B, C]


def test_on_flat_ground_sight_is_that_of_the_lidar_whose_turn_it_is():
    """T2's lidars detect half of the scans, the lead's all; at the goal both phases count."""
    robots = Robot(detection=0.5), Robot(detection=0.5)
    flat = terrain_of(np.zeros((30, 120)))
    made = Workspace.from_terrain(flat, (1, 4), Team(robots=robots), bounding="alternate")
    table, rule = made.watch, made.watch.rule([A, B, C, D])
    seen = table.seen_along((A, B, C, D), rule)
    lead, t2 = seen.lead_time, seen.times.max(1)
    np.testing.assert_allclose(lead[1], 0.0, atol=1e-6)
    np.testing.assert_allclose(t2[0], 0.0, atol=1e-6)
    last = (0.5 * lead[2] + t2[2]) / (lead[2] + t2[2])  # the lead from B to D, T2 from C to D
    expected = np.repeat([[0.5], [1.0], [last]], 2, axis=1)
    np.testing.assert_allclose(seen.line_of_sight(), expected, atol=1e-6)
    missions = KinematicSimulator(made).run_batch([A, B, C, D], range(400))
    rates = np.mean([mission.contact_rate for mission in missions], axis=0)
    np.testing.assert_allclose(rates, expected, atol=0.03)  # 9 scans x 400 missions: .008
    # A bound of the map is of either turn: half of the time by T2's lidars.
    known = made.bound_awareness.sel(move="e", feature="line_of_sight").values[:, 0, 1:]
    np.testing.assert_allclose(known, 0.75, atol=1e-6)


@pytest.mark.parametrize("path", PATHS)
def test_what_is_planned_is_what_is_driven_and_predicted(by_turns, path):
    posts = by_turns.ground.posts
    lead, t2 = posts.places(path)
    missions = KinematicSimulator(by_turns).run_batch(path, range(24))
    assert {mission.status for mission in missions} == {"ok"}
    for k, ways in enumerate(by_turns.ground.along(path)):
        poses, goals = missions[0].bounds[k].poses[..., :2], np.stack([lead[k + 1], *t2[k + 1]])
        for i, way in enumerate(ways):
            np.testing.assert_array_equal(way[-1], goals[i])
            assert np.linalg.norm(poses[-1, i] - way[-1]) <= 0.5  # where robots have arrived
            if (way[0] == way[-1]).all():
                np.testing.assert_array_equal(poses[:, i], poses[[0] * len(poses), i])
                continue
            fine = np.concatenate([np.linspace(p, q, 20) for p, q in itertools.pairwise(way)])
            gap = np.linalg.norm(poses[:, i, None] - fine, axis=-1).min(1)
            assert gap.max() <= 1.5  # a pixel, and slip
    rates = np.mean([mission.contact_rate for mission in missions], axis=0).mean(1)
    expected = by_turns.watch.seen_along(tuple(path), posts.along(path)).line_of_sight().mean(1)
    assert np.abs(rates - expected).mean() < 0.06  # T2 is taken to go as the lead would


def test_posts_are_where_the_lead_is_seen_to_come_from_the_cell_before(by_turns):
    """Those of successive bounding look at the way from the cell itself."""
    table, gains = by_turns.watch, []
    for before, a, c in (
        [(2, 0), (2, 1), (1, 2)],
        [(0, 0), (1, 1), (1, 2)],
        [(2, 3), (1, 2), (0, 1)],
    ):
        posts = by_turns.posts(a, c, before), by_turns.posts(a, c)
        path = before, a, c
        way = by_turns.ground.posts.lead_line(*path)
        gains.append(np.subtract(*(_sight(table, way, some, by_turns) for some in posts)))
    assert np.mean(gains) > 0.0
    successive = Workspace.from_terrain(by_turns.terrain, (3, 4))
    np.testing.assert_array_equal(successive.posts(a, c, before), successive.posts(a, c))


def _sight(table, way, posts, workspace):
    """Mean sight of points of a way from posts."""
    lidar = optics(workspace.team.robots[0], workspace.team.lead)
    surface = workspace.ground.posts.surface
    eyes, aims = posts[:, None], way[None, ::4]
    return detection_between(surface, workspace.sights[0], eyes, aims, lidar).mean()


def test_missions_start_from_given_posts_in_alternate_bounding(by_turns):
    path, simulator = PATHS[0], KinematicSimulator(by_turns)
    own = by_turns.ground.posts.along(path)[:, ::-1]
    mission = simulator.run(path, seed=0, posts=own)
    assert mission.status == "ok"
    np.testing.assert_array_equal(mission.bounds[0].poses[0, 1:, :2], own[0])
    third = mission.bounds[2].poses  # T2 has passed the lead and stands
    assert np.linalg.norm(third[:, 1:, :2] - own[2], axis=-1).max() <= 0.5
    filled, known = by_turns.fill(mission).awareness, by_turns.along(path, own)
    np.testing.assert_array_equal(filled[..., -1], known[..., -1])
    with pytest.raises(
        TrustboError, match=r"posts\[1, 0\] = .* from the lead's stop in cell \(2, 0"
    ):
        simulator.run(
            path, seed=0, posts=own + np.array([0.0, 1000.0])[(np.arange(4) == 1) * 1, None, None]
        )


def test_a_truth_has_the_value_of_paths_but_no_best(by_turns, tmp_path):
    path, simulator = PATHS[0], KinematicSimulator(by_turns)
    truth = Truth.of(simulator, folder=tmp_path)
    found = truth.value(path)
    rates = [m.contact_rate.mean() for m in simulator.run_batch(path, range(100, 164))]
    error = np.std(rates) * np.sqrt(2.0 / 64)
    assert abs(found.mean - np.mean(rates)) < 4.0 * error
    assert found.lost == pytest.approx(4.0 * (1.0 - found.mean))
    assert not list(tmp_path.iterdir())
    with pytest.raises(TrustboError, match="alternate bounding has no best path, and so no regret"):
        truth.regret(path)
    campaign = Campaign(by_turns, path[0], path[-1], sampler="exact")
    with pytest.raises(TrustboError, match="alternate bounding has no best path"):
        next(iter(campaign.run(simulator, 1, truth=truth)))
    with pytest.raises(TrustboError, match="unknown bounding 'leapfrog'; choose one of successive"):
        Workspace.from_terrain(by_turns.terrain, (3, 4), bounding="leapfrog")
