"""Baselines of the benchmark: each against enumeration, a hand formula or a closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from baselines import line_of_sight, oracle, paths, residual_process, running_mean
from enumeration import paths_of

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.hazard.components import Components
from trustbo.planning import Planner
from trustbo.simulation import Degradation, KinematicSimulator, Truth
from trustbo.workspace.moves import MOVES, bounds_along

START, GOAL = (3, 0), (0, 3)
LEARNERS = [
    line_of_sight.LineOfSight,
    running_mean.greedy,
    running_mean.optimistic,
    residual_process.ResidualProcess,
]


@pytest.fixture(scope="module")
def workspace():
    terrain = tb.terrain.synthetic_terrain((80.0, 80.0), seed=3, relief=5.0)
    return tb.Workspace.from_terrain(terrain, (4, 4), n_posts=1)


@pytest.fixture(scope="module")
def planner(workspace):
    return Planner(workspace, START, GOAL, max_bounds="shortest+2")


def mission_of(planner, path, rates, n_driven=None):
    """Mission with these rates of its bounds, the same of all robots."""
    rates = np.repeat(np.asarray(rates, float)[:n_driven, None], 3, axis=1)
    z = np.full((*rates.shape, len(planner.workspace.features)), 0.5)
    status = "ok" if n_driven is None else "stuck"
    return Mission.from_arrays(path, z, rates, np.ones(len(rates)), status)


def rates_along(table, path):
    return table[tuple(bounds_along(path).T)]


@pytest.mark.parametrize("objective", ["lost_contact", "mean"])
def test_best_paths_are_admissible_and_the_best_under_their_rates(planner, objective):
    planner = Planner(planner.workspace, START, GOAL, objective, max_bounds="shortest+2")
    walks, rng = paths_of(planner), np.random.default_rng(0)
    sight = paths.line_of_sight(planner)
    tables = np.clip(sight + rng.normal(0.0, 0.2, (40, *sight.shape)), 0.0, 1.0)
    chosen = paths.best_paths(planner, tables)
    assert set(chosen) <= set(walks)
    for table, path in zip(tables, chosen, strict=True):
        values = [paths.value(planner, rates_along(table, walk)) for walk in walks]
        assert paths.value(planner, rates_along(table, path)) == pytest.approx(max(values))
    assert len(set(chosen)) > 5


def test_best_paths_pay_for_failures_what_plans_pay(planner):
    """Against enumeration: the most contact less the cost of a failure times its probability."""
    rng = np.random.default_rng(0)
    sight = paths.line_of_sight(planner)
    exists = planner.workspace.difficulty.exists
    groups = np.where(exists, rng.beta(0.5, 3.0, (2, *exists.shape)), np.nan)
    mixed = Components(groups, np.array([0.7, 0.3]))  # bounds fail together, not independently
    free = planner.with_risk(0.7 * groups[0] + 0.3 * groups[1], components=mixed)
    walks = paths_of(planner)

    chosen = {}
    for cost in (0.0, 0.5, 6.0):
        priced = free.with_failure_cost(cost)
        tables = np.clip(sight + rng.normal(0.0, 0.1, (10, *sight.shape)), 0.0, 1.0)
        tables[0] = sight
        for table, path in zip(tables, paths.best_paths(priced, tables), strict=True):
            values = [
                paths.value(planner, rates_along(table, walk))
                - cost * priced.problem.risk.failure(walk)
                for walk in walks
            ]
            assert path in walks
            assert values[walks.index(path)] == pytest.approx(max(values))
        chosen[cost] = paths.best_paths(priced, sight[None])[0]
    assert chosen[0.0] == paths.best_paths(planner, sight[None])[0] != chosen[6.0]


def test_line_of_sight_is_the_mean_over_robots_of_the_workspace_s_feature(planner):
    feature = planner.workspace.awareness.sel(feature="line_of_sight").values
    table = paths.line_of_sight(planner)
    there = np.isfinite(table)
    np.testing.assert_allclose(table[there], feature.mean(0)[there])


def test_the_running_mean_is_the_formula_by_hand(planner):
    """Two bounds, one seen twice: moments and shrinkage written out."""
    policy, sight = running_mean.greedy(), np.full((8, 4, 4), 0.5)
    policy.rates |= {(0, 1, 1): [0.7, 0.6], (3, 2, 2): [0.4]}
    mean, sd = policy.estimate(sight)
    averages = np.array([0.15, -0.1])
    mu = averages.sum() / 4
    between = (((averages - mu) ** 2).sum() + 2 * 0.1**2) / 4
    within = (0.05**2 + 0.05**2 + 2 * 0.03**2) / 3
    shrunk = [(n * a / within + mu / between) / (n / within + 1 / between)
              for n, a in zip((2, 1), averages, strict=True)]  # fmt: skip
    assert mean[0, 1, 1] == pytest.approx(0.5 + shrunk[0])
    assert mean[3, 2, 2] == pytest.approx(0.5 + shrunk[1])
    assert mean[5, 0, 0] == pytest.approx(0.5 + mu)
    assert sd[0, 1, 1] == pytest.approx((2 / within + 1 / between) ** -0.5)
    assert sd[5, 0, 0] == pytest.approx(between**0.5)


def test_the_residual_process_is_the_closed_form_under_its_hyperparameters(planner):
    policy, sight = residual_process.ResidualProcess(), paths.line_of_sight(planner)
    there = np.argwhere(np.isfinite(sight))
    rng = np.random.default_rng(1)
    seen = there[rng.permutation(len(there))[:12]]
    errors = 0.1 * np.sin(seen[:, 1]) + 0.03 * rng.standard_normal(12)
    policy.rates = [
        (tuple(b), sight[tuple(b)] + e) for b, e in zip(seen.tolist(), errors, strict=True)
    ]
    mean, sd = policy.estimate(sight)
    kernel = policy.process(sight).kernel_
    shared, scale, lengths, noise = np.split(np.exp(kernel.theta), [1, 2, 6])

    def covariance(a, b):
        a, b = (residual_process.places(x) / lengths for x in (a, b))
        square = ((a[:, None] - b[None]) ** 2).sum(-1)
        return shared + scale * np.exp(-0.5 * square)

    inner = covariance(seen, seen) + noise * np.eye(12)
    cross = covariance(there, seen)
    expected = cross @ np.linalg.solve(inner, errors)
    variance = shared + scale - np.einsum("ij,ji->i", cross, np.linalg.solve(inner, cross.T))
    where = tuple(there.T)
    np.testing.assert_allclose(mean[where] - sight[where], expected, atol=1e-6)
    np.testing.assert_allclose(sd[where], np.sqrt(np.maximum(variance, 0.0)), atol=1e-5)

    def evidence(noise):  # the maximum of the marginal likelihood is in its hyperparameters
        inner = covariance(seen, seen) + noise * np.eye(12)
        return -0.5 * (errors @ np.linalg.solve(inner, errors) + np.linalg.slogdet(inner)[1])

    steps = [evidence(noise[0] * factor) for factor in (0.7, 1.0, 1.4)]
    assert steps[1] >= max(steps) - 1e-3 or noise[0] in (1e-5, 0.1)


def test_the_middle_of_a_bound_lies_between_its_cells_and_its_direction_has_length_1():
    diagonal = MOVES.index((-1, 1))
    place = residual_process.places(np.array([[diagonal, 2, 3]]))[0]
    np.testing.assert_allclose(place, [2.5, 2.5, -(0.5**0.5), 0.5**0.5])


@pytest.mark.parametrize("make", LEARNERS)
def test_a_baseline_is_that_of_line_of_sight_at_first_and_leaves_a_path_that_is_bad(planner, make):
    policy = make()
    campaign = SimpleNamespace(planner=planner)
    first = policy.recommend(campaign)
    walks = paths_of(planner)
    best = max(paths.predicted(planner, walk) for walk in walks)
    assert paths.predicted(planner, first) == pytest.approx(best)
    sight = paths.line_of_sight(planner)
    for k in range(6):  # no contact on the first path, as predicted on others
        path = policy.choose(planner, np.random.default_rng(k))
        assert path in walks
        rates = np.zeros(len(path) - 1) if path == first else rates_along(sight, path)
        policy.learn(campaign, mission_of(planner, path, rates))
    after = policy.recommend(campaign)
    assert after in walks
    learns = not isinstance(policy, line_of_sight.LineOfSight)
    assert (after != first) == learns


def test_the_oracle_is_without_regret_in_the_world_of_each_mission(workspace, tmp_path):
    blind = [Degradation(robot, 0.0, first=1, last=1) for robot in ("r1", "r2")]
    simulator = KinematicSimulator(workspace, events=blind)
    truth = Truth.from_simulator(simulator, n_replicates=1, folder=tmp_path)
    policy = oracle.Oracle(truth)
    now = Planner(workspace, START, GOAL, "lost_contact", max_bounds="shortest+2")
    campaign = SimpleNamespace(planner=now)
    chosen = []
    for mission in range(3):
        chosen.append(policy.recommend(campaign))
        assert truth.at(mission).regret(chosen[-1], max_bounds="shortest+2") == 0.0
        assert policy.choose(now, np.random.default_rng(0)) == chosen[-1]
        policy.learn(campaign, None)
    assert chosen[0] == chosen[2]
    lost = [truth.at(mission).lost(path) for mission, path in enumerate(chosen)]
    assert lost[1] > lost[0]  # another world
    with pytest.raises(TrustboError, match="the oracle needs the truth of the scene"):
        oracle.Oracle(None).recommend(campaign)
