"""Rows and columns of positions, in NumPy and in kernels: centres, edges and off the raster."""

import numpy as np
from numba import njit

from trustbo.terrain.pixels import index_within, nearest_pixel, row_and_col

ORIGIN = 3.0, 7.0
PIXEL = 0.5, 2.0
SHAPE = 40, 30


def test_the_centre_of_a_pixel_has_its_row_and_column():
    row, col = np.indices(SHAPE)
    x = ORIGIN[0] + col * PIXEL[1]
    y = ORIGIN[1] - row * PIXEL[0]  # row 0 is in the north
    np.testing.assert_array_equal(row_and_col(x, y, ORIGIN, PIXEL), (row, col))
    np.testing.assert_array_equal(nearest_pixel(x, y, ORIGIN, PIXEL, SHAPE), (row, col))


def test_an_edge_belongs_to_the_southern_or_eastern_pixel():
    x = ORIGIN[0] + 4.5 * PIXEL[1]
    y = ORIGIN[1] - 6.5 * PIXEL[0]
    assert nearest_pixel(x, y, ORIGIN, PIXEL, SHAPE) == (7, 5)


def test_positions_off_the_raster_are_in_a_pixel_at_its_edge():
    far = np.array([-np.inf, -1e30, -0.6, 0.0, 4.4, 1e30, np.inf, np.nan])
    np.testing.assert_array_equal(index_within(far, 5), [0, 0, 0, 0, 4, 4, 4, 0])


def test_kernels_find_the_pixels_that_numpy_finds():
    @njit
    def compiled(x, y):
        found = np.empty((len(x), 2), np.int64)
        for k in range(len(x)):
            found[k] = nearest_pixel(x[k], y[k], ORIGIN, PIXEL, SHAPE)
        return found

    x, y = np.random.default_rng(0).uniform(-30.0, 80.0, (2, 500)).round(1)  # edges too
    x[0] = np.nan
    expected = np.stack(nearest_pixel(x, y, ORIGIN, PIXEL, SHAPE), axis=1)
    np.testing.assert_array_equal(compiled(x, y), expected)
