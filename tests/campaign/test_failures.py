"""Failures in the loop: learned, priced from the first one on, and bounds that are avoided."""

import itertools

import numpy as np
import pytest
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.campaign.choose import informed_planner
from trustbo.hazard import Hazard
from trustbo.hazard.model import fit_hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import LostMission
from trustbo.workspace.moves import END, moves_along, pairs_along

ENDS = ((3, 0), (0, 3))


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


@pytest.fixture(scope="module")
def hills():
    terrain = tb.terrain.synthetic_terrain(size=(150.0, 150.0), resolution=2.0, seed=3)
    return tb.Workspace.from_terrain(terrain, (5, 5))


@pytest.fixture(scope="module")
def steep():
    """Ground of which many bounds are near the limit of 11 degrees."""
    robot = tb.Robot(max_slope=np.deg2rad(11.0))
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    team = tb.Team(robots=(robot,), lead=robot)
    return tb.Workspace.from_terrain(terrain, (5, 5), team, bounds=False)


def begin(workspace, **options):
    ends = ENDS if workspace.terrain is None else ((4, 0), (0, 4))
    return tb.Campaign(workspace, *ends, sampler="importance", seed=1, **options)


def at(bound):
    return int(moves_along(bound)[0]), *bound[1]


def price(campaign):
    return campaign.planner.problem.cost_of_failure


def trapped(workspace, bound, path, seed):
    """Mission on a path, which ends in a bound if it comes to it."""
    bounds = list(itertools.pairwise(path))
    fail_at = bounds.index(bound) + 1 if bound in bounds else None
    return ModelSimulator(workspace, fail_at=fail_at).run(path, seed=seed)


def test_hazard_is_that_of_all_missions_and_in_the_posterior(workspace):
    campaign = begin(workspace)
    path = campaign.ask().path
    before = campaign.risk.mean[at(path[1:3])][END]
    posterior = campaign.tell(trapped(workspace, path[1:3], path, 0))
    assert posterior["hazard"]["failures"].values[at(path[1:3])].sum() == 1
    assert campaign.risk.mean[at(path[1:3])][END] > 2.0 * before
    alone = fit_hazard(campaign.missions, workspace, seed=campaign.state.seed_of("hazard"))
    assert alone.drop_attrs().identical(campaign.hazard.drop_attrs())
    kept = campaign.posterior["hazard"].to_dataset()
    np.testing.assert_array_equal(kept["p_fail"].values, campaign.risk.mean)
    assert kept.drop_vars("p_fail").identical(campaign.hazard)


def test_only_attempted_and_planned_bounds_are_measured_until_failures_matter(tmp_path):
    """Then all are, and a campaign that goes on in another process reads them from its folder."""
    terrain = tb.terrain.synthetic_terrain((120.0, 120.0), 2.0, seed=2)
    hilly = tb.Workspace.from_terrain(terrain, (5, 5), tb.Team(n_robots=1), bounds=False)
    free = {"failure_cost": 0.0}
    with begin(hilly, directory=tmp_path, planner=free) as campaign:
        plan = campaign.ask()
        campaign.tell(ModelSimulator(hilly).run(plan.path, seed=0))
        assert campaign.plan().p_arrive > 0.0
        campaign.maps(n_draws=5)
        assert not hilly.difficulty.is_whole
        assert not tb.load_result(tmp_path).workspace.difficulty.is_whole

        where = plan.path[1]
        for _ in range(2):
            campaign.suggest(plan.path)
            campaign.fail("stuck", where=where)
        campaign.ask()
        assert hilly.difficulty.is_whole

    with tb.Campaign.load(tmp_path) as again:
        kept = again.workspace.difficulty
        assert kept.is_whole
        np.testing.assert_array_equal(kept.whole().values, hilly.difficulty.whole().values)
        np.testing.assert_array_equal(kept.whole().unit, hilly.difficulty.whole().unit)
        again.save(tmp_path / "copy")
    assert tb.load_result(tmp_path / "copy").workspace.difficulty.is_whole

    (tmp_path / "difficulty.nc").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="difficulty"):
        again = tb.Campaign.load(tmp_path)
    assert not again.workspace.difficulty.is_whole
    assert len(again.missions) == len(campaign.missions)
    again.close()


def test_mission_without_a_report_is_learned_from_if_a_bound_failed(workspace):
    campaign = begin(workspace)
    path = campaign.ask().path
    campaign.fail("tipped")
    lost, seed = [LostMission(path)], campaign.state.seed_of("hazard")
    expected = fit_hazard([], workspace, lost=lost, seed=seed)
    assert campaign.hazard.drop_attrs().identical(expected.drop_attrs())
    campaign.ask()
    campaign.fail("rain")


def test_prior_of_the_hazard_can_be_given(workspace):
    prior = Hazard(intercept=(-3.0, 1.0))
    campaign = begin(workspace, hazard=prior)
    expected = fit_hazard([], workspace, prior, seed=campaign.state.seed_of("hazard"))
    assert campaign.hazard.drop_attrs().identical(expected.drop_attrs())


def test_refused_hazard_leaves_the_previous_one(workspace, monkeypatch):
    campaign = begin(workspace)
    campaign.tell(ModelSimulator(workspace, fail_at=1).run(campaign.ask().path, seed=0))
    before = campaign.hazard

    def refuse(*args, **kwargs):
        raise tb.PosteriorError("hazard refused: k-hat = 0.90 > 0.7.")

    monkeypatch.setattr("trustbo.campaign.learning.fit_hazard", refuse)
    with pytest.warns(UserWarning, match="hazard"):
        campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=1))
    assert campaign.hazard.identical(before)


# --- past failures in the cells of a plan ---


def test_a_plan_lists_the_failures_on_the_way_into_its_cells(workspace):
    """A failure on the way into (1, 1) from the south-west, before a move to the north-east."""
    campaign = begin(workspace)
    campaign.suggest(path := ((3, 0), (2, 0), (1, 1), (0, 2), (0, 3)))
    assert campaign.ask().past_failures == ()
    campaign.tell(ModelSimulator(workspace, fail_at=2).run(path, seed=0))
    planned = campaign.plan().path
    in_plan = {(f.bound, f.way) for f in campaign.plan().past_failures}
    assert in_plan == {(k, path[1:4]) for k, cell in enumerate(planned) if cell == path[2]}

    p_fail = campaign.risk.mean[*pairs_along(path[1:4], 1)[0]]
    other_side = ((3, 0), (2, 1), (1, 1), (1, 2), (0, 3))
    other_move = ((3, 0), (2, 0), (1, 1), (1, 2), (0, 3))
    for suggested in (other_side, other_move, path):
        campaign.suggest(suggested)
        [failure] = campaign.ask().past_failures
        assert failure[:4] == (2, 1, "stuck", path[1:4])
        assert failure.p_fail == pytest.approx(p_fail, rel=1e-12)
    assert campaign.ask().p_fail[1] == failure.p_fail

    campaign.suggest(((3, 0), (2, 1), (1, 2), (0, 3)))
    assert campaign.ask().past_failures == ()


def test_past_failures_include_missions_given_up_and_are_stored(workspace, tmp_path):
    campaign = begin(workspace, directory=tmp_path / "c")
    path = campaign.ask().path
    campaign.fail("stuck", where=path[1])
    campaign.suggest(path)
    [failure] = campaign.ask().past_failures
    assert failure[:4] == (1, None, "stuck", path[:3])
    campaign.close()
    with tb.Campaign.load(tmp_path / "c") as again:
        assert again.ask().past_failures == (failure,)


def test_after_replanning_the_failure_of_this_mission_counts_for_the_rest(workspace):
    path = ((3, 0), (2, 0), (1, 1), (0, 2), (0, 3))
    campaign = begin(workspace)
    campaign.suggest(path)
    so_far = ModelSimulator(workspace, fail_at=2).run(path, seed=0)
    rest = campaign.replan(path[1], so_far)
    ahead = [k for k, cell in enumerate(rest.path) if cell == path[2] and k > rest.n_driven]
    assert [failure.bound for failure in rest.past_failures] == ahead
    assert {failure.mission for failure in rest.past_failures} <= {1}


# --- bounds that are avoided ---


def test_bound_that_stopped_robots_twice_is_not_entered_again(workspace):
    """Failures cost nothing here, so that no other reason keeps the plan away."""
    campaign = begin(workspace, objective="mean")
    bound = tuple(campaign.ask().path[1:3])
    paths = []
    for seed in range(5):
        paths.append(campaign.ask().path)
        campaign.tell(trapped(workspace, bound, paths[-1], seed))
    assert sum(bound in itertools.pairwise(path) for path in paths) <= 2
    assert bound not in itertools.pairwise(campaign.recommend().path)


def test_bounds_are_avoided_from_the_second_failure_until_they_recover(workspace):
    """Failures have no price here."""
    path = ((3, 0), (2, 1), (1, 2), (0, 3))
    free = tb.planning.Planner(workspace, path[0], path[-1], failure_cost=0.0)
    stuck, fine = (ModelSimulator(workspace, fail_at=n).run(path, seed=0) for n in (2, None))
    for told, avoided in (([stuck], 0), ([stuck] * 2, 1), ([stuck] * 2 + [fine] * 15, 0)):
        risk = BoundRisk(fit_hazard(told, workspace), workspace)
        planner = informed_planner(free, risk)
        found = planner.problem.paths.avoided
        found = np.zeros(risk.mean.shape[:3]) if found is None else found
        assert found.sum() == found[at(path[1:3])] == avoided


def test_avoided_bound_is_entered_if_there_is_no_other_way():
    corridor = tb.Workspace.from_awareness(np.full((1, 1, 3, 1), 0.6))
    campaign = tb.Campaign(corridor, (0, 0), (0, 2), sampler="importance")
    for _ in range(3):
        campaign.ask()
        campaign.fail("stuck", where=(0, 2))
    assert campaign.risk.mean[4, 0, 2, END] > 0.5
    assert campaign.ask().path == ((0, 0), (0, 1), (0, 2))


# --- the price of a failure ---


def test_failure_is_priced_from_the_first_plan_on(hills):
    campaign = begin(hills)
    assert price(campaign) == campaign.planner.problem.paths.shortest
    assert price(begin(hills, planner={"failure_cost": 3.0})) == 3.0
    assert price(begin(hills, planner={"failure_cost": 0.0})) == 0.0
    assert price(begin(hills, objective="mean")) == 0.0


def test_a_failure_lowers_the_value_of_plans(hills):
    simulator, campaign = tb.simulation.KinematicSimulator(hills), begin(hills)
    campaign.tell(simulator.run(campaign.ask().path, seed=0))
    before = campaign.plan()
    campaign.fail("stuck", where=campaign.ask().path[1])
    assert campaign.plan().value == campaign.recommend().value < before.value


def test_the_first_plan_keeps_away_from_slopes_at_the_limit(steep):
    free, priced = (begin(steep, planner={"failure_cost": cost}).ask() for cost in (0.0, 100.0))
    default = begin(steep).ask()
    assert free.p_arrive <= default.p_arrive <= priced.p_arrive
    assert free.p_arrive < priced.p_arrive


def test_price_after_a_failure_is_joint_over_strata(steep):
    """F sum_m w_m (1 - prod (1 - p_m)), below that of the product of the means."""
    campaign = begin(steep, planner={"failure_cost": 8.0})
    campaign.fail("stuck", where=campaign.ask().path[1])
    problem = campaign.planner.problem
    path = campaign.planner.plan(campaign.belief.mean()).path
    p, weights = campaign.risk.components()
    joint = 8.0 * weights @ (1.0 - np.prod(1.0 - p[:, *pairs_along(path, 1).T], axis=1))
    assert problem.failure_along(path) == pytest.approx(joint, rel=1e-12)
    assert joint < 8.0 * (1.0 - np.prod(1.0 - problem.risk.along(path).p_fail)) - 1e-3


def test_limit_holds_without_a_price_and_warns_if_no_path_keeps_it(workspace, hills):
    campaign = begin(hills, planner={"max_failure": 0.5})
    plan = campaign.ask()
    problem = campaign.planner.problem
    assert problem.is_within_limit(plan.stations)
    assert plan.p_arrive == pytest.approx(problem.risk.along(plan.stations).p_arrive)
    with pytest.warns(UserWarning, match="max_failure"):
        plan = begin(workspace, planner={"max_failure": 1e-6}).ask()
    assert plan.infeasible
    assert not begin(workspace, planner={"max_failure": 0.9}).ask().infeasible


# --- what is given up ---


def test_next_try_may_take_another_path(workspace):
    campaign, paths = begin(workspace, policy="random"), set()
    for _ in range(7):
        paths.add(campaign.ask().path)
        campaign.fail("the lead lost its map")
    assert campaign.missions == []
    assert len(paths) > 1


def test_table_has_a_row_for_each_mission_given_up(workspace):
    campaign, simulator = begin(workspace), ModelSimulator(workspace)
    path = campaign.ask().path
    campaign.fail("stuck", where=path[2])
    campaign.tell(simulator.run(campaign.ask().path, seed=0))
    simulator.fail_at = 2
    part = simulator.run(campaign.ask().path, seed=1)
    campaign.tell(part)
    campaign.fail("rain")
    table = campaign.table()
    assert table.index.isna().tolist() == [True, False, False, True]
    where = [f"{row},{col}" for row, col in (path[2], part.path[2])]
    assert table["where"].tolist() == [where[0], "", where[1], ""]
    assert table["reason"].tolist() == ["stuck", "", "stuck", "rain"]
    assert table["state"].tolist() == ["given up", "learned", "learned", "given up"]
    assert table["status"].tolist() == ["stuck", "ok", part.status, "aborted"]
    assert table["n_bounds"].tolist()[:3] == [2, len(campaign.missions[0].bounds), 2]


def test_contradictory_reports_of_failures_are_refused(workspace):
    campaign = begin(workspace)
    path = campaign.ask().path
    for arguments, named in (
        ({"reason": ""}, "reason"),
        ({"reason": None}, "reason"),
        ({"reason": "stuck", "where": path[0]}, "where"),
        ({"reason": "rain", "where": path[0]}, "where"),
    ):
        with pytest.raises(tb.TrustboError, match=named):
            campaign.fail(**arguments)
    assert not campaign.state.failures
    assert not campaign.missions


def test_a_failure_without_a_planned_path_is_refused(workspace):
    campaign = begin(workspace)
    with pytest.raises(tb.TrustboError, match="Call ask"):
        campaign.fail("tipped")

    path = campaign.ask().path
    n_bounds = len(path) - 1
    rates = np.full((n_bounds, workspace.team.n_robots), 0.8)
    unknown = np.full((*rates.shape, len(workspace.features)), np.nan)
    features = workspace.features
    campaign.tell(tb.Mission.from_arrays(path, unknown, rates, status="stuck", features=features))
    with pytest.raises(tb.TrustboError, match="already counts"):
        campaign.fail("stuck")
    assert not campaign.state.failures


def test_a_withdrawn_failure_changes_the_table_alone(workspace, tmp_path):
    campaign = begin(workspace, directory=tmp_path / "c")
    plan = campaign.ask()
    without = campaign.risk.along(plan.path).p_arrive

    campaign.fail("stuck", where=plan.path[1])
    campaign.fail("tipped", where=campaign.ask().path[1])
    with_both = campaign.risk.along(plan.path).p_arrive
    assert with_both < without

    campaign.withdraw(1, "wrong team")
    assert campaign.state.asked is None
    assert campaign.hazard["failures"].values.sum() == 1
    assert with_both < campaign.risk.along(plan.path).p_arrive < without
    table = campaign.table()
    assert table["state"].tolist() == ["excluded", "given up"]
    assert table["reason"].tolist() == ["wrong team", "tipped"]
    assert table["status"].tolist() == ["stuck", "tipped"]

    campaign.close()
    with tb.Campaign.load(tmp_path / "c") as again:
        assert again.state.failures == campaign.state.failures
        again.withdraw(2, "as well")
        assert again.risk.past_failures.sum() == 0.0
        assert again.risk.along(plan.path).p_arrive == pytest.approx(without, abs=0.002)
        wrong = (1, "twice", "wrong team"), (3, "none", "there are 2"), (2, "", "empty")
        for n, reason, named in wrong:
            with pytest.raises(tb.TrustboError, match=named):
                again.withdraw(n, reason)


def test_causes_are_read_as_people_write_them(workspace):
    campaign = begin(workspace)
    path = campaign.ask().path
    campaign.fail(" Stuck")
    assert campaign.state.lost == [LostMission(path)]
    with pytest.raises(tb.TrustboError, match="nothing was recorded"):
        campaign.fail("The lead was Stuck in my office")
    assert len(campaign.state.failures) == 1
    assert campaign.state.lost == [LostMission(path)]

    other = campaign.ask().path
    campaign.fail("Lost contact")
    assert campaign.state.lost == [LostMission(path), LostMission(other)]
