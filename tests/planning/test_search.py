"""Plans against all admissible paths written out, against networkx, and by closed forms."""

import functools
import pickle
from dataclasses import replace

import jax.numpy as jnp
import networkx as nx
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from enumeration import paths_of
from fuzz_plans import draw_problem, faults
from peers import networkx_planner
from peers.every_path import TooManyError, best_walk
from peers.networkx_planner import network_of

from trustbo.errors import TrustboError
from trustbo.hazard.components import Components
from trustbo.inference.learner import learner_of
from trustbo.models import ContactRate, TrustParams
from trustbo.planning import OBJECTIVES, InfeasibleError, Planner
from trustbo.planning.objectives import Objective
from trustbo.workspace import Workspace
from trustbo.workspace.moves import bounds_along

PARAMS = TrustParams(0.6, np.array([0.8, 0.4]), -0.3, 0.1, 0.1)
ENDS = (3, 0), (0, 3)


@pytest.fixture(scope="module")
def workspace():
    passable = np.ones((4, 4), bool)
    passable[1, 1] = False
    z = np.random.default_rng(3).uniform(size=(2, 8, 4, 4, 2))
    return Workspace.from_awareness(z, passable, cell_size=20.0)


def random_problems(seed, n, most):
    """Random problems with their best score, by all paths written out."""
    found = []
    while len(found) < n:
        drawn = draw_problem(rng := np.random.default_rng([seed, len(found)]))
        while True:
            try:
                best, _ = best_walk(drawn[2], most)
            except TooManyError:
                best = np.nan
            if not np.isnan(best):
                break
            drawn = draw_problem(rng)
        found.append((*drawn, best))
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.filterwarnings("ignore:Mean of empty slice")
def test_plans_are_the_best_of_all_paths_written_out(seed):
    for planner, params, world, best in random_problems(seed, 40, 30_000):
        assert faults(planner, params, world, best) == ([], True)


@pytest.mark.parametrize("seed", [9, 10])
@pytest.mark.filterwarnings("ignore:Mean of empty slice")
def test_networkx_finds_plans_of_the_same_value(seed):
    refused = 0
    for planner, params, _, best in random_problems(seed, 50, 500):
        if planner.workspace.onward is not None:  # networkx has no pairs of bounds
            continue
        if best == -np.inf:
            with pytest.raises(InfeasibleError) as expected:
                networkx_planner.plan(planner, params)
            with pytest.raises(InfeasibleError) as error:
                planner.plan(params)
            assert error.value.p_fail == pytest.approx(expected.value.p_fail, rel=1e-9)
            refused += 1
            continue

        x0 = None if planner.workspace.team.n_robots < 3 else [0.9, -0.3, 0.2]
        expected = networkx_planner.plan(planner, params, x0=x0)
        plan = planner.plan(params, x0=x0)
        assert plan.value == pytest.approx(expected.value, rel=1e-9, abs=1e-9)
        assert expected.exact
        assert expected.limit == expected.value
    assert refused > 0


@functools.cache
def draws_of_function(workspace, by_robot):
    """Prior draws of a NumPyro function, which is compiled once."""

    def model(awareness, contact_rate=None):
        weight = dist.HalfNormal(0.5).expand([2]).to_event(1)
        most = numpyro.sample("most", weight if by_robot else dist.HalfNormal(0.5))
        fading = dist.Beta(2.0, 2.0).expand([2]).to_event(1)
        beta0 = numpyro.sample("beta0", fading if by_robot else dist.Beta(2.0, 2.0))
        drift = most * (1.0 - jnp.exp(-2.0 * awareness[..., 1]))
        with numpyro.plate("mission", len(drift)):
            rates = ContactRate(drift, beta0, 0.1, 0.1)
            numpyro.sample("contact_rate", rates, obs=contact_rate)

    return learner_of(model, workspace).prior_draws(20, 0, workspace)


@pytest.mark.parametrize(
    "options",
    [
        {}, {"objective": "terminal"}, {"objective": "mean", "max_bounds": 5},
        {"family": "censored"}, {"family": "beta_binomial", "max_bounds": "shortest"},
        {"max_failure": 0.2, "failure_cost": 3.0}, {"objective": "mean", "max_failure": 0.2},
    ],
)  # fmt: skip
@pytest.mark.parametrize("by_robot", [False, True])
def test_networkx_finds_plans_of_functions(workspace, options, by_robot):
    """With and without weights of each robot."""
    options = dict(options)
    family = options.pop("family", "gaussian")
    draws = replace(draws_of_function(workspace, by_robot), family=family)
    planner = Planner(workspace, *ENDS, **options)
    if "max_failure" in options:
        planner = planner.with_risk(np.random.default_rng(0).uniform(0.0, 0.1, (8, 4, 4)))
    expected, plan = networkx_planner.plan(planner, draws), planner.plan(draws)
    assert plan.exact
    assert plan.value == pytest.approx(expected.value, rel=1e-9)
    assert plan.value_band == pytest.approx(expected.value_band, rel=1e-9)
    np.testing.assert_allclose(plan.bands, expected.bands, rtol=1e-9)


@pytest.mark.parametrize("max_bounds", ["shortest", "shortest+2", 5])
def test_the_unrolled_graph_has_every_admissible_path(workspace, max_bounds):
    planner = Planner(workspace, *ENDS, max_bounds=max_bounds)
    paths = planner.problem.paths
    graph = network_of(paths.graph, np.zeros(len(paths.graph.head)))
    assert nx.is_directed_acyclic_graph(graph)
    found = set()
    for s in paths.graph.starts.tolist():
        start = (None, int(paths.graph.cell[s]), int(paths.graph.n_bounds_left[s]))
        for nodes in nx.all_simple_paths(graph, start, "goal"):
            cells = np.array([node[1] for node in nodes[:-1]])
            found.add((*paths.cells(cells), paths.goal))
    assert found == set(paths_of(planner))
    assert max_bounds == "shortest" or len(found) > 3


def test_a_new_objective_is_a_row(workspace, monkeypatch):
    """Trust discounted by the bounds that are left, by its definition on every path."""
    row = Objective("late", credit=lambda left: 0.7**left, scale=lambda n_bounds: n_bounds + 1.0)
    monkeypatch.setitem(OBJECTIVES, "late", row)
    bound_cost = np.random.default_rng(1).uniform(0.0, 0.2, (8, 4, 4))
    planner = Planner(workspace, *ENDS, "late", bound_cost=bound_cost)
    values = []
    for path in paths_of(planner):
        plan = planner.evaluate(path, PARAMS)
        trust = plan.trust.mean(1)
        n = len(trust)
        paid = planner.problem.bound_cost_along(path)
        values.append(
            (sum(0.7 ** (n - k) * trust[k - 1] for k in range(1, n + 1)) - paid) / (n + 1)
        )
        assert plan.value == pytest.approx(values[-1], rel=1e-12)
    assert planner.plan(PARAMS).value == pytest.approx(max(values), rel=1e-12)
    limited = Planner(workspace, *ENDS, "late", bound_cost=bound_cost, max_failure=0.99)
    limited = limited.with_risk(np.full((8, 4, 4), 0.01))
    assert limited.plan(PARAMS).value == pytest.approx(max(values), rel=1e-12)


def test_bounds_that_fail_together_are_priced_as_one_failure(workspace):
    """Half of the draws fail every bound: a price of F / 2, whatever the number of bounds."""
    p = np.array([0.0, 1.0])[:, None, None, None] * np.ones((8, 4, 4))
    planner = Planner(workspace, *ENDS, failure_cost=8.0)
    plan = planner.with_risk(p.mean(0), None, Components(p, np.array([0.5, 0.5]))).plan(PARAMS)
    free = planner.with_failure_cost(0.0).plan(PARAMS)
    assert plan.value == pytest.approx(free.value - 4.0, rel=1e-12)
    assert planner.with_failure_cost(0.0).with_risk(p.mean(0)).plan(PARAMS).path == plan.path


def test_an_infeasible_limit_is_an_error_with_the_safest_path(workspace):
    p = np.random.default_rng(2).uniform(0.05, 0.3, (8, 4, 4))
    planner = Planner(workspace, *ENDS, max_failure=0.1).with_risk(p)
    risk = planner.problem.risk
    failure = {path: risk.failure(path) for path in paths_of(planner)}
    with pytest.raises(InfeasibleError, match="max_failure") as error:
        planner.plan(PARAMS)
    assert error.value.path == min(failure, key=failure.get)
    assert error.value.p_fail == pytest.approx(min(failure.values()), rel=1e-9)
    copied = pickle.loads(pickle.dumps(error.value))  # as from a worker process
    assert (str(copied), copied.path) == (str(error.value), error.value.path)
    assert copied.p_fail == error.value.p_fail
    assert planner.evaluate(error.value.path, PARAMS).infeasible
    assert planner.maps(PARAMS)["path_probability"].sum() == len(error.value.path)
    with pytest.raises(TrustboError, match="max_failure"):
        Planner(workspace, *ENDS, max_failure=0.1).plan(PARAMS)  # without a risk


@pytest.mark.parametrize("objective", ["lost_contact", "terminal"])
def test_the_limit_holds_for_bounds_that_fail_together(workspace, objective):
    """The failure probability is averaged over components, by enumeration of all paths."""
    rng = np.random.default_rng(4)
    without_risk = Planner(workspace, *ENDS, objective)
    paths = paths_of(without_risk)
    index = [(slice(None), *bounds_along(path).T) for path in paths]
    of_trust = np.array([without_risk.evaluate(path, PARAMS).value for path in paths])
    # By default, a failure costs the bounds of the shortest path, if contact is lost in bounds.
    cost = 3.0 if objective == "lost_contact" else 0.0
    refused = 0
    changed = 0

    for _ in range(60):
        weights = rng.dirichlet(np.ones(3))
        severity = rng.uniform(0.0, 1.0, (3, 1, 1, 1))
        p = severity * rng.uniform(0.0, 0.6, (3, 8, 4, 4))
        limit = rng.uniform(0.1, 0.6)
        planner = Planner(workspace, *ENDS, objective, max_failure=limit)
        planner = planner.with_risk(np.tensordot(weights, p, 1), None, Components(p, weights))

        failure = np.array([weights @ (1.0 - np.prod(1.0 - p[i], axis=1)) for i in index])
        values = of_trust - cost * failure
        if failure.min() > limit:
            refused += 1
            with pytest.raises(InfeasibleError) as error:
                planner.plan(PARAMS)
            assert error.value.stations == paths[failure.argmin()]
            assert error.value.p_fail == pytest.approx(failure.min(), rel=1e-9)
            continue

        allowed = np.where(failure <= limit, values, -np.inf)
        changed += values.argmax() != allowed.argmax()
        assert planner.plan(PARAMS).value == pytest.approx(allowed.max(), rel=1e-9)
    assert refused > 1
    assert changed > 1


def test_a_search_that_is_cut_short_keeps_the_limit_and_says_what_could_be_better(monkeypatch):
    rng, cut = np.random.default_rng(3), 0
    for _ in range(4):
        workspace = Workspace.from_awareness(rng.uniform(size=(1, 8, 12, 12, 2)))
        planner = Planner(workspace, (11, 0), (0, 11), max_failure=0.3)
        planner = planner.with_risk(rng.uniform(0.0, 0.05, (8, 12, 12)))
        whole = planner.plan(PARAMS)
        monkeypatch.setattr("trustbo.planning.labels.MAX_LABELS", 9)
        plan = planner.plan(PARAMS)
        monkeypatch.undo()
        assert whole.exact
        assert not plan.infeasible
        assert plan.value <= whole.value + 1e-9 <= plan.limit + 2e-9
        cut += not plan.exact
    assert cut > 0


def test_draws_are_planned_as_one_by_one(workspace):
    rng = np.random.default_rng(0)
    draws = TrustParams(
        rng.uniform(0.2, 0.8, 70), rng.normal(size=(70, 2)), rng.normal(size=70), np.full(70, 0.1),
        np.full(70, 0.1),
    )  # fmt: skip
    p = rng.uniform(0.0, 0.1, (8, 4, 4))
    for family, options in (
        ("gaussian", {}), ("censored", {}), ("gaussian", {"objective": "mean", "max_failure": 0.5})
    ):  # fmt: skip
        draws = draws.replace(family=family)
        planner = Planner(workspace, *ENDS, **options).with_risk(p)
        alone = [planner.plan(draws.draw(d)).value for d in range(70)]
        np.testing.assert_allclose(planner.plan_draws(draws).values, alone, rtol=1e-9)


def test_objectives_of_contact_need_memory_that_is_not_negative(workspace):
    for family in ("gaussian", "censored"):
        forgetful = PARAMS.replace(beta0=-0.2, family=family)
        with pytest.raises(TrustboError, match="beta0"):
            Planner(workspace, *ENDS).plan(forgetful)
    assert Planner(workspace, *ENDS, "mean").plan(forgetful).exact


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_of_equally_good_paths_a_shortest_is_planned(workspace, objective):
    params = TrustParams(0.0, np.zeros(2), 1.0, 0.1, 0.1)  # the same trust after every bound
    planner = Planner(workspace, *ENDS, objective=objective, max_bounds="shortest+3")
    assert len(planner.plan(params).path) == 4


def test_contact_that_is_lost_depends_on_all_noise_of_a_rate():
    """Censored rates depend on the sd of the noise, whether robots share the noise or not."""
    rng = np.random.default_rng(0)
    workspace = Workspace.from_awareness(
        rng.uniform(size=(2, 3, 3, 1)), features=("line_of_sight",)
    )
    planner = Planner(workspace, (0, 0), (2, 2), objective="lost_contact")
    shared = TrustParams(0.5, np.array([0.4]), 0.3, 0.05, 0.1, delta_s=0.3, family="censored")
    own = TrustParams(0.5, np.array([0.4]), 0.3, 0.05, np.hypot(0.1, 0.3), family="censored")

    path = [(0, 0), (1, 1), (2, 2)]
    values = [planner.evaluate(path, params).value for params in (shared, own)]
    assert values[0] == pytest.approx(values[1], rel=1e-12)
