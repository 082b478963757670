"""Files for Nav2, read as its loaders read them."""

import copy
import dataclasses
import json

import networkx as nx
import numpy as np
import pytest
from worlds import unequal_robots

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import Frame, write_nav2
from trustbo.export.nav2 import occupancy
from trustbo.workspace.moves import bounds_along


def picture(file):
    """Pixels of a PGM file, the northern row first."""
    kind, size, most, pixels = file.read_bytes().split(b"\n", 3)
    assert (kind, most) == (b"P5", b"255")
    width, height = map(int, size.split())
    return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width)


@pytest.mark.parametrize("rotation", [0.0, 0.7])
def test_pixels_are_the_costs_of_the_cells_at_their_centres(rotation, result, tmp_path):
    workspace, cost = result.workspace, result.maps()["cost"]
    grid, frame = workspace.grid, Frame(workspace.grid.center((1, 1)), rotation)
    write_nav2(tmp_path / "nav2", result, frame=frame, pixel=3.0)
    about = json.loads((tmp_path / "nav2" / "cost_map.yaml").read_text())
    values = picture(tmp_path / "nav2" / about["image"])[::-1]
    for row, col in [(0, 0), (0, 1), (1, 2), (2, 3)]:
        x, y = (frame.of_crs(grid.center((row, col))) - about["origin"][:2]) / about["resolution"]
        expected = 100 if not workspace.passable[row, col] else round(100 * float(cost[row, col]))
        assert values[int(y), int(x)] == min(expected, 98 if workspace.passable[row, col] else 100)
    assert (values[0, 0] == 255) == (rotation > 0.0)
    with pytest.raises(TrustboError, match="pixel"):
        write_nav2(tmp_path / "no", result, frame=frame, pixel=1e-4)
    assert not (tmp_path / "no").exists()
    with pytest.raises(TrustboError, match="cost"):
        occupancy(cost.values + 1.0, workspace, frame)


def test_waypoints_are_stops_and_posts_that_look_at_the_lead(result, tmp_path):
    plan, frame = result.plan(), Frame(result.workspace.grid.center(result.path[0]), 0.3, "odom")
    write_nav2(tmp_path / "größe", result, frame=frame)
    for robot, expected in (("lead", plan.stops), ("r2", plan.posts[:, 1])):
        poses = json.loads((tmp_path / "größe" / f"waypoints_{robot}.yaml").read_text())["poses"]
        assert {pose["header"]["frame_id"] for pose in poses} == {"odom"}
        places = [[p["pose"]["position"][axis] for axis in "xy"] for p in poses]
        found = frame.to_crs(places)[: len(expected)]
        np.testing.assert_allclose(found, expected, atol=1e-6)
        turns = [p["pose"]["orientation"] for p in poses]
        heading = frame.rotation + np.array([2.0 * np.arctan2(q["z"], q["w"]) for q in turns])
        to = plan.stops[1:] - expected[: len(plan.stops) - 1]
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])[: len(to)]
        np.testing.assert_allclose(ahead, to / np.linalg.norm(to, axis=1)[:, None], atol=1e-9)
    about = json.loads((tmp_path / "größe" / "frame.yaml").read_text())
    assert (about["origin"], about["rotation"]) == ([*frame.origin], 0.3)


def test_the_route_graph_has_the_costs_of_all_bounds(result, tmp_path):
    write_nav2(tmp_path, result)
    features = json.loads((tmp_path / "route_graph.geojson").read_text())["features"]
    about = [feature["properties"] for feature in features]
    nodes = {one["id"]: (one["metadata"]["row"], one["metadata"]["col"])
             for one in about if "startid" not in one}  # fmt: skip
    edges = [one for one in about if "startid" in one]
    assert len({one["id"] for one in about}) == len(about)
    found = nx.DiGraph()
    for one in edges:
        found.add_edge(nodes[one["startid"]], nodes[one["endid"]], cost=one["cost"])
        assert one["cost"] == one["metadata"]["penalty"] > 0.0
    planner = result.planner
    graph = planner.graph(result.posterior)
    assert {*found.edges} == {*graph.edges}
    for a, c, lost in graph.edges(data="lost"):
        assert found.edges[a, c]["cost"] == pytest.approx(max(lost, 1e-9))


def test_edges_cost_their_failures_after_the_first_one(tmp_path):
    workspace = unequal_robots(blocked=[(0, 0)])
    campaign = tb.Campaign(workspace, (2, 0), (0, 3))
    driven = tb.simulation.KinematicSimulator(workspace).run(campaign.ask().path, seed=0)
    campaign.tell(driven)
    failed = campaign.ask().path[:2]
    campaign.fail("stuck", where=failed[1])
    write_nav2(tmp_path, campaign)
    features = json.loads((tmp_path / "route_graph.geojson").read_text())["features"]
    ids = [row * workspace.grid.shape[1] + col for row, col in failed]
    found = [f["properties"] for f in features if f["properties"].get("startid") == ids[0]]
    [edge] = [one for one in found if one["endid"] == ids[1]]
    graph, price = (
        campaign.planner.graph(campaign.posterior),
        campaign.planner.problem.cost_of_failure,
    )
    # A route graph does not know the next move.
    p_fail = np.nanmean(campaign.risk.mean[bounds_along(failed)[0][0], *failed[1]])
    assert edge["metadata"]["p_fail"] == pytest.approx(p_fail)
    assert edge["cost"] == pytest.approx(graph.edges[failed]["lost"] + price * p_fail)
    assert edge["cost"] > max(one["cost"] for one in found if one is not edge)


@pytest.mark.parametrize(
    "wrong",
    [
        {"origin": (np.nan, 0.0)}, {"origin": "xy"}, {"origin": (1.0, 2.0, 3.0)}, {"origin": 1.0},
        {"rotation": 90.0}, {"rotation": np.inf}, {"rotation": None}, {"name": ""}, {"name": None},
    ],
)  # fmt: skip
def test_frames_that_no_robot_has_are_refused(wrong):
    with pytest.raises(TrustboError, match=next(iter(wrong))):
        Frame(**{"origin": (0.0, 0.0)} | wrong)


def test_frames_of_numpy_numbers_are_written_as_those_of_floats(result, tmp_path):
    x, y = result.workspace.grid.center((0, 0))
    numbers = np.array([x, y]), np.float32(0.5)
    write_nav2(tmp_path / "numpy", result, frame=Frame(*numbers))
    write_nav2(tmp_path / "floats", result, frame=Frame((x, y), 0.5))
    for file in (tmp_path / "floats").iterdir():
        assert (tmp_path / "numpy" / file.name).read_bytes() == file.read_bytes()
    whole = Frame((np.int64(round(x)), round(y)))
    assert all(type(value) is float for value in (*whole.origin, whole.rotation))


def test_frames_off_the_map_and_other_objects_are_refused_before_any_file(result, tmp_path):
    x, y = result.workspace.grid.center((0, 0))
    for frame in (Frame((-88.5, 47.2)), Frame((y, x)), (x, y), 0):
        with pytest.raises(TrustboError, match="frame"):
            write_nav2(tmp_path, result, frame=frame)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name", ["/tb3_0", "../r1", "Lead", "-rf", " ", "r1 ", "r1.", "con", "CON.txt", "R2"]
)
def test_names_of_robots_that_are_no_names_of_files_are_refused(name, result, tmp_path):
    other = copy.copy(result)
    team = dataclasses.replace(
        result.workspace.team, names=(name, *result.workspace.team.names[1:])
    )
    other.workspace = dataclasses.replace(result.workspace, team=team)
    with pytest.raises(tb.TrustboError, match="name"):
        write_nav2(tmp_path, other)
    assert not list(tmp_path.iterdir())


def poses(file):
    """Positions of the waypoints in a file, (stop, 2)."""
    listed = json.loads(file.read_text())["poses"]
    return np.array([[one["pose"]["position"][axis] for axis in "xy"] for one in listed])


def test_the_first_plan_of_a_campaign_is_written_as_waypoints(tmp_path):
    campaign = tb.Campaign(unequal_robots(), (2, 0), (0, 3))
    write_nav2(tmp_path, campaign.ask())
    robots = ("lead", "r1", "r2", "r3")
    names = {"frame.yaml", *(f"waypoints_{robot}.yaml" for robot in robots)}
    assert {file.name for file in tmp_path.iterdir()} == names
    frame = Frame(campaign.workspace.grid.corner)
    expected = frame.of_crs(campaign.ask().stops)
    np.testing.assert_allclose(poses(tmp_path / "waypoints_lead.yaml"), expected, atol=1e-6)


def test_the_next_path_replaces_the_recommended_one_beside_the_map_of_the_prior(tmp_path):
    campaign = tb.Campaign(unequal_robots(blocked=[(0, 0)]), (2, 0), (0, 3))
    write_nav2(tmp_path, campaign)  # nothing is learned yet
    assert picture(tmp_path / "cost_map.pgm").min() < 98
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    lead = "waypoints_lead.yaml"
    expected = Frame(campaign.workspace.grid.corner).of_crs(campaign.plan().stops)
    np.testing.assert_allclose(poses(tmp_path / lead), expected, atol=1e-6)

    other = campaign.suggest([(2, 0), (2, 1), (2, 2), (2, 3), (1, 3), (0, 3)])
    assert other.path != campaign.plan().path
    write_nav2(tmp_path, other)
    assert len(poses(tmp_path / lead)) == len(other.path)
    for name in ("cost_map.yaml", "cost_map.pgm", "route_graph.geojson", "frame.yaml"):
        assert (tmp_path / name).read_bytes() == before[name]


@pytest.mark.parametrize("is_stuck", [True, False])
def test_waypoints_of_a_replanned_mission_are_those_still_ahead(is_stuck, tmp_path):
    workspace = unequal_robots()
    campaign = tb.Campaign(workspace, (2, 0), (0, 3))
    path = [(2, 0), (2, 1), (2, 2), (1, 3), (0, 3)]
    campaign.suggest(path)
    write_nav2(tmp_path, campaign.ask())

    n_run = 2 if is_stuck else 1
    statuses = ["ok", "stuck"][:n_run]
    unknown = np.full((n_run, 3, len(workspace.features)), np.nan)
    so_far = tb.Mission.from_arrays(
        path[: n_run + 1],
        unknown,
        np.ones((n_run, 3)),
        status=statuses,
        features=workspace.features,
    )
    plan = campaign.replan((2, 1), so_far)
    ahead = plan.path[3:] if is_stuck else plan.path[1:]
    assert ahead[0] == (2, 1)
    write_nav2(tmp_path, plan)

    # As for a fresh plan from the cell in which the team is.
    fresh = campaign.planner.from_cell((2, 1)).evaluate(ahead, campaign.belief.mean())
    frame = Frame(workspace.grid.corner)
    found = poses(tmp_path / "waypoints_lead.yaml")
    np.testing.assert_allclose(found, frame.of_crs(fresh.stops), atol=1e-6)
    for i, robot in enumerate(workspace.team.names):
        found = poses(tmp_path / f"waypoints_{robot}.yaml")
        assert len(found) == len(ahead)
        np.testing.assert_allclose(found[:-1], frame.of_crs(fresh.posts[:, i]), atol=1e-6)


def test_waypoints_in_another_frame_than_the_map_are_refused(result, tmp_path):
    write_nav2(tmp_path, result, frame=Frame(result.workspace.grid.center((2, 0)), 0.3))
    before = (tmp_path / "waypoints_lead.yaml").read_bytes()
    with pytest.raises(TrustboError, match="frame"):
        write_nav2(tmp_path, result.plan())
    assert (tmp_path / "waypoints_lead.yaml").read_bytes() == before


def test_a_plan_without_a_terrain_has_no_waypoints(result, nowhere, tmp_path):
    bare = dataclasses.replace(result.plan(), workspace=nowhere.workspace)
    with pytest.raises(TrustboError, match="waypoints"):
        write_nav2(tmp_path, bare)
    assert not list(tmp_path.iterdir())
