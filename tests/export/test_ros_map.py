"""Maps for ROS, read as map_server and Nav2 read them in raw mode."""

import dataclasses
import math

import numpy as np
import pytest
import xarray as xr
import yaml
from pyproj import Transformer

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.export import Frame, write_ros_map
from trustbo.export.frame import OF_CRS
from trustbo.export.ros import occupancy


@pytest.fixture(scope="module")
def workspace():
    """Cells of 2 m, 2 rows and 3 columns, the south-western one impassable."""
    passable = np.array([[True, True, True], [False, True, True]])
    return tb.Workspace.from_awareness(np.full((1, 2, 3, 2), 0.5), passable, cell_size=2.0)


@pytest.fixture(scope="module")
def cost():
    return xr.DataArray([[0.0, 0.104, np.nan], [0.5, 0.987, 1.0]], dims=("row", "col"))


def load(path):
    """Both loaders' reading of a map: values (row, col), the southern row first, and the record."""
    record = yaml.safe_load(path.read_text())
    assert set(record) == {
        *("image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
    }
    assert record["mode"] == "raw"
    assert record["negate"] == 0
    assert 0.0 < record["free_thresh"] < record["occupied_thresh"] < 1.0
    assert all(isinstance(value, float) for value in record["origin"])
    magic, size, top, pixels = (path.parent / record["image"]).read_bytes().split(b"\n", 3)
    assert (magic, top) == (b"P5", b"255")
    width, height = map(int, size.split())
    assert len(pixels) == width * height
    ros1, nav2 = np.empty((2, height, width), int)
    for y in range(height):
        for x in range(width):
            shade = pixels[y * width + x]
            # image_loader.cpp: value = color_avg, into a char; map_io.cpp: if within 0..100.
            ros1[height - y - 1, x] = shade - 256 if shade > 127 else shade
            nav2[height - y - 1, x] = shade if shade <= 100 else -1
    np.testing.assert_array_equal(ros1, nav2)
    return ros1, record


def test_costs_are_percent_and_the_south_comes_first(workspace, cost):
    found = occupancy(cost, workspace)
    assert found.dtype == np.int8
    np.testing.assert_array_equal(found, [[100, 98, 98], [0, 10, -1]])
    np.testing.assert_array_equal(occupancy(cost.transpose("col", "row"), workspace), found)


def test_pixels_are_as_the_cell_at_their_centre(workspace, cost):
    cells = occupancy(cost, workspace)
    np.testing.assert_array_equal(
        occupancy(cost, workspace, resolution=0.5), np.kron(cells, np.ones((4, 4), int))
    )
    # Centres at 0.75, 2.25, 3.75, 5.25 m; the last is in the third column, 4 to 6 m.
    np.testing.assert_array_equal(
        occupancy(cost, workspace, resolution=1.5), cells[np.ix_([0, 1, 1], [0, 1, 1, 2])]
    )
    # Centres at 2.5 and 7.5 m: the second is off the grid, as both in the north are not.
    np.testing.assert_array_equal(occupancy(cost, workspace, resolution=5.0), [[10, -1]])
    # 3 * 1.1 / 0.3 is 11.000000000000002 in floating point; that makes no twelfth pixel.
    uneven = dataclasses.replace(
        workspace, grid=dataclasses.replace(workspace.grid, cell_width=1.1, cell_height=1.1)
    )
    assert occupancy(cost, uneven, resolution=0.3).shape == (8, 11)


@pytest.mark.parametrize(
    ("resolution", "origin"), [(None, None), (7.0, None), (10.0, (380000.0, 5224910.0))]
)
def test_each_place_has_its_value_in_both_loaders(result, maps, resolution, origin, tmp_path):
    workspace, cost = result.workspace, maps["cost"]
    path = tmp_path / "maps" / "cost.map.yaml"
    write_ros_map(
        path,
        cost,
        workspace,
        resolution=resolution,
        frame=OF_CRS if origin is None else Frame(origin),
    )
    names = {"cost.map.yaml", "cost.map.pgm"} | ({"cost.map_frame.yaml"} if origin else set())
    assert {file.name for file in path.parent.iterdir()} == names
    values, record = load(path)
    side = record["resolution"]
    assert side == (resolution or 30.0)
    left, bottom, yaw = record["origin"]
    assert yaw == 0.0
    east, north = (0.0, 0.0) if origin is None else (380000.0, 5224910.0)
    seen = 0
    for (i, j), value in np.ndenumerate(values):
        x, y = left + (j + 0.5) * side + east, bottom + (i + 0.5) * side + north
        if not (380000.0 < x < 380120.0 and 5224910.0 < y < 5225000.0):
            assert value == -1
            continue
        seen += 1
        row, col = workspace.grid.cell_at(x, y)
        if not workspace.passable.values[row, col]:
            assert value == 100
        else:
            assert value == round(100 * float(cost[row, col]))
    assert seen >= 0.9 * values.size
    assert len(np.unique(values)) > 3


def test_cells_that_are_not_square_are_of_ten_pixels_on_their_shorter_side(result, tmp_path):
    oblong = tb.Workspace.from_terrain(result.workspace.terrain, (3, 3))  # cells of 40 x 30 m
    cost = oblong.awareness.isel(robot=0, feature=0)
    cells = np.clip(np.rint(100 * cost.values[::-1]), 0, 98)
    write_ros_map(tmp_path / "map.yaml", cost, oblong)
    values, record = load(tmp_path / "map.yaml")
    assert record["resolution"] == 3.0
    # Of 40 pixels to three cells, the centres at 40.5 and 79.5 m are just beyond and within.
    widths = np.repeat([0, 1, 2], [13, 14, 13])
    np.testing.assert_array_equal(values, np.repeat(cells, 10, axis=0)[:, widths])
    np.testing.assert_array_equal(
        occupancy(cost, oblong, resolution=10.0), np.kron(cells, np.ones((3, 4)))
    )


def test_without_a_terrain_the_corner_is_that_of_the_grid(workspace, cost, tmp_path):
    write_ros_map(tmp_path / "map.yml", cost, workspace)
    values, record = load(tmp_path / "map.yml")
    assert record["origin"] == [0.0, 0.0, 0.0]
    assert record["resolution"] == 2.0
    np.testing.assert_array_equal(values, occupancy(cost, workspace))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": 0.0}, "resolution must be positive and finite; got 0.0"),
        ({"resolution": 1e-4}, r"resolution=0\.0001 m gives 2\.4e\+09 pixels; take a coarser one"),
        ({"frame": Frame((0.0,))}, r"origin must be two finite numbers \(x, y\); got \(0\.0,\)"),
        ({"frame": Frame("here")}, "origin must be two finite numbers"),
        ({"frame": Frame()}, "is the start of a path; a map alone has none"),
        ({"frame": Frame((0.0, 3e5))}, r"y 300000\.0 m in no CRS\) is 300 km from the grid"),
        ({"frame": Frame("crs", np.nan)}, "rotation must be a finite angle; got nan"),
        ({"frame": Frame("crs", name="my map")}, "one of ROS such as 'map' .* got 'my map'"),
        ({"frame": "map"}, r"frame: got str 'map'; give export.Frame\(name='odom'\)"),
        ({"frame": Frame((0.0, np.inf))}, "origin must be two finite numbers"),
        ({"path": "map.pgm"}, r"map\.pgm' must end in \.yaml or \.yml"),
        ({"path": "busy.yaml"}, r"cannot write '.*busy\.pgm': it is a folder"),
    ],
)
def test_what_makes_no_map_is_refused(change, message, workspace, cost, tmp_path):
    (tmp_path / "busy.pgm").mkdir()
    path = tmp_path / change.pop("path", "map.yaml")
    with pytest.raises(TrustboError, match=message):
        write_ros_map(path, cost, workspace, **change)
    assert [file.name for file in tmp_path.iterdir()] == ["busy.pgm"]


def test_costs_are_shares(workspace, cost):
    with pytest.raises(TrustboError, match=r"cost\[1, 2\] = 1\.5 is outside \[0, 1\]"):
        occupancy(xr.where(cost == 1.0, 1.5, cost), workspace)
    with pytest.raises(ShapeError, match=r"map 'cost' has \(1, 3\) cells, the workspace \(2, 3\)"):
        occupancy(cost[:1], workspace)
    hidden = dataclasses.replace(workspace, passable=~workspace.passable)
    assert (occupancy(cost, hidden) == 100).sum() == 5


def test_a_map_in_a_turned_frame_has_the_cost_of_the_cell_at_each_centre(result, maps, tmp_path):
    """By pyproj's affine operation, which is another's."""
    workspace, cost, angle = result.workspace, maps["cost"], 0.4
    east, north = 380060.0, 5224950.0
    path = tmp_path / "turned.yaml"
    write_ros_map(path, cost, workspace, frame=Frame((east, north), angle, "odom"))
    values, record = load(path)
    side, (left, bottom, yaw) = record["resolution"], record["origin"]
    assert (side, yaw) == (3.0, 0.0)
    c, s = math.cos(angle), math.sin(angle)
    to_crs = Transformer.from_pipeline(
        f"+proj=affine +xoff={east} +yoff={north} +s11={c} +s12={-s} +s21={s} +s22={c}"
    )
    i, j = np.indices(values.shape)
    u, v = left + (j.ravel() + 0.5) * side, bottom + (i.ravel() + 0.5) * side
    x, y = to_crs.transform(u, v)
    within = (x > 380000.0) & (x < 380120.0) & (y > 5224910.0) & (y < 5225000.0)
    assert (values.ravel()[~within] == -1).all()
    for place, value in zip(np.column_stack([x, y])[within], values.ravel()[within], strict=True):
        row, col = workspace.grid.cell_at(*place)
        closed = not workspace.passable.values[row, col]
        assert value == (100 if closed else round(100 * float(cost[row, col])))
    assert within.sum() * side**2 == pytest.approx(90.0 * 120.0, rel=0.01)  # all cells are there
    frame = yaml.safe_load((tmp_path / "turned_frame.yaml").read_text())
    assert (frame["frame"], frame["origin"], frame["rotation"]) == ("odom", [east, north], angle)
    lon, lat = Transformer.from_crs(frame["crs"], 4326, always_xy=True).transform(east, north)
    assert (frame["longitude"], frame["latitude"]) == pytest.approx((lon, lat), abs=1e-9)


def test_the_side_of_a_pixel_is_a_number_that_one_can_read(cost, tmp_path):
    z = np.full((1, 2, 3, 2), 0.5)
    for size, side in ((24.5623880996136, 2.5), (24.56, 24.56)):
        workspace = tb.Workspace.from_awareness(z, cell_size=size)
        write_ros_map(tmp_path / "map.yaml", cost, workspace)
        assert yaml.safe_load((tmp_path / "map.yaml").read_text())["resolution"] == side
