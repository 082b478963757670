"""Cells of locations, against pyproj and rasterio, and the words for those that are none."""

import numpy as np
import pytest
from pyproj import Transformer
from rasterio.transform import from_origin, rowcol

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.planning import Planner
from trustbo.simulation import ModelSimulator
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid
from trustbo.workspace.location import cell_of, position_near


@pytest.fixture(scope="module")
def grid():
    return Grid((8, 5), 1_802_139.0, 5_467_490.0, 20.0, 30.0, "EPSG:2193")


@pytest.fixture(scope="module")
def walled():
    """A workspace without a terrain; its cell (2, 2) is impassable."""
    z = np.full((2, 4, 4, 2), 0.5)
    passable = np.ones((4, 4), bool)
    passable[2, 2] = False
    return Workspace.from_awareness(z, passable, cell_size=10.0)


def test_positions_are_in_the_cells_that_rasterio_and_pyproj_find(grid):
    rng = np.random.default_rng(3)
    left, bottom, right, top = grid.bounds
    x, y = rng.uniform((left, bottom), (right, top), (200, 2)).T
    affine = from_origin(grid.left, grid.top, grid.cell_width, grid.cell_height)
    expected = list(zip(*(np.asarray(n).tolist() for n in rowcol(affine, x, y)), strict=True))
    lon, lat = Transformer.from_crs(2193, 4326, always_xy=True).transform(x, y)
    for i, cell in enumerate(expected):
        spellings = (
            {"x": x[i], "y": y[i]},
            {"lon": lon[i], "lat": lat[i]},
            f"x={x[i]!r},y={y[i]!r}".replace("np.float64(", "").replace(")", ""),
            f"lat={lat[i]:.12f} lon={lon[i]:.12f}",
            {"row": cell[0], "col": cell[1]},
            "{},{}".format(*cell),
            cell,
        )
        for spelling in spellings:
            assert grid.locate(spelling) == cell, spelling
        assert grid.locate(lon=lon[i], lat=lat[i]) == cell


def test_every_user_of_a_cell_takes_a_position(walled):
    start, goal = "x=5,y=5", {"x": 35.0, "y": 35.0}
    planner = Planner(walled, start, goal)
    assert (planner.start, planner.goal) == ((3, 0), (0, 3))
    campaign = tb.Campaign(walled, start, goal)
    assert campaign.ask().path[0] == (3, 0)
    simulator = ModelSimulator(walled, tb.models.TrustParams(0.5, [0.2, 0.1], 0.2, 0.05, 0.05))
    options = {"simulator": simulator, "n_iterations": 1, "progress": False}
    model = tb.models.PooledTrust()
    result = tb.iterate(walled, start, goal, sampler="importance", model=model, **options)
    assert (result.path[0], result.path[-1]) == ((3, 0), (0, 3))


def test_an_origin_is_refused_in_the_words_of_an_end(grid):
    lon, lat = grid.lonlat((3, 4))
    swapped = f"lon={lat:.6f},lat={lon:.6f}"
    said = []
    for find, reach in ((cell_of, ()), (position_near, (1e5,))):
        with pytest.raises(TrustboError, match=r"longitude .*no place of the CRS") as error:
            find("it", swapped, grid, *reach)
        said.append(str(error.value).partition("Were lon and lat swapped? ")[2])
    assert said[0] == said[1]
    assert "is in cell (3, 4)" in said[0]
    assert position_near("it", f"lon={lon:.9f},lat={lat:.9f}", grid, 1e5) == pytest.approx(
        grid.center((3, 4)), abs=0.01
    )


def test_row_and_col_are_asked_for_of_cells_only(grid):
    lon, lat = grid.lonlat((3, 4))
    with pytest.raises(TrustboError, match=r"Were lon and lat swapped\? .* in cell \(3, 4\)"):
        cell_of("start", f"{lat:.6f},{lon:.6f}", grid)
    x, y = grid.center((3, 4))
    with pytest.raises(TrustboError, match=r"Were x and y swapped\? .* in cell \(3, 4\)"):
        cell_of("start", f"{y},{x}", grid)
    with pytest.raises(TrustboError, match=r"Were row and col swapped\? 7,1 is in cell"):
        cell_of("start", "1,7", grid)


def test_swapped_coordinates_are_said_with_the_cell_that_was_meant(grid):
    lon, lat = grid.lonlat((3, 4))
    with pytest.raises(TrustboError, match=r"lon and lat swapped\? .* is in cell \(3, 4\)") as said:
        grid.locate(lon=lat, lat=lon)
    typed, understood = f"lon={lat:.12g},lat={lon:.12g}", f"longitude {lat:g}, latitude {lon:g}"
    assert typed in str(said.value)
    assert understood in str(said.value)
    x, y = grid.center((1, 2))
    with pytest.raises(TrustboError, match=r"x and y swapped\? .* is in cell \(1, 2\)"):
        grid.locate(x=y, y=x)


def test_a_position_off_the_grid_is_told_its_extent_and_the_nearest_cell(grid):
    left, bottom, right, top = grid.bounds
    with pytest.raises(TrustboError, match="is outside the grid of 8 rows and 5 columns") as said:
        grid.locate(x=right + 2000.0, y=top - 70.0)
    words = str(said.value)
    west, south, east, north = Transformer.from_crs(2193, 4326, always_xy=True).transform_bounds(
        left, bottom, right, top
    )
    for part in (
        f"x {left:.1f} to {right:.1f}", f"y {bottom:.1f} to {top:.1f} m in EPSG:2193",
        f"longitude {west:.5f} to {east:.5f}", f"latitude {south:.5f} to {north:.5f}",
        "nearest cell is (3, 4)", "2 km away",
    ):  # fmt: skip
        assert part in words


@pytest.mark.parametrize(
    ("location", "message"),
    [
        ((1_802_150.5, 5_467_480.0), r"must be two whole .* x=1802150.5,y=5467480 is in cell"),
        ("1802150.5,5467480", r"got '1802150.5,5467480'. .* x=1802150.5,y=5467480 is in cell"),
        ((1_802_150, 5_467_480), r"is outside the grid .* x=1802150,y=5467480 is in cell \(0, 0\)"),
        ("here", r"must be two whole numbers \(row, col\), or a position with names; got 'here'"),
        ({"lon": 175.4}, r"must have the names .* got {'lon': 175.4}"),
        ("x=1,lat=2", "must have the names .* got 'x=1,lat=2'"),
        ({"x": np.nan, "y": 0.0}, "x must be a finite number; got nan"),
        ("row=1.5,col=2", "row must be a whole number; got '1.5'"),
        (7, "must be two whole numbers .* got 7"),
        ((2, 6), r"\(2, 6\) is outside .* columns 0..4"),
    ],
)
def test_a_location_that_is_none_is_refused_with_the_spellings(grid, location, message):
    with pytest.raises(TrustboError, match=message):
        grid.locate(location)


def test_an_impassable_cell_names_the_nearest_and_degrees_need_a_crs(walled):
    with pytest.raises(TrustboError, match=r"x 25.0, y 15.0 .* in cell \(2, 2\), is impassable"):
        walled.locate(x=25.0, y=15.0)
    with pytest.raises(TrustboError, match=r"\(2, 2\) is impassable; the nearest passable cell"):
        Planner(walled, (2, 2), (0, 0))
    with pytest.raises(TrustboError, match="no coordinate reference system"):
        walled.locate("lon=1,lat=2")
