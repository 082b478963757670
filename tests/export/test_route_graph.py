"""Route graphs for Nav2, read by its loader's rules and searched by networkx."""

import copy
import json
import math
from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
import shapely
import yaml
from peers.nav2_loader import GraphError, load
from worlds import unequal_robots

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import Frame, edge_updates, write_frame, write_route_graph
from trustbo.export.frame import OF_CRS
from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.workspace.moves import MOVES

PARAMS = TrustParams(0.3, np.array([0.5, 0.3]), 0.02, 0.1, 0.1, 0.5, 0.5)


@pytest.fixture(scope="module")
def planner():
    """On a terrain, with a cell that is impassable."""
    workspace = unequal_robots(blocked=[(0, 0)])
    params = PARAMS._replace(beta=np.array([0.3, 0.1, 0.1]))
    return Planner(workspace, (2, 0), (0, 3)), params


@pytest.fixture
def written(planner, tmp_path):
    file = tmp_path / "graph.geojson"
    return file, write_route_graph(file, *planner)


def random_case(seed):
    """A workspace of random awareness of bounds and closed cells, with a risk."""
    rng = np.random.default_rng(seed)
    passable = rng.random((7, 8)) > 0.08
    passable[6, 0] = passable[0, 7] = True
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(2, 8, 7, 8, 2)), passable)
    params = PARAMS._replace(beta0=rng.uniform(0.0, 0.6))
    return workspace, params, rng.uniform(0.0, 0.05, (8, 7, 8))


def cells_of(file, planner):
    """Cells of the cheapest route of a file, by networkx."""
    rows, cols = planner.workspace.grid.shape
    ends = (row * cols + col for row, col in (planner.start, planner.goal))
    return tuple(divmod(n, cols) for n in load(file).route(*ends) if n < rows * cols)


def test_edges_follow_the_ways_of_the_lead_in_the_frame(planner, written, tmp_path):
    (file, graph), (planner, _) = written, planner
    workspace, server = planner.workspace, load(file)
    write_frame(tmp_path / "frame.yaml", workspace, frame=Frame(workspace.grid.center((2, 0))))
    text = (tmp_path / "frame.yaml").read_text()
    assert (tmp_path / "graph_frame.yaml").read_text() == text
    shift = np.array(yaml.safe_load(text)["origin"])
    assert np.abs(list(server.positions.values())).max() < 200.0
    cols, n_cells = 4, 12
    near = 0.5 * min(workspace.surface.pixel)
    chains = nx.DiGraph()
    for number, edge in server.edges.items():
        chains.add_edge(edge["startid"], edge["endid"], id=number, cost=edge["cost"])
    bounds = set()
    for a, c in planner.graph.edges:
        start, goal = (row * cols + col for row, col in (a, c))
        m = MOVES[8].index((c[0] - a[0], c[1] - a[1]))
        inner = [n for n in chains if n >= n_cells] + [start, goal]
        chain = nx.shortest_path(chains.subgraph(inner), start, goal)
        points = np.array([server.positions[node] for node in chain]) + shift
        way = workspace.ground.posts.lead_way(a, c)
        np.testing.assert_allclose(points[[0, -1]], way[[0, -1]], rtol=0.0, atol=1e-6)
        far = shapely.hausdorff_distance(shapely.LineString(points), shapely.LineString(way), 0.01)
        assert far <= near + 1e-6
        assert chains.edges[chain[:2]]["id"] == (1 + m) * n_cells + goal
        bounds |= set(pairwise(chain))
        first, *_ = lengths = np.hypot(*np.diff(points, axis=0).T)
        costs = [chains.edges[ends]["cost"] for ends in pairwise(chain)]
        assert costs[0] == pytest.approx(sum(costs) * first / sum(lengths))
    assert bounds == set(chains.edges)  # and there are no others
    assert len(chains.edges) > len(planner.graph.edges)  # some ways are bent
    assert len(server.edges) == len(graph.edges)
    text = (tmp_path / "graph_params.yaml").read_text()
    assert f"The cheapest route from node 8 to 3:\n# {graph.compared()}.\n" in text
    assert (graph.node_of((2, 0)), graph.node_of((0, 3))) == (8, 3)
    with pytest.raises(TrustboError, match=r"the graph has no node of cell \(0, 0\)"):
        graph.node_of((0, 0))
    record = yaml.safe_load(text)
    server = record["route_server"]["ros__parameters"]
    assert (server["graph_filepath"], server["route_frame"]) == ("graph.geojson", "map")
    assert server["edge_cost_functions"] == ["PenaltyScorer", "DynamicEdgesScorer"]


def test_the_cheapest_route_is_the_stationary_plan(tmp_path):
    for seed in range(8):
        workspace, params, _ = random_case(seed)
        for overridable in (True, False):
            planner = Planner(workspace, (6, 0), (0, 7), "stationary", length_weight=1e-4)
            graph = write_route_graph(tmp_path / "g.json", planner, params, overridable=overridable)
            plan = planner.plan(params)
            assert cells_of(tmp_path / "g.json", planner) == plan.path == graph.route
            assert graph.gap == 0.0


def test_the_cheapest_route_loses_hardly_more_contact_than_the_plan(tmp_path):
    """Under memory up to .6; the plan may have more bounds too, as a route is not limited."""
    gaps, reported = [], []
    for seed in range(24):
        workspace, params, risk = random_case(seed)
        planner = Planner(workspace, (6, 0), (0, 7)).with_risk(risk)
        graph = write_route_graph(tmp_path / "g.json", planner, params)
        route = cells_of(tmp_path / "g.json", planner)
        assert route == graph.route
        longer = Planner(workspace, (6, 0), (0, 7), max_bounds="shortest+8").with_risk(risk)
        plan, found = longer.plan(params), longer.evaluate(route, params)
        contact = len(plan.path) - 1 + plan.value + planner.problem.cost_of_failure(plan.path)
        gaps.append((plan.value - found.value) / contact)
        plan = planner.plan(params)
        contact = len(plan.path) - 1 + plan.value + planner.problem.cost_of_failure(plan.path)
        reported.append(graph.gap - (plan.value - found.value) / contact)
    assert min(gaps) >= -1e-12
    assert np.median(gaps) <= 0.002
    assert max(gaps) <= 0.01
    np.testing.assert_allclose(reported, 0.0, atol=1e-12)


def node(text, **changes):
    return changed(text, "Point", **changes)


def edge(text, **changes):
    return changed(text, "MultiLineString", **changes)


def changed(content, kind, **changes):
    """The graph with other properties of its last node or edge, less those that are None."""
    content = copy.deepcopy(content)
    one = [f for f in content["features"] if f["geometry"]["type"] == kind][-1]["properties"]
    one.update(changes)
    for name, value in changes.items():
        if value is None:
            del one[name]
    return json.dumps(content)


def without(content, kind):
    features = [f for f in content["features"] if f["geometry"]["type"] != kind]
    return json.dumps({"features": features})


FAULTS = {
    "no nodes": (lambda g: without(g, "Point"), "no nodes or no edges"),
    "no edges": (lambda g: without(g, "MultiLineString"), "no nodes or no edges"),
    "cut": (lambda g: json.dumps(g)[:-1], "failed to parse"),
    "start": (lambda g: edge(g, startid=60000), "node 60000 of edge .* does not exist"),
    "end": (lambda g: edge(g, endid=60000), "node 60000 of edge .* does not exist"),
    "no id": (lambda g: edge(g, id=None), "the id of edge is None"),
    "id of a node": (lambda g: edge(g, id=g["features"][0]["properties"]["id"]), "not its alone"),
    "large id": (lambda g: node(g, id=65536), "id 65536 of node is more than 65535"),
    "negative id": (lambda g: node(g, id=-1), "the id of node is -1"),
    "whole penalty": (lambda g: edge(g, metadata={"penalty": 1}), "any_cast<float> fails"),
    "final and free": (lambda g: edge(g, overridable=False, cost=0.0), "no valid cost"),
    "null": (lambda g: node(g, metadata={"row": [None]}), "failed to convert row: None"),
    "nested": (lambda g: edge(g, metadata={"a": [[1.0]]}), "failed to convert a"),
    "frame": (lambda g: node(g, frame="odom"), "no transform from 'odom' to 'map'"),
    "NaN": (lambda g: edge(g, cost=math.nan), "NaN is no JSON"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_loader_that_accepts_our_files_refuses_a_planted_fault(written, name):
    plant, message = FAULTS[name]
    file, _ = written
    load(file)
    file.write_text(plant(json.loads(file.read_text())))
    with pytest.raises(GraphError, match=message):
        load(file)


def test_small_and_whole_costs_have_a_decimal_point(tmp_path):
    """Metadata without one are integers to the loader, and planning throws."""
    rng = np.random.default_rng(0)
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(1, 3, 3, 2)))
    for b, beta in ((30.0, [1.0, 1.0]), (1.0, [0.0, 0.0]), (-2.0, [0.0, 0.0])):
        params = TrustParams(0.0, np.array(beta), b, 0.1, 0.1, 0.5, 0.5)
        graph = write_route_graph(
            tmp_path / "g.json", Planner(workspace, (2, 0), (0, 2)), params, frame=OF_CRS
        )
        assert graph.costs.min() == pytest.approx(max(1e-9, 1.0 - b))
        server = load(tmp_path / "g.json")
        assert set(server.costs().values()) == set(graph.costs.tolist())


def test_updates_make_the_old_graph_the_new_one(planner, tmp_path):
    planner, params = planner
    files = [tmp_path / name for name in ("before.geojson", "between.geojson", "after.geojson")]
    avoided = np.zeros((8, 3, 4), bool)
    avoided[4, 2, 1] = True  # from (2, 0) to (2, 1)
    risk = np.where(planner.workspace.passable_bounds.values, 0.01, np.nan)
    planners = (planner, planner.avoiding(avoided, risk), planner)
    first, *others = graphs = [
        write_route_graph(file, one, params._replace(b=b))
        for file, b, one in zip(files, (0.02, 0.5, -0.2), planners, strict=True)
    ]
    server = load(files[0])
    # The second update holds whatever the first one was.
    for file, graph in zip(files[1:], others, strict=True):
        request = edge_updates(first, graph)
        assert json.loads(json.dumps(request)) == yaml.safe_load(yaml.safe_dump(request)) == request
        server.adjust(request)
        new = load(file)
        costs, expected = server.costs(), new.costs()
        assert costs.keys() == expected.keys()
        for number, cost in expected.items():
            assert costs[number] == pytest.approx(cost, rel=1e-12, abs=1e-15)
        assert server.route(8, 3) == new.route(8, 3)
    assert edge_updates(first, graphs[1])["closed_edges"]
    assert not edge_updates(first, graphs[2])["closed_edges"]
    with pytest.raises(TrustboError, match=r"9 nodes and 10 edges of the graph after are not in"):
        edge_updates(graphs[1], first)


def test_updates_of_graphs_that_do_not_fit_are_refused(planner, tmp_path):
    first = write_route_graph(tmp_path / "a.json", *planner)
    for options, message in (
        ({"objective": "stationary"}, "of 'lost_contact' before, and of 'stationary' after"),
        (
            {"frame": Frame(rotation=0.5)},
            "nodes and 0 edges of the graph after are not in that before",
        ),
        ({"tolerance": math.inf}, "edges of the graph after are not in that before"),
    ):
        other = write_route_graph(tmp_path / "b.json", *planner, **options)
        with pytest.raises(TrustboError, match=message):
            edge_updates(first, other)
    assert "bounds; it loses" in str(first)


def test_a_route_beyond_the_limit_on_risk_is_said(tmp_path):
    rng = np.random.default_rng(3)
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(1, 6, 6, 2)))
    risk = rng.uniform(0.0, 0.2, (8, 6, 6))
    options = {"max_failure": 0.35, "engine": "networkx"}
    planner = Planner(workspace, (5, 0), (0, 5), "stationary", **options).with_risk(risk)
    with pytest.warns(UserWarning, match=r"fails with a chance of .*, beyond max_failure = 0\.35"):
        write_route_graph(tmp_path / "g.json", planner, PARAMS)


def test_what_no_route_graph_can_hold_is_refused(planner, tmp_path):
    planner, params = planner
    many = tb.Workspace.from_awareness(np.full((1, 86, 86, 2), 0.5), cell_size=5.0)
    large = Planner(many, (85, 0), (0, 85))
    terminal = Planner(planner.workspace, (2, 0), (0, 3), "terminal")
    for given, options, message in (
        ((planner, params), {"frame": OF_CRS}, r"float32, in steps of 0.5 m .* origin='auto' is"),
        (
            (large, PARAMS),
            {},
            "86 x 86 cells has ids up to 66563, and messages of Nav2 up to 65535",
        ),
        ((terminal, params), {}, "the value of 'terminal' is no sum of costs of bounds"),
        ((planner, params), {"objective": "mean"}, "unknown objective 'mean'; choose one of lost"),
        ((planner, params._replace(beta0=1.0)), {}, r"abs\(beta0\) < 1; got 1"),
        (
            (planner, params),
            {"tolerance": -1.0},
            r"tolerance must be 0 or more, and finite; got -1",
        ),
        ((planner,), {}, "a planner needs parameters, such as"),
        (("planner",), {}, "planner: got str 'planner'; give a Result, or a Planner and"),
    ):
        with pytest.raises(TrustboError, match=message):
            write_route_graph(tmp_path / "g.json", *given, **options)
    with pytest.raises(TrustboError, match=r"must end in \.geojson or \.json"):
        write_route_graph(tmp_path / "g.yaml", planner, params)
    assert list(tmp_path.iterdir()) == []
    write_route_graph(tmp_path / "g.json", terminal, params, objective="stationary")
