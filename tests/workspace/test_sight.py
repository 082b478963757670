"""Line of sight against an exact test in plain Python, and against GDAL's viewsheds."""

from fractions import Fraction
from math import ceil, floor
from pathlib import Path

import numpy as np
import pytest
import rasterio

from trustbo.team import Robot
from trustbo.terrain import rays
from trustbo.workspace.sight import Sight, detection_probability, optics
from trustbo.workspace.surface import Surface

VIEWSHEDS = Path(__file__).parent.parent / "data" / "gdal" / "viewsheds.tif"


def surface_of(ground, height=0.0):
    shape = (2, *ground.shape)
    passable = np.ones(ground.shape, bool)
    return Surface(ground, ground + height, np.zeros(shape), passable, (1.0, 1.0), (0.0, 0.0))


def clearance(ground, a, b):
    """Least height of the segment a-b above the ground where it crosses a line; exact fractions."""
    (r0, c0, z0), (r1, c1, z1) = ([Fraction(float(v)) for v in point] for point in (a, b))
    crossings = set()
    for x0, x1 in ((r0, r1), (c0, c1)):
        if x0 != x1:
            low, high = sorted((x0, x1))
            crossings |= {(line - x0) / (x1 - x0) for line in range(ceil(low), floor(high) + 1)}
    least = Fraction(10**6)
    for t in crossings - {Fraction(0), Fraction(1)}:
        r, c, z = r0 + t * (r1 - r0), c0 + t * (c1 - c0), z0 + t * (z1 - z0)
        i, j = floor(r), floor(c)
        fr, fc = r - i, c - j
        h = Fraction(0)
        for k, m, w in (
            (i, j, (1 - fr) * (1 - fc)),
            (i, j + 1, (1 - fr) * fc),
            (i + 1, j, fr * (1 - fc)),
            (i + 1, j + 1, fr * fc),
        ):
            if w:
                h += w * Fraction(float(ground[k, m]))
        least = min(least, z - h)
    return float(least)


def test_sight_is_that_of_an_exact_test():
    agree = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        ground = np.cumsum(rng.normal(0.0, 0.4, (30, 30)), axis=rng.integers(2))
        for _ in range(25):
            ends = rng.uniform(0.0, 29.0, (2, 2)) if seed % 2 else rng.integers(0, 30, (2, 2))
            a, b = ((*p, rays.ground_height(ground, *map(float, p)) + 1.5) for p in ends)
            exact = clearance(ground, a, b)
            if abs(exact) > 1e-6:  # not a grazing ray
                points = [tuple(map(float, p)) for p in (a, b)]
                ours = rays.ray_transmittance(
                    ground, ground, (1.0, 1.0), *points, rays.BARE, 0.1, 0.3, rays.work_space()
                )
                agree.append((ours > 0.5) == (exact > 0.0))
    assert len(agree) > 900
    assert np.mean(agree) >= 0.999


def test_gdal_sees_the_same(real_terrain):
    """Viewsheds of 20 observers, see tests/data/gdal/README.md; GDAL's planes are approximate."""
    with rasterio.open(real_terrain("wellington")[0]) as source:
        dem = source.read(1).astype(float)
    agree = []
    with rasterio.open(VIEWSHEDS) as source:
        for band, name in enumerate(source.descriptions, start=1):
            _, row, _, col = name.split()
            r, c = int(row), int(col)
            eye, seen = (float(r), float(c), dem[r, c] + 1.0), source.read(band) > 0
            ours = [
                rays.ray_transmittance(
                    dem, dem, (1.0, 1.0), eye, (float(i), float(j), dem[i, j] + 1.0),
                    rays.TRANSMITTANCE, 0.1, 0.3, rays.work_space(),
                ) > 0.5
                for i, j in np.ndindex(dem.shape)
            ]  # fmt: skip
            agree.append(np.mean(ours == seen.ravel()))
    assert len(agree) == 20
    assert min(agree) >= 0.97


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
    for mode in ("bare", "wall", "transmittance"):
        pair = optics(robot, robot)
        there, back = (
            detection_probability(surface, Sight(mode), *ends, pair) for ends in ((a, b), (b, a))
        )
        np.testing.assert_allclose(there, back, rtol=1e-9, atol=1e-12)


def test_raising_an_obstacle_never_opens_sight():
    ground, height, a, b = random_pairs(1)
    pair = np.array([30.0, 30.0, np.inf, 1.0])
    for mode in ("bare", "wall"):
        before = detection_probability(surface_of(ground, height), Sight(mode), a, b, pair)
        wall = ground.copy()
        wall[:, 20] += 40.0
        after = detection_probability(surface_of(wall, height), Sight(mode), a, b, pair)
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
                flat, Sight("bare"), here, there, optics(Robot(lidar_range=reach), Robot())
            )
            == seen
        )
    # 20 m away and 2 m up is an elevation of 5.7 degrees.
    for view, seen in ((np.deg2rad(6.0), 1.0), (np.deg2rad(5.5), 0.0)):
        tall = Robot(target_height=3.0)
        assert (
            detection_probability(
                flat, Sight("bare"), here, there, optics(Robot(vertical_fov=view), tall)
            )
            == seen
        )
    # On ground that falls as steeply as the target rises, the body's plane tilts away from it.
    tilted = flat._replace(gradient=np.stack([np.full((40, 40), -0.1), np.zeros((40, 40))]))
    pair = optics(Robot(vertical_fov=np.deg2rad(6.0)), Robot(target_height=3.0))
    assert detection_probability(tilted, Sight("bare"), here, there, pair) == pytest.approx(0.0)


def test_one_position_is_in_the_pixel_that_many_are_in():
    surface = surface_of(np.zeros((40, 30)))._replace(pixel=(0.5, 2.0), origin=(3.0, 7.0))
    x, y = np.random.default_rng(0).uniform(-30.0, 80.0, (2, 500)).round(1)  # halves too
    rows, cols = surface.nearest(x, y)
    one_by_one = [surface.pixel_at(*p) for p in zip(x.tolist(), y.tolist(), strict=True)]
    assert one_by_one == list(zip(rows.tolist(), cols.tolist(), strict=True))
