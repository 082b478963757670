"""Waypoints for Nav2."""

import math

import numpy as np
import pytest
import yaml

from trustbo.errors import TrustboError
from trustbo.export import Frame, write_waypoints
from trustbo.export.frame import OF_CRS
from trustbo.export.poses import onward


def poses_of(file):
    """Poses (x, y, heading) of a goal of FollowWaypoints: `poses`, geometry_msgs/PoseStamped[]."""
    (name, stamped), *others = yaml.safe_load(file.read_text()).items()
    assert (name, others) == ("poses", [])
    poses = []
    for one in stamped:
        assert one.keys() == {"header", "pose"}
        assert one["header"] == {"frame_id": "odom"}
        place, turn = one["pose"]["position"], one["pose"]["orientation"]
        assert place["z"] == turn["x"] == turn["y"] == 0.0
        assert math.hypot(turn["z"], turn["w"]) == pytest.approx(1.0)
        poses.append((place["x"], place["y"], 2.0 * math.atan2(turn["z"], turn["w"])))
    return np.array(poses)


@pytest.mark.parametrize("robot", ["lead", "r2"])
def test_waypoints_are_the_stops_of_a_robot_in_the_frame(result, tmp_path, robot):
    plan, angle = result.plan, 0.3
    origin = np.array([380010.0, 5224920.0])
    write_waypoints(
        tmp_path / "w.yaml", result, robot=robot, frame=Frame(tuple(origin), angle, "odom"),
    )  # fmt: skip
    assert yaml.safe_load((tmp_path / "w_frame.yaml").read_text())["rotation"] == angle
    poses = poses_of(tmp_path / "w.yaml")
    c, s = math.cos(angle), math.sin(angle)
    places = poses[:, :2] @ [[c, s], [-s, c]] + origin
    headings = np.column_stack([np.cos(poses[:, 2] + angle), np.sin(poses[:, 2] + angle)])
    if robot == "lead":
        np.testing.assert_allclose(places, plan.stops, rtol=0.0, atol=1e-6)
        ahead = np.diff(plan.stops, axis=0)
        ahead = np.vstack([ahead, ahead[-1:]])
    else:
        at_goal = plan.ways[-1][2][-1]  # ways begin with the lead's
        expected = np.vstack([plan.posts[:, 1], at_goal])
        np.testing.assert_allclose(places, expected, rtol=0.0, atol=1e-6)
        ahead = np.vstack([plan.stops[1:], plan.stops[-1:]]) - expected
    np.testing.assert_allclose(headings, ahead / np.linalg.norm(ahead, axis=1)[:, None], atol=1e-9)


def test_what_cannot_be_followed_is_refused(result, nowhere, tmp_path):
    with pytest.raises(TrustboError, match="unknown robot 'r9'; choose one of lead, r1, r2, r3"):
        write_waypoints(tmp_path / "w.yaml", result, robot="r9")
    with pytest.raises(TrustboError, match="a plan has posts and ways where its workspace was"):
        write_waypoints(tmp_path / "w.yaml", nowhere, frame=OF_CRS)
    assert list(tmp_path.iterdir()) == []


def test_a_robot_that_stands_faces_its_next_place():
    places = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 2.0], [3.0, 2.0]])
    np.testing.assert_allclose(onward(places)[:, 2], [np.pi / 2, np.pi / 2, 0.0, 0.0])
