"""Cells of locations, compared with pyproj and rasterio, and means over cells."""

import numpy as np
import pytest
from pyproj import Transformer
from rasterio.transform import from_origin, rowcol

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.planning import Planner
from trustbo.terrain import synthetic_terrain
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid


@pytest.fixture(scope="module")
def grid():
    return Grid((8, 5), 1_802_139.0, 5_467_490.0, 20.0, 30.0, "EPSG:2193")


def test_positions_are_in_the_cells_that_rasterio_and_pyproj_find(grid):
    rng = np.random.default_rng(3)
    left, bottom, right, top = grid.bounds
    x, y = rng.uniform((left, bottom), (right, top), (200, 2)).T
    affine = from_origin(grid.left, grid.top, grid.cell_width, grid.cell_height)
    expected = list(zip(*(np.asarray(n).tolist() for n in rowcol(affine, x, y)), strict=True))
    lon, lat = Transformer.from_crs(2193, 4326, always_xy=True).transform(x, y)
    for i, cell in enumerate(expected):
        for location in ({"x": x[i], "y": y[i]}, {"lon": lon[i], "lat": lat[i]}, cell):
            assert grid.locate(location) == cell, location


def test_centres_in_degrees_are_those_of_pyproj(grid):
    to_degrees = Transformer.from_crs(2193, 4326, always_xy=True)
    for cell in ((0, 0), (7, 4), (3, 2)):
        assert grid.lonlat(cell) == pytest.approx(to_degrees.transform(*grid.center(cell)))
        assert grid.locate(dict(zip(("x", "y"), grid.center(cell), strict=True))) == cell


@pytest.mark.parametrize(
    "location",
    [
        (1_802_150.5, 5_467_480.0), (1_802_150, 5_467_480), (-1, 0), (2, 5), 7, "9,0", (1, 2, 3),
        {"lon": 175.4}, {"x": 1.0, "lat": 2.0}, {"x": np.nan, "y": 0.0}, {"x": "east", "y": 0.0},
        {"x": 1_804_000.0, "y": 5_467_480.0}, {"lon": -41.0, "lat": 175.4}, {"row": 1, "col": 2},
    ],
)  # fmt: skip
def test_what_is_no_location_or_off_the_grid_is_refused(grid, location):
    with pytest.raises(TrustboError, match="start"):
        grid.locate(location, "start")


def test_every_user_of_a_cell_takes_a_position():
    """Without a terrain, the lower left corner is the origin; the cell (2, 2) is impassable."""
    passable = np.ones((4, 4), bool)
    passable[2, 2] = False
    walled = Workspace.from_awareness(np.full((2, 4, 4, 2), 0.5), passable, cell_size=10.0)
    start, goal = {"x": 5.0, "y": 5.0}, {"x": 35.0, "y": 35.0}
    planner = Planner(walled, start, goal)
    assert (planner.start, planner.goal) == ((3, 0), (0, 3))
    assert tb.Campaign(walled, start, goal).ask().path[0] == (3, 0)
    with pytest.raises(TrustboError, match=r"goal \(2, 2\) is impassable.* \(1, 2\)"):
        Planner(walled, start, {"x": 25.0, "y": 15.0})
    with pytest.raises(TrustboError, match="coordinate reference system"):
        walled.locate({"lon": 1.0, "lat": 2.0})
    with pytest.raises(TrustboError, match="coordinate reference system"):
        walled.grid.lonlat((0, 0))


def test_cell_means_are_means_of_the_pixels_inside():
    terrain = synthetic_terrain((120.0, 90.0), seed=2, relief=6.0)
    grid, dem = Grid.over(terrain, (4, 3)), terrain["dem"].copy()
    dem[:10, :10] = np.nan
    pixels = dem.values.reshape(4, 30, 3, 30)
    np.testing.assert_allclose(grid.cell_means(dem), np.nanmean(pixels, axis=(1, 3)))
    assert grid.bounds == pytest.approx(terrain.rio.bounds())


@pytest.mark.parametrize("shape", [(100, 3), (1, 1), 10, (3.0, 3.0), (3, 3, 3)])
def test_a_grid_too_fine_or_empty_is_refused(shape):
    with pytest.raises(TrustboError):
        Grid.over(synthetic_terrain((120.0, 90.0), seed=2), shape)


def test_cells_of_many_positions_are_those_of_each_position():
    grid = Grid((4, 3), 100.0, 80.0, 10.0, 20.0)
    x, y = np.random.default_rng(0).uniform(20.0, 180.0, (2, 400)).round(-1)  # edges too
    x[0] = 1e300
    found = zip(*(values.tolist() for values in grid.cells_at(x, y)), strict=True)

    for position, (row, col, inside) in zip(zip(x, y, strict=True), found, strict=True):
        located = {"x": position[0], "y": position[1]}
        if inside:
            assert grid.locate(located) == (row, col)
        else:
            with pytest.raises(TrustboError, match="outside the grid"):
                grid.locate(located)
