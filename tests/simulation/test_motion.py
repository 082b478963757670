"""Drives along routes, against their kinematics."""

import itertools

import numpy as np
import pytest
from scipy import ndimage
from worlds import Steady

from trustbo.simulation.motion import drive
from trustbo.team import Robot
from trustbo.workspace.pursuit import Driving, tilts_along
from trustbo.workspace.routes import Routes
from trustbo.workspace.surface import Surface


def flat_surface(n=60, dz_dx=0.0, dz_dy=0.0):
    gradient = np.stack([np.full((n, n), dz_dx), np.full((n, n), dz_dy)])
    row, col = np.mgrid[:n, :n]
    ground = dz_dx * col - dz_dy * row
    ground = ground.astype(float)
    return Surface(ground, ground, gradient, np.ones((n, n), bool), (1.0, 1.0), (0.0, 0.0))


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


def test_a_longer_look_ahead_cuts_corners_more():
    surface = flat_surface()
    route = np.array([[10.0, -30.0], [30.0, -30.0], [30.0, -50.0]])
    passed = []
    for lookahead in (0.5, 1.5, 4.0):
        fine = np.concatenate([np.linspace(p, q, 81) for p, q in itertools.pairwise(route)])
        robot = Robot(lookahead=lookahead)
        poses, status = drive(surface, robot, fine, 0.0, 0.1, 2000, np.random.default_rng(0))
        assert status == "ok"
        passed.append(np.hypot(*(poses[:, :2] - route[1]).T).min())
    assert passed[0] < passed[1] < passed[2]
    assert passed[0] < 0.5
    assert 1.0 < passed[2] < 4.0


def test_the_largest_tilt_is_that_of_a_drive_without_slip():
    """On ground that undulates, at every tenth of a second, by the slopes under the robot."""
    rng = np.random.default_rng(1)
    surface = flat_surface()
    surface.gradient[:] = ndimage.gaussian_filter(rng.normal(size=(2, 60, 60)), (0, 4, 4))
    route = np.array([[10.0, -20.0], [30.0, -30.0], [45.0, -12.0]])
    poses, _ = drive(surface, Robot(), route, np.arctan2(-10.0, 20.0), 0.1, 2000, Steady())
    slopes = surface.gradient[:, *surface.nearest(*poses[:, :2].T)]
    heading = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    left = np.stack([-heading[1], heading[0]])
    tilts = [np.abs((slopes * axis).sum(0)).max() for axis in (heading, left)]
    place = surface.gradient, surface.pixel, surface.origin
    driving = Driving.of(Robot())
    (largest,) = tilts_along(*place, route, np.array([0, 3]), driving)
    assert largest == pytest.approx(max(tilts), rel=0.03)


def test_routes_that_begin_alike_have_the_tilts_of_each_route_alone():
    """Steps down and to the right at random; two routes turn off, and others end early."""
    rng = np.random.default_rng(2)
    surface = flat_surface()
    surface.gradient[:] = ndimage.gaussian_filter(rng.normal(size=(2, 60, 60)), (0, 2, 2))
    trunk = np.array([5.0, -5.0]) + np.cumsum(
        rng.permutation([[1.0, 0.0], [0.0, -1.0]] * 20), axis=0
    )
    routes = [trunk[:n] for n in (40, 1, 0, 2, 25, 40)]
    routes += [
        np.concatenate([trunk[:n], trunk[n - 1] + [[1.0, -1.0], [2.0, -2.0]]]) for n in (9, 30)
    ]

    place = surface.gradient, surface.pixel, surface.origin
    driving = Driving.of(Robot(turn_rate=0.5))
    first = np.cumsum([0, *map(len, routes)])
    together = tilts_along(*place, np.concatenate(routes), first, driving)
    alone = [
        tilts_along(*place, route.copy(), np.array([0, len(route)]), driving) for route in routes
    ]
    np.testing.assert_array_equal(together, np.concatenate(alone))
    assert np.isnan(together[2])
    assert len(np.unique(together)) > 3


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
