"""GridMap messages: by the layouts of CDR and ROS 1, and by the index arithmetic of grid_map."""

import struct

import numpy as np
import pytest
import xarray as xr

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.export import Frame, read_grid_map, write_grid_map
from trustbo.export.frame import OF_CRS
from trustbo.terrain import read_terrain, synthetic_terrain

rosbags = pytest.importorskip("rosbags", reason="needs the extra ros")


def position_of(index, info):
    """Centre of a cell (row, column), as `getPositionFromIndex` of grid_map_core has it."""
    lengths, place = (info.length_x, info.length_y), info.pose.position
    return tuple(
        centre + 0.5 * length - 0.5 * info.resolution - info.resolution * i
        for centre, length, i in zip((place.x, place.y), lengths, index, strict=True)
    )


def matrices(message):
    """Layers as Eigen matrices, as `multiArrayMessageCopyToMatrixEigen` makes them."""
    layers = {}
    for name, array in zip(message.layers, message.data, strict=True):
        (columns, rows) = array.layout.dim
        assert (columns.label, rows.label) == ("column_index", "row_index")  # isRowMajor() is false
        assert columns.stride == columns.size * rows.size
        assert rows.stride == rows.size
        layers[name] = np.reshape(array.data, (rows.size, columns.size), order="F")
    return layers


def decoded(path):
    """The map and the frame of an mcap by mcap's decoder."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return {c.topic: m for _, c, _, m in reader.iter_decoded_messages()}


@pytest.mark.parametrize("options", [
    {}, {"frame": Frame((380010.0, 5224920.0), 0.0, "odom")}, {"resolution": 7.5},
    {"frame": Frame((380010.0, 5224920.0), 0.5)},
])  # fmt: skip
def test_each_place_has_its_values_by_the_arithmetic_of_grid_map(result, maps, tmp_path, options):
    write_grid_map(tmp_path / "bag", maps, result.workspace, **options)
    found = decoded(tmp_path / "bag" / "bag.mcap")
    message, (static,) = found["/trustbo/maps"], found["/tf_static"].transforms
    assert message.header.frame_id == static.child_frame_id == options.get("frame", OF_CRS).name
    assert set(message.layers) == set(maps.data_vars)
    assert not message.basic_layers
    angle, grid = options.get("frame", OF_CRS).rotation, result.workspace.grid
    c, s = np.cos(angle), np.sin(angle)
    shift, n_seen = static.transform.translation, 0
    for name, matrix in matrices(message).items():
        for index, value in np.ndenumerate(matrix):
            u, v = position_of(index, message.info)
            x, y = shift.x + c * u - s * v, shift.y + s * u + c * v
            left, bottom, right, top = grid.bounds
            if not (left < x < right and bottom < y < top):
                assert np.isnan(value)
                continue
            row, col = grid.cell_at(x, y)
            expected = np.float32(maps[name].values[row, col])
            assert value == expected or (np.isnan(value) and np.isnan(expected))
            n_seen += np.isfinite(value)
    assert n_seen


@pytest.mark.parametrize(("name", "options"), [
    ("maps.bag", {}), ("maps", {}), ("maps", {"storage": "sqlite3"}),
    ("maps", {"frame": Frame((380010.0, 5224920.0), 0.0, "odom")}),
])  # fmt: skip
def test_maps_come_back_bit_by_bit(result, maps, tmp_path, name, options):
    write_grid_map(tmp_path / name, maps, result.workspace, **options)
    again = read_grid_map(tmp_path / name)
    assert list(again.data_vars) == list(maps.data_vars)
    for layer, values in maps.data_vars.items():
        assert again[layer].values.dtype == np.float32
        assert again[layer].values.tobytes() == values.values.astype(np.float32).tobytes()
    for axis in ("y", "x"):
        np.testing.assert_allclose(again[axis], maps[axis], rtol=0.0, atol=1e-6)
    assert again.rio.crs == maps.rio.crs
    assert again.attrs["frame"] == options.get("frame", OF_CRS).name


@pytest.mark.parametrize("corner", [(0, 0), (0, 3), (2, 0), (2, 3)])
def test_one_marked_cell_comes_out_at_its_corner(result, tmp_path, corner):
    """Row 0 is north, column 0 west; in the message index (0, 0) is in the north-east."""
    marked = xr.zeros_like(result.workspace.passable, dtype=float).rename("mark")
    marked[corner] = 1.0
    write_grid_map(tmp_path / "map.bag", marked, result.workspace)
    from rosbags.rosbag1 import Reader

    with Reader(tmp_path / "map.bag") as reader:
        (connection,) = (c for c in reader.connections if c.topic == "/trustbo/maps")
        assert connection.digest == "95681e052b1f73bf87b7eb984382b401"  # that of ROS itself
        ((_, _, raw),) = reader.messages([connection])
    values = struct.unpack("<12f", raw[-4 - 48 : -4])  # before the two start indices
    row, col = corner
    i, j = 3 - col, row  # of 4 rows along -x and 3 columns along -y
    assert values.index(1.0) == j * 4 + i
    assert sum(values) == 1.0
    again = read_grid_map(tmp_path / "map.bag")["mark"]
    assert again.values[corner] == 1.0
    where = again.where(again == 1.0, drop=True)
    x, y = result.workspace.grid.center(corner)
    assert (where["x"].item(), where["y"].item()) == (x, y)


def write_elevation(path, heights, side, centre, start=(0, 0), labels=None, n=None):
    """A bag of another program: a circular buffer of a layer `elevation` in the frame `odom`."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    info = "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose\n"
    store.register(get_types_from_msg(info, "grid_map_msgs/msg/GridMapInfo"))
    text = "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\n"
    text += "string[] basic_layers\nstd_msgs/Float32MultiArray[] data\n"
    text += "uint16 outer_start_index\nuint16 inner_start_index\n"
    store.register(get_types_from_msg(text, "grid_map_msgs/msg/GridMap"))
    make = {name.split("/")[-1]: kind for name, kind in store.types.items()}
    rows, columns = heights.shape
    buffer = np.empty_like(heights)
    for i, j in np.ndindex(rows, columns):
        buffer[(i + start[0]) % rows, (j + start[1]) % columns] = heights[i, j]
    first, second = labels or ("column_index", "row_index")
    dim = [
        make["MultiArrayDimension"](label=first, size=columns, stride=rows * columns),
        make["MultiArrayDimension"](label=second, size=rows, stride=rows),
    ]
    layout = make["MultiArrayLayout"](dim=dim, data_offset=0)
    data = buffer.T.astype(np.float32).ravel()[:n]
    pose = make["Pose"](
        position=make["Point"](x=centre[0], y=centre[1], z=0.0),
        orientation=make["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    stamp = make["Time"](sec=7, nanosec=500_000_000)
    message = make["GridMap"](
        header=make["Header"](stamp=stamp, frame_id="odom"),
        info=make["GridMapInfo"](
            resolution=side, length_x=rows * side, length_y=columns * side, pose=pose
        ),
        layers=["elevation"], basic_layers=["elevation"],
        data=[make["Float32MultiArray"](layout=layout, data=data)],
        outer_start_index=start[0], inner_start_index=start[1],
    )  # fmt: skip
    kind = "grid_map_msgs/msg/GridMap"
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/elevation_map", kind, typestore=store)
        writer.write(connection, 1, store.serialize_cdr(message, kind))


def test_a_dem_is_read_from_the_buffer_of_a_moving_robot(tmp_path):
    terrain = synthetic_terrain((30.0, 40.0), seed=3)
    dem = terrain["dem"]
    (y, x), side = (dem[axis].values for axis in ("y", "x")), 1.0
    heights = np.empty((len(x), len(y)))  # of grid_map: rows along -x, columns along -y
    for i, j in np.ndindex(heights.shape):
        heights[i, j] = dem.values[j, len(x) - 1 - i]
    centre = 0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1])
    write_elevation(tmp_path / "mapping", heights, side, centre, start=(5, 17))
    for path in (tmp_path / "mapping", tmp_path / "mapping" / "mapping.mcap"):
        maps = read_grid_map(path, "/elevation_map")
    assert (maps.attrs, maps.rio.crs) == ({"frame": "odom", "time": 7.5}, None)
    np.testing.assert_array_equal(maps["elevation"], dem.astype(np.float32))
    with pytest.warns(UserWarning, match="no surface"):
        again = read_terrain(maps["elevation"], crs=terrain.rio.crs)
    np.testing.assert_array_equal(again["dem"], dem.astype(np.float32))
    np.testing.assert_allclose(again["y"], dem["y"], rtol=0.0, atol=1e-9)
    assert tb.Workspace.from_terrain(again, (3, 4)).passable.any()


def test_maps_that_do_not_agree_with_themselves_are_refused(result, maps, tmp_path):
    heights = np.zeros((3, 4))
    for name, options, message in (
        (
            "a",
            {"labels": ("row_index", "column_index")},
            r"axes of the layer 'elevation' are \['row",
        ),
        ("b", {"n": 5}, "the layer 'elevation' has 5 values of 3 x 4 cells, and the map 3 x 4"),
        ("c", {}, r"lacks /map; it has /elevation_map \(grid_map_msgs/msg/GridMap\)"),
    ):
        write_elevation(tmp_path / name, heights, 1.0, (0.0, 0.0), **options)
        with pytest.raises(TrustboError, match=message):
            read_grid_map(tmp_path / name, "/map" if name == "c" else None)
    tb.export.write_ros_bag(tmp_path / "d", result, maps["cost"])
    with pytest.raises(TrustboError, match=r"one topic of grid_map_msgs/msg/GridMap, .* has none"):
        read_grid_map(tmp_path / "d")
    with pytest.raises(TrustboError, match=r"/trustbo/path is nav_msgs/msg/Path; it must be grid"):
        read_grid_map(tmp_path / "d", "/trustbo/path")
    before = set(tmp_path.iterdir())
    with pytest.raises(ShapeError, match="there are no maps"):
        write_grid_map(tmp_path / "e", xr.Dataset(), result.workspace)
    with pytest.raises(TrustboError, match=r"d' exists; bags are not overwritten"):
        write_grid_map(tmp_path / "d", maps, result.workspace)
    assert set(tmp_path.iterdir()) == before
