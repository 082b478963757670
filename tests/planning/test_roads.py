"""Plans on graphs of roads, against all walks written out, and against the planner of cells."""

from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
from scipy.special import expit

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.models import TrustParams
from trustbo.planning import Planner, RoadPlanner
from trustbo.planning.graph import NoPathError

PARAMS = TrustParams(0.4, np.array([0.35, 0.2]), 0.03, 0.1, 0.1, 0.5, 0.5)


def roads(seed, n=7, share=0.45):
    """Random directed roads: some two-way, with awareness by robot."""
    rng = np.random.default_rng(seed)
    graph = nx.DiGraph(robots=("a", "b"))
    for i in range(n):
        graph.add_edge(i, (i + 1) % n)  # the goal can be reached
    for i in range(n):
        for j in range(n):
            if i != j and (i, j) != (0, 4) and rng.uniform() < share:
                graph.add_edge(i, j)
    for _, _, edge in graph.edges(data=True):
        edge["length"] = float(rng.uniform(10.0, 90.0))
        edge["awareness"] = {"z1": rng.uniform(size=2).tolist(), "z2": float(rng.uniform())}
    return graph


def walks(graph, start, goal, most, *, u_turns):
    """All walks of at most `most` edges that end on entering the goal."""
    queue = [(start,)]
    while queue:
        path = queue.pop()
        if path[-1] == goal:
            yield path
        elif len(path) <= most:
            turns = path[-2:-1] if not u_turns else ()
            queue += [(*path, c) for c in graph.successors(path[-1]) if c not in turns]


def value_of(graph, path, objective, weight=0.0, x0=0.5):
    """Value by the equations: mean trust of the robots, of one recursion each."""
    u, trust, length = [], [], 0.0
    for a, c in pairwise(path):
        edge = graph.edges[a, c]
        z = np.stack(np.broadcast_arrays(edge["awareness"]["z1"], edge["awareness"]["z2"]), axis=1)
        u.append((z @ PARAMS.beta).mean() + PARAMS.b)
        length += edge["length"]
    if objective == "lost_contact":  # no bound gains contact
        u = np.minimum(u, 1.0 - PARAMS.beta0)
    x = x0
    for one in u:
        x = PARAMS.beta0 * x + one
        trust.append(x)
    trust, toll = np.array(trust), weight * length
    settled = np.array(u) / (1.0 - PARAMS.beta0)
    return {
        "lost_contact": -(1.0 - trust).sum() - toll,
        "mean": trust.mean() - toll,
        "terminal": expit(trust[-1] - toll),
        "success": np.prod(expit(trust)) * np.exp(-toll),
        "bottleneck": trust.min(),
        "stationary": np.prod(expit(settled)) * np.exp(-toll),
    }[objective]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("objective", "max_bounds", "weight"),
    [
        ("lost_contact", None, 0.0), ("lost_contact", "shortest+3", 0.002),
        ("lost_contact", 6, 0.0), ("mean", None, 0.001), ("terminal", "shortest+3", 0.0),
        ("success", 5, 0.0), ("success", "shortest+2", 0.002), ("bottleneck", "shortest+2", 0.0),
        ("stationary", None, 0.001),
    ],
)  # fmt: skip
def test_no_walk_is_better(seed, objective, max_bounds, weight):
    graph = roads(seed)
    planner = RoadPlanner(
        graph, 0, 4, objective, max_bounds=max_bounds, length_weight=weight, team="mean"
    )
    plan = planner.plan(PARAMS)
    if objective == "stationary":
        every = list(nx.all_simple_paths(graph, 0, 4))
    else:
        every = list(walks(graph, 0, 4, planner.longest, u_turns=isinstance(max_bounds, int)))
    best = max(value_of(graph, path, objective, weight) for path in every)
    assert plan.exact
    assert len(every) > 3
    # Rounding alone: the sums are of some ten terms near 1.
    assert plan.value == pytest.approx(best, abs=1e-12)
    assert plan.value == pytest.approx(value_of(graph, plan.path, objective, weight), abs=1e-12)


@pytest.mark.parametrize("objective", ["lost_contact", "success", "stationary"])
@pytest.mark.parametrize("connectivity", [4, 8])
def test_on_the_graph_of_a_grid_the_plan_is_the_planner_s(objective, connectivity):
    maps = np.random.default_rng(3).uniform(size=(3, 5, 6, 2))
    maps[:, 2, 2] = np.nan
    workspace = tb.Workspace.from_awareness(maps)
    planner = Planner(workspace, (4, 0), (0, 5), objective, connectivity=connectivity)
    graph = planner.graph.copy()
    for _, cell, edge in graph.edges(data=True):
        edge["awareness"] = dict(zip(workspace.features, maps[:, *cell].T, strict=True))
    found = RoadPlanner(graph, (4, 0), (0, 5), objective).plan(PARAMS)
    plan = planner.plan(PARAMS)
    assert found.value == pytest.approx(plan.value, abs=1e-12)
    assert found.path == plan.path
    costs, expected = RoadPlanner(graph, (4, 0), (0, 5)).graph_of(PARAMS), planner.graph_of(PARAMS)
    for edge in expected.edges:
        assert costs.edges[edge]["cost"] == pytest.approx(expected.edges[edge]["cost"], rel=1e-12)
        if objective == "lost_contact":
            assert costs.edges[edge]["lost"] == pytest.approx(expected.edges[edge]["lost"])
    assert found.length == pytest.approx(plan.length)
    np.testing.assert_allclose(found.trust, plan.trust, rtol=0.0, atol=1e-14)
    assert found.exact


def test_missions_on_roads_teach_and_change_the_plan():
    graph, rng = roads(11, n=9), np.random.default_rng(0)
    planner = RoadPlanner(graph, 0, 5)
    missions, plan = [], planner.plan(PARAMS)
    for _ in range(12):
        z = plan.awareness
        rates = np.clip(0.1 + z @ [0.1, 0.7] + rng.normal(0.0, 0.03, z.shape[:2]), 0.0, 1.0)
        missions.append(plan.mission(rates, duration=np.full(rates.shape, 20.0)))
        posterior = tb.fit(missions, sampler="exact", progress=False, seed=0)
        plan = planner.plan(tb.inference.params_of(posterior).draw(len(missions)))  # Thompson
    plan = planner.plan(posterior)
    assert missions[0].robots == ("a", "b")
    assert not missions[0].has_map
    lost = {
        path: (0.9 - planner.evaluate(path, PARAMS).awareness @ [0.1, 0.7]).mean(1).sum()
        for path in walks(graph, 0, 5, planner.longest, u_turns=False)
    }
    # What is lost beyond the best walk: a tenth of what the first plan lost beyond it, at most.
    first = lost[planner.plan(PARAMS).path] - min(lost.values())
    assert first > 0.05
    assert lost[plan.path] - min(lost.values()) < 0.1 * first
    assert (plan.bands[-1] > plan.bands[0]).all()


def test_what_is_no_graph_of_bounds_is_refused_in_a_sentence():
    graph = roads(0)
    bare = nx.DiGraph([(0, 1), (1, 2)])
    for make, error, message in (
        (
            lambda: RoadPlanner(bare.to_undirected(), 0, 2),
            TrustboError,
            "graph: got Graph .*; give",
        ),
        (lambda: RoadPlanner(graph, 0, 99), TrustboError, "goal 99 is no node of the graph"),
        (lambda: RoadPlanner(graph, 0, 0), TrustboError, "start and goal are the same node 0"),
        (lambda: RoadPlanner(bare, 2, 0), NoPathError, "no edges lead from 2 to 0"),
        (lambda: RoadPlanner(bare, 0, 2), TrustboError, "edge 0 to 1 needs awareness of some feat"),
        (lambda: RoadPlanner(graph, 0, 4, max_bounds=0), TrustboError, "max_bounds must be"),
        (lambda: RoadPlanner(graph, 0, 4, "speed"), TrustboError, "unknown objective 'speed'"),
        (lambda: RoadPlanner(graph, 0, 4, team="min").plan(PARAMS), TrustboError, "robots that sh"),
        (lambda: RoadPlanner(graph, 0, 4).evaluate([0, 4, 0], PARAMS), TrustboError, "no edge l"),
        (lambda: RoadPlanner(graph, 0, 4).evaluate([0], PARAMS), TrustboError, "two nodes at le"),
        (lambda: RoadPlanner(graph, 0, 4, max_bounds=10**8).plan(PARAMS), TrustboError, "unroll"),
    ):
        with pytest.raises(error, match=message):
            make()
    odd = roads(0)
    edge = next(iter(odd.edges))
    odd.edges[edge]["awareness"] = {"z1": [1.0, 2.0, 3.0], "z2": 0.5}
    with pytest.raises(TrustboError, match=r"edge 0 to 1 must be finite .* \('a', 'b'\)"):
        RoadPlanner(odd, 0, 4)
    del odd.edges[edge]["length"], odd.edges[edge]["awareness"]["z1"]
    with pytest.raises(TrustboError, match=r"edge 0 to 1 needs awareness of z1, z2 feat|of z2"):
        RoadPlanner(odd, 0, 4)
    other = TrustParams(0.4, np.ones(3), 0.03, 0.1, 0.1, 0.5, 0.5)
    with pytest.raises(ShapeError, match="features"):
        RoadPlanner(graph, 0, 4).plan(other)


def test_the_posterior_of_a_campaign_plans_on_roads_without_its_effects_of_places():
    graph, rng = roads(0), np.random.default_rng(0)
    for _, _, edge in graph.edges(data=True):
        edge["awareness"] = dict(
            zip(("z1", "line_of_sight"), edge["awareness"].values(), strict=True)
        )
    path, names = (
        [(2, 0), (1, 1), (0, 2)],
        {"features": ("z1", "line_of_sight"), "robots": ("a", "b")},
    )
    missions = [
        tb.Mission.from_arrays(path, rng.uniform(size=(2, 2, 2)), rng.uniform(size=(2, 2)), **names)
        for _ in range(2)
    ]
    effects = [tb.models.PlaceEffect(), tb.models.RobotEffect()]  # the default of campaigns
    posterior = tb.fit(missions, tb.models.PooledTrust(effects=effects), progress=False, seed=0)
    planner, params = RoadPlanner(graph, 0, 4), tb.inference.params_of(posterior)
    assert sorted(params.places) == ["place", "place_bound"]
    plan = planner.plan(posterior)
    bare = planner.plan(params._replace(place=None, place_bound=None).mean())
    assert (plan.path, plan.value) == (bare.path, bare.value)
    assert (plan.bands[-1] > plan.bands[0]).all()
    with pytest.raises(TrustboError, match=r"give tb.fit\(result.missions, tb.models.PooledT"):
        RoadPlanner(graph, 0, 4, "success").plan(posterior)
