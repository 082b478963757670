"""Simulated missions: what must be seen is seen, what fails says so, what is seeded repeats."""

import subprocess
import sys

import numpy as np
import pytest
from worlds import hillside, terrain_of

from trustbo.errors import TrustboError
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.sensing import contact_of, new_tracks
from trustbo.team import Robot, Team
from trustbo.workspace import Sight, Workspace

PATH = [(2, 0), (1, 1), (0, 2)]


def workspace_of(dem, height, shape=(3, 3), team=None, resolution=1.0):
    return Workspace.from_terrain(terrain_of(dem, height, resolution), shape, team)


@pytest.fixture(scope="module")
def wooded():
    return Workspace.from_terrain(hillside(), (3, 3))


@pytest.fixture(scope="module")
def flat():
    return workspace_of(np.zeros((60, 60)), 0.0)


def test_open_flat_ground_gives_full_contact(flat):
    mission = KinematicSimulator(flat).run(PATH, seed=0)
    assert mission.status == "ok"
    np.testing.assert_array_equal(mission.contact_rate, 1.0)


def test_contact_is_lost_beyond_the_lidar_s_range():
    robot = Robot(lidar_range=6.0)
    team = Team(robots=(robot, Robot(), Robot()), lead=Robot())
    workspace = workspace_of(np.zeros((60, 60)), 0.0, team=team)
    rates = KinematicSimulator(workspace).run(PATH, seed=0).contact_rate
    assert (rates[:, 0] < 0.8).all()
    np.testing.assert_array_equal(rates[:, 1:], 1.0)


def test_a_mission_records_what_happened(wooded):
    mission = KinematicSimulator(wooded).run(PATH, seed=3)
    assert mission.status == "ok"
    np.testing.assert_array_equal(mission.awareness, wooded.along(PATH))
    first, second = mission.bounds
    assert first.cell == (1, 1)
    assert second.t0 == pytest.approx(first.t1)
    assert first.duration[0] == pytest.approx(0.5 * len(first.poses))
    np.testing.assert_allclose(first.contact_rate, first.contact.mean(0))
    # All end in the cell entered, the lead at its stop and T2 around it.
    ends = [wooded.grid.locate({"x": x, "y": y}) for x, y in second.poses[-1, :, :2]]
    assert ends == [(0, 2)] * 4
    gaps = np.linalg.norm(second.poses[-1, 1:, :2] - second.poses[-1, 0, :2], axis=1)
    assert (gaps <= 9.0).all()


def test_t2_watches_while_the_lead_moves_and_the_other_way_round(wooded):
    bound = KinematicSimulator(wooded).run(PATH, seed=3).bounds[0]
    moved = np.linalg.norm(np.diff(bound.poses[..., :2], axis=0), axis=-1) > 1e-9
    lead, t2 = moved[:, 0], moved[:, 1:].any(1)
    assert lead.any()
    assert t2.any()
    assert np.flatnonzero(lead).max() < np.flatnonzero(t2).min()


def test_the_same_seed_gives_the_same_mission(wooded):
    simulator = KinematicSimulator(wooded)
    first, again, other = (simulator.run(PATH, seed=s) for s in (7, 7, 8))
    np.testing.assert_array_equal(first.contact_rate, again.contact_rate)
    np.testing.assert_array_equal(first.bounds[1].poses, again.bounds[1].poses)
    assert (first.contact_rate != other.contact_rate).any()


@pytest.mark.slow  # a process starts for long
def test_the_same_seed_gives_the_same_mission_in_a_fresh_process(wooded):
    first = KinematicSimulator(wooded).run(PATH, seed=7)
    program = (
        "from trustbo.terrain import synthetic_terrain\n"
        "from trustbo.workspace import Workspace\n"
        "from trustbo.simulation import KinematicSimulator\n"
        "w = Workspace.from_terrain(synthetic_terrain((90.0, 90.0), seed=5, relief=6.0), (3, 3))\n"
        f"print(KinematicSimulator(w).run({PATH}, seed=7).contact_rate.tolist())"
    )
    printed = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert printed.stdout.strip() == str(first.contact_rate.tolist())


def test_bare_ground_hinders_sight_least_and_dense_canopy_most(wooded):
    mean = {
        k: np.mean([
            KinematicSimulator(wooded, sight=Sight(extinction=k)).run(PATH, seed=s).contact_rate
            for s in range(3)
        ])
        for k in (0.0, 0.1, 1.0, np.inf)
    }  # fmt: skip
    assert mean[0.0] >= mean[0.1] >= mean[1.0] >= mean[np.inf]
    assert mean[0.0] > mean[1.0] + 0.1


def test_a_mission_without_a_route_is_stuck():
    dem = np.zeros((60, 60))
    dem[:, 30] = 30.0  # a wall nobody can cross or look over
    mission = KinematicSimulator(workspace_of(dem, 0.0, (2, 2))).run([(0, 0), (0, 1)], seed=0)
    assert mission.status == mission.bounds[-1].status == "stuck"
    assert len(mission.bounds) == 1


def test_a_mission_that_runs_out_of_time_keeps_what_it_measured(flat):
    mission = KinematicSimulator(flat, bound_timeout=5.0).run(PATH, seed=0)
    assert mission.status == "timeout"
    assert len(mission.bounds) == 1
    assert mission.duration[0, 0] == pytest.approx(5.0)
    np.testing.assert_array_equal(mission.contact_rate, 1.0)


def test_a_robot_that_tips_over_ends_the_mission():
    """A true hillside beyond the limit, where the workspace assumed level ground."""
    planned = workspace_of(np.zeros((60, 60)), 0.0)
    dem = np.zeros((60, 60))
    dem[:, 35:] = 1.5 * np.arange(60)[:, None]  # a side slope for who drives east
    simulator = KinematicSimulator(planned, terrain=terrain_of(dem, 0.0))
    mission = simulator.run([(1, 0), (1, 1), (1, 2)], seed=0)
    assert mission.status in ("tipped", "stuck")


def test_on_coarse_pixels_nobody_stands_on_the_lead():
    workspace = workspace_of(np.zeros((12, 12)), 0.0, (2, 2), resolution=10.0)
    mission = KinematicSimulator(workspace).run([(0, 0), (0, 1)], seed=0)
    last = mission.bounds[-1].poses[-1, :, :2]
    gaps = np.linalg.norm(last[:, None] - last[None], axis=-1)[np.triu_indices(4, 1)]
    assert (gaps > 5.0).all()


def test_robots_may_brush_the_edge_of_the_data():
    rng = np.random.default_rng(0)
    dem = rng.normal(0.0, 0.05, (90, 90))
    dem[rng.uniform(size=dem.shape) < 0.01] = np.nan
    simulator = KinematicSimulator(workspace_of(dem, 1.0))
    for seed in range(3):
        mission = simulator.run(PATH, seed=seed)
        assert mission.status == "ok"
        assert np.isfinite(mission.bounds[-1].poses).all()


def track_by_hand(looks, acquire, drop):
    """The same rule, said plainly."""
    tracked, streak, contact = False, 0, []
    for found in looks:
        streak = streak + 1 if found != tracked else 0
        if streak == (drop if tracked else acquire):
            tracked, streak = not tracked, 0
        contact.append(tracked)
    return contact


@pytest.mark.parametrize(("acquire", "drop"), [(1, 1), (3, 1), (1, 4), (2, 3)])
def test_a_track_begins_after_some_finds_and_ends_after_some_misses(acquire, drop):
    looks = np.random.default_rng(0).random((200, 3)) < 0.6
    robots = [Robot(acquire=acquire, drop=drop)] * 3
    tracks = new_tracks(3)
    contact = np.concatenate(  # in two pieces: the state is carried over
        [contact_of(part, robots, tracks[0]) for part in (looks[:77], looks[77:])]
    )
    for i in range(3):
        assert contact[:, i].tolist() == track_by_hand(looks[:, i], acquire, drop)


def test_a_worse_lidar_has_less_contact(flat):
    team = Team(robots=(Robot(detection=0.6), Robot(), Robot()))
    simulator = KinematicSimulator(flat, team=team)
    missions = [simulator.run(PATH, seed=seed) for seed in range(20)]
    rates = np.mean([m.contact_rate for m in missions], axis=(0, 1))
    assert 0.7 < rates[0] < 0.9  # T2 looks about half of the time, else the lead's good lidar does
    np.testing.assert_array_equal(rates[1:], 1.0)


@pytest.mark.parametrize(
    "make",
    [
        lambda flat: KinematicSimulator(Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))),
        lambda flat: KinematicSimulator(flat, tick=0.0),
        lambda flat: KinematicSimulator(flat, bound_timeout=np.inf),
        lambda flat: KinematicSimulator(flat, team=Team(2)),
        lambda flat: KinematicSimulator(flat, terrain=terrain_of(np.zeros((30, 30)))),
        lambda flat: KinematicSimulator(flat).run([(0, 0), (9, 9)], seed=0),
        lambda flat: KinematicSimulator(flat).run([(0, 0)], seed=0),
        lambda flat: KinematicSimulator(flat).run(PATH, seed=-1),
    ],
)
def test_impossible_settings_are_refused(flat, make):
    with pytest.raises(TrustboError):
        make(flat)
