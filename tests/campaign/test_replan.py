"""The rest of a mission that is planned again: the best one, recorded, and told as a whole."""

from itertools import pairwise

import numpy as np
import pytest
from enumeration import every_path, value_of
from worlds import random_cells

import trustbo as tb
from trustbo.campaign.replan import trust_filter
from trustbo.errors import TrustboError
from trustbo.hazard.model import fit_hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.models import PooledTrust
from trustbo.planning import NoPathError, Planner
from trustbo.workspace.moves import END, bounds_along, pairs_along

ENDS = ((3, 0), (0, 3))
PATH = ((3, 0), (2, 1), (1, 2), (0, 3))


def mission(path, rates, status="ok"):
    """A mission whose awareness was not measured."""
    unknown = np.full((*np.shape(rates), 2), np.nan)
    return tb.Mission.from_arrays(path, unknown, rates, status=status)


def rates_of(n_bounds, seed=0):
    return np.random.default_rng(seed).uniform(0.2, 1.0, (n_bounds, 3))


def begun(model=None, **options):
    """A campaign of one mission, with the plan `PATH` for the next one."""
    campaign = tb.Campaign(
        random_cells(), *ENDS, model=model, sampler="importance", fit={"draws": 200}, **options
    )
    campaign.suggest(PATH)
    campaign.tell(mission(PATH, rates_of(3, 1)))
    campaign.suggest(PATH)
    return campaign


def test_the_table_and_the_report_name_the_bound_that_failed_before_replanning():
    campaign = begun()
    so_far = mission(PATH, rates_of(2), ["ok", "stuck"])
    rest = campaign.replan(PATH[1], so_far).path[3:]
    whole = (*PATH[:3], *rest)
    n_bounds = len(whole) - 1
    statuses = ["ok", "stuck", *["ok"] * (n_bounds - 2)]
    campaign.tell(mission(whole, rates_of(n_bounds), statuses))

    row = campaign.table().loc[2]
    assert (row["status"], row["reason"], row["where"]) == ("ok", "stuck", "1,2")
    assert campaign.history["reason"].values.tolist() == ["", "stuck"]
    assert campaign.table()["failed_bounds"].tolist() == ["", "2 into 1,2 (stuck)"]
    assert campaign.table()["replanned"].tolist() == [False, True]

    again = campaign.ask().path
    campaign.fail("tipped", where=again[1])
    campaign.exclude(2, "a bad day")
    assert campaign.table()["reason"].tolist() == ["", "a bad day", "tipped"]
    cell = ",".join(map(str, again[1]))
    table = campaign.table()
    assert table["failed_bounds"].tolist()[1:] == ["2 into 1,2 (stuck)", f"into {cell} (tipped)"]
    assert table["replanned"].tolist() == [False, True, False]


def test_a_mission_is_replanned_if_its_plan_contains_driven_or_blocked_bounds():
    campaign = begun()
    assert not campaign.ask().is_replanned
    assert campaign.ask().n_driven == 0
    plan = campaign.replan(PATH[1])
    assert plan.is_replanned
    assert plan.n_driven == 1

    campaign = begun()
    assert campaign.replan(PATH[0], blocked=[PATH[:2]]).is_replanned


@pytest.mark.parametrize("objective", ["lost_contact", "terminal", "mean"])
@pytest.mark.parametrize("family", ["gaussian", "censored"])
def test_the_rest_is_the_best_of_all_rests(objective, family):
    campaign = begun(PooledTrust(family=family), objective=objective)
    ahead = campaign.ask().path
    so_far = mission(PATH, rates_of(2), ["ok", "stuck"])
    plan = campaign.replan(PATH[1], so_far, blocked=[((2, 1), (1, 1))])
    assert plan.path[:4] == (*PATH[:3], PATH[1])
    assert plan.exact

    # The belief is computed again, by a filter of the same bounds.
    workspace = campaign.workspace
    trust = trust_filter(campaign, workspace)
    z = workspace.along((*PATH[:3], PATH[1]))
    rates = [*so_far.contact_rate, np.full(3, np.nan)]
    for of_bound, rate in zip(z, rates, strict=True):
        trust.update(of_bound, rate)
    mean = trust.resample().mean()

    bounds = workspace.passable_bounds.values.copy()
    for blocked in (PATH[1:3], PATH[2:0:-1], ((2, 1), (1, 1)), ((1, 1), (2, 1))):
        bounds[tuple(bounds_along(blocked)[0])] = False
    fewest = 3  # both bounds that lead straight to the goal are blocked
    assert not every_path(bounds, PATH[1], ENDS[1], fewest - 1, u_turns=False)
    longest = fewest + (4 if objective == "lost_contact" else 2)
    rests = every_path(bounds, PATH[1], ENDS[1], longest, u_turns=False)
    assert len(rests) > 20

    noise_sd = mean.state_space(3).rate_sd.mean()
    values = [
        value_of(mean, workspace, rest, objective, family, noise_sd, x0=trust.state.mean)
        for rest in rests
    ]
    if objective == "lost_contact":  # since a bound failed, a failure costs the rest
        tried = [campaign.missions[0], so_far]
        seed = campaign.state.seed_of("hazard")
        p_fail, weights = BoundRisk(fit_hazard(tried, workspace, seed=seed), workspace).components()
        for k, rest in enumerate(rests):
            passes = np.prod(1.0 - p_fail[:, *pairs_along(rest, 1).T], axis=1)
            values[k] -= fewest * weights @ (1.0 - passes)

    found = values[rests.index(plan.path[3:])]
    assert found == pytest.approx(max(values), abs=1e-9)
    if objective != "lost_contact":
        assert plan.value == pytest.approx(found)
    assert ahead == PATH


def test_contact_so_far_changes_what_is_expected_of_the_rest():
    campaign = begun()
    low, high = (
        campaign.replan(PATH[1], mission(PATH[:2], np.full((1, 3), rate))).trust
        for rate in (0.2, 1.0)
    )
    assert low[1:].mean() < high[1:].mean()


def test_a_follower_replans_after_a_bound_that_failed_and_the_mission_is_told_whole():
    campaign = begun()
    follower = tb.Follower(campaign)
    seen = (np.random.default_rng(3).uniform(size=(20, 10, 3)) < 0.6).astype(float)

    def drive(t, status="ok"):
        follower.begin(t)
        for j, tick in enumerate(seen[len(follower.bounds)]):
            follower.tick(t + j, tick)
        follower.end(t + 10.0, status)

    drive(0.0)
    drive(10.0, "stuck")
    with pytest.raises(TrustboError, match="over"):
        follower.begin(20.0)
    with pytest.raises(TrustboError, match="progress"):
        follower.tick(20.0, [1, 1, 1])

    stuck = PATH[1:3]
    plan = follower.replan()
    assert follower.path == plan.path == campaign.ask().path
    assert plan.path[:4] == (*PATH[:3], PATH[1])
    assert plan.blocked == (stuck,)
    while len(follower.rest) > 1:
        drive(10.0 * len(follower.bounds))
        if len(follower.bounds) == 4:
            plan = follower.replan()
            assert plan.path[:5] == follower.path[:5]

    driven = follower.path[3:]
    assert stuck not in pairwise(driven)
    assert stuck[::-1] not in pairwise(driven)

    told = follower.to_mission()
    assert told.status == "ok"
    assert [bound.status for bound in told.bounds[:3]] == ["ok", "stuck", "ok"]
    np.testing.assert_allclose(told.contact_rate, seen[: len(told.bounds)].mean(1))
    np.testing.assert_allclose(plan.trust[:2], campaign.ask().trust[:2])
    campaign.tell(told)
    assert campaign.table()["where"].tolist() == ["", "1,2"]

    # Each rate is an observation once, and only the bound that failed counts as a failure.
    rates = campaign.posterior["observed_data"]["contact_rate"].values[1]
    np.testing.assert_allclose(rates[: len(told.bounds)], told.contact_rate)
    risk = campaign.risk
    failed = tuple(bounds_along(stuck)[0])
    back = tuple(bounds_along(stuck[::-1])[0])
    assert risk.failures.sum() == risk.failures[failed].sum() == 1
    assert risk.trials[failed].sum() == 2  # and in the first mission, which passed
    assert risk.trials[back].sum() == 0
    assert risk.trials.sum() == 3 + len(told.bounds) - 1


def test_trust_of_a_plan_is_that_of_the_follower():
    campaign = begun()
    follower = tb.Follower(campaign)
    follower.begin(0.0)
    for t in range(10):
        follower.tick(float(t), [t < 2, t < 9, np.nan])
    follower.end(10.0)
    plan = follower.replan()
    np.testing.assert_allclose(plan.trust[0], follower.trust.mean)
    lost = 1.0 - np.array([0.2, 0.9, follower.trust.mean[2]]).mean()
    without = campaign.planner.from_cell(PATH[1], x0=follower.trust.mean)
    draws = follower._before.resample()
    rest = without.evaluate(plan.path[1:], draws.mean())
    assert plan.value == pytest.approx(rest.value - lost, abs=0.02)  # another hazard posterior
    assert plan.bands.shape == (4, len(plan.path) - 1, 3)
    assert (np.diff(plan.bands, axis=0) >= 0.0).all()


def test_a_team_that_reached_the_cell_in_which_a_bound_failed_goes_on_from_there():
    campaign = begun()
    so_far = mission(PATH, rates_of(2), ["ok", "lost_contact"])
    plan = campaign.replan(PATH[2], so_far)
    assert plan.path[:3] == PATH[:3]
    assert plan.path[3] != PATH[1]


def test_without_the_bounds_so_far_the_team_has_driven_the_plan():
    campaign = begun()
    plan = campaign.replan(PATH[1], blocked=[PATH[1:3]])
    assert plan.path[:2] == PATH[:2]
    assert plan.path[2] != PATH[2]
    again = campaign.replan(plan.path[2], blocked=[plan.path[2:4]])
    assert again.path[:3] == plan.path[:3]
    assert set(again.blocked) == {PATH[1:3], plan.path[2:4]}  # blocked for the whole mission
    assert again.path[3] != plan.path[3]

    at_start = begun().replan(ENDS[0], blocked=[PATH[:2]])
    assert at_start.path[0] == ENDS[0]
    assert at_start.path[1] != PATH[1]


def test_a_new_plan_survives_a_crash(tmp_path):
    campaign = begun(directory=tmp_path / "field")
    plan = campaign.replan(PATH[1], mission(PATH, rates_of(2), ["ok", "stuck"]))
    campaign.close()  # nothing else is written
    with tb.Campaign.load(tmp_path / "field") as loaded:
        asked = loaded.ask()
        assert asked.path == plan.path
        assert asked.blocked == plan.blocked
        assert asked.n_driven == plan.n_driven == 3  # with the way back
        np.testing.assert_array_equal(asked.trust, plan.trust)
        rates = rates_of(len(plan.path) - 1)
        statuses = ["ok", "stuck", *["ok"] * (len(rates) - 2)]
        loaded.tell(mission(plan.path, rates, statuses))

    with tb.Campaign.load(tmp_path / "field") as loaded:
        told = loaded.missions[-1]
        assert [bound.status for bound in told.bounds] == statuses
        assert loaded.risk.failures.sum() == 1


def test_failures_of_the_mission_in_progress_lower_the_probability_to_arrive():
    campaign = begun()
    assert campaign.risk.past_failures.sum() == 0.0
    plan = campaign.ask()
    statuses = []
    for _ in range(3):
        statuses += ["ok", "stuck"]  # the first bound or the way back, and the next one
        so_far = mission(plan.path, rates_of(len(statuses)), statuses)
        plan = campaign.replan(PATH[1], so_far)
    assert plan.p_arrive < 0.9


def test_what_cannot_be_replanned_leaves_the_plan_as_it_was(tmp_path):
    campaign = begun(directory=tmp_path / "field")
    asked = campaign.ask()
    so_far = mission(PATH, rates_of(2), ["ok", "stuck"])
    around = [((2, 1), (2 + i, 1 + j)) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    for error, given in (
        (TrustboError, {"cell": (0, 0)}),  # not in the plan
        (TrustboError, {"cell": ENDS[1]}),
        (TrustboError, {"cell": (0, 0), "so_far": so_far}),
        (TrustboError, {"cell": PATH[0], "so_far": so_far}),
        (TrustboError, {"cell": PATH[1], "so_far": mission(PATH[1:], rates_of(1), "stuck")}),
        (TrustboError, {"cell": PATH[1], "blocked": [((0, 0), (3, 3))]}),
        (TrustboError, {"cell": PATH[1], "blocked": [(0, 0)]}),
        (NoPathError, {"cell": PATH[1], "blocked": around}),
    ):
        with pytest.raises(error):
            campaign.replan(**given)
    assert campaign.ask() is asked

    (tmp_path / "field").rename(tmp_path / "elsewhere")
    with pytest.raises(TrustboError):
        campaign.replan(PATH[1], so_far)
    assert campaign.ask() is asked


def test_a_mission_without_the_way_back_is_refused():
    campaign = begun()
    jump = mission([(3, 0), (2, 1), (1, 2), (3, 1), (2, 2), (1, 3), (0, 3)], rates_of(6),
                   ["ok", "stuck", *["ok"] * 4])  # fmt: skip
    with pytest.raises(TrustboError, match="back"):
        campaign.tell(jump)
    assert len(campaign.missions) == 1


def test_the_limit_on_bounds_is_that_of_the_whole_mission():
    planner = Planner(random_cells(), *ENDS, max_bounds=5)
    assert planner.from_cell((2, 1), n_driven=1).problem.paths.longest == 4
    assert planner.from_cell((3, 0), n_driven=4).problem.paths.longest == 3  # the fewest
    assert planner.from_cell((2, 1)).start == (2, 1)


def test_a_table_of_such_a_mission_is_read_and_told():
    campaign = begun()
    plan = campaign.replan(PATH[1], mission(PATH, rates_of(2), ["ok", "stuck"]))
    rates = rates_of(len(plan.path) - 1)
    rates[2] = np.nan  # the way back
    told = mission(plan.path, rates, ["ok", "stuck", *["ok"] * (len(rates) - 2)])
    [read] = tb.logs.read_table(tb.logs.to_frame([told]))
    assert [bound.status for bound in read.bounds] == [bound.status for bound in told.bounds]
    assert read.has_same_data(told)
    campaign.tell(read)
    assert campaign.table()["state"].tolist() == ["learned", "learned"]
    assert campaign.risk.failures.sum() == 1


@pytest.mark.parametrize("log", ["whole path", "up to the failure", "replanned"])
def test_a_bound_that_stopped_robots_is_not_planned_again_with_its_next_move(log):
    """Its failure may depend on the next move, which a log that ends or turns back lacks."""
    robot = tb.Robot(max_slope=np.radians(25.0))
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), 1.0, seed=2)
    team = tb.Team(robots=(robot, robot), lead=robot)
    hilly = tb.Workspace.from_terrain(terrain, (4, 4), team, n_posts=1)
    campaign = tb.Campaign(hilly, *ENDS)
    path = campaign.ask().path
    k = 3
    planned = tuple(pairs_along(path, 1)[k])
    before = campaign.risk.mean[planned]
    of_units = hilly.difficulty.whole().unit[planned[:3]]
    assert of_units[planned[3]] not in (of_units[END], of_units[6])  # south is the way back

    def told(cells, statuses):
        n = len(statuses)
        z = np.full((n, 2, len(hilly.features)), np.nan)
        rates = np.full((n, 2), 0.9)
        return tb.Mission.from_arrays(cells, z, rates, status=statuses, features=hilly.features)

    stuck = ["ok"] * k + ["stuck"]
    if log == "whole path":
        campaign.tell(told(path, stuck))
    elif log == "up to the failure":
        campaign.tell(told(path[: k + 2], stuck))
    else:
        new = campaign.replan(path[k], told(path[: k + 2], stuck)).path
        campaign.tell(told(new, stuck + ["ok"] * (len(new) - k - 2)))

    assert campaign.risk.failures[planned] == campaign.risk.failures.sum() == 1.0
    assert campaign.risk.mean[planned] > max(0.1, 2.0 * before)
    assert planned not in [tuple(bound) for bound in pairs_along(campaign.ask().path, 1)]
