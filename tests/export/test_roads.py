"""Route graphs read back as graphs of bounds: our own, and those of others on a terrain."""

import json
import math

import numpy as np
import pytest
from worlds import hillside, unequal_robots

import trustbo as tb
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.export import Frame, from_route_graph, write_route_graph
from trustbo.models import TrustParams
from trustbo.planning import Planner, RoadPlanner

PARAMS = TrustParams(0.3, np.array([0.5, 0.3]), 0.02, 0.1, 0.1, 0.5, 0.5)


def written_by_others(folder, nodes, edges):
    """A file of another program: nodes by id with x and y, edges of ends, without metadata."""
    features = [
        {
            "type": "Feature",
            "properties": {"id": i},
            "geometry": {"type": "Point", "coordinates": p},
        }
        for i, p in nodes.items()
    ] + [
        {
            "type": "Feature",
            "properties": {"id": 100 + n, "startid": a, "endid": c},
            "geometry": {"type": "LineString", "coordinates": []},
        }
        for n, (a, c) in enumerate(edges)
    ]
    file = folder / "roads.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return file


@pytest.mark.parametrize("objective", ["lost_contact", "success", "mean", "stationary"])
@pytest.mark.parametrize("seed", range(3))
def test_our_own_graph_read_back_gives_the_plan_of_the_planner(seed, objective, tmp_path):
    rng = np.random.default_rng(seed)
    passable = rng.random((6, 7)) > 0.1
    passable[5, 0] = passable[0, 6] = True
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(2, 8, 6, 7, 2)), passable)
    planner = Planner(workspace, (5, 0), (0, 6), objective)
    file = tmp_path / "graph.geojson"
    graph = write_route_graph(file, planner, PARAMS, objective="lost_contact")
    found = RoadPlanner(
        from_route_graph(file), graph.node_of((5, 0)), graph.node_of((0, 6)), objective
    ).plan(PARAMS)
    plan = planner.plan(PARAMS)
    # Awareness is written with all its digits; sums are in another order.
    assert found.value == pytest.approx(plan.value, rel=1e-13, abs=0.0)
    assert tuple(divmod(node, 7) for node in found.path) == plan.path
    np.testing.assert_allclose(found.trust, plan.trust, rtol=0.0, atol=1e-14)


def test_a_chain_along_a_bent_way_is_one_bound(tmp_path):
    workspace = unequal_robots(blocked=[(0, 0)])
    params = PARAMS._replace(beta=np.array([0.3, 0.1, 0.1]))
    planner, file = Planner(workspace, (2, 0), (0, 3)), tmp_path / "graph.geojson"
    graph = write_route_graph(file, planner, params)
    roads = from_route_graph(file)
    cells = {graph.node_of(cell): cell for cell in planner.graph}
    assert {(cells[a], cells[c]) for a, c in roads.edges} == set(planner.graph.edges)
    assert max(len(ids) for *_, ids in roads.edges(data="ids")) > 1
    assert roads.graph["robots"] == workspace.team.names
    costs = planner.graph_of(params)
    for a, c, edge in roads.edges(data=True):
        bound = cells[a], cells[c]
        assert edge["cost"] == pytest.approx(costs.edges[bound]["lost"], rel=1e-9)
        way = workspace.ground.posts.lead_line(*bound)
        length = np.hypot(*np.diff(way, axis=0).T).sum()
        assert edge["length"] == pytest.approx(length, abs=0.02 * length)  # thinned
    plan = planner.plan(params)
    found = RoadPlanner(roads, graph.node_of((2, 0)), graph.node_of((0, 3))).plan(params)
    assert tuple(cells[node] for node in found.path) == plan.path
    assert found.value == pytest.approx(plan.value, rel=1e-13)


def test_roads_of_others_get_their_awareness_from_a_terrain(tmp_path):
    workspace = tb.Workspace.from_terrain(hillside(90.0, 120.0), (3, 4))
    left, bottom, *_ = workspace.grid.bounds
    nodes = {1: [10.0, 12.0], 2: [60.0, 20.0], 3: [100.0, 70.0], 4: [15.0, 75.0]}
    edges = [(1, 2), (2, 3), (1, 4), (4, 3), (2, 1), (3, 2)]
    angle = 0.3
    turned = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    file = written_by_others(tmp_path, {i: (p @ turned).tolist() for i, p in nodes.items()}, edges)
    # x, y of the CRS = origin + rotation of those of the file
    roads = from_route_graph(file, workspace, frame=Frame((left, bottom), angle))
    straight = written_by_others(tmp_path, nodes, edges)
    same = from_route_graph(straight, workspace, frame=Frame((left, bottom)))
    assert set(roads.edges) == set(edges)
    for edge in edges:
        for feature in workspace.features:
            values = roads.edges[edge]["awareness"][feature]
            np.testing.assert_allclose(values, same.edges[edge]["awareness"][feature], atol=1e-9)
            assert all(0.0 <= value <= 1.0 for value in values)
    plan = RoadPlanner(roads, 1, 3).plan(PARAMS._replace(beta=np.array([0.2, 0.1, 0.4])))
    assert plan.path in ((1, 2, 3), (1, 4, 3))
    with pytest.raises(TrustboError, match=r"edge 1 to 2 needs awareness .* On a terrain, export"):
        RoadPlanner(from_route_graph(straight), 1, 3)
    with pytest.raises(TrustboError, match=r"a road leads through x 10.0, y 12.0, off the terrain"):
        from_route_graph(straight, workspace)
    bare = tb.Workspace.from_awareness(np.full((3, 2, 2, 2), 0.5))
    with pytest.raises(TrustboError, match="awareness of roads needs a terrain in memory and an"):
        from_route_graph(straight, bare)
    with pytest.raises(TrustboError, match="has two edges from 1 to 2, of which a path of nodes"):
        from_route_graph(written_by_others(tmp_path, nodes, [(1, 2), (1, 2)]))
    for fault in ([(1, 9)], []):
        with pytest.raises(DamagedFileError, match="damaged: it does not hold what it should"):
            from_route_graph(written_by_others(tmp_path, nodes if fault else {}, fault))


def test_a_chain_without_an_end_is_damage(tmp_path):
    file = written_by_others(tmp_path, {1: [0, 0], 2: [1, 0], 3: [2, 0]}, [(1, 2), (2, 3), (3, 2)])
    record = json.loads(file.read_text())
    record["features"][0]["properties"]["metadata"] = {"row": 0, "col": 0}  # the only stop
    file.write_text(json.dumps(record))
    with pytest.raises(DamagedFileError, match="a chain without an end"):
        from_route_graph(file)
