"""Failures in the loop: learned beside trust, kept, resumed, and bounds that are avoided."""

import itertools

import numpy as np
import pandas as pd
import pytest
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.campaign.planners import to_avoid
from trustbo.errors import PosteriorError
from trustbo.hazard import Hazard, fit_hazard
from trustbo.hazard.exposures import LostMission
from trustbo.hazard.risk import BoundRisk
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace.moves import moves_along

ENDS = ((3, 0), (0, 3))


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


class Trap:
    """Missions that end in one bound, whenever they come to it."""

    def __init__(self, workspace, bound):
        self.inner, self.bound = ModelSimulator(workspace), bound

    def run(self, path, *, seed, mission=0):
        bounds = list(itertools.pairwise(path))
        fail_at = bounds.index(self.bound) + 1 if self.bound in bounds else None
        self.inner.fail_at = fail_at
        return self.inner.run(path, seed=seed)

    def describe(self):
        return {"simulator": "Trap"}


def begin(workspace, **options):
    return tb.Campaign(workspace, *ENDS, sampler="exact", seed=1, **options)


def recommended(workspace, limit):
    return begin(workspace, max_failure=limit).recommend()


def at(bound):
    return int(moves_along(bound)[0]), *bound[1]


def test_the_hazard_is_that_of_all_missions_and_in_the_posterior(workspace):
    campaign = begin(workspace)
    first = campaign.ask().path
    bound = first[1:3]
    simulator = Trap(workspace, bound)
    before = campaign.risk.mean[at(bound)]
    posterior = campaign.tell(simulator.run(first, seed=0))
    assert posterior["hazard"]["failures"].values[at(bound)] == 1
    assert campaign.risk.mean[at(bound)] > 2.0 * before
    alone = fit_hazard(campaign.missions, workspace, seed=campaign.seed_of("hazard"))
    assert alone.drop_attrs().identical(campaign.hazard.drop_attrs())
    assert campaign.posterior["hazard"].to_dataset().identical(campaign.hazard)
    assert "latent" in campaign.posterior.children


def test_a_bound_that_stopped_robots_twice_is_not_entered_again(workspace):
    """Failures cost nothing here, so that no other reason keeps the plan away."""
    campaign = begin(workspace, objective="mean", policy="greedy")
    bound = tuple(campaign.ask().path[1:3])
    simulator = Trap(workspace, bound)
    paths = []
    for seed in range(5):
        paths.append(campaign.ask().path)
        campaign.tell(simulator.run(paths[-1], seed=seed))
    assert sum(bound in itertools.pairwise(path) for path in paths) <= 2
    assert bound not in itertools.pairwise(campaign.recommend().path)


def test_bounds_are_avoided_from_the_second_failure_until_they_recover(workspace):
    path = ((3, 0), (2, 1), (1, 2), (0, 3))
    stuck, fine = (
        ModelSimulator(workspace, fail_at=fail_at).run(path, seed=0) for fail_at in (2, None)
    )
    for told, avoided in (([stuck], 0), ([stuck] * 2, 1), ([stuck] * 2 + [fine] * 15, 0)):
        risk = BoundRisk.of(fit_hazard(told, workspace), workspace)
        assert to_avoid(risk).sum() == avoided
        assert to_avoid(risk)[at(path[1:3])] == avoided


def test_it_is_entered_where_there_is_no_other_way():
    corridor = tb.Workspace.from_awareness(np.full((1, 1, 3, 1), 0.6))
    campaign = tb.Campaign(corridor, (0, 0), (0, 2), sampler="exact")
    for _ in range(3):
        campaign.ask()
        campaign.fail("stuck", where=(0, 2))
    assert campaign.risk.mean[4, 0, 2] > 0.5
    assert campaign.ask().path == ((0, 0), (0, 1), (0, 2))


def test_a_mission_that_did_not_report_is_learned_from(workspace):
    campaign = begin(workspace)
    path = campaign.ask().path
    campaign.fail("tipped")
    expected = fit_hazard(
        [], workspace, lost=[LostMission(path, "tipped")], seed=campaign.seed_of("hazard")
    )
    assert campaign.hazard.drop_attrs().identical(expected.drop_attrs())
    mean = campaign.risk.mean[moves_along(path), *np.array(path)[1:].T]
    assert (mean > BoundRisk.of(fit_hazard([], workspace), workspace).mean[at(path[:2])]).all()
    campaign.ask()
    campaign.fail("rain")
    assert campaign.hazard["failures_by_cause"].values.tolist() == [0, 1, 0, 0, 0]


def test_a_plan_beyond_the_limit_says_so(workspace):
    with pytest.warns(UserWarning, match=r"fails with a chance of .* beyond max_failure = 1e-06"):
        plan = begin(workspace, max_failure=1e-6).ask()
    assert plan.infeasible
    assert plan_from_record(plan_to_record(plan), workspace).infeasible
    assert "none keeps within max_failure" in repr(recommended(workspace, 1e-6))
    assert "fails beyond max_failure" in repr(plan)
    within = begin(workspace, max_failure=0.9).ask()  # no warning, which would be an error
    assert not within.infeasible
    assert "max_failure" not in repr(within)


@pytest.mark.parametrize(
    ("reason", "message"),
    [
        ("", "give a reason, such as one of stuck, tipped"),
        (None, "got None"),
    ],
)
def test_an_empty_reason_is_refused(workspace, reason, message):
    campaign = begin(workspace)
    with pytest.raises(tb.TrustboError, match=message):
        campaign.fail(reason)
    assert campaign.state.failures == []


def test_a_mission_that_arrived_did_not_fail(workspace):
    campaign = begin(workspace)
    mission = ModelSimulator(workspace).run(campaign.ask().path, seed=0)
    with pytest.raises(tb.TrustboError, match="its status is 'ok', and 'stuck' is a failure"):
        campaign.fail("stuck", mission)
    assert campaign.missions == []


def test_tables_have_a_row_for_each_mission_that_failed(workspace, tmp_path):
    with begin(workspace, directory=tmp_path / "kept") as campaign:
        path = campaign.ask().path
        campaign.fail("stuck", where=path[2])
        assert campaign.table()["where"].tolist() == [f"{path[2][0]},{path[2][1]}"]
        simulator = ModelSimulator(workspace)
        campaign.tell(simulator.run(campaign.ask().path, seed=0))
        simulator.fail_at = 2
        part = simulator.run(campaign.ask().path, seed=1)
        campaign.fail("the wheel broke", part)
        campaign.ask()
        campaign.fail("rain")
        table = campaign.table()
        saved = tb.load_result(tmp_path / "kept").table()
    assert table.index.isna().tolist() == [True, False, False, True]
    assert table.loc[2, "where"] == ",".join(map(str, part.path[2]))
    assert table["reason"].tolist() == ["stuck", "", "the wheel broke", "rain"]
    assert table["state"].tolist() == ["given up", "learned", "learned", "given up"]
    assert table["status"].tolist() == ["stuck", "ok", part.status, "aborted"]
    n_bounds = [2, len(campaign.missions[0].bounds), 2]
    assert table["n_bounds"].tolist()[:3] == n_bounds
    pd.testing.assert_frame_equal(saved[table.columns], table)
    written = pd.read_csv(tmp_path / "kept" / "history.csv", keep_default_na=False)
    assert written["reason"].tolist() == table["reason"].tolist()


def test_where_is_checked(workspace):
    campaign = begin(workspace)
    path = campaign.ask().path
    with pytest.raises(tb.TrustboError, match=r"where must be a cell that the plan enters"):
        campaign.fail("stuck", where=path[0])
    with pytest.raises(tb.TrustboError, match="is for the reasons stuck, tipped"):
        campaign.fail("rain", where=path[1])
    with pytest.raises(tb.TrustboError, match="the mission tells where it failed"):
        campaign.fail("stuck", ModelSimulator(workspace).run(path, seed=0), where=path[1])
    assert campaign.state.failures == []


def test_a_campaign_resumes_with_the_same_hazard(workspace, tmp_path):
    campaign = begin(workspace, directory=tmp_path)
    bound = tuple(campaign.ask().path[1:3])
    simulator = Trap(workspace, bound)
    for seed in range(2):
        campaign.tell(simulator.run(campaign.ask().path, seed=seed))
    campaign.ask()
    campaign.fail("stuck")
    campaign.fail("lost_contact", where=campaign.ask().path[1])
    with campaign:
        pass
    with tb.Campaign.load(tmp_path) as again:
        assert again.state.failures == campaign.state.failures
        assert again.hazard.drop_attrs().identical(campaign.hazard.drop_attrs())
        np.testing.assert_array_equal(again.risk.draw(5), campaign.risk.draw(5))
        assert again.ask().path == campaign.ask().path
        kept = again.posteriors[1]["hazard"].to_dataset()
        assert kept.identical(campaign.posteriors[1]["hazard"].to_dataset())


def test_a_refused_hazard_leaves_the_one_before(workspace, monkeypatch):
    campaign = begin(workspace)
    campaign.tell(ModelSimulator(workspace, fail_at=1).run(campaign.ask().path, seed=0))
    before = campaign.hazard

    def refuse(*args, **kwargs):
        raise PosteriorError("hazard refused: k-hat = 0.90 > 0.7.")

    monkeypatch.setattr("trustbo.campaign.learning.fit_hazard", refuse)
    with pytest.warns(UserWarning, match="goes on with the hazard before"):
        campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=1))
    assert campaign.hazard.identical(before)


def test_a_mission_set_aside_by_hand_is_forgotten(workspace):
    campaign = begin(workspace)
    for seed in range(2):
        campaign.tell(ModelSimulator(workspace, fail_at=1).run(campaign.ask().path, seed=seed))
    campaign.set_aside("a person pushed the robot")
    assert campaign.hazard["failures"].values.sum() == 1


def test_priors_of_the_hazard_are_an_option_that_is_kept(workspace, tmp_path):
    prior = Hazard(intercept=(-3.0, 1.0), cause=0.5)
    campaign = begin(workspace, hazard=prior, directory=tmp_path)
    expected = fit_hazard([], workspace, prior, seed=campaign.seed_of("hazard"))
    assert campaign.hazard.drop_attrs().identical(expected.drop_attrs())
    assert campaign.options == begin(workspace, hazard={"intercept": [-3, 1], "cause": 0.5}).options
    campaign.ask()
    with campaign:
        pass
    with tb.Campaign.load(tmp_path) as again:
        assert again.options.hazard == prior
        assert again.risk.mean[4, 0, 1] == campaign.risk.mean[4, 0, 1]
    with pytest.raises(tb.TrustboError, match="unknown prior of the hazard 'intercpt'; did you"):
        begin(workspace, hazard={"intercpt": (0.0, 1.0)})
    with pytest.raises(tb.TrustboError, match=r"hazard must be a hazard\.Hazard"):
        begin(workspace, hazard=0.1)
