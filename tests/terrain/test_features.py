"""Pixel features against closed forms, and under turning and mirroring."""

import numpy as np
import pytest
import xarray as xr

from trustbo.terrain import (
    assemble_terrain,
    canopy_cover,
    canopy_height,
    openness,
    pixel_features,
    roughness,
    slope,
    step_height,
    tri,
)
from trustbo.terrain.features import TRAVERSABILITY, VISIBILITY


def make_terrain(dem, height=0.0, resolution=1.0):
    rows, cols = dem.shape
    coords = {
        "y": 1000.0 - (np.arange(rows) + 0.5) * resolution,
        "x": 2000.0 + (np.arange(cols) + 0.5) * resolution,
    }
    dem = xr.DataArray(dem.astype(float), coords, ("y", "x")).rio.write_crs("EPSG:32633")
    return assemble_terrain(dem, dem + height)


def tilted(a=0.3, b=-0.2, resolution=1.0, n=12):
    row, col = np.mgrid[:n, :n]
    return a * col * resolution + b * row * resolution


@pytest.mark.parametrize("resolution", [0.5, 1.0, 3.0])
def test_a_plane_has_its_own_slope_everywhere_inside(resolution):
    terrain = make_terrain(tilted(resolution=resolution), resolution=resolution)
    inside = slope(terrain).values[1:-1, 1:-1]
    # xarray-spatial computes in float32.
    np.testing.assert_allclose(inside, np.arctan(np.hypot(0.3, 0.2)), rtol=1e-5)


def test_a_plane_s_roughness_tri_and_step_have_closed_forms():
    terrain = make_terrain(tilted())
    inside = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(roughness(terrain).values[inside], 2 * 0.5, rtol=1e-5)
    np.testing.assert_allclose(step_height(terrain).values[inside], 0.5, rtol=1e-9)
    squares = 6 * 0.3**2 + 6 * 0.2**2  # each of the 8 steps is +-0.3 i +- 0.2 j
    np.testing.assert_allclose(tri(terrain).values[inside], np.sqrt(squares), rtol=1e-5)


def test_canopy_height_and_cover():
    height = np.zeros((40, 40))
    height[:, 20:] = 8.0
    terrain = make_terrain(np.zeros((40, 40)), height)
    np.testing.assert_allclose(canopy_height(terrain), height)
    cover = canopy_cover(terrain, radius=5.0).values
    np.testing.assert_allclose(cover[:, :14], 0.0, atol=1e-12)
    np.testing.assert_allclose(cover[:, 26:], 1.0)
    np.testing.assert_allclose(cover[20, 20], 6 / 11)  # 6 of 11 columns are wooded


def test_openness_of_flat_ground_and_of_uniform_shrubs():
    flat = make_terrain(np.zeros((60, 60)))
    np.testing.assert_allclose(openness(flat, reach=20.0), 1.0)
    shrubs = make_terrain(np.zeros((60, 60)), 2.0)
    # Rays at 1 m, inside the layer from 0.6 m to 2 m all the way.
    through = openness(shrubs, reach=20.0, eye=1.0, target=1.0).values
    np.testing.assert_allclose(through, np.exp(-0.1 * 20.0), rtol=1e-9)


def test_features_keep_missing_pixels_missing():
    dem = tilted()
    dem[5, 6] = np.nan
    terrain = make_terrain(dem, 1.0)
    for features in (TRAVERSABILITY, VISIBILITY):
        for name, values in pixel_features(terrain, features).items():
            assert np.isnan(values.values[5, 6]), name


@pytest.mark.parametrize("turn", [np.rot90, np.fliplr, np.flipud])
def test_turning_the_terrain_turns_every_feature(turn):
    rng = np.random.default_rng(0)
    dem, height = rng.normal(size=(16, 16)), rng.uniform(0.0, 6.0, (16, 16))
    before, after = make_terrain(dem, height), make_terrain(turn(dem), turn(height))
    for features in (TRAVERSABILITY, VISIBILITY):
        a, b = pixel_features(before, features), pixel_features(after, features)
        for name in features:
            np.testing.assert_allclose(
                b[name], turn(a[name].values), rtol=1e-5, atol=1e-6, err_msg=name
            )


def test_a_constant_height_changes_nothing():
    rng = np.random.default_rng(1)
    dem, height = rng.normal(size=(16, 16)), rng.uniform(0.0, 6.0, (16, 16))
    before, after = make_terrain(dem, height), make_terrain(dem + 64.0, height)
    for features in (TRAVERSABILITY, VISIBILITY):
        a, b = pixel_features(before, features), pixel_features(after, features)
        for name in features:
            # float32 inside xarray-spatial: 64 m costs 6 of its 24 bits.
            np.testing.assert_allclose(b[name], a[name], rtol=1e-4, atol=1e-4, err_msg=name)
