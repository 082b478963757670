"""Plans under every draw, expectations over draws, and the value of knowing more."""

import numpy as np
import pytest
from references import walks

from trustbo.errors import TrustboError
from trustbo.inference import sample_prior
from trustbo.models import HierarchicalTrust, PooledTrust
from trustbo.planning import Planner, roll_trust
from trustbo.planning.graph import NoPathError
from trustbo.planning.objectives import OBJECTIVES
from trustbo.workspace import Workspace

N = 4


@pytest.fixture
def workspace():
    rng = np.random.default_rng(3)
    passable = np.ones((N, N), bool)
    passable[1, 1] = False
    return Workspace.from_awareness(rng.uniform(size=(2, N, N, 2)), passable)


@pytest.fixture
def draws():
    return sample_prior(PooledTrust(), 2, 200, seed=4)


def all_paths(workspace):
    return list(walks(workspace.passable.values.tolist(), (3, 0), (0, 3), 5, u_turns=False))


def terminal_trust(workspace, draws, path):
    """E[x^K] of the team under every draw, by rolling it."""
    z = workspace.awareness.values[:, *zip(*path[1:], strict=True)]
    return roll_trust(draws, np.swapaxes(z, 0, 1))[:, -1].mean(-1)


def test_regret_and_the_value_of_information_are_what_enumeration_says(workspace, draws):
    planner = Planner(workspace, (3, 0), (0, 3), "terminal")
    drawn = planner.plan_draws(draws)
    paths = all_paths(workspace)
    values = 1.0 / (
        1.0 + np.exp(-np.stack([terminal_trust(workspace, draws, p) for p in paths], 1))
    )
    np.testing.assert_allclose(drawn.values, values.max(1), rtol=1e-12)
    np.testing.assert_allclose(drawn.values_of(paths), values, rtol=1e-12)
    regret = drawn.regret(paths[0])
    np.testing.assert_allclose(regret, values.max(1) - values[:, 0], atol=1e-12)
    evpi = values.max(1).mean() - values.mean(0).max()
    # The best mean value is sought among the paths that are best under some draw.
    assert drawn.expected_value_of_information() >= evpi - 1e-12
    np.testing.assert_allclose(drawn.expected_value_of_information(), evpi, atol=1e-3)
    assert drawn.counts.sum() == 200
    assert len(drawn.candidates) == len(drawn.counts)
    winners = [paths[i] for i in values.argmax(1)]
    assert drawn.candidates[0] == max(drawn.candidates, key=winners.count)


def test_the_path_posterior_is_the_share_of_best_paths(workspace, draws):
    planner = Planner(workspace, (3, 0), (0, 3), "terminal")
    share = planner.path_posterior(draws, n_draws=None)
    count = np.zeros((N, N))
    for d in range(200):
        for cell in planner.plan(draws.draw(d)).path:
            count[cell] += 1
    np.testing.assert_allclose(share.values, count / 200)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_the_band_of_a_value_is_of_the_values_of_draws(workspace, draws, objective):
    planner = Planner(workspace, (3, 0), (0, 3), objective)
    path = planner.plan(draws.mean()).path
    if objective == "lost_contact":  # trust is not capped in it, but no path gains contact
        z = np.swapaxes(workspace.awareness.values[:, *zip(*path[1:], strict=True)], 0, 1)
        values = np.minimum(-(1.0 - roll_trust(draws, z).mean(-1)).sum(-1), 0.0)
    else:
        values = [planner.evaluate(path, draws.draw(d)).value for d in range(200)]
    assert planner.evaluate(path, draws.draw(0)).value_band is None
    np.testing.assert_allclose(
        planner.evaluate(path, draws).value_band, np.quantile(values, (0.05, 0.95)), rtol=1e-12
    )


def test_bands_are_quantiles_of_rolled_trust(workspace, draws):
    planner = Planner(workspace, (3, 0), (0, 3), "terminal")
    plan = planner.evaluate(planner.plan(draws.mean()).path, draws)
    z = np.swapaxes(workspace.awareness.values[:, *zip(*plan.path[1:], strict=True)], 0, 1)
    rolled = roll_trust(draws, z)
    np.testing.assert_allclose(plan.bands[0], np.quantile(rolled, 0.05, axis=0))
    np.testing.assert_allclose(plan.trust, rolled.mean(0))
    alone = planner.plan(draws.mean())
    np.testing.assert_allclose(alone.bands, np.repeat(alone.trust[None], 4, 0))
    team = plan.trust.mean(1)
    np.testing.assert_allclose(plan.success_index, np.prod(1.0 / (1.0 + np.exp(-team))))
    x, y = workspace.grid.center(plan.path[1])
    assert plan.positions[1].tolist() == [x, y]
    steps = np.diff(plan.positions, axis=0)
    np.testing.assert_allclose(plan.length, np.hypot(*steps.T).sum())


def test_the_summary_is_over_the_trust_maps_of_draws(workspace, draws):
    planner = Planner(workspace, (3, 0), (0, 3), "terminal")
    summary = planner.trust_summary(draws, n_draws=200)
    maps = np.stack([planner.trust_map(draws.draw(d)).values for d in range(200)])
    np.testing.assert_allclose(summary["mean"].values, maps.mean(0))
    np.testing.assert_allclose(summary["sd"].values, maps.std(0))
    np.testing.assert_allclose(summary["cost"].values, (1.0 / (1.0 + np.exp(maps))).mean(0))
    assert planner.trust_map(draws).dims == ("draw", "row", "col")


@pytest.mark.parametrize("team", ["mean", "min"])
def test_trust_maps_of_vector_trust_are_the_best_of_all_paths(workspace, team):
    draws = sample_prior(HierarchicalTrust(), 2, 200, seed=4, n_robots=2)
    planner = Planner(workspace, (3, 0), (0, 3), "terminal", team=team)
    params = draws.draw(0)
    found = planner.trust_map(params)
    passable = workspace.passable.values.tolist()
    for cell in planner.graph:
        if cell == (3, 0):
            continue
        fewest = int(planner.paths.bounds_from_start[cell])
        trusts = []
        for path in walks(passable, (3, 0), cell, fewest + 2, u_turns=False):
            z = workspace.awareness.values[:, *zip(*path[1:], strict=True)]
            last = roll_trust(params, np.swapaxes(z, 0, 1))[-1]
            trusts.append(last.mean() if team == "mean" else last.min())
        np.testing.assert_allclose(float(found[cell]), max(trusts), rtol=1e-12)


def test_onward_plans_what_is_left_from_the_trust_of_now(workspace, draws):
    planner = Planner(workspace, (3, 0), (0, 3), "terminal")
    params = draws.mean()
    plan = planner.plan(params)
    rest = planner.onward(plan.path[:2])
    again = rest.plan(params, x0=plan.trust[0])
    # Bellman: the rest of the best path is the best rest.
    assert again.path == plan.path[1:]
    np.testing.assert_allclose(again.value, plan.value, rtol=1e-12)
    np.testing.assert_allclose(
        float(rest.trust_map(params, x0=plan.trust[0])[0, 3]), plan.trust[-1].mean(), rtol=1e-12
    )
    longer = Planner(workspace, (3, 0), (0, 3), max_bounds="shortest+5")
    rest = longer.onward([(3, 0), (3, 1), (2, 1)])  # one bound of five was spent
    assert (rest.max_bounds, rest.longest, rest.paths.u_turns) == ("shortest+4", 6, False)
    with pytest.raises(TrustboError, match=r"the mission began at \(0, 0\)"):
        planner.onward([(0, 0), (1, 0)])
    with pytest.raises(TrustboError, match=r"no bound leads from \(3, 0\) to \(0, 1\)"):
        planner.onward([(3, 0), (0, 1)])
    with pytest.raises(TrustboError, match="give the cells so far, the start first"):
        planner.onward([])
    with pytest.raises(NoPathError, match=r"it takes 3 bounds, but 2 are left"):
        planner.onward([(3, 0), (2, 0), (3, 0), (2, 0)])


def test_regret_is_a_share_of_the_contact_that_the_best_path_keeps(workspace, draws):
    planner = Planner(workspace, (3, 0), (0, 3))
    drawn = planner.plan_draws(draws)
    path = planner.plan(draws.mean()).path
    for d in range(20):
        best, own = planner.plan(draws.draw(d)), planner.evaluate(path, draws.draw(d))
        kept = len(best.path) - 1 + best.value
        regret = best.value - own.value
        nothing = np.inf if regret > 1e-12 else 0.0
        expected = regret / kept if kept > 0.0 else nothing
        np.testing.assert_allclose(drawn.relative_regret(path)[d], expected, rtol=1e-9, atol=1e-12)
