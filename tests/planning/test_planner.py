"""The planner that a user holds: plans, costs and graph of bounds, draws and rests of missions."""

import networkx as nx
import numpy as np
import pytest
import xarray as xr
from dense_statespace import mission_of_params, trust_of_params
from enumeration import paths_of, value_of
from every_model import KINDS, draws_of
from missions import counted_missions
from scipy.special import expit

from trustbo.errors import TrustboError
from trustbo.hazard.components import Components
from trustbo.inference import fit, params_of, sample_prior
from trustbo.inference.place_maps import place_maps_of
from trustbo.models import PooledTrust, TrustParams
from trustbo.planning import OBJECTIVES, Planner, expected_trust
from trustbo.planning.paths import STEPS
from trustbo.simulation import ModelSimulator
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVE_NAMES

PARAMS = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
ENDS = (4, 0), (0, 5)


@pytest.fixture
def workspace():
    rng = np.random.default_rng(0)
    passable = np.ones((5, 6), bool)
    passable[2, 1:4] = False
    return Workspace.from_awareness(rng.uniform(size=(3, 5, 6, 2)), passable, cell_size=20.0)


@pytest.fixture
def draws():
    return sample_prior(PooledTrust(), 2, 200, seed=0)


def trust_along(workspace, params, path):
    """Trust of the team (..., bound) along a path, by the dense reference."""
    return trust_of_params(params, workspace.along(path), path).mean(-1)


@pytest.mark.parametrize("x0", [None, 0.3])
@pytest.mark.parametrize("kind", KINDS)
def test_expected_trust_is_the_mean_of_the_joint_normal(kind, x0):
    path = [(0, 0), (1, 1), (1, 2), (2, 1), (2, 2)]
    z = np.random.default_rng(1).uniform(size=(4, 3, 2))
    draws = draws_of(kind)
    trust = expected_trust(draws, z, x0, path=path)
    expected = trust_of_params(draws, z, path, x0=x0)
    np.testing.assert_allclose(trust, expected, rtol=1e-10)
    np.testing.assert_allclose(expected_trust(draws.draw(1), z, x0, path=path)[0], expected[1])


def test_expected_trust_of_other_features_is_refused():
    with pytest.raises(TrustboError):
        expected_trust(PARAMS, np.zeros((4, 2, 3)))


@pytest.mark.parametrize("family", ["gaussian", "censored", "beta_binomial"])
@pytest.mark.parametrize("kind", KINDS)
def test_plans_of_every_model_are_the_best_of_all_paths(kind, family):
    """Trust is that of the dense reference, and values are by their definition."""
    z = np.random.default_rng(2).uniform(size=(3, 8, 3, 3, 2))
    workspace = Workspace.from_awareness(z)
    params = draws_of(kind, shape=(3, 3)).draw(0).replace(family=family)
    one = mission_of_params(params, np.zeros((1, 3, 2)), [(0, 0), (0, 1)])
    noise_sd = np.sqrt(np.diag(one.rate_cov - one.trust_cov)).mean()
    for objective in OBJECTIVES:
        planner = Planner(workspace, (2, 0), (0, 2), objective, max_bounds="shortest+2")
        plan = planner.plan(params)
        values = {
            path: value_of(params, workspace, path, objective, family, noise_sd)
            for path in paths_of(planner)
        }
        assert len(values) > 10
        assert plan.value == pytest.approx(max(values.values()), rel=1e-9)
        assert values[plan.path] == pytest.approx(plan.value, rel=1e-9)
        trust = trust_of_params(params, workspace.along(plan.path), plan.path)
        np.testing.assert_allclose(plan.trust, trust, rtol=1e-9)


def test_a_plan_has_the_trust_and_the_value_of_its_path(workspace, draws):
    planner = Planner(workspace, *ENDS, "terminal")
    plan = planner.plan(PARAMS)
    assert (plan.path[0], plan.path[-1], plan.exact, plan.revisits) == (*ENDS, True, 0)
    assert plan.limit == plan.value == planner.evaluate(plan.path, PARAMS).value
    last = trust_along(workspace, PARAMS, plan.path)[-1]
    assert plan.value == pytest.approx(1.0 / (1.0 + np.exp(-last)), rel=1e-12)
    given, rolled = planner.evaluate(plan.path, draws), trust_along(workspace, draws, plan.path)
    np.testing.assert_allclose(given.trust.mean(1), rolled.mean(0))
    values = 1.0 / (1.0 + np.exp(-rolled[:, -1]))
    np.testing.assert_allclose(given.value_band, np.quantile(values, (0.05, 0.95)), rtol=1e-12)
    assert planner.plan(draws).path == planner.plan(draws.mean()).path
    assert planner.plan(draws).bands.shape[::2] == (4, 3)


def test_plan_of_a_posterior_reads_it_once_and_is_that_of_its_mean_and_draws(
    workspace, monkeypatch
):
    planner = Planner(workspace, *ENDS)
    simulator = ModelSimulator(workspace, PARAMS)
    missions = [simulator.run(planner.plan(PARAMS).path, seed=seed) for seed in range(2)]
    posterior = fit(missions, workspace=workspace, draws=100, progress=False)  # with all effects
    mean = planner.plan(params_of(posterior, workspace).mean())
    expected = mean.with_draws(planner.evaluate(mean.path, posterior))

    maps = []

    def counted(*arguments):
        maps.append(place_maps_of(*arguments))
        return maps[-1]

    monkeypatch.setattr("trustbo.inference.ahead.place_maps_of", counted)
    plan = planner.plan(posterior)
    assert len(maps) == 1
    assert (plan.path, plan.value) == (expected.path, expected.value)
    assert plan.value_band == expected.value_band
    np.testing.assert_array_equal(plan.bands, expected.bands)


def test_the_cost_of_a_bound_is_taken_from_the_value(workspace):
    metres = 20.0 * np.hypot(*STEPS.T)[:, None, None]
    plan = Planner(workspace, *ENDS, bound_cost=0.001 * metres).plan(PARAMS)
    free = Planner(workspace, *ENDS).evaluate(plan.path, PARAMS)
    assert plan.value == pytest.approx(free.value - 0.001 * plan.length, rel=1e-12)
    for bound_cost in (np.zeros((3, 5, 6)), np.nan):
        with pytest.raises(TrustboError, match="bound_cost"):
            Planner(workspace, *ENDS, bound_cost=bound_cost)


def test_the_graph_of_bounds_is_for_any_algorithm_of_networkx(workspace):
    p_fail = np.random.default_rng(1).uniform(0.0, 0.2, (8, 5, 6))
    planner = Planner(workspace, *ENDS, bound_cost=0.01, failure_cost=2.0).with_risk(p_fail)
    graph, plan = planner.graph(PARAMS), planner.plan(PARAMS)
    assert len(graph) == 27
    assert graph.nodes[4, 0] == {"x": 10.0, "y": 10.0}
    assert graph.edges[(4, 0), (3, 1)]["length"] == pytest.approx(20.0 * np.sqrt(2.0))
    risk = nx.path_weight(graph, plan.path, "risk")
    assert np.exp(-risk) == pytest.approx(1.0 - planner.problem.risk.failure(plan.path), rel=1e-12)
    edge = graph.edges[plan.path[:2]]
    assert edge["trust"] == pytest.approx(edge["drift"] / 0.4)
    assert edge["lost"] == pytest.approx(max(0.0, 1.0 - edge["trust"]) + 0.01)
    assert edge["cost"] == pytest.approx(edge["lost"] - 2.0 * np.expm1(-edge["risk"]))
    with pytest.raises(TrustboError, match="beta0"):
        planner.graph(PARAMS.replace(beta0=1.0))


def problem_without_memory(rng, objective, **options):
    """A planner of a random workspace, and parameters of any kind that carry nothing over."""
    n = int(rng.integers(1, 4))
    scale = rng.choice([0.3, 3.0])
    b = rng.normal(0.4, 0.3, n)
    sd = float(rng.choice([0.05, 0.4]))
    params = {
        "pooled": TrustParams(0.0, rng.normal(0.0, scale, 2), b[0], 0.1, sd),
        "deviation": TrustParams(0.6, rng.normal(0.0, scale, 2), b[0], 0.1, sd, memory="deviation"),
        "robots": TrustParams(
            np.zeros(n),
            rng.normal(0.0, scale, (n, 2)),
            b,
            np.full(n, 0.1),
            np.full(n, sd),
            per_robot=True,
        ),
        "coupled": TrustParams(
            B0=np.zeros((n, n)),
            B=rng.normal(0.0, scale, (2, n, n)),
            b=b,
            Delta_w=np.eye(n),
            Delta_v=sd**2 * np.eye(n),
        ),
    }[str(rng.choice(["pooled", "deviation", "robots", "coupled"]))]

    while True:
        shape = tuple(rng.integers(2, 6, 2).tolist())
        passable = rng.random(shape) > 0.2
        if passable.sum() < 2:
            continue
        ends = rng.choice(np.argwhere(passable), 2, replace=False).tolist()
        workspace = Workspace.from_awareness(rng.random((n, 8, *shape, 2)), passable)
        bound_cost = rng.choice([0.0, 0.2]) * rng.exponential(size=(8, *shape))
        options = {"max_bounds": passable.size} | options
        try:
            planner = Planner(workspace, *ends, objective, bound_cost=bound_cost, **options)
        except nx.NetworkXNoPath:
            continue
        return planner, params


@pytest.mark.parametrize("family", ["gaussian", "censored", "beta_binomial"])
@pytest.mark.parametrize("objective", ["lost_contact", "terminal"])
def test_without_memory_the_shortest_path_of_networkx_is_the_plan(objective, family):
    for seed in range(25):
        rng = np.random.default_rng(seed)
        planner, params = problem_without_memory(rng, objective)
        params = params.replace(family=family)
        graph, plan = planner.graph(params), planner.plan(params)
        assert min(cost for _, _, cost in graph.edges(data="cost")) >= 0.0

        path = nx.shortest_path(graph, planner.start, planner.goal, weight="cost")
        assert plan.exact
        assert planner.evaluate(path, params).value == pytest.approx(plan.value, rel=1e-9)
        score = graph.graph["constant"] - nx.path_weight(graph, path, "cost")
        value = expit(score) if objective == "terminal" else score
        assert value == pytest.approx(plan.value, rel=1e-9, abs=1e-12)


def test_the_shortest_path_of_networkx_is_at_least_as_good_as_a_plan_of_few_bounds():
    longer = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        planner, params = problem_without_memory(rng, "lost_contact", max_bounds="shortest")
        graph, plan = planner.graph(params), planner.plan(params)
        path = nx.shortest_path(graph, planner.start, planner.goal, weight="cost")
        cost = nx.path_weight(graph, path, "cost")
        if len(path) == len(plan.path):
            assert -cost == pytest.approx(plan.value, rel=1e-9, abs=1e-12)
        else:
            assert -cost > plan.value
            longer += 1
    assert longer > 0


def test_costs_of_a_mean_order_the_paths_with_the_same_number_of_bounds(workspace):
    forgetful = PARAMS.replace(beta0=0.0)
    planner = Planner(workspace, *ENDS, "mean", bound_cost=0.01, max_bounds="shortest+1")
    graph = planner.graph(forgetful)
    assert min(cost for _, _, cost in graph.edges(data="cost")) >= 0.0
    for path in paths_of(planner):
        mean = nx.path_weight(graph, path, "cost") / (len(path) - 1)
        value = planner.evaluate(path, forgetful).value
        assert graph.graph["constant"] - mean == pytest.approx(value, rel=1e-9)


def test_failures_cost_at_most_what_the_graph_says(workspace):
    forgetful = PARAMS.replace(beta0=0.0)
    p_fail = np.random.default_rng(1).uniform(0.0, 0.2, (8, 5, 6))
    planner = Planner(workspace, *ENDS, failure_cost=2.0).with_risk(p_fail)
    graph = planner.graph(forgetful)
    for path in paths_of(Planner(workspace, *ENDS, max_bounds="shortest")):
        plan = planner.evaluate(path, forgetful)
        lost = nx.path_weight(graph, path, "lost") + 2.0 * (1.0 - plan.p_arrive)
        assert lost == pytest.approx(-plan.value, rel=1e-9)
        cost = nx.path_weight(graph, path, "cost")
        assert -plan.value < cost < -plan.value + 2.0 * plan.p_fail.sum() ** 2


def test_regret_and_shares_of_cells_are_what_enumeration_says(workspace, draws):
    planner = Planner(workspace, *ENDS, "terminal")
    drawn = planner.plan_draws(draws)
    paths = paths_of(planner)
    last = np.stack([trust_along(workspace, draws, path)[:, -1] for path in paths], axis=1)
    values = 1.0 / (1.0 + np.exp(-last))
    np.testing.assert_allclose(drawn.values, values.max(1), rtol=1e-12)
    np.testing.assert_allclose(drawn.values_of(paths[:9]), values[:, :9], rtol=1e-12)
    regret = values.max(1) - values[:, 0]
    np.testing.assert_allclose(drawn.regret(paths[0]), regret, atol=1e-12)
    np.testing.assert_allclose(drawn.relative_regret(paths[0]), regret / values.max(1), atol=1e-12)
    count = np.zeros((5, 6))
    for best in values.argmax(1):
        count[tuple(np.array(paths[best]).T)] += 1
    share = planner.maps(draws)["path_probability"].fillna(0.0)
    np.testing.assert_allclose(share, count / 200)


def test_regret_of_contact_is_a_share_of_what_the_best_path_keeps(workspace, draws):
    planner = Planner(workspace, *ENDS, bound_cost=0.01)
    path = planner.plan(draws.mean()).path
    relative = planner.plan_draws(draws).relative_regret(path)
    for d in range(20):
        best, own = planner.plan(draws.draw(d)), planner.evaluate(path, draws.draw(d))
        kept = len(best.path) - 1 + best.value + 0.01 * (len(best.path) - 1)
        regret = best.value - own.value
        expected = regret / kept if kept > 0.0 else np.inf if regret > 1e-12 else 0.0
        assert relative[d] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_a_plan_avoids_bounds_unless_there_is_no_other_way(workspace):
    first = Planner(workspace, *ENDS).plan(PARAMS).path[:2]
    closed, risk = np.zeros((8, 5, 6), bool), np.zeros((8, 5, 6))
    closed[:, *first[1]] = True
    planner = Planner(workspace, *ENDS).avoiding(closed, risk)
    assert first[1] not in planner.plan(PARAMS).path
    closed[:, *ENDS[1]], risk[:, *ENDS[1]] = True, 0.5
    risk[3, *ENDS[1]], risk[4, *ENDS[1]] = 0.9, 0.2  # the least of those that lead to the goal
    assert planner.avoiding(closed, risk).plan(PARAMS).path[-2] == (0, 4)


def test_the_rest_of_the_best_path_is_the_best_rest(workspace):
    """Bellman's principle: from the cell and the trust after a bound."""
    plan = Planner(workspace, *ENDS, "terminal", max_bounds=7).plan(PARAMS)
    rest = Planner(workspace, plan.path[1], ENDS[1], "terminal", max_bounds=6)
    again = rest.plan(PARAMS, x0=plan.trust[0])
    assert again.path == plan.path[1:]
    assert again.value == pytest.approx(plan.value, rel=1e-12)


def test_what_cannot_be_planned_is_refused(workspace):
    for ends in (((5, 0), (0, 5)), ((4, 0), (0, 9)), ((2, 2), (0, 5)), ((4, 0), (4, 0))):
        with pytest.raises(TrustboError, match=r"start|goal"):
            Planner(workspace, *ends)
    for name, value in (
        ("objective", "best"), ("max_bounds", 3), ("max_bounds", 0), ("max_bounds", "long"),
        ("max_failure", 1.0), ("max_failure", True), ("failure_cost", -1.0),
    ):  # fmt: skip
        with pytest.raises(TrustboError, match=name):
            Planner(workspace, *ENDS, **{name: value})
    with pytest.raises(TrustboError, match="failure_cost"):
        Planner(workspace, *ENDS, "mean", failure_cost=1.0)
    planner = Planner(workspace, *ENDS)
    for path in ([(4, 0), (0, 5)], [(4, 0), (3, 0)], [(4, 0), "a", (0, 5)]):
        with pytest.raises(TrustboError):
            planner.evaluate(path, PARAMS)
    with pytest.raises(TrustboError, match="p_fail"):
        planner.with_risk(np.zeros((8, 3, 3)))
    with pytest.raises(TrustboError, match="p_fail"):
        planner.with_risk(np.full((8, 5, 6), np.nan)).plan(PARAMS)
    wall = np.ones((4, 4), bool)
    wall[2] = False
    apart = Workspace.from_awareness(np.full((1, 4, 4, 2), 0.5), wall)
    with pytest.raises(nx.NetworkXNoPath):
        Planner(apart, (3, 0), (0, 3))


def test_walks_that_need_too_large_a_graph_are_refused():
    workspace = Workspace.from_awareness(np.full((1, 60, 60, 1), 0.5))
    with pytest.raises(TrustboError, match="max_bounds"):
        Planner(workspace, (0, 0), (59, 59), max_bounds=50_000).plan(
            TrustParams(0.5, np.array([0.3]), 0.1, 0.1, 0.1)
        )


def test_with_a_risk_the_limit_is_on_the_states_that_know_the_bound_before(workspace, monkeypatch):
    planner = Planner(workspace, *ENDS, max_bounds=12)
    n_plain = len(planner.problem.paths.graph.cell)
    with_risk = planner.with_risk(np.full((8, 5, 6), 0.01))
    assert len(with_risk.problem.paths.committed.graph.cell) > 4 * n_plain

    monkeypatch.setattr("trustbo.planning.paths._MOST_STATES", 2 * n_plain)
    planner = Planner(workspace, *ENDS, max_bounds=12)
    planner.plan(PARAMS)
    with pytest.raises(TrustboError, match="max_bounds"):
        planner.with_risk(np.full((8, 5, 6), 0.01)).plan(PARAMS)


def test_plans_have_the_family_of_the_posterior():
    """Trust is a logit here, which must not be read as a contact rate."""
    workspace = Workspace.from_awareness(np.random.default_rng(0).uniform(size=(1, 1, 6, 2)))
    missions = counted_missions("beta_binomial", n=3)[2]
    posterior = fit(missions, PooledTrust(family="beta_binomial"), draws=100, progress=False)
    planner = Planner(workspace, (0, 0), (0, 5))
    path = tuple((0, k) for k in range(6))
    plan = planner.plan(posterior)
    lost = 1.0 - expit(plan.trust.mean(1))
    assert plan.value == pytest.approx(-lost.sum(), rel=1e-9)
    of_trust = Planner(workspace, (0, 0), (0, 5), "mean").plan(posterior)  # no rates
    assert of_trust.value == pytest.approx(plan.trust.mean(), rel=1e-9)

    draws = params_of(posterior, workspace)
    trust = planner.trust(draws, cell=(0, 3), move="e")
    rate = planner.trust(draws, cell=(0, 3), move="e", as_rate=True)
    np.testing.assert_allclose(rate, expit(trust), rtol=1e-12)
    maps = planner.robot_maps(draws).isel(y=0, x=3)
    np.testing.assert_allclose(maps["contact_rate"], rate.mean("draw"), rtol=1e-9)

    drawn = planner.plan_draws(draws)
    values = [planner.evaluate(path, draws.draw(d)).value for d in range(draws.n_draws)]
    np.testing.assert_allclose(drawn.values, values, rtol=1e-9)
    edge = planner.graph(draws).edges[(0, 2), (0, 3)]
    assert edge["lost"] == pytest.approx(1.0 - expit(edge["trust"]), rel=1e-9)


@pytest.mark.parametrize("weights", [[0.5], [1.0, 1.0], [np.nan, 1.0], [2.0, -1.0]])
def test_weights_of_components_that_are_no_shares_are_refused(workspace, weights):
    p = np.full((2, 8, 5, 6), 0.1)
    with pytest.raises(TrustboError, match="weights"):
        Planner(workspace, *ENDS).with_risk(p[0], None, Components(p, np.array(weights)))


@pytest.mark.parametrize("n_driven", [-5, 2.5])
def test_a_number_of_driven_bounds_is_whole_and_not_negative(workspace, n_driven):
    with pytest.raises(TrustboError, match="n_driven"):
        Planner(workspace, *ENDS, max_bounds=12).from_cell((3, 0), n_driven=n_driven)


def test_costs_risks_and_starts_are_read_by_name(workspace):
    rng = np.random.default_rng(1)
    values = rng.uniform(size=(8, 5, 6))
    coords = {"move": list(MOVE_NAMES), "row": range(5), "col": range(6)}
    labelled = xr.DataArray(values, coords, tuple(coords))
    turned = labelled.transpose().isel(move=slice(None, None, -1), row=[4, 0, 1, 2, 3])
    x0 = {"r3": 0.9, "r1": 0.1, "r2": 0.5}

    right = Planner(workspace, *ENDS, bound_cost=values).with_risk(0.1 * values, 0.1 * values[None])
    found = Planner(workspace, *ENDS, bound_cost=turned).with_risk(
        0.1 * turned, 0.1 * turned.expand_dims("draw", -1)
    )
    plan, expected = found.plan(PARAMS, x0=x0), right.plan(PARAMS, x0=[0.1, 0.5, 0.9])
    assert (plan.path, plan.value, plan.p_arrive) == (
        expected.path, expected.value, expected.p_arrive
    )  # fmt: skip

    of_cells = Planner(workspace, *ENDS, bound_cost=turned.isel(move=0, drop=True))
    np.testing.assert_array_equal(
        of_cells.problem.bound_cost,
        Planner(workspace, *ENDS, bound_cost=values[7]).problem.bound_cost,
    )
    of_moves = Planner(workspace, *ENDS, bound_cost=dict(zip(MOVE_NAMES, range(8), strict=True)))
    by_place = Planner(workspace, *ENDS, bound_cost=np.arange(8.0)[:, None, None])
    np.testing.assert_array_equal(of_moves.problem.bound_cost, by_place.problem.bound_cost)


def test_effects_of_places_on_another_grid_are_refused(workspace):
    with pytest.raises(TrustboError, match="map of"):
        Planner(workspace, *ENDS).plan(PARAMS.replace(place=np.zeros((1, 1, 3, 4))))


def test_options_that_are_no_maps_are_refused(workspace):
    for bound_cost in ("a", {"up": 1.0}, xr.DataArray(np.zeros((5, 6)), dims=("y", "x"))):
        with pytest.raises(TrustboError, match="bound_cost"):
            Planner(workspace, *ENDS, bound_cost=bound_cost)
    planner = Planner(workspace, *ENDS)
    for p_fail in ("a", xr.DataArray(np.zeros((5, 6)), dims=("row", "col"))):
        with pytest.raises(TrustboError, match="p_fail"):
            planner.with_risk(p_fail)
    for x0 in ("3", np.inf, [], [0.5, 0.5], {"r1": 0.5}, 1j):
        with pytest.raises(TrustboError, match="x0"):
            planner.plan(PARAMS, x0=x0)


@pytest.mark.parametrize("value", ["3", b"3", 1j, np.inf, np.nan, 1e24, np.datetime64("2026")])
@pytest.mark.parametrize("field", ["beta0", "b", "delta_v", "x0_mean"])
def test_unsafe_parameters_are_refused(field, value):
    with pytest.raises(TrustboError, match=field):
        PARAMS.replace(**{field: value})
