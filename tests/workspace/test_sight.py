"""Sight between robots: range, field of view and obstruction."""

import math

import numpy as np
import pytest

from trustbo.team import Robot
from trustbo.workspace.sight import Sight, detection_probability, optics
from trustbo.workspace.surface import Surface

BARE, WALL = Sight(0.0), Sight(math.inf, 0.0)


def surface_of(ground, height=0.0):
    shape = (2, *ground.shape)
    passable = np.ones(ground.shape, bool)
    return Surface(ground, ground + height, np.zeros(shape), passable, (1.0, 1.0), (0.0, 0.0))


def random_pairs(seed, n=200, size=40):
    rng = np.random.default_rng(seed)
    ground = np.cumsum(rng.normal(0.0, 0.3, (size, size)), axis=1)
    height = rng.uniform(0.0, 5.0, (size, size))
    a, b = rng.uniform(1.0, size - 2.0, (2, n, 2))
    return ground, height, a * [1, -1], b * [1, -1]  # x, y of pixels from the origin


def test_sight_between_equal_heights_is_symmetric():
    ground, height, a, b = random_pairs(0)
    robot = Robot(vertical_fov=1.5)
    surface = surface_of(ground, height)
    for sight in (BARE, WALL, Sight()):
        pair = optics(robot, robot)
        there, back = (
            detection_probability(surface, sight, *ends, pair) for ends in ((a, b), (b, a))
        )
        np.testing.assert_allclose(there, back, rtol=1e-9, atol=1e-12)


def test_raising_an_obstacle_never_opens_sight():
    ground, height, a, b = random_pairs(1)
    pair = np.array([30.0, 30.0, np.inf, 1.0])
    for sight in (BARE, WALL):
        before = detection_probability(surface_of(ground, height), sight, a, b, pair)
        wall = ground.copy()
        wall[:, 20] += 40.0
        after = detection_probability(surface_of(wall, height), sight, a, b, pair)
        # Robots that stand on the wall are lifted with it.
        off = (np.abs(a[:, 0] - 20) > 1) & (np.abs(b[:, 0] - 20) > 1)
        assert (after[off] <= before[off]).all()
        assert (after[off] < before[off]).any()


def test_sight_turns_with_the_terrain():
    ground, height, a, b = random_pairs(2)
    pair = optics(Robot(vertical_fov=1.5), Robot())
    before = detection_probability(surface_of(ground, height), Sight(), a, b, pair)
    turned = [np.ascontiguousarray(np.rot90(v)) for v in (ground, height)]
    # A quarter turn anticlockwise: (row, col) -> (n - 1 - col, row).
    a, b = (np.stack([-p[:, 1], -(39.0 - p[:, 0])], axis=1) for p in (a, b))
    after = detection_probability(surface_of(*turned), Sight(), a, b, pair)
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12)


def test_range_and_field_of_view_limit_sight():
    flat = surface_of(np.zeros((40, 40)))
    here, there = np.array([[5.0, -5.0]]), np.array([[25.0, -5.0]])
    for reach, seen in ((20.1, 1.0), (19.9, 0.0)):
        assert (
            detection_probability(
                flat, BARE, here, there, optics(Robot(lidar_range=reach), Robot())
            )
            == seen
        )
    # 20 m away and 2 m up is an elevation of 5.7 degrees.
    for view, seen in ((np.deg2rad(6.0), 1.0), (np.deg2rad(5.5), 0.0)):
        tall = Robot(target_height=3.0)
        assert (
            detection_probability(flat, BARE, here, there, optics(Robot(vertical_fov=view), tall))
            == seen
        )
    # On ground that falls as steeply as the target rises, the body's plane tilts away from it.
    tilted = flat._replace(gradient=np.stack([np.full((40, 40), -0.1), np.zeros((40, 40))]))
    pair = optics(Robot(vertical_fov=np.deg2rad(6.0)), Robot(target_height=3.0))
    assert detection_probability(tilted, BARE, here, there, pair) == pytest.approx(0.0)


@pytest.mark.parametrize("extinction", [1, np.float32(1.0), np.int64(1), np.inf])
def test_numbers_of_a_sight_are_floats(extinction):
    sight = Sight(extinction, np.int64(0))
    assert type(sight.extinction) is type(sight.crown_base) is float
    assert sight == Sight(float(extinction), 0.0)


def test_one_position_is_in_the_pixel_that_many_are_in():
    surface = surface_of(np.zeros((40, 30)))._replace(pixel=(0.5, 2.0), origin=(3.0, 7.0))
    x, y = np.random.default_rng(0).uniform(-30.0, 80.0, (2, 500)).round(1)  # halves too
    rows, cols = surface.nearest(x, y)
    one_by_one = [surface.nearest(*p) for p in zip(x.tolist(), y.tolist(), strict=True)]
    assert one_by_one == list(zip(rows.tolist(), cols.tolist(), strict=True))
