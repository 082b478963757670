"""The planner a user holds, its graph, its maps and the policies."""

import jax
import networkx as nx
import numpy as np
import pytest
from references import walks

from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import sample_prior
from trustbo.models import PooledTrust, TrustParams
from trustbo.planning import Planner, policies, roll_trust
from trustbo.planning.graph import NoPathError
from trustbo.planning.policies import resolve_policy
from trustbo.workspace import Workspace

PARAMS = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


@pytest.fixture
def workspace():
    rng = np.random.default_rng(0)
    passable = np.ones((5, 6), bool)
    passable[2, 1:4] = False
    return Workspace.from_awareness(rng.uniform(size=(3, 5, 6, 2)), passable, cell_size=20.0)


@pytest.fixture
def draws():
    return sample_prior(PooledTrust(), 2, 300, seed=0)


def test_the_graph_is_networkx_s_with_positions_and_lengths(workspace):
    graph = Planner(workspace, (4, 0), (0, 5)).graph
    assert isinstance(graph, nx.DiGraph)
    assert len(graph) == 27
    assert (2, 2) not in graph
    assert graph.nodes[4, 0] == {"x": 10.0, "y": 10.0}
    assert graph.edges[(4, 0), (3, 0)]["length"] == 20.0
    assert graph.edges[(4, 0), (3, 1)]["length"] == pytest.approx(20.0 * np.sqrt(2))
    assert not Planner(workspace, (4, 0), (0, 5), connectivity=4).graph.has_edge((4, 0), (3, 1))


def test_the_graph_of_costs_has_the_stationary_plan_as_its_shortest_path(workspace):
    p_fail = np.random.default_rng(1).uniform(0.0, 0.2, (8, 5, 6))
    planner = Planner(workspace, (4, 0), (0, 5), length_weight=1e-3).with_risk(p_fail)
    graph = planner.graph_of(PARAMS)
    plan = Planner(workspace, (4, 0), (0, 5), "stationary", length_weight=1e-3).plan(PARAMS)
    assert tuple(nx.dijkstra_path(graph, (4, 0), (0, 5), weight="cost")) == plan.path
    total = nx.path_weight(graph, plan.path, "cost")
    np.testing.assert_allclose(np.exp(-total), plan.value, rtol=1e-12)
    risk = nx.path_weight(graph, plan.path, "risk")
    np.testing.assert_allclose(np.exp(-risk), planner.problem.risk.survival(plan.path), rtol=1e-12)
    assert "cost" not in planner.graph.edges[plan.path[:2]]
    assert planner.with_objective("stationary").plan(PARAMS).path == plan.path
    free = PARAMS._replace(beta0=0.0)  # without memory, losses of bounds are those of the plan
    lost = Planner(workspace, (4, 0), (0, 5), length_weight=1e-3)
    best = lost.plan(free)
    total = nx.path_weight(lost.graph_of(free), best.path, "lost")
    np.testing.assert_allclose(-total, best.value, rtol=1e-12)
    assert not nx.get_edge_attributes(lost.with_objective("mean").graph_of(free), "lost")
    with pytest.raises(TrustboError, match=r"abs\(beta0\) < 1; got 1"):
        planner.graph_of(PARAMS._replace(beta0=1.0))


def test_a_plan_says_what_it_is(workspace):
    planner = Planner(workspace, (4, 0), (0, 5), "terminal")
    plan = planner.plan(PARAMS)
    assert plan.path[0] == (4, 0)
    assert plan.path[-1] == (0, 5)
    assert plan.trust.shape == (len(plan.path) - 1, 3)
    assert (plan.exact, plan.engine, plan.revisits) == (True, "numba", 0)
    assert plan.bound == plan.value == planner.evaluate(plan.path, PARAMS).value
    awareness = workspace.awareness.values[:, *zip(*plan.path[1:], strict=True)]
    np.testing.assert_allclose(plan.trust, roll_trust(PARAMS, awareness.swapaxes(0, 1)))


def test_expected_trust_follows_equation_3():
    z = np.random.default_rng(1).uniform(size=(4, 2, 2))
    trust = roll_trust(PARAMS, z, x0=0.3)
    x = np.full(2, 0.3)
    for k in range(4):
        x = 0.6 * x + z[k] @ [0.3, 0.2] + 0.05
        np.testing.assert_allclose(trust[k], x)
    many = TrustParams(*(np.stack([v, v]) for v in PARAMS[:5]), 0.3, 0.5)
    assert roll_trust(many, z).shape == (2, 4, 2)
    np.testing.assert_allclose(roll_trust(many, z)[1], trust)
    with pytest.raises(ShapeError, match="awareness has 3 features"):
        roll_trust(PARAMS, np.zeros((4, 2, 3)))


def test_the_cost_map_is_the_paper_s_f_of_the_trust_map(workspace):
    planner = Planner(workspace, (4, 0), (0, 5))
    trust, cost = planner.trust_map(PARAMS), planner.cost_map(PARAMS)
    np.testing.assert_allclose(cost, 1.0 - 1.0 / (1.0 + np.exp(-trust)))
    assert trust.dims == ("row", "col")
    assert float(trust[4, 0]) == 0.5
    per_robot = planner.cost_map(PARAMS, per_robot=True)
    assert per_robot.dims == ("robot", "row", "col")
    assert list(per_robot["robot"].values) == ["r1", "r2", "r3"]


def test_the_goal_s_trust_is_that_of_the_terminal_plan(workspace):
    planner = Planner(workspace, (4, 0), (0, 5), "terminal")
    plan = planner.plan(PARAMS)
    np.testing.assert_allclose(float(planner.trust_map(PARAMS)[0, 5]), plan.trust[-1].mean())


def test_the_path_posterior_is_a_share_of_draws(workspace, draws):
    planner = Planner(workspace, (4, 0), (0, 5))
    share = planner.path_posterior(draws, n_draws=40)
    assert float(share[4, 0]) == float(share[0, 5]) == 1.0
    assert float(share[2, 2]) == 0.0
    assert 0.0 < float(share.where(share > 0).min()) < 1.0


def test_bad_ends_are_named_with_a_remedy(workspace):
    for start, goal, message in (
        ((5, 0), (0, 5), r"start \(5, 0\) is outside the grid of 5 rows and 6 columns"),
        ((4, 0), (0, 9), r"goal \(0, 9\) is outside"),
        ((2, 2), (0, 5), r"start \(2, 2\) is impassable; the nearest passable cell is \(1, 2\)"),
        ((4, 0), (4, 0), r"start and goal are the same cell \(4, 0\)"),
    ):
        with pytest.raises(TrustboError, match=message):
            Planner(workspace, start, goal)


def test_an_unreachable_goal_says_how_far_one_gets():
    passable = np.ones((4, 4), bool)
    passable[2] = False
    workspace = Workspace.from_awareness(np.full((1, 4, 4, 2), 0.5), passable)
    with pytest.raises(
        NoPathError, match="4 of 12 passable cells can be reached from the start"
    ) as error:
        Planner(workspace, (3, 0), (0, 3))
    assert isinstance(error.value, nx.NetworkXNoPath)
    assert isinstance(error.value, ValueError)


def test_bad_options_list_the_good_ones(workspace):
    ends = (workspace, (4, 0), (0, 5))
    with pytest.raises(
        TrustboError, match="unknown objective 'best'; choose one of lost_contact, terminal"
    ):
        Planner(*ends, "best")
    with pytest.raises(TrustboError, match="connectivity must be 4 or 8; got 6"):
        Planner(*ends, connectivity=6)
    with pytest.raises(TrustboError, match="max_bounds = 3 is below the fewest possible"):
        Planner(*ends, max_bounds=3)
    with pytest.raises(
        TrustboError, match=r"unknown max_bounds 'long'; choose shortest, shortest\+n"
    ):
        Planner(*ends, max_bounds="long")
    with pytest.raises(TrustboError, match="choose one of greedy, optimistic, thompson"):
        resolve_policy("bold")
    with pytest.raises(TrustboError, match="policy must be a name or a callable; got 3"):
        resolve_policy(3)


def test_the_plan_of_draws_is_that_of_their_mean_with_their_bands(workspace, draws):
    planner = Planner(workspace, (4, 0), (0, 5))
    plan, mean = planner.plan(draws), planner.plan(draws.mean())
    assert (plan.path, plan.value, plan.exact) == (mean.path, mean.value, True)
    np.testing.assert_array_equal(plan.bands, planner.evaluate(plan.path, draws).bands)


def test_evaluating_is_for_whole_paths(workspace):
    planner = Planner(workspace, (4, 0), (0, 5))
    with pytest.raises(TrustboError, match=r"no bound leads from \(4, 0\) to \(0, 5\)"):
        planner.evaluate([(4, 0), (0, 5)], PARAMS)
    with pytest.raises(TrustboError, match=r"must lead from \(4, 0\) to \(0, 5\)"):
        planner.evaluate([(4, 0), (3, 0)], PARAMS)


def test_random_walks_long_corridors(draws):
    workspace = Workspace.from_awareness(np.full((1, 1, 600, 2), 0.5))
    planner = Planner(workspace, (0, 0), (0, 599))
    assert len(policies.random(jax.random.key(0), draws, planner).path) == 600


def test_random_draws_every_admissible_path_equally_often(draws):
    workspace = Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))
    planner = Planner(workspace, (2, 0), (0, 2), "terminal")
    admissible = list(walks(np.ones((3, 3), bool).tolist(), (2, 0), (0, 2), 4, u_turns=False))
    n_draws = 2000
    counts = dict.fromkeys(admissible, 0)
    for i in range(n_draws):
        counts[policies.random(jax.random.key(i), draws, planner).path] += 1
    expected = n_draws / len(admissible)
    chi2 = sum((count - expected) ** 2 / expected for count in counts.values())
    assert sum(counts.values()) == n_draws
    # Chi-squared with n - 1 degrees of freedom: mean n - 1, sd sqrt(2 (n - 1)); 4 of these.
    n = len(admissible) - 1
    assert chi2 < n + 4 * np.sqrt(2 * n)
