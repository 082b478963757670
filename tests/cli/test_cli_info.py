"""`trustbo info`, and ends of `trustbo run` as positions: refused before anything is computed."""

import matplotlib.pyplot as plt
import pytest
import rasterio
import rioxarray
from pyproj import Transformer
from rasterio.transform import rowcol

from trustbo.plots.grid import grid_map
from trustbo.terrain import synthetic_terrain
from trustbo.workspace import survey


@pytest.fixture(scope="module")
def corners(rasters):
    """Centres of the cells (2, 0) and (0, 2) of 3 x 3: x and y, and longitude and latitude."""
    with rasterio.open(rasters / "dem.tif") as raster:
        left, bottom, right, top = raster.bounds
        to_degrees = Transformer.from_crs(raster.crs, 4326, always_xy=True)
        assert rowcol(raster.transform, left + 15.0, bottom + 15.0) == (75, 15)
    start, goal = (left + 15.0, bottom + 15.0), (right - 15.0, top - 15.0)
    return start, goal, to_degrees.transform(*start), to_degrees.transform(*goal)


def test_info_prints_and_draws_the_grid(invoke, rasters, corners, tmp_path):
    (x, y), _, (lon, lat), _ = corners
    files = rasters / "dem.tif", rasters / "dsm.tif"
    done = invoke("info", *files, "--shape", "3,3", "--out", tmp_path / "grid.png")
    assert done.exit_code == 0, done.output
    assert f"e.g. start  2,0 or x={x:.1f},y={y:.1f} or lon={lon:.6f},lat={lat:.6f}" in done.output
    assert "pixels      90 x 90 of 1 m x 1 m" in done.output
    assert "cells       30 m (north-south) x 30 m" in done.output
    assert (tmp_path / "grid.png").read_bytes().startswith(b"\x89PNG")


def test_info_takes_a_steeper_team_and_refuses_other_pictures(invoke, rasters, tmp_path):
    done = invoke("info", rasters / "dem.tif", "--max-slope", 0.5, "--out", tmp_path / "g.png")
    assert done.exit_code == 0, done.output
    assert "impassable  100 of 100 cells (100%)" in done.output
    assert "e.g. start" not in done.output
    done = invoke("info", rasters / "dem.tif", "--out", tmp_path / "g.pdf")
    assert done.exit_code == 2
    assert "must end in .png" in done.output


@pytest.mark.parametrize(("size", "shape"), [((60.0, 60.0), (20, 5)), ((240.0, 40.0), (20, 5))])
def test_the_grid_fills_its_picture_and_its_cells_are_named(size, shape):
    ax = grid_map(survey(synthetic_terrain(size, seed=5, relief=6.0), shape))
    ax.figure.canvas.draw()
    assert {text.get_text() for text in ax.texts} >= {"0,0", "19,4"}
    area, whole = ax.get_window_extent(), ax.figure.bbox
    assert area.width > 0.5 * whole.width
    assert area.height > 0.5 * whole.height
    plt.close(ax.figure)


def test_info_says_from_which_crs_heights_were_warped(invoke, rasters, tmp_path):
    for name in ("dem", "dsm"):
        with rioxarray.open_rasterio(rasters / f"{name}.tif", masked=True) as raster:
            raster.rio.reproject("EPSG:4326").rio.to_raster(tmp_path / f"{name}.tif")
    ask = ("--shape", "3,3", "--out", tmp_path / "grid.png")
    done = invoke("info", tmp_path / "dem.tif", tmp_path / "dsm.tif", *ask)
    assert ", to which are warped: dem from EPSG:4326, dsm from EPSG:4326\n" in done.output
    assert "e.g. goal" in done.output
    assert "warped" not in invoke("info", rasters / "dem.tif", *ask).output


@pytest.mark.usefixtures("blank_figures")
def test_run_takes_ends_as_positions(invoke, rasters, corners, tmp_path):
    _, (x, y), (lon, lat), _ = corners
    files = ("--dem", rasters / "dem.tif", "--dsm", rasters / "dsm.tif", "--sampler", "exact")
    ends = ("--start", f"lon={lon:.7f},lat={lat:.7f}", "--goal", f"x={x},y={y}")
    more = ("--shape", "3,3", "--iterations", 1, "--out", tmp_path / "out")
    done = invoke("run", *files, *ends, *more)
    assert done.exit_code == 0, done.output
    assert "recommended: 2,0 " in done.output


def test_run_refuses_ends_before_it_computes_awareness(
    invoke, rasters, corners, tmp_path, monkeypatch
):
    def stop(*_, **__):
        raise AssertionError("awareness was computed")

    monkeypatch.setattr("trustbo.workspace.workspace.cell_maps", stop)
    lon, lat = corners[2]
    files = ("--dem", rasters / "dem.tif", "--dsm", rasters / "dsm.tif", "--shape", "3,3")
    for start, message in (
        (f"lon={lat:.6f},lat={lon:.6f}", "lon and lat swapped?"),
        ("x=5,y=5", "(x 5.0, y 5.0 m in"),
        ("3,0", "(row 3, column 0) is outside the grid of 3 rows and 3 columns"),
        ("lon=1", "must have the names row and col, x and y, or lon and lat; got 'lon=1'"),
    ):
        done = invoke("run", *files, "--start", start, "--goal", "0,2", "--out", tmp_path / "o")
        assert done.exit_code == 2
        assert message in done.output
    gentle = ("--max-slope", 0.5, "--start", "2,0", "--goal", "0,2", "--out", tmp_path / "o")
    done = invoke("run", *files, *gentle)
    assert done.exit_code == 2
    assert "no cell is passable" in done.output
    assert not (tmp_path / "o").exists()
