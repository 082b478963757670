"""Tolls on the time in which nobody sees anybody, in closed form and beside missions."""

from itertools import pairwise

import numpy as np
import pytest

from trustbo import Workspace, iterate
from trustbo.inference import sample_prior
from trustbo.models import PooledTrust, TrustParams
from trustbo.planning import Planner
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.simulation import KinematicSimulator
from trustbo.terrain import synthetic_terrain
from trustbo.workspace.line_of_sight import N_SAMPLES, Phases
from trustbo.workspace.moves import bounds_along


@pytest.fixture(scope="module")
def workspace():
    terrain = synthetic_terrain((250.0, 250.0), seed=2, relief=12.0)
    return Workspace.from_terrain(terrain, (5, 5))


def test_unseen_in_closed_form():
    def always(*chances):
        return np.repeat(np.array([chances])[..., None], N_SAMPLES, axis=-1)

    seen = Phases(
        always(0.5, 0.4), always(0.2, 0.0), always(1.0, 1.0),
        np.array([30.0]), np.array([[20.0, 10.0]]), np.empty(0),
    )  # fmt: skip
    # Phase 1: 0.5 x 0.6 for 30 s. Phase 2: nobody waits in its first 10 s, then robot 2 does.
    expected = (30.0 * 0.3 + 10.0 * 0.8 + 0.0) / 50.0
    assert seen.unseen()[0] == pytest.approx(expected, abs=1e-12)
    los = seen.line_of_sight()[0]
    first, second = (30 * 0.5 + 20 * 0.2) / 50, (30 * 0.4 + 10 * 0.0 + 10 * 1.0) / 50
    np.testing.assert_allclose(los, [first, second])


def test_the_time_unseen_is_that_of_missions_where_the_map_is_right(workspace):
    simulator, errors = KinematicSimulator(workspace), []
    for path in ([(4 - k, k) for k in range(5)], [(4, k) for k in range(5)]):
        path = tuple(path)
        posts = np.stack([workspace.posts(*bound) for bound in pairwise(path)])
        seen = workspace.watch.seen_along(path, posts)
        time = seen.lead_time + seen.times.max(1)
        shares = [
            1.0 - np.concatenate([bound.contact.any(1) for bound in mission.bounds]).mean()
            for mission in (simulator.run(path, seed=seed) for seed in range(12))
        ]
        errors.append(seen.unseen() @ time / time.sum() - np.mean(shares))
    assert np.abs(errors).max() < 0.02  # 16 times in each phase, and robots slip


def test_the_more_the_time_unseen_costs_the_less_of_it_there_is(workspace):
    params = TrustParams(0.4, np.array([0.1, 0.0, 0.5]), 0.05, 0.1, 0.1)
    unseen, lost = [], []
    for cost in (0.0, 1.0, 5.0, 100.0):
        planner = Planner(workspace, (4, 0), (0, 4), unseen_cost=cost)
        plan = planner.plan(params)
        moves = bounds_along(plan.path)
        unseen.append(workspace.unseen_bounds.values[tuple(moves.T)].sum())
        assert plan.unseen_toll == pytest.approx(cost * unseen[-1], rel=1e-12)
        lost.append(-plan.value - plan.unseen_toll)
        free = Planner(workspace, (4, 0), (0, 4)).evaluate(plan.path, params)
        assert free.value == pytest.approx(-lost[-1], rel=1e-12)
        assert free.unseen_toll == 0.0
        assert ("on the time unseen" in repr(plan)) == (cost > 0.0)
    assert unseen == sorted(unseen, reverse=True)
    assert unseen[-1] < unseen[0]
    assert (np.diff(lost) > -1e-12).all()  # but for rounding, of paths that lose the same
    assert plan.exact


def test_shares_of_bounds_are_near_those_along_paths(workspace):
    """But for turns, which bounds do not know, and for the goal, where T2 closes up otherwise."""
    draws, shares = sample_prior(PooledTrust(), 3, 6, seed=1), []
    for end in ((0, 4), (0, 1), (1, 4), (2, 3), (0, 2)):
        for path in Planner(workspace, (4, 0), end).plan_draws(draws).candidates:
            along = workspace.watch.seen_along(path, workspace.watch.rule(path)).unseen()
            known = workspace.unseen_bounds.values[tuple(bounds_along(path).T)]
            shares += zip(known, along, strict=True)
    known, along = np.array(shares).T
    assert np.corrcoef(known, along)[0, 1] > 0.95
    assert abs((known - along).mean()) < 0.02


def test_regret_is_a_share_of_the_contact_kept_with_a_toll_too(workspace):
    draws = sample_prior(PooledTrust(), 3, 20, seed=2)
    planner = Planner(workspace, (4, 0), (0, 4), unseen_cost=1000.0)
    drawn = planner.plan_draws(draws)
    path = drawn.candidates[0]
    paths = [planner.paths.cells(flat) for flat in drawn.paths]
    free = Planner(workspace, (4, 0), (0, 4)).plan_draws(draws).values_of(paths).diagonal()
    kept = np.maximum(0.0, [len(one) - 1 for one in paths] + free)
    regret, share = drawn.regret(path), drawn.relative_regret(path)
    some = kept > 1e-6
    np.testing.assert_allclose(share[some], regret[some] / kept[some], rtol=1e-9, atol=1e-12)
    assert some.sum() > 5  # the prior has draws of no contact
    assert (drawn.values < -4.0).all()  # more is paid than bounds could lose


def test_campaigns_pay_for_the_time_unseen_and_say_so(workspace, tmp_path):
    options = {"unseen_cost": 2.5, "sampler": "exact", "seed": 0}
    result = iterate(workspace, (4, 0), (0, 4), n_iterations=1, progress=False, **options)
    assert result.settings["unseen_cost"] == 2.5
    plan = result.plan
    unseen = workspace.unseen_bounds.values[tuple(bounds_along(plan.path).T)].sum()
    assert plan.unseen_toll == pytest.approx(2.5 * unseen)
    kept = plan_from_record(plan_to_record(plan), workspace)
    assert kept.unseen_toll == plan.unseen_toll
