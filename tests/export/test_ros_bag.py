"""Bags of a cost map and a path, their bytes decoded by the layouts of ROS 1 and CDR."""

import math
import sqlite3
import struct
import sys
import time

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import Frame, write_ros_bag
from trustbo.export.ros import occupancy

rosbags = pytest.importorskip("rosbags", reason="needs the extra ros")


class Bytes:
    """Reads little-endian fields in turn; CDR aligns them, ROS 1 does not."""

    def __init__(self, data, *, cdr):
        self.data, self.at, self.cdr = bytes(data), 0, cdr
        if cdr:
            assert self.data[:4] == b"\x00\x01\x00\x00"  # plain, little-endian
            self.data = self.data[4:]

    def take(self, kind, n=1):
        size = struct.calcsize(kind)
        if self.cdr:
            self.at += -self.at % size
        values = struct.unpack_from(f"<{n}{kind}", self.data, self.at)
        self.at += n * size
        return values if n > 1 else values[0]

    def header(self):
        if not self.cdr:
            assert self.take("I") == 0  # seq
        seconds, _ = self.take("I", 2)  # stamp: now, not 1970
        assert 0 <= time.time() - seconds < 600
        text = bytes(self.take("B", self.take("I")))
        assert text == (b"map\0" if self.cdr else b"map")

    def pose(self):
        """X, y and heading."""
        x, y, z = self.take("d", 3)
        qx, qy, qz, qw = self.take("d", 4)
        assert z == qx == qy == 0.0
        assert math.hypot(qz, qw) == pytest.approx(1.0)
        return x, y, 2.0 * math.atan2(qz, qw)

    def grid(self):
        self.header()
        seconds, _ = self.take("I", 2)  # map_load_time
        assert 0 <= time.time() - seconds < 600
        resolution, width, height = self.take("f"), *self.take("I", 2)
        corner, n = self.pose(), self.take("I")
        assert n == width * height
        values = np.reshape(self.take("b", n), (height, width))
        assert len(self.data) == self.at
        return resolution, corner, values

    def path(self):
        self.header()
        poses = []
        for _ in range(self.take("I")):
            self.header()
            poses.append(self.pose())
        assert len(self.data) == self.at
        return np.array(poses)


def assert_is_the_result(grid, path, result, maps, shift=(0.0, 0.0), side=30.0):
    resolution, corner, values = grid
    assert resolution == side
    assert corner == (380000.0 + shift[0], 5224910.0 + shift[1], 0.0)
    np.testing.assert_array_equal(
        values, occupancy(maps["cost"], result.workspace, resolution=side)
    )
    centers = [(380015.0 + 30.0 * col, 5224985.0 - 30.0 * row) for row, col in result.path]
    np.testing.assert_array_equal(path[:, :2], np.add(centers, shift))
    for k in range(len(path) - 1):
        (row, col), (to_row, to_col) = result.path[k : k + 2]
        heading = math.atan2(row - to_row, to_col - col)  # rows go south
        assert path[k, 2] == pytest.approx(heading)
    assert path[-1, 2] == path[-2, 2]


def test_a_bag_of_ros_1_is_latched(result, maps, tmp_path):
    from rosbags.rosbag1 import Reader

    write_ros_bag(tmp_path / "path.bag", result.plan, maps["cost"])
    with Reader(tmp_path / "path.bag") as reader:
        raw = {c.topic: data for c, _, data in reader.messages()}
        kinds = {c.topic: (c.msgtype, c.digest, c.ext.latching) for c in reader.connections}
    # The sums are those that ROS 1 itself has of these types.
    path = ("nav_msgs/msg/Path", "6227e2b7e9cce15051f669a5e197bbf7", 1)
    poses = ("geometry_msgs/msg/PoseArray", "916c28c5764443f268b296bb671b9d97", 1)
    assert kinds == {
        "/trustbo/cost": ("nav_msgs/msg/OccupancyGrid", "3381f2d731d4076ec5c71b0759edbe4e", 1),
        "/trustbo/path": path,
        "/trustbo/lead/waypoints": poses,
        "/tf_static": ("tf2_msgs/msg/TFMessage", "94810edda583a504dfda3829e70d7eec", 1),
        **{f"/trustbo/{robot}/posts": poses for robot in ("r1", "r2", "r3")},
        **{f"/trustbo/{robot}/way": path for robot in ("lead", "r1", "r2", "r3")},
    }
    grid = Bytes(raw["/trustbo/cost"], cdr=False).grid()
    path = Bytes(raw["/trustbo/path"], cdr=False).path()
    assert_is_the_result(grid, path, result, maps)


def test_a_database_of_ros_2_is_transient_local(result, maps, tmp_path):
    options = {"storage": "sqlite3", "resolution": 10.0, "frame": Frame((380000, 5224910))}
    write_ros_bag(tmp_path / "path", result, maps["cost"], **options)
    assert {f.name for f in (tmp_path / "path").iterdir()} == {"metadata.yaml", "path.db3"}
    assert (tmp_path / "path_frame.yaml").exists()
    base = sqlite3.connect(tmp_path / "path" / "path.db3")
    topics = base.execute(
        "SELECT name, type, serialization_format, offered_qos_profiles, id FROM topics"
    ).fetchall()
    raw = dict(base.execute("SELECT topic_id, data FROM messages").fetchall())
    base.close()
    assert len(topics) == 11
    assert {topic[:3] for topic in topics} >= {
        ("/trustbo/cost", "nav_msgs/msg/OccupancyGrid", "cdr"),
        ("/trustbo/path", "nav_msgs/msg/Path", "cdr"),
        ("/trustbo/r1/posts", "geometry_msgs/msg/PoseArray", "cdr"),
    }
    for *_, qos, _ in topics:
        assert "durability: 1" in qos  # RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL
        assert "reliability: 1" in qos  # reliable
    of_topic = {name: raw[number] for name, *_, number in topics}
    grid = Bytes(of_topic["/trustbo/cost"], cdr=True).grid()
    path = Bytes(of_topic["/trustbo/path"], cdr=True).path()
    assert_is_the_result(grid, path, result, maps, (-380000.0, -5224910.0), 10.0)


def test_mcap_is_read_by_its_own_library(result, maps, tmp_path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    write_ros_bag(tmp_path / "path", result.plan, maps["cost"])
    with (tmp_path / "path" / "path.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = {c.topic: (s.name, c, m) for s, c, _, m in reader.iter_decoded_messages()}
    for _, channel, _ in found.values():
        assert "durability: 1" in channel.metadata["offered_qos_profiles"]
    kind, _, grid = found["/trustbo/cost"]
    assert kind == "nav_msgs/msg/OccupancyGrid"
    assert grid.header.frame_id == "map"
    info, corner = grid.info, grid.info.origin.position
    values = np.reshape(grid.data, (info.height, info.width))
    kind, _, path = found["/trustbo/path"]
    assert kind == "nav_msgs/msg/Path"
    assert {pose.header.frame_id for pose in (path, *path.poses)} == {"map"}
    poses = []
    for stamped in path.poses:
        place, turn = stamped.pose.position, stamped.pose.orientation
        poses.append((place.x, place.y, 2.0 * math.atan2(turn.z, turn.w)))
    assert_is_the_result(
        (info.resolution, (corner.x, corner.y, 0.0), values), np.array(poses), result, maps
    )


def test_without_a_terrain_the_frame_is_the_grid_s(maps, tmp_path):
    from rosbags.rosbag1 import Reader

    workspace = tb.Workspace.from_awareness(np.full((3, 3, 4, 2), 0.5), cell_size=2.0)
    params = tb.models.TrustParams(0.5, np.array([0.3, 0.3]), 0.1, 0.1, 0.1, 0.5, 0.5)
    plan = tb.planning.Planner(workspace, (2, 0), (2, 1), max_bounds="shortest").plan(params)
    write_ros_bag(tmp_path / "path.bag", plan, maps["cost"])
    with Reader(tmp_path / "path.bag") as reader:
        raw = {c.topic: data for c, _, data in reader.messages()}
    _, corner, values = Bytes(raw["/trustbo/cost"], cdr=False).grid()
    assert corner == (0.0, 0.0, 0.0)
    assert values[2, 0] == -1  # passable here, but without a cost
    np.testing.assert_array_equal(
        Bytes(raw["/trustbo/path"], cdr=False).path(), [[1.0, 1.0, 0.0], [3.0, 1.0, 0.0]]
    )


def test_what_makes_no_bag_is_refused(result, maps, tmp_path):
    plan, cost = result.plan, maps["cost"]
    (tmp_path / "there").mkdir()
    for name, options, message in (
        ("there", {}, r"there' exists; bags are not overwritten"),
        ("new", {"storage": "zip"}, "unknown storage 'zip'; choose one of sqlite3, mcap"),
        ("new", {"resolution": -1.0}, r"resolution must be positive and finite; got -1\.0"),
        ("new", {"frame": Frame((1.0, 2.0, 3.0))}, "origin must be two finite numbers"),
    ):
        with pytest.raises(TrustboError, match=message):
            write_ros_bag(tmp_path / name, plan, cost, **options)
    assert [file.name for file in tmp_path.iterdir()] == ["there"]


def test_without_rosbags_the_extra_is_named(result, maps, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(TrustboError, match=r"ROS bags need rosbags: .* pip install rosbags$"):
        write_ros_bag(tmp_path / "path", result.plan, maps["cost"])
    assert list(tmp_path.iterdir()) == []
