"""A bag that is replayed, and the node of ROS 2, whose messages are of types that there are."""

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from worlds import hillside

import trustbo as tb
from trustbo.live import Live

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Folder of a campaign, and a bag of two missions, the second on another path."""
    folder = tmp_path_factory.mktemp("recorded")
    workspace = tb.Workspace.from_terrain(hillside(), (3, 3))
    simulator = tb.simulation.KinematicSimulator(workspace)
    with tb.Campaign(
        workspace, (2, 0), (0, 2), sampler="exact", directory=folder / "campaign"
    ) as campaign:
        first = campaign.ask().path
    second = next(
        path
        for path in (((2, 0), (1, 0), (0, 1), (0, 2)), ((2, 0), (2, 1), (1, 2), (0, 2)))
        if path != first
    )
    missions = [simulator.run(path, seed=i) for i, path in enumerate((first, second))]
    tb.logs.write_bag(missions, folder / "log.bag", start=1000.0)
    return folder


def test_a_bag_is_told_as_it_is_read(recorded, tmp_path, serving):
    folder = tmp_path / "campaign"
    shutil.copytree(recorded / "campaign", folder)
    with serving(folder, bag=recorded / "log.bag", rate=0.0) as served:
        state = served.until(lambda s: s["mission"] == 3 and s["phase"] == "ready")
        assert state["refused"] == 0
        assert set(state["poses"]) == {"lead", "r1", "r2", "r3"}
    with tb.Campaign.load(folder) as campaign:
        told, workspace = campaign.state.measured, campaign.workspace
    read = tb.logs.read_bag(recorded / "log.bag", workspace)
    assert len(told) == len(read) == 2
    for one, other in zip(told, read, strict=True):
        assert (one.path, one.status) == (other.path, other.status)
        np.testing.assert_array_equal(one.contact_rate, other.contact_rate)
        np.testing.assert_array_equal(one.n_ticks, other.n_ticks)
        np.testing.assert_array_equal(one.awareness, other.awareness)
        np.testing.assert_allclose(one.duration, other.duration, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(
            [b.t0 for b in one.bounds], [b.t0 for b in other.bounds], rtol=0.0, atol=1e-6
        )


@pytest.mark.slow  # a terrain and a fit more
def test_a_bag_that_ends_in_a_bound_ends_the_mission(recorded, tmp_path, serving):
    folder = tmp_path / "campaign"
    shutil.copytree(recorded / "campaign", folder)
    with tb.Campaign.load(folder) as campaign:
        workspace = campaign.workspace
        path = campaign.ask().path
    mission = tb.simulation.KinematicSimulator(workspace).run(path, seed=3)
    half = tb.Mission(path, mission.bounds[:1], "aborted", mission.features, mission.robots)
    tb.logs.write_bag([half], tmp_path / "half.bag", start=1000.0)
    with serving(folder, bag=tmp_path / "half.bag", rate=0.0) as served:
        served.until(lambda s: s["mission"] == 2 and s["phase"] == "ready")
    with tb.Campaign.load(folder) as campaign:
        assert (campaign.missions[0].status, len(campaign.missions[0].bounds)) == ("aborted", 1)


@pytest.fixture(scope="module")
def node():
    """The node, imported where there is no ROS."""
    file = ROOT / "examples" / "ros2" / "trustbo_live.py"
    spec = importlib.util.spec_from_file_location("trustbo_live_node", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_node_of_ros_2_sends_messages_that_are_taken(node, recorded, tmp_path):
    types = get_typestore(Stores.ROS2_JAZZY).types
    made = {kind: types[name] for kind, name in node.TYPES.items()}
    shutil.copytree(recorded / "campaign", tmp_path / "campaign")
    with Live(tmp_path / "campaign") as live:
        path = live.mission.path
        marker = json.dumps({"bound": 1, "cell": path[1], "mission": 0})
        live.tell(node.line_of("bound", "", made["bound"](data=marker), 10.0))
        live.tell(node.line_of("contact", "r2", made["contact"](data=True), 10.5, "a-token"))
        live.tell(node.line_of("contact", "r1", made["contact"](data=False), 10.5))
        live.tell(node.line_of("status", "", made["status"](data="ok"), 11.0))
        run = live.mission.bounds[0]
        assert (run.n_contact.tolist(), run.n_ticks.tolist()) == ([0, 1, 0], [1, 1, 0])
        assert (run.begun, run.last, run.status) == (10.0, 11.0, "ok")


def test_the_node_of_ros_2_fills_a_path_that_can_be_sent(node):
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)

    def header():
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    def pose():
        place = types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
        turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=0.0)
        of = types["geometry_msgs/msg/Pose"](position=place, orientation=turn)
        return types["geometry_msgs/msg/PoseStamped"](header=header(), pose=of)

    path = types[node.TYPES["plan"]](header=header(), poses=[])
    filled = node.fill_plan(path, {"positions": [[1.5, 2.5], [3.0, 4.0]]}, pose)
    sent = store.serialize_cdr(filled, node.TYPES["plan"])
    read = store.deserialize_cdr(sent, node.TYPES["plan"])
    assert read.header.frame_id == "map"
    assert [(p.pose.position.x, p.pose.position.y) for p in read.poses] == [(1.5, 2.5), (3.0, 4.0)]


def test_the_node_subscribes_to_the_topics_of_bags(node):
    """By its text, as there is no ROS here to run it."""
    text, names = Path(node.__file__).read_text(), tb.logs.Topics()
    assert f'f"{names.contact}"' in text
    for kind in ("bound", "status"):
        assert getattr(names, kind) == f"/mission/{kind}"
    assert 'f"/mission/{kind}"' in text
