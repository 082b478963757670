"""Routes against networkx, drives against their kinematics."""

import networkx as nx
import numpy as np
import pytest

from trustbo.data import Robot
from trustbo.simulation.motion import Routes, _a_star, drive
from trustbo.simulation.positions import _largest_region
from trustbo.simulation.sight import Surface


def flat_surface(n=60, dz_dx=0.0, dz_dy=0.0, passable=None):
    gradient = np.stack([np.full((n, n), dz_dx), np.full((n, n), dz_dy)])
    row, col = np.mgrid[:n, :n]
    ground = dz_dx * col - dz_dy * row
    passable = np.ones((n, n), bool) if passable is None else passable
    return Surface(
        ground.astype(float), ground.astype(float), gradient, passable, (1.0, 1.0), (0.0, 0.0)
    )


def cheapest(pace, start, goal):
    """Cost of the cheapest way by networkx, with the same rule against cutting corners."""
    graph = nx.Graph()
    rows, cols = pace.shape
    for r in range(rows):
        for c in range(cols):
            for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
                i, j = r + dr, c + dc
                if not (0 <= i < rows and 0 <= j < cols):
                    continue
                if np.isfinite([pace[r, c], pace[i, j], pace[i, c], pace[r, j]]).all():
                    length = np.hypot(dr, dc)
                    graph.add_edge((r, c), (i, j), weight=0.5 * (pace[r, c] + pace[i, j]) * length)
    return nx.dijkstra_path_length(graph, start, goal)


@pytest.mark.parametrize("seed", range(10))
def test_routes_cost_what_networkx_says_is_the_least(seed):
    rng = np.random.default_rng(seed)
    pace = rng.uniform(1.0, 8.0, (15, 20))
    pace[rng.uniform(size=pace.shape) < 0.25] = np.inf
    pace[0, 0] = pace[14, 19] = 1.0
    cells = _a_star(pace, (1.0, 1.0), (0, 0), (14, 19))
    try:
        expected = cheapest(pace, (0, 0), (14, 19))
    except (nx.NetworkXNoPath, nx.NodeNotFound):
        assert not len(cells)
        return
    steps = np.hypot(*np.diff(cells, axis=0).T)
    paces = pace[cells[:, 0], cells[:, 1]]
    np.testing.assert_allclose((0.5 * (paces[1:] + paces[:-1]) * steps).sum(), expected)


def test_no_way_gives_no_route():
    passable = np.ones((60, 60), bool)
    passable[:, 30] = False
    surface = flat_surface(passable=passable)
    route = Routes(surface).find(
        Robot(), np.array([5.0, -5.0]), np.array([50.0, -5.0]), (0, 60, 0, 60)
    )
    assert route is None


def test_on_flat_ground_a_robot_arrives_at_its_speed():
    surface = flat_surface()
    route = Routes(surface).find(
        Robot(), np.array([5.0, -30.0]), np.array([45.0, -30.0]), (0, 60, 0, 60)
    )
    poses, status = drive(surface, Robot(), route, 0.0, 0.5, 1000, np.random.default_rng(0))
    assert status == "ok"
    assert np.hypot(*(poses[-1, :2] - [45.0, -30.0])) < 0.5
    # 40 m at 2 m/s with 5 % slip per tick: 20 s.
    assert len(poses) * 0.5 == pytest.approx(20.0, rel=0.05)


def test_a_robot_turns_on_the_spot_at_its_turn_rate_first():
    surface = flat_surface()
    route = np.array([[30.0, -30.0], [50.0, -30.0]])
    poses, _ = drive(surface, Robot(), route, np.pi, 0.5, 1000, np.random.default_rng(0))
    assert np.allclose(poses[0, :2], [30.0, -30.0])  # facing away: no step yet
    turned = np.abs(np.diff(np.unwrap(poses[:, 2])))
    assert turned.max() <= 1.0 * 0.5 + 1e-9


@pytest.mark.parametrize(
    ("dz_dx", "dz_dy", "status"), [(1.2, 0.0, "stuck"), (0.0, 1.2, "tipped"), (0.8, 0.0, "ok")]
)
def test_a_pitch_beyond_the_limit_sticks_and_a_roll_tips(dz_dx, dz_dy, status):
    surface = flat_surface(dz_dx=dz_dx, dz_dy=dz_dy)
    route = np.array([[10.0, -30.0], [40.0, -30.0]])
    _, found = drive(surface, Robot(), route, 0.0, 0.5, 1000, np.random.default_rng(0))
    assert found == status


def test_routes_and_regions_agree_that_corners_do_not_connect():
    passable = np.zeros((60, 60), bool)
    passable[:30, :30] = passable[30:, 30:] = True
    assert not len(_a_star(np.where(passable, 1.0, np.inf), (1.0, 1.0), (5, 5), (50, 50)))
    region = _largest_region(passable)
    assert region.sum() == 900


def test_steeper_is_slower():
    times = []
    for rise in (0.0, 0.3, 0.6):
        surface = flat_surface(dz_dx=rise)
        route = np.array([[10.0, -30.0], [40.0, -30.0]])
        poses, _ = drive(surface, Robot(), route, 0.0, 0.5, 1000, np.random.default_rng(0))
        times.append(len(poses))
    assert times[0] < times[1] < times[2]


@pytest.mark.parametrize("speed", [0.3, 8.0, 20.0])
def test_slow_and_fast_robots_stop_at_their_goal(speed):
    robot = Robot(speed=speed)
    route = np.array([[10.0, -30.0], [50.0, -30.0]])
    poses, status = drive(flat_surface(), robot, route, 0.5, 0.5, 1000, np.random.default_rng(0))
    assert status == "ok"
    assert np.hypot(*(poses[-1, :2] - route[-1])) < 0.5
    assert len(poses) * 0.5 < 1.5 * 40.0 / speed + 3.0


def test_a_drive_that_takes_too_long_times_out():
    route = np.array([[10.0, -30.0], [40.0, -30.0]])
    rng = np.random.default_rng(0)
    poses, status = drive(flat_surface(), Robot(), route, 0.0, 0.5, 4, rng)
    assert (status, len(poses)) == ("timeout", 4)
