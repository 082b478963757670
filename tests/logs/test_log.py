"""Logs of poses and detections: reading, poses between samples, geometry, and bad tables."""

import gzip

import numpy as np
import pandas as pd
import pytest

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.logs import Log, geometry, read_log, read_mrclam, synthetic_log

POSES = {
    "t": [0.0, 4.0, 8.0] * 2,
    "robot": ["a"] * 3 + ["b"] * 3,
    "x": [0.0, 0.0, 0.0, 2.0, 4.0, 8.0],
    "y": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "heading": [0.0, 0.0, np.pi / 2, 3.0, 3.2, 3.4],
}
SEEN = {"t": [0.5, 0.7, 6.2], "watcher": ["a", "a", "b"], "seen": ["b", "b", "a"]}


def test_poses_are_interpolated_but_over_gaps():
    log = Log(POSES, SEEN, max_gap=4.0)
    assert log.robots == ("a", "b")
    assert log.span == (0.0, 8.0)
    a, b = log.at([-1.0, 0.0, 2.0, 6.0, 8.0, 9.0])
    np.testing.assert_allclose(b[1:5], [[2, 0, 3.0], [3, 0, 3.1], [6, 0, 3.3], [8, 0, 3.4]])
    np.testing.assert_allclose(a[3], [0.0, 0.0, np.pi / 4])
    assert np.isnan(a[[0, 5]]).all()
    short = Log(POSES, SEEN, max_gap=3.9).at([0.0, 2.0, 4.0])
    assert np.isnan(short[:, 1]).all()
    assert np.isfinite(short[:, [0, 2]]).all()


def test_headings_are_those_of_motion_where_not_given():
    poses = {n: v for n, v in POSES.items() if n != "heading"}
    poses["y"] = [0.0, 1.0, 1.0, 0.0, 2.0, 6.0]  # a stops
    log = Log(poses, SEEN)
    np.testing.assert_allclose(log.at([0.0, 8.0])[0, :, 2], np.pi / 2)
    np.testing.assert_allclose(log.at([8.0])[1, :, 2], np.pi / 4)
    poses["y"] = poses["x"] = [0.0] * 6
    with pytest.raises(TrustboError, match="'a' has no heading, and never moves"):
        Log(poses, SEEN)


def test_dates_are_seconds_from_the_first_pose_and_numbers_of_robots_are_names():
    start = pd.Timestamp("2026-11-24T10:00:00Z")
    poses = pd.DataFrame(POSES).assign(robot=[1.0] * 3 + [2.0] * 3)
    seen = pd.DataFrame({"t": SEEN["t"], "watcher": [1, 1, 2], "seen": [2, 2, 1]})
    for table in (poses, seen):
        table["t"] = start + pd.to_timedelta(table["t"], unit="s")
    log = Log(poses, seen)
    assert log.robots == ("1", "2")
    np.testing.assert_allclose(log.detections, [[0.5, 0, 1], [0.7, 0, 1], [6.2, 1, 0]])
    assert log.span == (0.0, 8.0)


def test_a_part_of_a_log_has_its_poses_and_detections():
    part = Log(POSES, SEEN).between(4.0, 8.0)
    assert part.span == (4.0, 8.0)
    assert part.detections.tolist() == [[6.2, 1.0, 0.0]]
    with pytest.raises(TrustboError, match="'a' has no two poses from 5 to 8 s"):
        part.between(5.0, 8.0)
    with pytest.raises(TrustboError, match="nobody is seen from 0 to 4"):
        Log(POSES, {n: v[2:] for n, v in SEEN.items()}).between(0.0, 4.0)


def test_geometry_is_that_of_the_plane():
    poses = {"t": [0.0, 10.0] * 3, "robot": [*"aabbcc"], "x": [0, 0, 4, 4, 2, 2],
             "y": [0, 0, 0, 0, 0, 10], "heading": [0, 0, 0, 0, 0, 1.0]}  # fmt: skip
    log = Log(poses, SEEN, landmarks=[[0.0, 5.0, 0.2]], robot_radius=0.3, max_gap=10.0)
    found = geometry(log, tick=1.0)
    assert found.sizes == {"watcher": 3, "seen": 3, "time": 10}
    np.testing.assert_allclose(found["time"], np.arange(10) + 0.5)
    ab, ba = found.sel(watcher="a", seen="b"), found.sel(watcher="b", seen="a")
    np.testing.assert_allclose(ab["range"], 4.0)
    np.testing.assert_allclose(ab["bearing"], 0.0)
    np.testing.assert_allclose(np.abs(ba["bearing"]), np.pi)
    # c, at (2, t), hides b from a while it is within .3 m of their line.
    np.testing.assert_array_equal(ab["hidden"], 0.0)  # .5 m beside the line at first
    ac = found.sel(watcher="a", seen="c", time=9.5)
    np.testing.assert_allclose(ac["range"], np.hypot(2.0, 9.5))
    np.testing.assert_allclose(ac["bearing"], np.arctan2(9.5, 2.0))
    np.testing.assert_allclose(found.sel(watcher="c", seen="a")["turning"], 0.1)
    np.testing.assert_allclose(found.sel(watcher="a", seen="c")["speed"], 1.0)
    assert found["contact"].sel(watcher="a", seen="b").values.tolist() == [1.0] + [0.0] * 9
    assert found["contact"].sel(watcher="b", seen="a").values.argmax() == 6
    assert np.isnan(found["range"].sel(watcher="a", seen="a")).all()


def test_landmarks_and_terrain_hide():
    poses = {"t": [0.0, 4.0] * 2, "robot": [*"aabb"], "x": [10.0, 10.0, 50.0, 50.0],
             "y": [20.0, 20.0, 20.0, 60.0], "heading": [0.0] * 4}  # fmt: skip
    hidden = geometry(Log(poses, SEEN, landmarks=[[30.0, 20.0, 6.0]]))["hidden"]
    assert hidden.sel(watcher="a", seen="b").values.tolist() == [1.0, 0.0, 0.0, 0.0]
    terrain = tb.terrain.synthetic_terrain((80.0, 80.0), seed=1, relief=0.01, canopy_cover=0.0)
    x, y = float(terrain["x"][0]), float(terrain["y"][-1])
    wall = terrain["dem"].values.copy()
    wall[:, (terrain["x"] > x + 29.0) & (terrain["x"] < x + 32.0)] += 9.0
    walled = terrain.assign(dem=terrain["dem"].copy(data=wall), dsm=terrain["dsm"].copy(data=wall))
    moved = poses | {"x": np.add(poses["x"], x), "y": np.add(poses["y"], y)}
    log = Log(moved, SEEN)
    open_, blocked = (
        geometry(log, terrain=ground)["passes"].sel(watcher="a", seen="b").values
        for ground in (terrain, walled)
    )
    assert (open_ > 0.9).all()
    assert (blocked == 0.0).all()


def test_a_folder_of_tables_is_read(tmp_path):
    pd.DataFrame(POSES).to_csv(tmp_path / "poses.csv", index=False)
    with gzip.open(tmp_path / "detections.csv.gz", "wt") as file:
        pd.DataFrame(SEEN).to_csv(file, index=False)
    (tmp_path / "landmarks.csv").write_text("x,y\n1,2\n")
    log = read_log(tmp_path)
    assert log.landmarks.tolist() == [[1.0, 2.0, 0.0]]
    np.testing.assert_array_equal(log.tracks, Log(POSES, SEEN).tracks)
    with pytest.raises(TrustboError, match=r"holds no poses\.csv and detections\.csv"):
        read_log(tmp_path / "..")


def test_a_bag_of_poses_and_names_is_read(tmp_path):
    rosbags = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    made = {name: store.types[name] for name in store.types}
    text, pose = "std_msgs/msg/String", "geometry_msgs/msg/PoseStamped"
    with rosbags.Writer(tmp_path / "bag", version=9) as bag:
        topics = {}
        for robot in "ab":
            for end, kind in (("odom", pose), ("seen", text)):
                topics[robot, end] = bag.add_connection(f"/{robot}/{end}", kind, typestore=store)
        for t, robot, x, y, heading in sorted(zip(*POSES.values(), strict=True)):
            ns = int((t + 100.0) * 1e9)
            stamp = made["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
            message = made[pose](
                made["std_msgs/msg/Header"](stamp, "map"),
                made["geometry_msgs/msg/Pose"](
                    made["geometry_msgs/msg/Point"](x, y, 0.0),
                    made["geometry_msgs/msg/Quaternion"](
                        0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)
                    ),
                ),
            )
            bag.write(topics[robot, "odom"], ns, store.serialize_cdr(message, pose))
        for t, watcher, seen in zip(*SEEN.values(), strict=True):
            raw = store.serialize_cdr(made[text](seen), text)
            bag.write(topics[watcher, "seen"], int((t + 100.0) * 1e9), raw)
    log, expected = read_log(tmp_path / "bag"), Log(POSES, SEEN)
    np.testing.assert_allclose(log.detections, expected.detections)
    np.testing.assert_allclose(log.tracks, expected.tracks, atol=1e-9)


def test_a_run_of_mrclam_is_read_as_published(tmp_path):
    """Barcodes name subjects; poses come a hundred times a second, and are thinned."""
    t = np.arange(0.0, 20.0, 0.01)
    for i in range(1, 6):
        track = np.column_stack([t + 1000.0, t * 0.1 + i, t * 0.0, t * 0.05])
        np.savetxt(tmp_path / f"Robot{i}_Groundtruth.dat", track, header="Time x y orientation")
        looks = [[1003.0 + i, 10 + i % 5 + 1, 2.0, 0.1], [1004.0, 90, 2.0, 0.1]]
        np.savetxt(tmp_path / f"Robot{i}_Measurement.dat", looks)
    np.savetxt(tmp_path / "Barcodes.dat", [[n, n + 10] for n in range(1, 6)] + [[6, 90]])
    np.savetxt(tmp_path / "Landmark_Groundtruth.dat", [[6, 1.5, 2.5, 0.0, 0.0]])
    log = read_mrclam(tmp_path)
    assert log.robots == ("1", "2", "3", "4", "5")
    assert len(log.tracks[0]) == 40
    expected = [[3.0 + i, i - 1, i % 5] for i in range(1, 6)]
    np.testing.assert_allclose(log.detections, expected)
    np.testing.assert_allclose(log.at([10.0])[1, 0], [3.0, 0.0, 0.5])
    np.testing.assert_allclose(log.landmarks, [[1.5, 2.5, 0.06]])
    (tmp_path / "Barcodes.dat").unlink()
    with pytest.raises(TrustboError, match=r"there is no Barcodes\.dat"):
        read_mrclam(tmp_path)


@pytest.mark.parametrize(
    ("poses", "seen", "options", "message"),
    [
        ({"t": None}, {}, {}, "the table of poses lacks t; it has robot, x, y, heading"),
        ({}, {"seen": None}, {}, "the table of detections lacks seen; it has t, watcher"),
        ({"x": ["1", "2", "?", "1", "1", "1"]}, {}, {}, r"poses, row 3: x = '\?' is no number"),
        ({"x": [0, 1, np.nan, 2, 3, 4]}, {}, {}, "poses, row 3: x = '' is no number"),
        ({"t": [0, 1, 1, 0, 1, 2]}, {}, {}, "robot 'a' has two poses at t = 1 s"),
        ({"heading": [0, np.nan, 0, 0, 0, 0]}, {}, {}, "heading of robot 'a' at t = 4 s is blank"),
        ({"robot": ["a"] * 6}, {}, {}, "two robots at least; poses are of"),
        ({"robot": ["a"] * 5 + ["b"]}, {}, {}, "(two poses|a single pose)"),
        ({}, {"seen": ["c", "d", "A"]}, {}, "no detection is of a robot by another, of a and b"),
        ({}, {"t": ["noon", 1, 2]}, {}, "detections, row 1: t = 'noon' is no number"),
        (
            {"t": ["noon"] + [1] * 5},
            {},
            {},
            "row 1: t = 'noon' is neither seconds nor a date",
        ),
        ({}, {}, {"max_gap": 0.0}, "max_gap must be positive"),
        ({}, {}, {"robot_radius": -1.0}, "robot_radius must"),
        ({}, {}, {"landmarks": [[1.0]]}, "landmarks must be"),
        ({}, {}, {"landmarks": [[1.0, 2.0, -3.0]]}, "a radius below 0"),
    ],
)
def test_odd_tables_have_one_line_each(poses, seen, options, message):
    tables = [
        {name: v for name, v in (known | new).items() if v is not None}
        for known, new in ((POSES, poses), (SEEN, seen))
    ]
    with pytest.raises((TrustboError, ShapeError), match=message) as raised:
        Log(*tables, **options)
    assert "\n" not in str(raised.value)


def test_geometry_refuses_what_is_no_log():
    with pytest.raises(TrustboError, match="log"):
        geometry(3)
    with pytest.raises(TrustboError, match="longer than the log"):
        geometry(Log(POSES, SEEN), tick=9.0)


def test_made_up_logs_are_those_of_their_seed():
    one, again, other = (synthetic_log(3, 1.0, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.detections, again.detections)
    assert len(one.detections) != len(other.detections)
