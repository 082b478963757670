"""Real-time awareness of the paper: the map fused with the robot's state."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import hillside

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.simulation import KinematicSimulator, RealtimeAwareness
from trustbo.simulation.realtime import MIN_SAMPLES, lidar_state
from trustbo.team import Robot, Team
from trustbo.workspace import Workspace

PATHS = ([(2, 0), (1, 1), (0, 2)], [(0, 0), (1, 0), (1, 1)], [(2, 2), (1, 2), (0, 1)])


@pytest.fixture(scope="module")
def simulator():
    return KinematicSimulator(Workspace.from_terrain(hillside(), (3, 3)))


@pytest.fixture(scope="module")
def missions(simulator):
    return [simulator.run(path, seed=seed) for path in PATHS for seed in range(12)]


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
def test_awareness_is_the_first_component_of_map_and_state(simulator, missions):
    realtime = RealtimeAwareness(simulator, missions)
    measured = realtime.measured(missions[0])
    assert measured.awareness.shape == missions[0].awareness.shape
    np.testing.assert_array_equal(measured.contact_rate, missions[0].contact_rate)
    fused = measured.awareness[..., :2]
    assert ((fused >= 0.0) & (fused <= 1.0)).all()
    assert not np.allclose(fused, missions[0].awareness[..., :2])
    np.testing.assert_array_equal(measured.awareness[..., 2], missions[0].awareness[..., 2])


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
def test_inputs_are_those_of_the_way(simulator, missions):
    inputs = RealtimeAwareness(simulator, missions).inputs(missions[0].bounds[0])
    motion, sensing = inputs["traversability"], inputs["visibility"]
    assert (motion["speed_ratio"] > 0.5).all()
    assert (np.hypot(motion["pitch"], motion["roll"]) < np.pi / 4).all()
    assert ((sensing["visible_share"] >= 0.0) & (sensing["visible_share"] <= 1.0)).all()
    assert (sensing["return_range"] <= 45.0 + 1e-9).all()


def test_on_open_ground_all_beams_are_clear(missions):
    terrain = hillside()
    terrain["dem"][:] = 0.0
    terrain["dsm"] = terrain["dem"].copy()
    flat = KinematicSimulator(
        Workspace.from_terrain(terrain, (3, 3), Team(1), bounds=False,
                               features={"traversability": ["slope", "tri"]})
    )  # fmt: skip
    seen = lidar_state(flat.world(), missions[0].bounds[0].poses[:, 1:2])
    return_range, visible = seen["return_range"], seen["visible_share"]
    np.testing.assert_allclose(visible, 1.0)
    np.testing.assert_allclose(return_range, 45.0)


def test_each_robot_looks_as_far_as_its_own_lidar(simulator, missions):
    near, far = Robot(lidar_range=20.0), Robot(lidar_range=40.0)
    poses = missions[0].bounds[0].poses[:, 1:3]

    def state(*robots):
        world = simulator.world()._replace(team=Team(robots=robots))
        return lidar_state(world, poses[:, : len(robots)])

    mixed, short = state(near, far), state(near)
    for name in ("return_range", "visible_share"):
        np.testing.assert_array_equal(mixed[name][:, :1], short[name])
        np.testing.assert_array_equal(mixed[name][:, 1], state(far, far)[name][:, 1])
    assert (mixed["return_range"][:, 0] <= 20.0 + 1e-9).all()


def test_few_missions_are_refused(simulator, missions):
    with pytest.raises(TrustboError):
        RealtimeAwareness(simulator, missions[:2])


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
def test_it_is_a_simulator_of_missions_with_measured_awareness(simulator, missions):
    robots = RealtimeAwareness(simulator, missions)
    run = robots.run(PATHS[0], seed=4)
    plain = simulator.run(PATHS[0], seed=4)
    np.testing.assert_array_equal(run.contact_rate, plain.contact_rate)
    np.testing.assert_array_equal(run.awareness, robots.measured(plain).awareness)
    assert robots.describe_world(0) == simulator.describe_world(0)
    other = RealtimeAwareness(simulator, missions[12:] + missions[24:])
    assert robots.describe() == RealtimeAwareness(simulator, missions).describe()
    assert robots.describe() != other.describe()


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
@pytest.mark.filterwarnings("ignore:the loading of")
def test_random_missions_calibrate_it(simulator):
    one = RealtimeAwareness(simulator, seed=1)
    again = RealtimeAwareness(simulator, seed=1)
    assert one.describe() == again.describe() != RealtimeAwareness(simulator, seed=2).describe()
    assert MIN_SAMPLES == 200


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
def test_a_bound_without_poses_and_a_workspace_without_its_features_are_refused(
    simulator, missions
):
    robots = RealtimeAwareness(simulator, missions)
    one = missions[0]
    without = replace(one, poses=(None, *one.poses[1:]))
    with pytest.raises(TrustboError, match="poses"):
        robots.measured(without)
    other = Workspace.from_terrain(hillside(), (3, 3), features={"slope": ["slope"]})
    with pytest.raises(TrustboError, match="traversability"):
        RealtimeAwareness(KinematicSimulator(other))
    with pytest.raises(TrustboError, match="simulator"):
        RealtimeAwareness(robots)


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
def test_a_campaign_learns_from_the_awareness_of_its_choice(simulator, missions, tmp_path):
    robots = RealtimeAwareness(simulator, missions)
    options = {"model": tb.models.PooledTrust(), "sampler": "importance", "fit": {"draws": 100}}

    def run(awareness, n, **where):
        return tb.iterate(
            simulator.workspace, (2, 0), (0, 2), n_iterations=n, simulator=robots,
            awareness=awareness, progress=False, **options, **where,
        )  # fmt: skip

    mapped, measured = run("map", 2), run("measured", 2, directory=tmp_path / "two")
    for result in (mapped, measured):
        for entry in result.state.entries:
            of_map = simulator.workspace.along(entry.measured.stations)
            expected = of_map if result is mapped else entry.measured.awareness
            np.testing.assert_array_equal(entry.mission.awareness, expected)
    given = measured.state.entries[0].measured.awareness
    learned = measured.posterior["constant_data"]["awareness"].values[0]
    np.testing.assert_array_equal(learned[: len(given)], given)

    # A resumed campaign is the same, and plans with the map.
    resumed = tb.resume(tmp_path / "two", simulator=robots, n_iterations=3, progress=False)
    whole = run("measured", 3)
    assert resumed.settings["awareness"] == "measured"
    np.testing.assert_array_equal(resumed.missions[2].awareness, whole.missions[2].awareness)
    for name, draws in whole.posterior["posterior"].data_vars.items():
        np.testing.assert_array_equal(draws, resumed.posterior["posterior"][name])
    assert resumed.planner.workspace is resumed.workspace


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
@pytest.mark.filterwarnings("ignore:the loading of")
def test_without_a_simulator_robots_measure_if_the_model_learns_from_it(simulator, tmp_path):
    workspace = simulator.workspace
    options = {"model": tb.models.PooledTrust(), "sampler": "importance", "fit": {"draws": 100},
               "progress": False, "awareness": "measured"}  # fmt: skip
    tb.iterate(workspace, (2, 0), (0, 2), n_iterations=1, directory=tmp_path / "one", **options)
    result = tb.resume(tmp_path / "one", n_iterations=2, progress=False)
    assert len(result.missions) == 2
    for entry in result.state.entries:
        known = workspace.along(entry.plan.path)
        assert not np.allclose(entry.measured.awareness[..., :2], known[..., :2])
        np.testing.assert_array_equal(entry.measured.awareness, entry.mission.awareness)


def test_the_map_fills_what_was_not_measured():
    z = np.random.default_rng(0).uniform(size=(3, 4, 4, 2))
    workspace = tb.Workspace.from_awareness(z)
    campaign = tb.Campaign(workspace, (3, 0), (0, 3), awareness="measured", sampler="importance",
                           model=tb.models.PooledTrust())  # fmt: skip
    path = campaign.ask().path
    measured = np.full((len(path) - 1, 3, 2), 0.25)
    measured[0, 1] = np.nan
    campaign.tell(tb.Mission.from_arrays(path, measured, measured[..., 0]))
    expected = np.where(np.isnan(measured), workspace.along(path), measured)
    np.testing.assert_array_equal(campaign.missions[0].awareness, expected)
    with pytest.raises(TrustboError, match="awareness"):
        tb.Campaign(workspace, (3, 0), (0, 3), awareness="guessed")
