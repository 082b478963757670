"""Simulated missions: what must be seen is seen, what fails says so, what is seeded repeats."""

import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from worlds import hillside, terrain_of

from trustbo.errors import TrustboError
from trustbo.simulation import KinematicSimulator
from trustbo.team import Robot, Team
from trustbo.workspace import Sight, Workspace

PATH = [(2, 0), (1, 1), (0, 2)]


def workspace_of(dem, height, shape=(3, 3), team=None, resolution=1.0):
    return Workspace.from_terrain(terrain_of(dem, height, resolution), shape, team)


@pytest.fixture(scope="module")
def wooded():
    return Workspace.from_terrain(hillside(), (3, 3))


def test_open_flat_ground_gives_full_contact():
    mission = KinematicSimulator(workspace_of(np.zeros((60, 60)), 0.0)).run(PATH, seed=0)
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
    assert mission.awareness.shape == (2, 3, 3)
    assert np.isnan(mission.awareness[..., 2]).all()  # line of sight is predicted, not measured
    first, second = mission.bounds
    assert first.cell == (1, 1)
    assert second.t0 == pytest.approx(first.t1)
    n_ticks = len(first.poses)
    assert first.duration[0] == pytest.approx(0.5 * n_ticks)
    np.testing.assert_allclose(first.contact_rate, first.contact.mean(0))
    # Everybody ends in the cell entered, the lead at its waypoint, T2 around it.
    ends = [wooded.grid.cell_at(x, y) for x, y in second.poses[-1, :, :2]]
    assert ends == [(0, 2)] * 4
    gaps = np.linalg.norm(second.poses[-1, 1:, :2] - second.poses[-1, 0, :2], axis=1)
    assert (gaps <= 9.0).all()


def test_t2_watches_while_the_lead_moves_and_the_other_way_round(wooded):
    bound = KinematicSimulator(wooded).run(PATH, seed=3).bounds[0]
    moved = np.linalg.norm(np.diff(bound.poses[..., :2], axis=0), axis=-1) > 1e-9
    lead, t2 = moved[:, 0], moved[:, 1:].any(1)
    assert not (lead & t2).any()
    assert lead.any()
    assert t2.any()
    assert np.flatnonzero(lead).max() < np.flatnonzero(t2).min()


def test_measured_awareness_is_that_of_the_ground_driven_over(wooded):
    bound = KinematicSimulator(wooded).run(PATH, seed=3).bounds[0]
    values = wooded.pixels["visibility"]
    for robot in range(3):
        x, y = bound.poses[:, 1 + robot, 0], bound.poses[:, 1 + robot, 1]
        moving = np.append(False, np.hypot(np.diff(x), np.diff(y)) > 0)
        on = values.sel(
            x=xr.DataArray(x[moving], dims="t"),
            y=xr.DataArray(y[moving], dims="t"),
            method="nearest",
        )
        assert bound.awareness[robot, 1] == pytest.approx(float(on.mean()), abs=0.02)


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


def test_running_bound_by_bound_is_running_the_mission(wooded):
    simulator = KinematicSimulator(wooded)
    whole = simulator.run(PATH, seed=4)
    simulator.reset(PATH[0], 4, next_cell=PATH[1])
    first = simulator.run_bound(1, PATH[1], next_cell=PATH[2])
    second = simulator.run_bound(2, PATH[2])
    simulator.close()
    np.testing.assert_array_equal(
        whole.contact_rate, np.stack([first.contact_rate, second.contact_rate])
    )
    with pytest.raises(TrustboError, match="call reset"):
        simulator.run_bound(3, PATH[2])


def test_bare_ground_hinders_sight_least_and_a_wall_of_canopy_most(wooded):
    mean = {
        mode: np.mean(
            [
                KinematicSimulator(wooded, sight=mode).run(PATH, seed=s).contact_rate
                for s in range(3)
            ]
        )
        for mode in ("bare", "transmittance", "wall")
    }
    assert mean["bare"] >= mean["transmittance"] >= mean["wall"]
    assert mean["bare"] > mean["wall"] + 0.1


def test_denser_canopy_never_raises_contact(wooded):
    rates = [
        KinematicSimulator(wooded, sight=Sight(extinction=k)).run(PATH, seed=1).contact_rate.mean()
        for k in (0.0, 0.1, 1.0)
    ]
    assert rates[0] >= rates[1] >= rates[2]


def test_a_hidden_team_is_out_of_contact():
    dem = np.zeros((60, 60))
    dem[:, 30] = 30.0  # a wall nobody can cross or look over
    workspace = workspace_of(dem, 0.0, (2, 2))
    mission = KinematicSimulator(workspace).run([(0, 0), (0, 1)], seed=0)
    assert mission.status == "stuck"
    assert len(mission.bounds) == 1
    assert mission.bounds[0].status == "stuck"


def test_a_mission_that_runs_out_of_time_keeps_what_it_measured():
    workspace = workspace_of(np.zeros((60, 60)), 0.0)
    mission = KinematicSimulator(workspace, bound_timeout=5.0).run(PATH, seed=0)
    assert mission.status == "timeout"
    assert len(mission.bounds) == 1
    assert mission.duration[0, 0] == pytest.approx(5.0)
    np.testing.assert_array_equal(mission.contact_rate, 1.0)


def test_a_robot_that_tips_over_ends_the_mission():
    """A hillside steeper than the limit only where the gradient, not the cell, says so."""
    workspace = workspace_of(np.zeros((60, 60)), 0.0)
    simulator = KinematicSimulator(workspace)
    surface = simulator._surface
    surface.gradient[1, :, 35:] = 1.5  # a side slope that the route cannot know of
    mission = simulator.run([(1, 0), (1, 1), (1, 2)], seed=0)
    assert mission.status == "tipped"
    assert len(mission.bounds) <= 2


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
    workspace = workspace_of(dem, 1.0)
    for seed in range(3):
        mission = KinematicSimulator(workspace).run(PATH, seed=seed)
        assert mission.status == "ok"
        assert np.isfinite(mission.bounds[-1].poses).all()


def test_bad_input():
    bare = Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))
    with pytest.raises(TrustboError, match="needs a terrain"):
        KinematicSimulator(bare)
    workspace = workspace_of(np.zeros((60, 60)), 0.0)
    with pytest.raises(TrustboError, match="unknown sight mode 'fog'; choose one of bare, wall"):
        KinematicSimulator(workspace, sight="fog")
    with pytest.raises(TrustboError, match="tick must be positive and finite; got 0"):
        KinematicSimulator(workspace, tick=0.0)
    with pytest.raises(TrustboError, match=r"path\[1\] \(9, 9\) is outside the grid"):
        KinematicSimulator(workspace).run([(0, 0), (9, 9)], seed=0)
    with pytest.raises(TrustboError, match="at least two cells"):
        KinematicSimulator(workspace).run([(0, 0)], seed=0)
    for options, message in (
        ({"sight": 3}, "sight must be a mode's name or a Sight, or several; got 3"),
        ({"bound_timeout": np.inf}, "bound_timeout must be positive and finite; got inf"),
    ):
        with pytest.raises(TrustboError, match=message):
            KinematicSimulator(workspace, **options)
    with pytest.raises(TrustboError, match="seed must be a whole number from 0 on; got -1"):
        KinematicSimulator(workspace).run(PATH, seed=-1)
    with pytest.raises(TrustboError, match="extinction >= 0"):
        Sight(extinction=-1.0)
