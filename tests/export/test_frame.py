"""The frame that exports for robots share: a static transform in YAML, and a datum for GPS."""

import math

import numpy as np
import pytest
import yaml
from pyproj import CRS, Geod, Transformer

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import Frame, write_frame, write_ros_map, write_waypoints
from trustbo.export.frame import OF_CRS

ASK = Frame("auto", 0.4, "odom")


def test_one_transform_is_in_the_files_of_all_exports(result, maps, tmp_path):
    """As tf2 applies it: position in the parent = rotation by the quaternion, then translation."""
    write_frame(tmp_path / "frame.yaml", result, frame=ASK)
    text = (tmp_path / "frame.yaml").read_text()
    record = yaml.safe_load(text)
    write_waypoints(tmp_path / "lead.yaml", result, frame=ASK)
    assert (tmp_path / "lead_frame.yaml").read_text() == text
    of_map = ASK._replace(origin=result.workspace.grid.center(result.path[0]))
    write_ros_map(tmp_path / "map.yaml", maps["cost"], result.workspace, frame=of_map)
    assert (tmp_path / "map_frame.yaml").read_text() == text
    assert record["frame"] == "odom"
    assert CRS.from_user_input(record["parent"].replace("_", ":")) == CRS.from_epsg(32616)
    shift, turn = (record["transform"][name] for name in ("translation", "rotation"))
    yaw = 2.0 * math.atan2(turn["z"], turn["w"])
    assert yaw == pytest.approx(record["rotation"]) == pytest.approx(0.4)
    waypoints = yaml.safe_load((tmp_path / "lead.yaml").read_text())["poses"]
    for one, stop in zip(waypoints, result.plan.stops, strict=True):
        assert one["header"]["frame_id"] == "odom"
        x, y = (one["pose"]["position"][axis] for axis in "xy")
        in_parent = (
            shift["x"] + x * math.cos(yaw) - y * math.sin(yaw),
            shift["y"] + x * math.sin(yaw) + y * math.cos(yaw),
        )
        assert in_parent == pytest.approx(tuple(stop), abs=1e-6)
    command = text[text.index("ros2 run") :].splitlines()[0]
    assert command.endswith("--yaw 0.4 --frame-id epsg_32616 --child-frame-id odom")


@pytest.mark.parametrize("rotation", [0.0, 2.0, -1.0])
def test_the_datum_is_a_place_and_a_direction_on_earth(result, tmp_path, rotation):
    """50 m along the x axis, from the datum by geodesics, is 50 m along it by the CRS."""
    write_frame(tmp_path / "frame.yml", result.workspace,
                frame=Frame((380050, 5224950), rotation))  # fmt: skip
    record = yaml.safe_load((tmp_path / "frame.yml").read_text())
    lat, lon, yaw = record["datum"]
    assert (lon, lat) == (record["longitude"], record["latitude"])
    ahead = Geod(ellps="WGS84").fwd(lon, lat, 90.0 - math.degrees(yaw), 50.0)
    x, y = Transformer.from_crs(4326, 32616, always_xy=True).transform(*ahead[:2])
    expected = 380050 + 50 * math.cos(rotation), 5224950 + 50 * math.sin(rotation)
    # The scale of UTM is within .04 % of 1: 2 cm. North of the grid is a degree off the true one.
    np.testing.assert_allclose((x, y), expected, rtol=0.0, atol=0.02)
    assert abs(math.remainder(yaw - rotation, math.tau)) > 0.01


def test_without_a_crs_there_is_no_datum(tmp_path):
    workspace = tb.Workspace.from_awareness(np.full((3, 3, 4, 2), 0.5), cell_size=2.0)
    write_frame(tmp_path / "frame.yaml", workspace, frame=OF_CRS)
    record = yaml.safe_load((tmp_path / "frame.yaml").read_text())
    assert (record["frame"], record["parent"], record["origin"]) == ("map", "grid", [0.0, 0.0])
    assert not record.keys() & {"crs", "longitude", "latitude", "datum"}


def test_a_frame_that_cannot_be_is_refused(result, tmp_path):
    for given, options, message in (
        (result.workspace, {}, 'origin="auto" is the start of a path; a map alone has none'),
        (
            result,
            {"frame": Frame(name="epsg_32616")},
            "frame 'epsg_32616' is that of the CRS",
        ),
        ("result", {}, "plan: got str 'result'; give a Plan, a Result or a Workspace"),
    ):
        with pytest.raises(TrustboError, match=message):
            write_frame(tmp_path / "frame.yaml", given, **options)
    with pytest.raises(TrustboError, match=r"must end in \.yaml or \.yml"):
        write_frame(tmp_path / "frame.json", result)
    assert list(tmp_path.iterdir()) == []
