"""Physics against planes whose outcome is known; missions that repeat, fail and teach."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest
from worlds import CORNER, hillside, terrain_of

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.mujoco import MujocoSimulator
from trustbo.simulation.vehicle import WHEEL_RADIUS, Ground, Physics, center_of_mass, crop, grip_of
from trustbo.team import Robot, Team
from trustbo.workspace import Workspace
from trustbo.workspace.sight import detection_probability, optics
from trustbo.workspace.surface import Surface

PATH = [(2, 0), (1, 1), (0, 2)]
HUSKY = Robot()


def workspace_of(dem, team=None, resolution=1.0, shape=(3, 3)):
    return Workspace.from_terrain(terrain_of(dem, resolution=resolution), shape, team)


def surface_with(ground, gradient, pixel=(1.0, 1.0), origin=(0.0, 0.0)):
    ground = np.asarray(ground, float)
    return Surface(ground, ground, gradient, np.ones(ground.shape, bool), pixel, origin)


def plane(dz_dx, dz_dy, n=90, origin=(0.0, 0.0)):
    row, col = np.mgrid[:n, :n]
    gradient = np.stack([np.full((n, n), dz_dx), np.full((n, n), dz_dy)])
    return surface_with(dz_dx * col - dz_dy * row, gradient, origin=origin)


def rough(n=60, amplitude=0.15):
    row, col = np.mgrid[:n, :n]
    return amplitude * (np.sin(0.9 * col) + np.cos(0.7 * row + 0.3 * col)) + 0.1 * col


@pytest.fixture(scope="module")
def flat():
    return workspace_of(np.zeros((90, 90)))


@pytest.fixture(scope="module")
def wooded():
    return Workspace.from_terrain(hillside(), (3, 3))


def drive(workspace, surface, starts, goals, *, robot=HUSKY, heading=0.0, seconds=120.0, **options):
    """Drive robots over a surface that stands in for the workspace's flat one.

    Positions are in metres from the left and from the top edge.
    """
    simulator = MujocoSimulator(workspace, **options)
    origin = simulator._surface.origin
    simulator._surface = surface._replace(origin=origin)
    flip = np.array([1.0, -1.0])
    poses = np.array([[*(CORNER + flip * start), heading] for start in starts])
    goals = [CORNER + flip * goal for goal in goals]
    ticks = round(seconds / simulator.tick)
    robots, rng = [robot] * len(poses), np.random.default_rng(0)
    ways, window = simulator._ways, simulator._ways.posts.window((1, 0), (1, 2))
    routes = [
        ways.routes.find(robot, pose[:2], goal, window)
        for pose, goal in zip(poses, goals, strict=True)
    ]
    track, status = simulator._move(poses, robots, routes, window, ticks, rng)
    return np.concatenate([poses[None], track]), status


# ---------------------------------------------------------------- ground and vehicle


def test_the_heightfield_is_the_dem_where_it_says_it_is():
    heights = np.random.default_rng(0).uniform(0.0, 5.0, (40, 30))
    surface = surface_with(heights, np.zeros((2, 40, 30)), (2.0, 1.0), (7e5, 5.4e6))
    ground = crop(surface, (10, 25, 5, 20), 3.0)
    physics = Physics(ground, [HUSKY], [1.0], 0.01)
    assert ground.heights.shape == (19, 21)  # 3 m are two pixels of 2 m, or three of 1 m
    lowest = heights[8:27, 2:23].min()
    row, col = np.mgrid[9:26, 3:22]
    # A hair off the corners of triangles, where a ray might slip through.
    x, y = surface.origin[0] + col + 1e-4, surface.origin[1] - row * 2.0 + 1e-4
    place = np.column_stack([(x - ground.center[0]).ravel(), (y - ground.center[1]).ravel()])
    mujoco.mj_forward(physics.model, physics.data)
    geom, field = np.zeros(1, np.int32), np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for (east, north), expected in zip(place, heights[row, col].ravel(), strict=True):
        start, down = np.array([east, north, 50.0]), np.array([0.0, 0.0, -1.0])
        depth = mujoco.mj_ray(physics.model, physics.data, start, down, field, 1, -1, geom)
        assert 50.0 - depth + lowest == pytest.approx(expected, abs=2e-3)
    found = ground.height(place[:, 0], place[:, 1]) + lowest
    np.testing.assert_allclose(found, heights[row, col].ravel(), atol=2e-3)


def test_beyond_the_edge_the_ground_goes_on_and_gaps_are_filled():
    heights = np.arange(20.0)[:, None] * np.ones(20)
    heights[5, 5] = np.nan
    ground = crop(surface_with(heights, np.zeros((2, 20, 20))), (0, 20, 0, 20), 2.0)
    assert ground.heights.shape == (24, 24)
    assert np.isfinite(ground.heights).all()
    np.testing.assert_array_equal(ground.heights[:3, 4], 19.0)  # south, where rows end
    np.testing.assert_array_equal(ground.heights[-3:, 4], 0.0)


@pytest.mark.parametrize("heading", [0.0, 1.0])
@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0])
def test_a_parked_robot_stands_on_its_wheels_and_stays(degrees, heading):
    surface = plane(np.tan(np.deg2rad(degrees)), 0.0, 40)
    physics = Physics(crop(surface, (0, 40, 0, 40), 0.0), [HUSKY], [grip_of(HUSKY)], 0.01)
    pose = np.array([[20.0, -20.0, heading]])
    physics.place(pose)
    np.testing.assert_allclose(physics.poses, pose, atol=0.02)
    assert physics.data.time < 0.7  # at rest before the patience ends
    assert wheel_gaps(physics, surface).max() < 0.005
    assert wheel_gaps(physics, surface).min() > -0.005
    # Springs give on the lower side: the body leans a little more than the ground.
    lean = np.rad2deg(np.arccos(physics.up[0, 2]))
    assert degrees - 0.1 < lean < degrees + 3.0
    physics.advance(3000)
    assert np.linalg.norm(physics.poses - pose) < 0.1  # in half a minute


def wheel_gaps(physics, surface):
    """Height of the wheels over a plane, at right angles to it, shape (robot * wheel,), m."""
    hubs = np.array([physics.data.xpos[k] for k in range(2, physics.model.nbody) if (k - 1) % 5])
    dz_dx, dz_dy = surface.gradient[:, 0, 0]
    heights = hubs[:, 2] - physics._ground.height(hubs[:, 0], hubs[:, 1])
    normal = np.array([-dz_dx, -dz_dy, 1.0]) / np.sqrt(1.0 + dz_dx**2 + dz_dy**2)
    rotation = physics.data.xmat[1].reshape(3, 3)
    # Lowest point of an ellipsoid, 0.06 m wide on either side, along the normal.
    reach = np.linalg.norm((rotation.T @ normal) * [WHEEL_RADIUS, 0.06, WHEEL_RADIUS])
    return heights * normal[2] - reach


def test_robots_put_on_one_spot_are_moved_apart():
    ground = Ground(np.zeros((20, 20)), (1.0, 1.0), (0.0, 0.0))
    physics = Physics(ground, [HUSKY] * 4, [1.0] * 4, 0.01)
    physics.place(np.zeros((4, 3)))
    gaps = np.linalg.norm(physics.poses[:, None, :2] - physics.poses[:, :2], axis=2)
    assert gaps[np.triu_indices(4, 1)].min() > 1.0
    assert np.abs(physics.poses).max() < 2.0
    assert not physics.touching.any()


@pytest.mark.parametrize("height", [1.0, 20.0])
def test_a_robot_that_falls_does_not_end_below_the_ground(height):
    ground = Ground(rough() - rough().min(), (1.0, 1.0), (0.0, 0.0))
    physics = Physics(ground, [HUSKY], [1.0], 0.01)
    physics.place(np.zeros((1, 3)))
    physics.data.qpos[2] += height
    above = []
    for _ in range(500):
        physics.advance(1)
        x, y, z = physics.data.qpos[:3]
        above.append(z - float(ground.height(x, y)))
    assert above[-1] > 0.1
    assert min(above) > -0.3 if height > 10.0 else min(above) > 0.0  # soft at 20 m/s
    assert physics.speed[0] < 0.1
    assert physics.is_finite


@pytest.mark.parametrize("max_slope", np.deg2rad([20.0, 45.0, 60.0]))
def test_steep_climbers_have_their_weight_low_and_grip_well(max_slope):
    robot, steeper = Robot(max_slope=max_slope), Robot(max_slope=max_slope + 0.1)
    assert np.arctan(grip_of(robot)) > max_slope
    assert grip_of(steeper) > grip_of(robot)
    assert 0.1 <= center_of_mass(steeper) <= center_of_mass(robot) <= 0.4


# ---------------------------------------------------------------- one drive


@pytest.mark.parametrize("speed", [0.5, 2.0, 5.0])
def test_on_flat_ground_a_robot_arrives_at_its_speed(flat, speed):
    robot = Robot(speed=speed)
    poses, status = drive(flat, plane(0, 0), [(10, 45)], [(70, 45)], robot=robot, seconds=150.0)
    assert status == "ok"
    assert np.hypot(*(poses[-1, 0, :2] - CORNER - [70, -45])) < 0.5
    cruise = np.hypot(*np.diff(poses[4:-4, 0, :2], axis=0).T) / 0.5
    assert np.median(cruise) == pytest.approx(speed, rel=0.05)
    # It starts from rest and slows down at the goal.
    assert (len(poses) - 1) * 0.5 == pytest.approx(59.5 / speed, rel=0.12, abs=2.0)


def test_a_robot_turns_on_the_spot_at_its_turn_rate_first(flat):
    poses, status = drive(flat, plane(0, 0), [(20, 45)], [(40, 45)], heading=np.pi)
    heading = np.unwrap(poses[:, 0, 2])
    assert status == "ok"
    assert np.hypot(*(poses[3, 0, :2] - poses[0, 0, :2])) < 0.3
    rate = np.abs(np.diff(heading)) / 0.5
    assert 0.7 < rate[1:4].max() < 1.2


@pytest.mark.parametrize(
    ("dz_dx", "dz_dy", "friction", "expected"),
    [
        (np.tan(np.deg2rad(35.0)), 0.0, None, {"ok"}),
        (0.0, np.tan(np.deg2rad(35.0)), None, {"ok"}),
        (np.tan(np.deg2rad(20.0)), 0.0, 0.5, {"ok"}),
        # tan(35 degrees) = 0.7 is beyond a friction of 0.5: wheels spin, the robot slides back.
        (np.tan(np.deg2rad(35.0)), 0.0, 0.5, {"stuck", "tipped"}),
        (0.0, np.tan(np.deg2rad(35.0)), 0.5, {"stuck", "tipped"}),
        # Half the track over the weight's height is 1.3 = tan(53 degrees).
        (0.0, np.tan(np.deg2rad(60.0)), None, {"tipped"}),
        (np.tan(np.deg2rad(65.0)), 0.0, None, {"tipped"}),
    ],
)
def test_slopes_are_climbed_up_to_what_weight_and_grip_allow(
    flat, dz_dx, dz_dy, friction, expected
):
    poses, status = drive(
        flat, plane(dz_dx, dz_dy), [(30, 45)], [(50, 45)], friction=friction, seconds=300.0
    )
    assert status in expected
    assert np.isfinite(poses).all()
    if status == "ok":
        assert np.hypot(*(poses[-1, 0, :2] - CORNER - [50, -45])) < 0.5


def test_steeper_is_slower(flat):
    ticks = [
        len(drive(flat, plane(np.tan(np.deg2rad(a)), 0), [(30, 45)], [(45, 45)])[0])
        for a in (0.0, 15.0, 30.0)
    ]
    assert ticks[0] < ticks[1] < ticks[2]


def test_a_robot_that_slides_past_its_goal_has_not_arrived(flat):
    steep = plane(-np.tan(np.deg2rad(40.0)), 0.0)
    poses, status = drive(flat, steep, [(20, 45)], [(40, 45)], friction=0.3)
    assert status in ("stuck", "tipped")
    assert poses[-1, 0, 0] > CORNER[0] + 45.0


def test_wheels_stay_on_rough_ground_and_energy_is_bounded():
    heights = rough()
    ground = Ground(heights - heights.min(), (1.0, 1.0), (0.0, 0.0))
    physics = Physics(ground, [HUSKY], [1.0], 0.01)
    physics.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    physics.place(np.array([[-20.0, 0.0, 0.0]]))
    physics.command(np.full((1, 2), 1.5))
    gaps, kinetic = [], []
    for _ in range(250):
        physics.advance(10)
        hubs = np.array([physics.data.xpos[k] for k in range(2, 6)])
        gaps.append(hubs[:, 2] - ground.height(hubs[:, 0], hubs[:, 1]) - WHEEL_RADIUS)
        kinetic.append(physics.data.energy[1])
    assert physics.poses[0, 0] > 10.0
    assert np.isfinite(kinetic).all()
    # 50 kg at 1.5 m/s have 56 J, and the wheels and their gears some 20 J.
    assert max(kinetic) < 150.0
    assert abs(np.median(gaps)) < 0.02
    assert np.quantile(gaps, 0.95) < 0.06
    assert np.min(gaps) > -0.06


# ---------------------------------------------------------------- several robots


def test_robots_that_change_places_go_round_each_other(flat):
    poses, status = drive(flat, plane(0, 0), [(30, 45), (50, 45)], [(50, 45), (30, 45)])
    assert status == "ok"
    gaps = np.hypot(*(poses[:, 0, :2] - poses[:, 1, :2]).T)
    assert gaps.min() > 0.7  # never in each other


@pytest.mark.parametrize("considerate", [True, False])
def test_robots_that_want_one_place_collide_or_block_each_other(flat, monkeypatch, considerate):
    if not considerate:
        monkeypatch.setattr("trustbo.simulation.mujoco._around", lambda bearing, *_: bearing)
    starts = [(45 + 4 * np.cos(a), 45 + 4 * np.sin(a)) for a in np.arange(5) * 2 * np.pi / 5]
    poses, status = drive(flat, plane(0, 0), starts, [(45, 45)] * 5)
    assert status in (("collision", "stuck") if considerate else ("collision",))
    gaps = np.linalg.norm(poses[:, :, None, :2] - poses[:, None, :, :2], axis=3)
    assert gaps[:, *np.triu_indices(5, 1)].min() > 0.2  # jostling, but never in each other


def test_without_a_route_or_with_too_little_time_a_drive_fails(flat):
    dem = np.zeros((60, 60))
    dem[:, 30] = 30.0  # a wall nobody can cross
    mission = MujocoSimulator(workspace_of(dem, shape=(2, 2))).run([(0, 0), (0, 1)], seed=0)
    assert mission.status == "stuck"
    assert len(mission.bounds) == 1
    mission = MujocoSimulator(flat, bound_timeout=5.0).run(PATH, seed=0)
    assert (mission.status, len(mission.bounds)) == ("timeout", 1)
    assert mission.duration[0, 0] == pytest.approx(5.0)


def test_a_drive_whose_physics_breaks_down_is_aborted(flat, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # where MuJoCo leaves its log
    place = Physics.place

    def broken(self, poses):
        place(self, poses)
        self.data.qvel[0] = np.nan

    monkeypatch.setattr(Physics, "place", broken)
    poses, status = drive(flat, plane(0, 0), [(30, 45)], [(50, 45)])
    assert status == "aborted"
    assert np.isfinite(poses).all()


# ---------------------------------------------------------------- missions


@pytest.fixture(scope="module")
def mission(wooded):
    return MujocoSimulator(wooded, sight="bare").run(PATH, seed=3)


def test_a_mission_is_much_like_a_kinematic_one_on_easy_ground(wooded, mission):
    kinematic = KinematicSimulator(wooded, sight="bare").run(PATH, seed=3)
    assert mission.status == "ok"
    np.testing.assert_allclose(mission.duration, kinematic.duration, rtol=0.25)
    np.testing.assert_allclose(mission.awareness, kinematic.awareness, atol=0.05)
    ends = [wooded.grid.cell_at(x, y) for x, y in mission.bounds[-1].poses[-1, :, :2]]
    assert ends == [(0, 2)] * 4
    for bound in mission.bounds:
        assert bound.poses.shape == (len(bound.contact), 4, 3)
        assert np.isfinite(bound.poses).all()
        np.testing.assert_allclose(bound.contact_rate, bound.contact.mean(0))
    # A robot that waits has not moved.
    steps = np.linalg.norm(np.diff(mission.bounds[0].poses[..., :2], axis=0), axis=2)
    assert (steps[-1, 1:] == 0.0).sum() >= 1


def test_contact_is_what_sight_says_of_the_recorded_poses(wooded, mission):
    simulator, team = KinematicSimulator(wooded, sight="bare"), wooded.team
    for bound in mission.bounds:
        poses = bound.poses[..., :2]
        lead_moves = np.any(np.diff(poses[:, 0], axis=0, append=poses[-1:, 0]) != 0.0, axis=1)
        until = np.flatnonzero(lead_moves).max() + 2  # the tick it arrives in is its last
        for i, robot in enumerate(team.robots):
            by_t2, by_lead = optics(robot, team.lead), optics(team.lead, robot)
            lead, t2 = poses[:, 0], poses[:, 1 + i]
            scene = simulator._surface, simulator.sight
            seen = np.concatenate(
                [
                    detection_probability(*scene, t2[:until], lead[:until], by_t2),
                    detection_probability(*scene, lead[until:], t2[until:], by_lead),
                ]
            )
            np.testing.assert_array_equal(bound.contact[:, i], seen > 0.5)
        assert ((bound.contact_rate >= 0.0) & (bound.contact_rate <= 1.0)).all()


def test_contact_is_lost_beyond_the_lidar_s_range():
    team = Team(robots=(Robot(lidar_range=8.0),), lead=Robot(lidar_range=8.0))
    workspace = workspace_of(np.zeros((60, 60)), team)
    bound = MujocoSimulator(workspace).run(PATH[:2], seed=0).bounds[0]
    gap = np.linalg.norm(bound.poses[:, 0, :2] - bound.poses[:, 1, :2], axis=1)
    np.testing.assert_array_equal(bound.contact[:, 0], gap <= 8.0)
    assert 0.0 < bound.contact_rate[0] < 1.0


@pytest.mark.slow  # a process starts for long
def test_the_same_seed_gives_the_same_mission_even_in_a_fresh_process(wooded):
    simulator = MujocoSimulator(wooded)
    first, again, other = (simulator.run(PATH[:2], seed=s) for s in (7, 7, 8))
    np.testing.assert_array_equal(first.bounds[0].poses, again.bounds[0].poses)
    np.testing.assert_array_equal(first.contact_rate, again.contact_rate)
    assert (first.bounds[0].poses[20] != other.bounds[0].poses[20]).any()
    program = (
        "from trustbo.terrain import synthetic_terrain\n"
        "from trustbo.workspace import Workspace\n"
        "from trustbo.simulation.mujoco import MujocoSimulator\n"
        "w = Workspace.from_terrain(synthetic_terrain((90.0, 90.0), seed=5, relief=6.0), (3, 3))\n"
        f"bound = MujocoSimulator(w).run({PATH[:2]}, seed=7).bounds[0]\n"
        "print(bound.poses.tobytes().hex(), bound.contact.tobytes().hex())"
    )
    printed = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    bound = first.bounds[0]
    assert printed.stdout.split() == [
        bound.poses.tobytes().hex(),
        bound.contact.tobytes().hex(),
    ]


def test_running_bound_by_bound_is_running_the_mission(wooded, mission):
    simulator = MujocoSimulator(wooded, sight="bare")
    simulator.reset(PATH[0], 3, next_cell=PATH[1])
    first = simulator.run_bound(1, PATH[1], next_cell=PATH[2])
    second = simulator.run_bound(2, PATH[2])
    simulator.close()
    np.testing.assert_array_equal(mission.bounds[0].poses, first.poses)
    np.testing.assert_array_equal(mission.bounds[1].poses, second.poses)
    with pytest.raises(TrustboError, match=r"call reset"):
        simulator.run_bound(3, PATH[2])


def test_gaps_edges_and_other_pixels_are_no_obstacle():
    rng = np.random.default_rng(0)
    dem = rng.normal(0.0, 0.05, (60, 60))
    dem[rng.uniform(size=dem.shape) < 0.01] = np.nan
    coarse = rng.normal(0.0, 0.2, (12, 12))
    for workspace in (workspace_of(dem), workspace_of(coarse, resolution=5.0)):
        mission = MujocoSimulator(workspace).run(PATH[:2], seed=0)
        assert mission.status == "ok"
        assert np.isfinite(mission.bounds[-1].poses).all()


@pytest.mark.slow  # each tick is many steps of its solver
def test_a_campaign_on_steep_ground_learns_from_physical_failures(real_terrain):
    terrain = tb.terrain.read_terrain(*real_terrain("wellington"))
    workspace = Workspace.from_terrain(terrain, (6, 8), posts="end", stops="centre")
    simulator = MujocoSimulator(workspace, sight="transmittance")
    result = tb.iterate(
        workspace,
        (3, 4),
        (2, 3),
        n_iterations=3,
        sampler="exact",
        simulator=simulator,
        progress=False,
    )
    statuses = [mission.status for mission in result.missions]
    assert len(statuses) == 3
    # 37 degrees steep on average: by stops and posts chosen without a look at slopes, robots fail.
    assert set(statuses) & {"stuck", "tipped", "collision"}
    for mission in result.missions:
        assert ((mission.contact_rate >= 0.0) & (mission.contact_rate <= 1.0)).all()
        assert np.isfinite(mission.awareness).all()
        assert mission.bounds[-1].status == mission.status
        assert all(np.isfinite(bound.poses).all() for bound in mission.bounds)
        if mission.status != "ok":
            assert len(mission.bounds) <= len(mission.path) - 1
    assert list(result.history["status"].values) == statuses
    assert len(result.posteriors) == 3


# ---------------------------------------------------------------- input


def test_settings_are_recorded_and_bad_ones_refused(flat):
    simulator = MujocoSimulator(flat, sight="bare", friction=0.7, stuck_after=5.0)
    described = simulator.describe()
    assert described["simulator"] == "MujocoSimulator"
    assert described["friction"] == 0.7
    assert described["sight"] == "bare"
    assert described["mujoco"] == mujoco.__version__
    with pytest.raises(TrustboError, match=r"friction must be positive and finite; got -1"):
        MujocoSimulator(flat, friction=-1.0)
    with pytest.raises(TrustboError, match=r"stuck_after must be positive and finite; got 0"):
        MujocoSimulator(flat, stuck_after=0.0)
    with pytest.raises(TrustboError, match=r"step must be positive and finite; got nan"):
        MujocoSimulator(flat, step=np.nan)
    with pytest.raises(TrustboError, match=r"unknown sight mode 'fog'"):
        MujocoSimulator(flat, sight="fog")


def test_without_mujoco_the_remedy_is_named(flat, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(TrustboError, match=r"pip install mujoco$"):
        MujocoSimulator(flat)
