"""The policies, against all admissible paths under every draw."""

import numpy as np
import pytest
from enumeration import paths_of

from trustbo.errors import TrustboError
from trustbo.inference import sample_prior
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, TrustParams
from trustbo.planning import POLICIES, Planner, policies
from trustbo.planning.policies import resolve_policy
from trustbo.workspace import Workspace

ENDS = (3, 0), (0, 3)


@pytest.fixture
def workspace():
    z = np.random.default_rng(2).uniform(size=(2, 4, 4, 2))
    return Workspace.from_awareness(z)


def prior_draws(model=None, n_draws=60):
    return sample_prior(model or PooledTrust(), 2, n_draws, seed=1, n_robots=2)


def rng(seed=0):
    return np.random.default_rng(seed)


def values_of_all(planner, draws):
    """Every admissible path, and its value under every draw, shape (draw, path)."""
    paths = paths_of(planner)
    return paths, planner.plan_draws(draws).values_of(paths)


@pytest.mark.parametrize("objective", ["terminal", "mean", "lost_contact"])
@pytest.mark.parametrize("kappa", [0.0, 1.0, 100.0])
def test_ucb_takes_the_best_bound_of_the_paths_that_are_best_under_a_draw(
    objective, kappa, workspace
):
    planner, draws = Planner(workspace, *ENDS, objective, max_bounds="shortest+2"), prior_draws()
    paths, values = values_of_all(planner, draws)
    candidates = np.unique(values.argmax(1))
    score = values[:, candidates].mean(0) + kappa * values[:, candidates].std(0)
    plan = policies.ucb(rng(), draws, planner, kappa=kappa)
    chosen = values[:, paths.index(plan.path)]
    assert len(candidates) > 1
    assert chosen.mean() + kappa * chosen.std() == pytest.approx(score.max(), rel=1e-9)


@pytest.mark.parametrize("model", [PooledTrust(), HierarchicalTrust(), CoupledTrust()])
@pytest.mark.parametrize("name", list(POLICIES))
def test_every_policy_plans_an_admissible_path_and_repeats_it(name, model, workspace):
    planner, draws = Planner(workspace, *ENDS, "terminal"), prior_draws(model)
    plan, again = (resolve_policy(name)(rng(2), draws, planner) for _ in range(2))
    assert planner.require_path(plan.path) == plan.path == again.path
    mean = planner.evaluate(plan.path, draws.mean())
    np.testing.assert_allclose(plan.trust, mean.trust)


def test_greedy_is_the_best_under_the_mean_and_thompson_under_single_draws(workspace):
    planner, draws = Planner(workspace, *ENDS, "terminal"), prior_draws()
    paths, values = values_of_all(planner, draws)
    assert policies.greedy(rng(), draws, planner).path == planner.plan(draws.mean()).path
    best = {paths[i] for i in values.argmax(1)}
    drawn = {policies.thompson(rng(seed), draws, planner).path for seed in range(40)}
    assert drawn <= best
    assert len(drawn) > 3


def test_thompson_plans_for_one_draw_of_any_chain(workspace):
    planner, draws = Planner(workspace, *ENDS, "terminal"), prior_draws()
    of_chains = {name: v.reshape(3, 20, *v.shape[1:]) for name, v in draws.values.items()}
    chains = draws.replace(**of_chains)
    assert chains.n_draws == 60
    for seed in range(5):
        expected = policies.thompson(rng(seed), draws, planner)
        assert policies.thompson(rng(seed), chains, planner).path == expected.path

    alone = policies.thompson(rng(), draws.draw(0), planner)
    assert alone.path == planner.plan(draws.draw(0)).path


def test_optimistic_is_drawn_to_cells_it_knows_nothing_of():
    """Corridors alike on average, of which one is uncertain."""
    passable = np.ones((3, 5), bool)
    passable[1, 1:4] = False
    known = Workspace.from_awareness(np.full((1, 3, 5, 1), 0.5), passable)
    planner = Planner(known, (1, 0), (1, 4), "mean")
    place = np.zeros((50, 1, 3, 5))
    place[:, 0, 2, 1:4] = np.linspace(-0.2, 0.195, 50)[:, None]
    draws = TrustParams(0.5, np.array([0.5]), 0.0, 0.1, 0.1, place=place)
    assert (0, 2) in policies.greedy(rng(), draws, planner).path
    assert (2, 2) in policies.optimistic(rng(), draws, planner).path
    median = policies.optimistic(rng(), draws.draw(slice(0, 1)), planner, quantile=0.5)
    assert median.path == planner.plan(draws.draw(0)).path


def test_explore_leaves_a_path_that_repeats_only_in_doubt(workspace):
    planner = Planner(workspace, *ENDS, "mean", max_bounds="shortest+2")
    draws = prior_draws(HierarchicalTrust())
    best = policies.greedy(rng(), draws, planner).path
    other = policies.ucb(rng(), draws, planner).path
    doubt = np.mean(planner.plan_draws(draws).relative_regret(best) > 0.02)
    assert best != other
    assert 0.1 < doubt < 0.999

    def explored(driven, **options):
        return policies.explore(rng(), draws, planner, driven=driven, **options).path

    assert explored([other, best, best]) == other
    assert explored([best, best], doubt=0.999) == best
    for driven in ([], [best], [best, other], [best, other, best]):
        assert explored(driven) == best
    for same in ([[list(cell) for cell in best]] * 2, [np.array(best)] * 2):
        assert explored(same) == explored([best, best]) != best


def test_random_paths_ignore_what_was_learned_and_keep_the_limit(workspace):
    planner = Planner(workspace, *ENDS)
    paths = [
        [policies.random(rng(seed), draws, planner).path for seed in range(30)]
        for draws in (prior_draws(), prior_draws(n_draws=3))
    ]
    assert paths[0] == paths[1]
    assert len(set(paths[0])) > 10
    at_goal = Planner(workspace, *ENDS, "terminal")  # all bounds count, not the last one alone
    assert len({policies.random(rng(k), prior_draws(), at_goal).path for k in range(30)}) > 10
    p_fail = rng(1).uniform(0.0, 0.25, (8, 4, 4))
    limited = Planner(workspace, *ENDS, "terminal", max_failure=0.45).with_risk(p_fail)
    plans = [policies.random(rng(seed), prior_draws(), limited) for seed in range(20)]
    assert not any(plan.infeasible for plan in plans)
    assert len({plan.path for plan in plans}) > 1


def test_policies_have_names_and_can_be_one_s_own():
    own = lambda rng, params, planner: planner.plan(params.mean())  # noqa: E731
    assert next(iter(POLICIES)) == "explore"
    assert resolve_policy(own) is own
    for wrong in ("bold", None):
        with pytest.raises(TrustboError, match="policy"):
            resolve_policy(wrong)
