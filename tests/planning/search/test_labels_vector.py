"""Labels of several trusts: against all simple walks, and cut short by tolerances and limits."""

import numpy as np
import pytest
from references import walks

from trustbo.errors import TrustboError
from trustbo.models import CoupledParams, RobotParams
from trustbo.planning import Planner
from trustbo.planning.search import labels_vector
from trustbo.workspace import Workspace


def random_cells(seed, n):
    """Awareness of three robots, and passable cells with both ends among them."""
    rng = np.random.default_rng(seed)
    passable = rng.uniform(size=(n, n)) > 0.12
    passable[-1, 0] = passable[0, -1] = True
    return rng.uniform(size=(3, n, n, 2)), passable


def random_workspace(seed, n):
    return Workspace.from_awareness(*random_cells(seed, n))


def robots(seed):
    rng = np.random.default_rng(seed)
    sd = np.full(3, 0.1)
    return RobotParams(rng.uniform(0.3, 0.9, 3), rng.normal(size=(3, 2)), rng.normal(-0.3, 0.3, 3),
                       sd, sd)  # fmt: skip


def coupled(seed):
    rng = np.random.default_rng(seed)
    B0 = np.diag(rng.uniform(0.3, 0.9, 3)) + rng.normal(0.0, 0.08, (3, 3))
    b = rng.normal(-0.3, 0.3, 3)
    return CoupledParams(B0, rng.normal(size=(2, 3, 3)), b, *[np.eye(3)] * 2)


@pytest.mark.parametrize("objective", ["success", "bottleneck", "terminal", "mean"])
@pytest.mark.parametrize("team", ["mean", "min"])
def test_the_least_trust_of_unequal_robots_is_planned_best_of_all_walks(objective, team):
    for seed in range(4):
        (awareness, passable), params = random_cells(seed, 4), robots(seed)
        workspace = Workspace.from_awareness(awareness, passable)
        planner = Planner(workspace, (3, 0), (0, 3), objective, team=team, max_bounds=5)
        plan = planner.plan(params)
        paths = list(walks(passable.tolist(), (3, 0), (0, 3), 5))
        assert plan.exact
        assert plan.path in paths
        best = max(value(objective, path, awareness, params, team) for path in paths)
        np.testing.assert_allclose(plan.value, best, rtol=1e-9)


def value(objective, path, awareness, params, team):
    """Value of a path, bound by bound and robot by robot."""
    x, seen = np.full(3, params.x0_mean), []
    for row, col in path[1:]:
        u = (awareness[:, row, col] * params.beta).sum(1) + params.b
        x = params.beta0 * x + u
        seen.append(x.mean() if team == "mean" else x.min())
    sigma = 1.0 / (1.0 + np.exp(-np.array(seen)))
    return {
        "success": sigma.prod(), "bottleneck": min(seen), "terminal": sigma[-1],
        "mean": np.mean(seen),
    }[objective]  # fmt: skip


def test_a_plan_that_may_not_be_exact_says_by_how_much(monkeypatch):
    workspace = random_workspace(3, 7)
    params = robots(3)
    ends = (workspace, (6, 0), (0, 6))
    exact = Planner(*ends, "terminal", team="min", engine="numba").plan(params)
    assert exact.exact
    assert exact.bound == exact.value
    # A coarse tolerance drops labels that might have been better.
    monkeypatch.setattr(labels_vector, "_TOLERANCES", (0.5,))
    rough = Planner(*ends, "terminal", team="min", engine="numba").plan(params)
    assert rough.value <= exact.value + 1e-12 <= rough.bound + 2e-12
    assert rough.exact == (rough.bound <= rough.value + 1e-12)
    monkeypatch.setattr(labels_vector, "MAX_LABELS", 10)
    with pytest.raises(TrustboError, match="more than 10 partial paths are worth keeping; lower"):
        Planner(*ends, "terminal", team="min", engine="numba").plan(params)


def test_the_bound_holds_over_many_maps(monkeypatch):
    bounds = {}
    for tolerances in ((0.0,), (0.1,)):
        monkeypatch.setattr(labels_vector, "_TOLERANCES", tolerances)
        for seed in range(12):
            for objective in ("success", "bottleneck", "mean"):
                workspace = random_workspace(seed, 6)
                planner = Planner(
                    workspace, (5, 0), (0, 5), objective, team="min", engine="numba",
                    max_bounds=None if objective == "mean" else 8,
                )  # fmt: skip
                plan = planner.plan(coupled(seed))
                bounds.setdefault((seed, objective), []).append((plan.value, plan.bound))
    for (best, _), (value, bound) in bounds.values():
        assert value <= best + 1e-12
        assert best <= bound + 1e-9
