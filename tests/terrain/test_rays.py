"""Rays against closed forms, adaptive quadrature and GDAL's viewsheds."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import rasterio

from trustbo.terrain import rays, synthetic_terrain

VIEWSHEDS = Path(__file__).parent.parent / "data" / "gdal" / "viewsheds.tif"
BARE, WALL = (0.0, 0.3), (math.inf, 0.0)
"""Extinction and crown base with which only the ground blocks, and the whole surface does."""


def cast(ground, surface, start, end, canopy=(0.1, 0.3), pixel=(1.0, 1.0)):
    return rays.transmittances(ground, surface, pixel, np.array([[*start, *end]]), *canopy)[0]


def bilinear(values, r, c):
    i, j = (
        np.minimum(np.asarray(at).astype(int), n - 2)
        for at, n in zip((r, c), values.shape, strict=True)
    )
    p, q = r - i, c - j
    top, bottom = ((1 - q) * values[k, j] + q * values[k, j + 1] for k in (i, i + 1))
    return (1 - p) * top + p * bottom


def integrated(ground, surface, a, b):
    """Least height above the ground, and metres inside the canopy, by adaptive quadrature.

    33 samples between two crossings of the lines through pixel centres, where heights have kinks;
    an end of the canopy between two samples is bisected.
    """
    step = np.subtract(b, a)
    kinks = [np.array([0.0, 1.0])]
    for x0, dx in zip(a[:2], step[:2], strict=True):
        low, high = sorted((x0, x0 + dx))
        kinks.append((np.arange(math.ceil(low), math.floor(high) + 1) - x0) / dx)
    kinks = np.unique(np.clip(np.concatenate(kinks), 0.0, 1.0))
    t = np.unique([np.linspace(*pair, 33) for pair in pairwise(kinks)])

    def heights(t):
        r, c, z = (x + t * dx for x, dx in zip(a, step, strict=True))
        return z, bilinear(ground, r, c), bilinear(surface, r, c)

    def is_in(t):
        z, g, s = heights(t)
        return (g + 0.3 * (s - g) < z) & (z < s)

    z, g, _ = heights(t)
    known = is_in(t)
    inside = np.diff(t)[known[1:] & known[:-1]].sum()
    changes = np.flatnonzero(known[1:] != known[:-1])
    low, high = t[changes], t[changes + 1]
    for _ in range(20):
        middle = 0.5 * (low + high)
        same = is_in(middle) == known[changes]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    inside += np.where(known[changes], low - t[changes], t[changes + 1] - low).sum()
    return (z - g).min(), inside * np.linalg.norm(step)


def rough(seed, shape=(24, 24)):
    rng = np.random.default_rng(seed)
    ground = np.cumsum(rng.normal(0.0, 0.3, shape), axis=1)
    return ground, ground + rng.uniform(0.0, 6.0, shape)


def test_a_thousand_rays_are_those_of_adaptive_quadrature():
    """The equation of the module on bilinear heights, for rays that do not graze the ground."""
    terrain = synthetic_terrain((120.0, 120.0), seed=3, relief=8.0)
    ground, surface = terrain["dem"].values, terrain["dsm"].values
    rng, off, n_clear = np.random.default_rng(0), [], 0
    while len(off) < 1000:
        a, b = ((*p, bilinear(ground, *p) + 1.0) for p in rng.uniform(1.0, 118.0, (2, 2)))
        if math.dist(a, b) > 60.0:
            continue
        least, metres = integrated(ground, surface, a, b)
        if abs(least) > 0.001:
            n_clear += least > 0.0
            expected = math.exp(-0.1 * metres) if least > 0.0 else 0.0
            off.append(abs(cast(ground, surface, a, b) - expected))
    assert n_clear > 300
    assert max(off) <= 0.01


def test_open_flat_ground_lets_everything_through():
    flat = np.zeros((10, 10))
    for canopy in (BARE, WALL, (0.1, 0.3)):
        assert cast(flat, flat, (1.2, 1.7, 1.0), (8.1, 6.3, 0.5), canopy) == 1.0
    assert cast(flat, flat, (5.0, 5.0, 1.0), (5.0, 5.0, 0.5)) == 1.0  # of no length


@pytest.mark.parametrize("end", [(5.0, 25.0), (25.0, 5.0), (25.3, 17.7), (5.0, 5.4), (20.0, 20.0)])
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
    np.testing.assert_allclose(through, math.exp(-0.1 * math.hypot(24, 12) * 7 / 12), rtol=1e-12)
    wide = cast(ground, surface, (5.0, 5.0, 5.0), (15.0, 5.0, 5.0), pixel=(2.0, 0.5))
    np.testing.assert_allclose(wide, math.exp(-0.1 * 20.0), rtol=1e-12)


def test_a_ridge_blocks_and_canopy_blocks_only_as_a_wall():
    flat, ridge = np.zeros((11, 11)), np.zeros((11, 11))
    ridge[:, 5] = 3.0
    ends = (5.0, 1.0, 1.0), (5.0, 9.0, 1.0)
    for canopy in (BARE, WALL, (0.1, 0.3)):
        assert cast(ridge, ridge, *ends, canopy) == 0.0
    assert cast(flat, ridge, *ends, BARE) == 1.0
    assert cast(flat, ridge, *ends, WALL) == 0.0
    assert 0.0 < cast(flat, ridge, *ends) < 1.0


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
        bump = ground + (rng.uniform(size=ground.shape) < 0.05) * 2.0
        higher = np.maximum(surface, bump)
        assert cast(bump, higher, a, b, BARE) <= cast(ground, surface, a, b, BARE)
        assert cast(ground, surface, a, b, (0.2, 0.3)) <= there


def test_missing_ground_and_the_raster_s_edge_block():
    ground = np.zeros((10, 10))
    assert cast(ground, ground, (5.0, 1.0, 1.0), (5.0, 9.5, 1.0)) == 0.0
    for axis in (0, 1):
        unknown = [5.0, 5.0, 1.0]
        unknown[axis] = np.nan
        assert cast(ground, ground, unknown, (5.0, 8.0, 1.0)) == 0.0
        assert cast(ground, ground, (5.0, 8.0, 1.0), unknown) == 0.0
    ground[5, 5] = np.nan
    assert cast(ground, ground, (5.0, 1.0, 1.0), (5.0, 8.0, 1.0)) == 0.0
    assert cast(ground, ground, (2.0, 1.0, 1.0), (2.0, 8.0, 1.0)) == 1.0


def test_gdal_sees_the_same(real_terrain):
    """Viewsheds of 20 observers, see tests/data/gdal/README.md; GDAL's planes are approximate."""
    with rasterio.open(real_terrain("wellington")[0]) as source:
        dem = source.read(1).astype(float)
    rows, cols = (index.ravel().astype(float) for index in np.indices(dem.shape))
    agree = []
    with rasterio.open(VIEWSHEDS) as source:
        for band, name in enumerate(source.descriptions, start=1):
            _, row, _, col = name.split()
            eye = float(row), float(col), dem[int(row), int(col)] + 1.0
            ends = np.column_stack([*np.broadcast_arrays(*eye, rows), cols, dem.ravel() + 1.0])
            ours = rays.transmittances(dem, dem, (1.0, 1.0), ends, *BARE) > 0.5
            agree.append(np.mean(ours == (source.read(band) > 0).ravel()))
    assert len(agree) == 20
    assert min(agree) >= 0.97
