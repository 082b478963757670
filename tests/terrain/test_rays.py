"""Rays against closed forms, and against a reference that samples them finely."""

import math

import numpy as np
import pytest

from trustbo.terrain import rays


def cast(ground, surface, start, end, mode=rays.TRANSMITTANCE, k=0.1, base=0.3, pixel=(1.0, 1.0)):
    return rays.ray_transmittance(
        ground, surface, pixel, start, end, mode, k, base, rays.work_space()
    )


def bilinear(values, r, c):
    i, j = (
        np.minimum(np.asarray(at).astype(int), n - 2)
        for at, n in zip((r, c), values.shape, strict=True)
    )
    fr, fc = r - i, c - j
    top = values[i, j] * (1 - fc) + values[i, j + 1] * fc
    bottom = values[i + 1, j] * (1 - fc) + values[i + 1, j + 1] * fc
    return top * (1 - fr) + bottom * fr


def finely_sampled(ground, surface, start, end, k, base, n=20_000):
    """Transmittance by walking the ray in small steps over bilinear surfaces."""
    start, end = np.array(start), np.array(end)
    length, t = np.linalg.norm(end - start), (np.arange(n) + 0.5) / n
    r, c, z = (start + t[:, None] * (end - start)).T
    g, s = bilinear(ground, r, c), bilinear(surface, r, c)
    if (z < g).any():
        return 0.0
    inside = (g + base * (s - g) < z) & (z < s)
    return math.exp(-k * inside.mean() * length)


def rough(seed, shape=(24, 24)):
    rng = np.random.default_rng(seed)
    ground = np.cumsum(rng.normal(0.0, 0.3, shape), axis=1)
    return ground, ground + rng.uniform(0.0, 6.0, shape)


def test_open_flat_ground_lets_everything_through():
    flat = np.zeros((10, 10))
    for mode in (rays.BARE, rays.WALL, rays.TRANSMITTANCE):
        assert cast(flat, flat, (1.2, 1.7, 1.0), (8.1, 6.3, 0.5), mode) == 1.0


@pytest.mark.parametrize("end", [(5.0, 25.0), (25.0, 5.0), (25.3, 17.7), (5.0, 5.4)])
def test_a_uniform_canopy_attenuates_by_the_metres_inside(end):
    ground, surface = np.zeros((30, 30)), np.full((30, 30), 10.0)
    distance = math.hypot(end[0] - 5.0, end[1] - 5.0)
    through = cast(ground, surface, (5.0, 5.0, 5.0), (*end, 5.0))
    np.testing.assert_allclose(through, math.exp(-0.1 * distance), rtol=1e-12)
    assert cast(ground, surface, (5.0, 5.0, 2.9), (*end, 2.9)) == 1.0  # below the crowns


def test_only_the_part_of_a_rising_ray_inside_the_layer_counts():
    ground, surface = np.zeros((30, 30)), np.full((30, 30), 10.0)
    # From z = 1 to z = 13 over 24 m: inside the layer from 3 to 10, which is 7/12 of the way.
    through = cast(ground, surface, (3.0, 3.0, 1.0), (3.0, 27.0, 13.0))
    length = math.hypot(24.0, 12.0)
    np.testing.assert_allclose(through, math.exp(-0.1 * length * 7 / 12), rtol=1e-12)


def test_pixels_need_not_be_square():
    ground, surface = np.zeros((30, 30)), np.full((30, 30), 10.0)
    through = cast(ground, surface, (5.0, 5.0, 5.0), (15.0, 5.0, 5.0), pixel=(2.0, 0.5))
    np.testing.assert_allclose(through, math.exp(-0.1 * 20.0), rtol=1e-12)


def test_a_ridge_blocks_and_canopy_blocks_only_as_a_wall():
    ground = np.zeros((11, 11))
    ground[:, 5] = 3.0
    canopy = np.zeros((11, 11))
    canopy[:, 5] = 3.0
    start, end = (5.0, 1.0, 1.0), (5.0, 9.0, 1.0)
    for mode in (rays.BARE, rays.WALL, rays.TRANSMITTANCE):
        assert cast(ground, ground, start, end, mode) == 0.0
    flat = np.zeros((11, 11))
    assert cast(flat, canopy, start, end, rays.BARE) == 1.0
    assert cast(flat, canopy, start, end, rays.WALL) == 0.0
    assert 0.0 < cast(flat, canopy, start, end, rays.TRANSMITTANCE) < 1.0


def test_rays_agree_with_fine_sampling():
    off = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        ground, surface = rough(seed)
        ends = rng.uniform(1.0, 22.0, (2, 2))
        points = [(*end, bilinear(ground, *end) + 1.5) for end in ends]
        ours = cast(ground, surface, *points)
        reference = finely_sampled(ground, surface, *points, 0.1, 0.3)
        off.append(abs(ours - reference))
    # Between two lines we take everything as linear. Grazing rays may go either way, and the length
    # inside a canopy of independent random pixels, the worst there is, is off by a little.
    assert np.mean(np.array(off) > 0.1) < 0.05
    assert np.median(off) < 0.01


def test_rays_are_symmetric_and_turn_with_the_terrain():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        ground, surface = rough(seed)
        a, b = ((*p, bilinear(ground, *p) + 2.0) for p in rng.uniform(1.0, 22.0, (2, 2)))
        there = cast(ground, surface, a, b)
        np.testing.assert_allclose(cast(ground, surface, b, a), there, rtol=1e-9, atol=1e-12)
        turned = [(23.0 - c, r, z) for r, c, z in (a, b)]  # a quarter turn anticlockwise
        rotated = [np.ascontiguousarray(np.rot90(v)) for v in (ground, surface)]
        np.testing.assert_allclose(cast(*rotated, *turned), there, rtol=1e-9, atol=1e-12)


def test_raising_the_ground_or_the_canopy_never_clears_a_ray():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        ground, surface = rough(seed)
        a, b = ((*p, 4.0 + bilinear(ground, *p)) for p in rng.uniform(1.0, 22.0, (2, 2)))
        before = cast(ground, surface, a, b)
        bump = ground + (rng.uniform(size=ground.shape) < 0.05) * 2.0
        assert cast(bump, np.maximum(surface, bump), a, b, rays.BARE) <= cast(
            ground, surface, a, b, rays.BARE
        )
        assert cast(ground, surface, a, b, k=0.2) <= before


def test_missing_ground_and_the_raster_s_edge_block():
    ground = np.zeros((10, 10))
    assert cast(ground, ground, (5.0, 1.0, 1.0), (5.0, 9.5, 1.0)) == 0.0
    ground[5, 5] = np.nan
    assert cast(ground, ground, (5.0, 1.0, 1.0), (5.0, 8.0, 1.0)) == 0.0
    assert cast(ground, ground, (2.0, 1.0, 1.0), (2.0, 8.0, 1.0)) == 1.0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_ray_from_or_to_an_unknown_place_is_blocked(axis):
    """No pixel is read for it: NaN is no index."""
    ground = np.zeros((10, 10))
    unknown = [5.0, 5.0, 1.0]
    unknown[axis] = np.nan
    assert cast(ground, ground, tuple(unknown), (5.0, 8.0, 1.0)) == 0.0
    assert cast(ground, ground, (5.0, 8.0, 1.0), tuple(unknown)) == 0.0
    assert np.isnan(rays.ground_height(ground, *unknown[:2]))


def test_a_ray_of_no_length_is_clear():
    ground = np.zeros((10, 10))
    assert cast(ground, ground, (5.0, 5.0, 1.0), (5.0, 5.0, 0.5)) == 1.0
