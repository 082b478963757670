"""The planning grid and the workspace on it."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.simulation import KinematicSimulator
from trustbo.team import Robot, Team
from trustbo.terrain import pixel_size, read_terrain, synthetic_terrain
from trustbo.workspace import Workspace


@pytest.fixture(scope="module")
def terrain():
    return synthetic_terrain((120.0, 90.0), seed=2, relief=6.0)


def test_a_workspace_of_a_terrain(terrain):
    team = Team(n_robots=2)
    workspace = Workspace.from_terrain(terrain, (4, 3), team)
    assert workspace.awareness.dims == ("robot", "move", "row", "col", "feature")
    assert workspace.awareness.shape == (2, 3 * 8, 4, 3, 3)
    assert workspace.features == ("traversability", "visibility", "line_of_sight")
    assert float(workspace.awareness.min()) >= 0.0
    assert float(workspace.awareness.max()) <= 1.0
    assert workspace.passable.all()
    mean = workspace.grid.cell_means(workspace.pixels["visibility"])
    of_cells = workspace.awareness.sel(robot="r1", feature="visibility").mean("move")
    np.testing.assert_allclose(of_cells, mean)
    assert set(workspace.composites) == {"traversability", "visibility"}


def test_steep_cells_are_impassable(terrain):
    gentle = Workspace.from_terrain(terrain, (4, 3))
    robot = Robot(max_slope=float(np.deg2rad(6.0)))
    careful = Workspace.from_terrain(terrain, (4, 3), Team(robots=(robot,) * 3, lead=robot))
    assert int(careful.passable.sum()) < int(gentle.passable.sum())
    steep = tuple(int(i) for i in np.argwhere(~careful.passable.values)[0])
    with pytest.raises(TrustboError, match="steeper than 6 degrees"):
        careful.locate(steep)


def test_a_terrain_nobody_can_stand_on_is_refused(terrain):
    robot = Robot(max_slope=1e-3)
    with pytest.raises(TrustboError, match="no cell is passable"):
        Workspace.from_terrain(terrain, (4, 3), Team(robots=(robot,), lead=robot))


def test_a_cell_mostly_without_data_is_impassable_and_named(real_terrain):
    terrain = read_terrain(*real_terrain("bcts"))
    with pytest.warns(UserWarning, match="opposite sign"):
        workspace = Workspace.from_terrain(terrain, (40, 16), bounds=False)
    with pytest.raises(
        TrustboError, match=r"start \(39, 15\) is impassable: \d+% of it has no data; the nearest"
    ):
        workspace.locate((39, 15), "start")


@pytest.mark.filterwarnings("ignore:the loading of")  # 40 x 30 coarse pixels
def test_cells_that_miss_more_than_half_of_their_pixels_are_impassable(terrain):
    holed = terrain.copy(deep=True)
    for name in ("dem", "dsm"):
        holed[name][:10, :30] = np.nan  # a third of cell (0, 0)
        holed[name][60:80, 30:60] = np.nan  # two thirds of cell (2, 1)
    workspace = Workspace.from_terrain(holed, (4, 3))
    assert np.argwhere(~workspace.passable.values).tolist() == [[2, 1]]

    kept = np.nanmean(workspace.pixels["visibility"].values[:30, :30])
    of_cell = workspace.awareness.sel(robot="r1", feature="visibility")[:, 0, 0].mean("move")
    np.testing.assert_allclose(of_cell, kept)


def test_a_dataset_of_one_s_own_is_put_in_order(terrain):
    """Coarsened, cut or flipped datasets keep a stale transform: the coordinates count."""
    coarse = terrain.coarsen(x=3, y=3).mean()
    workspace = Workspace.from_terrain(coarse, (4, 3))
    left, _, right, top = terrain.rio.bounds()
    assert (workspace.grid.left, workspace.grid.top) == (left, top)
    assert workspace.grid.cell_width == pytest.approx((right - left) / 3)
    assert pixel_size(coarse) == (3.0, 3.0)
    south_up = Workspace.from_terrain(terrain.sortby("y"), (4, 3))
    np.testing.assert_array_equal(
        south_up.awareness, Workspace.from_terrain(terrain, (4, 3)).awareness
    )


def test_datasets_that_are_no_terrain_are_refused(terrain):
    for bad in (
        terrain.drop_vars("dsm"),
        terrain["dem"],
        terrain.drop_vars("spatial_ref"),
        terrain.isel(x=[0, 1, 2, 4, 7, 8]),
    ):
        with pytest.raises(TrustboError):
            Workspace.from_terrain(bad, (2, 2))
    for shape in (10, (3.0, 3.0), (3, 3, 3)):
        with pytest.raises(TrustboError, match="shape"):
            Workspace.from_terrain(terrain, shape)


@pytest.mark.parametrize("sight", [0.3, 0, "clear"])
def test_a_sight_that_is_no_model_of_sight_is_refused(sight, terrain):
    workspace = Workspace.from_terrain(terrain, (2, 3))
    for make in (
        lambda: Workspace.from_terrain(terrain, (2, 3), sight=sight),
        lambda: KinematicSimulator(workspace, sight=sight),
    ):
        with pytest.raises(TrustboError, match="sight"):
            make()


def test_pixel_features_in_a_set_have_no_order(terrain):
    with pytest.raises(TrustboError, match="order"):
        Workspace.from_terrain(terrain, (2, 3), features={"ease": {"slope", "roughness"}})


def test_a_workspace_of_arrays():
    awareness = np.full((2, 3, 4, 3), 0.5)
    awareness[:, 1, 2] = np.nan
    workspace = Workspace.from_awareness(awareness, cell_size=20.0)
    assert not workspace.passable[1, 2]
    assert int(workspace.passable.sum()) == 11
    assert workspace.features == ("traversability", "visibility", "z3")
    assert workspace.grid.center((2, 0)) == (10.0, 10.0)


def test_a_workspace_without_bounds_has_a_text():
    alone = np.arange(9).reshape(3, 3) == 4  # one passable cell
    text = repr(Workspace.from_awareness(np.zeros((2, 3, 3, 1)), alone))
    assert "11% passable" in text
    assert "nan" not in text


def test_bad_arrays_are_refused():
    awareness = np.full((2, 3, 4, 2), 0.5)
    with pytest.raises(TrustboError, match=r"with 8 moves, .*; got shape \(3, 4, 2\)"):
        Workspace.from_awareness(awareness[0])
    with pytest.raises(
        TrustboError, match=r"passable must be \(row, col\) = \(3, 4\); got \(4, 3\)"
    ):
        Workspace.from_awareness(awareness, np.ones((4, 3)))
    with pytest.raises(TrustboError, match="robots"):
        Workspace.from_awareness(awareness, team=Team(n_robots=3))
    high = awareness.copy()
    high[1, 2, 3, 0] = 1.5
    with pytest.raises(TrustboError, match=r"awareness\[1, 2, 3, 0\] = 1.5 is outside \[0, 1\]"):
        Workspace.from_awareness(high)
    hole = awareness.copy()
    hole[0, 1, 1, 0] = np.nan
    with pytest.raises(TrustboError, match=r"passable cell \(1, 1\) is NaN"):
        Workspace.from_awareness(hole, np.ones((3, 4)))
    with pytest.raises(TrustboError, match="no cell is passable"):
        Workspace.from_awareness(awareness, np.zeros((3, 4)))


def test_arrays_with_other_moves_are_refused():
    awareness = Workspace.from_awareness(np.full((2, 3, 4, 2), 0.5)).awareness
    np.testing.assert_array_equal(
        Workspace.from_awareness(awareness.isel(move=slice(None, None, -1))).awareness, awareness
    )
    with pytest.raises(TrustboError, match="move"):
        Workspace.from_awareness(awareness.assign_coords(move=np.arange(8)))
    of_cells = awareness.isel(move=1).fillna(0.5)
    assert Workspace.from_awareness(of_cells).passable.all()


def labelled_map():
    """Awareness of four by three cells with labels along all axes, of one robot and feature."""
    values = np.random.default_rng(1).uniform(size=(1, 4, 3, 1))
    coords = {"robot": ["r1"], "row": range(4), "col": range(3), "feature": ["visibility"]}
    return xr.DataArray(values, coords, tuple(coords))


def test_rows_and_columns_are_put_in_order_by_number():
    made = labelled_map()
    right = Workspace.from_awareness(made).awareness
    turned = made.isel(row=[3, 1, 0, 2], col=[2, 0, 1])
    np.testing.assert_array_equal(Workspace.from_awareness(turned).awareness, right)
    with pytest.raises(TrustboError, match="row"):
        Workspace.from_awareness(made.assign_coords(row=[400.0, 300.0, 200.0, 100.0]))


def test_passable_is_read_by_its_labels():
    free = np.ones((4, 3), bool)
    free[0, 2] = False
    labelled = xr.DataArray(free, {"row": range(4), "col": range(3)}, ("row", "col"))
    for given in (labelled.isel(row=[3, 2, 1, 0]), labelled.T, pd.DataFrame(free)):
        found = Workspace.from_awareness(labelled_map(), given).passable
        np.testing.assert_array_equal(found, free)
    for other in (np.full((4, 3), np.nan), np.full((4, 3), 0.5), np.full((4, 3), "no")):
        with pytest.raises(TrustboError, match="passable"):
            Workspace.from_awareness(labelled_map(), other)


def test_filling_a_mission_looks_up_only_the_cells_that_were_driven():
    free = np.ones((4, 3), bool)
    free[1, 2] = False
    workspace = Workspace.from_awareness(labelled_map(), free)
    path, unknown = [(3, 0), (2, 1), (1, 2), (0, 2)], np.full((1, 1, 1), np.nan)
    mission = Mission.from_arrays(
        path, unknown, [[0.7]], status="stuck", features=workspace.features
    )
    filled = workspace.fill(mission).awareness
    np.testing.assert_array_equal(filled, workspace.along(path[:2]))
