"""The policies, against brute force over all admissible paths."""

import jax
import numpy as np
import pytest
from references import of_bounds, path_values, walks

from trustbo.errors import TrustboError
from trustbo.inference import sample_prior
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, TrustParams
from trustbo.planning import POLICIES, Planner, policies
from trustbo.planning.dynamics import drift
from trustbo.planning.policies import resolve_policy
from trustbo.workspace import Workspace

ENDS = ((3, 0), (0, 3))
N_DRAWS = 60


@pytest.fixture
def workspace():
    rng = np.random.default_rng(0)
    passable = np.ones((4, 4), bool)
    passable[1, 1] = False
    return Workspace.from_awareness(rng.uniform(size=(2, 8, 4, 4, 2)), passable)


@pytest.fixture
def planner(workspace):
    return Planner(workspace, *ENDS, "terminal")


def prior_draws(model=None, n_draws=N_DRAWS):
    return sample_prior(model or PooledTrust(), 2, n_draws, seed=1, n_robots=2)


def brute_force(planner, draws, objective="terminal"):
    """Every admissible path, and its value under every draw, shape (draw, path)."""
    passable = planner.workspace.passable.values.tolist()
    paths = list(walks(passable, *ENDS, planner.longest, u_turns=False))
    n_cells = np.array([len(path) for path in paths])
    flat = np.zeros((len(paths), n_cells.max()), int)
    for i, path in enumerate(paths):
        flat[i, : len(path)] = [4 * row + col for row, col in path]
    values = []
    for d in range(draws.leading[0]):
        one = draws.draw(d)
        u = of_bounds(drift(one, planner.workspace.bound_maps))
        values.append(path_values(objective, flat, n_cells, u, one.beta0 * np.eye(2), one.x0_mean))
    return paths, np.stack(values)


@pytest.mark.parametrize("objective", ["terminal", "mean", "success"])
def test_ucb_takes_the_best_of_the_paths_that_are_best_under_a_draw(objective, workspace):
    options = {} if objective != "success" else {"max_bounds": "shortest+2"}
    planner, draws = Planner(workspace, *ENDS, objective, **options), prior_draws()
    paths, values = brute_force(planner, draws, objective)
    candidates = np.unique(values.argmax(1))
    assert len(candidates) > 1
    score = values[:, candidates].mean(0) + values[:, candidates].std(0)
    plan = policies.ucb(jax.random.key(0), draws, planner)
    np.testing.assert_allclose(
        score[candidates.tolist().index(paths.index(plan.path))], score.max(), rtol=1e-9
    )


def test_ucb_weighs_mean_against_spread_as_told(planner):
    draws, key = prior_draws(), jax.random.key(0)
    paths, values = brute_force(planner, draws)
    values = values[:, np.unique(values.argmax(1))]
    best = values.mean(0).max()
    calm = policies.ucb(key, draws, planner, kappa=0.0)
    of = {path: v for path, v in zip(paths, brute_force(planner, draws)[1].T, strict=True)}
    np.testing.assert_allclose(of[calm.path].mean(), best, rtol=1e-12)
    bold = policies.ucb(key, draws, planner, kappa=100.0)
    assert of[bold.path].std() >= of[calm.path].std()


@pytest.mark.parametrize(
    ("model", "objective"),
    [
        (PooledTrust(), "success"),
        (PooledTrust(), "stationary"),
        (HierarchicalTrust(), "terminal"),
        (CoupledTrust(), "terminal"),
    ],
)
@pytest.mark.parametrize("name", list(POLICIES))
def test_every_policy_plans_an_admissible_path_and_repeats_it(name, model, objective, workspace):
    planner, draws = Planner(workspace, *ENDS, objective), prior_draws(model)
    plans = [POLICIES[name](jax.random.key(2), draws, planner) for _ in range(2)]
    assert planner.require_path(plans[0].path) == plans[0].path
    if objective == "terminal":
        assert len(plans[0].path) - 1 <= planner.shortest + 2
    assert plans[0].path == plans[1].path
    # What it says of the path is under the posterior mean, whatever it was chosen by.
    mean = planner.evaluate(plans[0].path, draws.mean())
    np.testing.assert_allclose(plans[0].trust, mean.trust)


def test_greedy_is_the_best_under_the_mean_and_thompson_under_single_draws(planner):
    draws = prior_draws()
    paths, values = brute_force(planner, draws)
    greedy = policies.greedy(jax.random.key(0), draws, planner)
    assert greedy.path == planner.plan(draws.mean()).path
    best = {paths[i] for i in values.argmax(1)}
    drawn = {policies.thompson(jax.random.key(i), draws, planner).path for i in range(40)}
    assert drawn <= best
    assert len(drawn) > 3


def test_optimistic_is_greedy_at_the_median_of_one_draw_and_bolder_above(planner):
    one = prior_draws(n_draws=1)
    plan = policies.optimistic(jax.random.key(0), one, planner, quantile=0.5)
    assert plan.path == policies.greedy(jax.random.key(0), one, planner).path
    assert plan.value == planner.plan(one.draw(0)).value
    # Two draws that differ in the weight alone: above the median, the one with more counts.
    weights = np.array([[0.0, 0.0], [0.9, 0.0]])
    half = np.full(2, 0.5)
    two = TrustParams(half, weights, np.zeros(2), half, half)
    bold = policies.optimistic(jax.random.key(0), two, planner, quantile=1.0)
    assert bold.path == planner.plan(two.draw(1)).path


def test_optimistic_is_drawn_to_cells_it_knows_nothing_of(workspace):
    """Corridors alike on average, of which one is uncertain."""
    z = np.full((1, 3, 5, 1), 0.5)
    passable = np.ones((3, 5), bool)
    passable[1, 1:4] = False
    known = Workspace.from_awareness(z, passable)
    planner = Planner(known, (1, 0), (1, 4), "mean", connectivity=4)
    place = np.zeros((50, 1, 3, 5))
    place[:, 0, 2, 1:4] = np.linspace(-0.2, 0.195, 50)[:, None]
    one = TrustParams(0.5, np.array([0.5]), 0.0, 0.1, 0.1)
    draws = TrustParams(*(np.stack([np.asarray(v)] * 50) for v in one[:5]), place=place)
    assert (0, 2) in policies.greedy(jax.random.key(0), draws, planner).path
    assert (2, 2) in policies.optimistic(jax.random.key(0), draws, planner).path


def test_random_ignores_what_was_learned(planner):
    paths = [
        [policies.random(jax.random.key(i), draws, planner).path for i in range(5)]
        for draws in (prior_draws(), prior_draws(n_draws=3))
    ]
    assert paths[0] == paths[1]
    assert len(set(paths[0])) > 1


def test_policies_have_names_and_can_be_one_s_own():
    assert next(iter(POLICIES)) == "greedy"
    for name, policy in POLICIES.items():
        assert resolve_policy(name) is policy is getattr(policies, name)
        assert policy.__doc__
    own = lambda key, posterior, planner: planner.plan(posterior.mean())  # noqa: E731
    assert resolve_policy(own) is own
    with pytest.raises(TrustboError, match="unknown policy 'bold'; choose one of greedy"):
        resolve_policy("bold")
    with pytest.raises(TrustboError, match="policy must be a name or a callable; got None"):
        resolve_policy(None)


def test_random_paths_respect_max_failure(workspace):
    p_fail = np.random.default_rng(1).uniform(0.0, 0.25, (8, 4, 4))
    planner = Planner(workspace, *ENDS, "terminal", max_failure=0.45).with_risk(p_fail)
    free = Planner(workspace, *ENDS, "terminal").with_risk(p_fail)
    chosen, without = (
        [policies.random(jax.random.key(i), prior_draws(), which) for i in range(20)]
        for which in (planner, free)
    )
    assert max(1.0 - plan.p_arrive for plan in chosen) <= 0.45
    assert len({plan.path for plan in chosen}) > 1
    assert max(1.0 - plan.p_arrive for plan in without) > 0.45


def test_a_random_path_is_greedy_s_where_next_to_none_keeps_the_limit(workspace):
    """Only one path, of thousands, is free of risk; walks drawn at random miss it."""
    path, p_fail = ((3, 0), (3, 1), (3, 2), (3, 3), (2, 3), (1, 3), (0, 3)), np.ones((8, 4, 4))
    p_fail[4, 3, 1:], p_fail[1, :3, 3] = 0.0, 0.0
    planner = Planner(workspace, *ENDS, "terminal", max_bounds="shortest+4", max_failure=0.1)
    plan = policies.random(jax.random.key(0), prior_draws(), planner.with_risk(p_fail))
    assert plan.path == path
