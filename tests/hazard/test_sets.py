"""Failures with several sets of posts: counted, learned, priced and stored by set."""

import numpy as np
import pytest
import xarray as xr

import trustbo as tb
from trustbo.campaign.folder import earlier_from_tree, earlier_to_tree
from trustbo.campaign.state import EarlierMissions
from trustbo.data import POST_SETS
from trustbo.errors import TrustboError
from trustbo.hazard.model import fit_hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import UNKNOWN, LostMission, Trials
from trustbo.models import TrustParams
from trustbo.simulation import ModelSimulator
from trustbo.workspace.difficulty import MEASURES
from trustbo.workspace.moves import MOVES, next_names, pairs_along, way_names

EAST, SOUTH = 4, 6
FAR, ROUTE = 8, 16
PARAMS = TrustParams(0.5, [0.2, 0.3], 0.1, 0.05, 0.1)
RNG = np.random.default_rng(0)


def cells(n_posts=3):
    z = np.random.default_rng(1).uniform(size=(2, 8 * n_posts, 4, 4, 2))
    return tb.Workspace.from_awareness(z)


def mission(path, status="ok", n_bounds=None):
    n = len(path) - 1 if n_bounds is None else n_bounds
    rates = np.full((n, 2), 0.5)
    return tb.Mission.from_arrays(path, np.full((n, 2, 2), 0.5), rates, status=status)


@pytest.fixture(scope="module")
def hilly():
    """Ground of which some bounds are near the limit of 11 degrees."""
    robot = tb.Robot(max_slope=np.deg2rad(11.0))
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    team = tb.Team(robots=(robot,), lead=robot)
    return tb.Workspace.from_terrain(terrain, (5, 5), team, n_posts=3)


def path_of(way, row, col, after):
    """Path of a bound and the next one, with their sets of posts."""
    down, right = MOVES[way % 8]
    a = row - down, col - right, POST_SETS[way // 8]
    if after == 24:
        return a, (row, col)
    down, right = MOVES[after % 8]
    return a, (row, col, POST_SETS[after // 8]), (row + down, col + right)


# --- what is counted ---


def test_trials_are_those_of_the_sets_that_watched():
    path = ((0, 0, "far"), (0, 1), (0, 2, "route"), (1, 2))
    counted = Trials.from_missions([mission(path)], [LostMission(path, (0, 2))], n_posts=3)
    assert counted.bounds.tolist() == [
        [EAST, 0, 2, SOUTH + ROUTE],
        [EAST + FAR, 0, 1, EAST],
        [SOUTH + ROUTE, 1, 2, 24],
    ]
    assert counted.n.tolist() == [2.0, 2.0, 1.0]
    assert counted.failed.tolist() == [1.0, 0.0, 0.0]


def test_sets_that_are_not_offered_count_as_the_standard_one():
    path = (0, 0, "far"), (0, 1, "route"), (0, 2)
    two = Trials.from_missions([mission(path)], n_posts=2).bounds
    one = Trials.from_missions([mission(path)]).bounds
    assert two.tolist() == [[EAST, 0, 2, 16], [EAST + FAR, 0, 1, EAST]]
    assert one.tolist() == [[EAST, 0, 1, EAST], [EAST, 0, 2, 8]]


def test_a_failure_with_an_unknown_next_way_is_shared_by_those_of_its_set():
    path = (0, 0), (0, 1, "far"), (0, 2)
    counted = Trials.from_missions([mission(path, ("ok", "stuck"))], n_posts=2)
    assert counted.bounds.tolist() == [[EAST, 0, 1, EAST + FAR], [EAST + FAR, 0, 2, UNKNOWN]]
    exists = np.zeros((16, 1, 3, 17), bool)
    exists[EAST + FAR, 0, 2, [3, 3 + FAR, 16]] = True
    shared = counted.with_known_next(exists)
    assert shared.bounds[1:].tolist() == [[EAST + FAR, 0, 2, n] for n in (3, 3 + FAR, 16)]
    np.testing.assert_allclose(shared.failed[1:], 1 / 3)


# --- what is learned ---


def shared_by_lead(workspace):
    """A steep bound with the far set, the same one with the standard set, and a flat bound.

    Bounds are (way, row, col, next way). The first two share the steepest route, that of the lead.
    """
    values, unit = workspace.difficulty.whole()
    tilt = values[..., MEASURES.index("tilt")]
    steep = (unit >= 0) & (tilt > 0.85) & (tilt < 0.95)
    for way, row, col, n in np.argwhere(steep[FAR:ROUTE]).tolist():
        same = np.flatnonzero(unit[way, row, col] == unit[way + FAR, row, col, n])
        if len(same):
            flat = np.unravel_index(np.nanargmin(tilt), tilt.shape)
            return (way + FAR, row, col, n), (way, row, col, int(same[0])), flat
    raise AssertionError


def test_a_failure_teaches_other_sets_with_the_same_steepest_route_and_no_others(hilly):
    failed, sharing, unrelated = shared_by_lead(hilly)
    path = path_of(*failed)
    tipped = tb.Mission.from_arrays(path, np.full((1, 1, 3), 0.5), [[0.5]], status="tipped")
    before = BoundRisk(fit_hazard([], hilly), hilly)
    group = fit_hazard([tipped], hilly, goals=[path[-1][:2]])
    after = BoundRisk(group, hilly)

    assert after.failures[failed] == after.failures.sum() == 1.0
    assert after.mean[failed] > before.mean[failed] + 0.3
    assert after.mean[sharing] == after.mean[failed]
    assert after.mean[unrelated] < before.mean[unrelated] + 0.05
    move, row, col = failed[0] % 8, *failed[1:3]
    assert after.past_failures[move, row, col] == 1.0
    assert after.past_failures.sum() == 1.0
    assert after.along(path).p_fail[0] == pytest.approx(after.mean[failed], rel=1e-12)
    assert after.failure(path) > before.failure(path)

    assert group["move"].values.tolist() == way_names(3)
    assert group["next_move"].values.tolist() == next_names(3)
    turned = group.isel(move=slice(None, None, -1), next_move=slice(None, None, -1))
    np.testing.assert_array_equal(BoundRisk(turned, hilly).failures, after.failures)


def test_the_risk_of_a_path_is_that_of_draws_of_its_ways(hilly):
    path = ((4, 0, "far"), (3, 1), (2, 1, "route"), (1, 2, "far"), (0, 3))
    risk = BoundRisk(fit_hazard([], hilly, lost=[LostMission(path)]), hilly)
    at = tuple(pairs_along(path, 3).T)
    exact = risk.along(path)
    np.testing.assert_allclose(exact.p_fail, risk.mean[at], rtol=1e-9)
    drawn = (1.0 - risk.draw(20_000, seed=1)[:, *at]).prod(1)
    # 5 standard errors, of 1000 distinct hyperparameters.
    assert abs(exact.p_arrive - drawn.mean()) < 5.0 * drawn.std() / np.sqrt(1000)


# --- what is given ---


def test_probabilities_by_move_hold_for_all_sets():
    workspace = cells()
    planner = tb.Planner(workspace, (3, 0), (0, 3))

    def read(p):
        return planner.with_risk(p).problem.risk.p_fail

    by_move = RNG.uniform(0.0, 0.3, (8, 4, 4, 9))
    whole = read(by_move)
    assert whole.shape == (24, 4, 4, 25)
    for before in (0, FAR, ROUTE):
        np.testing.assert_array_equal(whole[before : before + 8, ..., -1], by_move[..., -1])
        for after in (0, FAR, ROUTE):
            of_sets = whole[before : before + 8, ..., after : after + 8]
            np.testing.assert_array_equal(of_sets, by_move[..., :8])
    np.testing.assert_array_equal(read(whole), whole)
    np.testing.assert_array_equal(
        read(by_move[..., 3])[..., 7], np.tile(by_move[..., 3], (3, 1, 1))
    )

    names = {"move": way_names(3), "row": range(4), "col": range(4), "next_move": next_names(3)}
    other = RNG.uniform(0.0, 0.3, whole.shape)
    labelled = xr.DataArray(other, names, tuple(names))
    turned = labelled.transpose().isel(move=slice(None, None, -1), next_move=RNG.permutation(25))
    np.testing.assert_array_equal(read(turned), other)
    of_ways = read(labelled.isel(next_move=3, drop=True))
    np.testing.assert_array_equal(of_ways, np.repeat(other[..., 3:4], 25, axis=-1))

    for wrong in (whole[:16], whole[..., :24], by_move[:7]):
        with pytest.raises(TrustboError, match="p_fail"):
            planner.with_risk(wrong)
    simulator = ModelSimulator(workspace, PARAMS, p_fail=np.zeros((8, 4, 4)))
    assert simulator.p_fail.shape == (24, 4, 4, 25)


def test_a_simulated_bound_fails_with_the_probability_of_its_ways():
    p = np.zeros((24, 4, 4, 25))
    p[EAST + FAR, 0, 1, SOUTH + ROUTE] = 1.0
    simulator = ModelSimulator(cells(), PARAMS, p_fail=p)
    failing = (0, 0, "far"), (0, 1, "route"), (1, 1)
    assert simulator.run(failing, seed=0).statuses == ["stuck"]
    for other in (((0, 0), *failing[1:]), (failing[0], (0, 1), (1, 1))):
        assert simulator.run(other, seed=0).statuses == ["ok", "ok"]


def test_a_plan_takes_the_sets_that_arrive_and_its_graph_has_their_risks():
    p = np.zeros((24, 4, 4, 25))
    p[:8] = 0.5
    p[ROUTE:, ..., :24] = 0.25
    planner = tb.Planner(cells(), (3, 0), (0, 3), max_failure=0.0).with_risk(p)
    plan = planner.plan(PARAMS)
    assert plan.exact
    assert {cell[2] for cell in plan.stations[:-2]} == {"far"}
    assert plan.stations[-2][2] in ("far", "route")  # the bound that ends the path
    assert plan.p_arrive == 1.0

    graph = planner.graph(PARAMS)
    risks = [graph.edges[(3, 0), (2, 1), name]["risk"] for name in POST_SETS]
    n_next = 3 * 8  # all neighbours of (2, 1), with each set
    expected = -np.log1p(-np.array([0.5, 0.0, 0.25 * n_next / (n_next + 1)]))
    np.testing.assert_allclose(risks, expected, atol=1e-12)


# --- campaigns ---


def test_a_campaign_with_sets_keeps_its_failures_and_says_with_which_posts(hilly, tmp_path):
    options = {"sampler": "importance", "fit": {"draws": 200}, "directory": tmp_path / "c"}
    path = ((4, 0, "far"), (3, 1), (2, 2, "route"), (1, 3), (0, 4))
    with tb.Campaign(hilly, (4, 0), (0, 4), **options) as campaign:
        campaign.suggest(path)
        campaign.ask()
        z = np.full((2, 1, 3), 0.5)
        rates = np.full((2, 1), 0.5)
        driven = (*path[:2], path[2][:2])  # the log does not say with which posts it went on
        campaign.tell(tb.Mission.from_arrays(driven, z, rates, status=("ok", "stuck")))
        failed = tuple(pairs_along(path, 3)[1])
        assert campaign.risk.failures[failed] == campaign.risk.failures.sum() == 1.0

        campaign.suggest(path)
        plan = campaign.ask()
        [failure] = plan.past_failures
        assert failure[:4] == (2, 1, "stuck", path[1:4])
        assert failure.p_fail == pytest.approx(plan.p_fail[1], rel=1e-9)
        assert "other posts" not in str(plan)

        units = hilly.difficulty.whole().unit[:, 2, 2]
        assert units[failed[0] + FAR, failed[3]] != units[failed[0], failed[3]]
        campaign.suggest((path[0], (3, 1, "far"), *path[2:]))
        plan = campaign.ask()
        assert plan.past_failures[0].way == path[1:4]
        assert "with other posts" in str(plan)
        risk = campaign.risk.mean

    with tb.Campaign.load(tmp_path / "c") as again:
        assert again.workspace.difficulty.is_whole
        np.testing.assert_array_equal(again.risk.mean, risk)
        assert again.ask().past_failures == plan.past_failures
        stored = again.posterior["hazard"]
        assert stored["p_fail"].shape == (24, 5, 5, 25)
        assert stored["move"].values.tolist() == way_names(3)


def test_lost_missions_of_earlier_campaigns_keep_their_sets():
    lost = LostMission(((0, 0, "far"), (0, 1), (0, 2)), (0, 1))
    planned = ((lost.path, lost.path[:2]),)
    earlier = EarlierMissions((mission(lost.path),), planned, (lost,))
    found = earlier_from_tree(earlier_to_tree(earlier))
    assert (found.lost, found.planned) == ((lost,), planned)
