"""When a campaign ends early, and what its loop shows."""

import itertools
import logging
import time

import numpy as np
import pytest
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo import simulation
from trustbo.campaign.stopping import reason_to_stop
from trustbo.inference.draws import params_of
from trustbo.planning import Planner

ENDS = ((3, 0), (0, 3))
QUIET = {"sampler": "exact", "progress": False}

TERMINAL = {"objective": "terminal"}


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


def iterate(workspace, **options):
    return tb.iterate(
        workspace, *ENDS, **{"simulator": ModelSimulator(workspace), **QUIET, **options}
    )


def test_a_campaign_stops_when_the_recommended_path_is_nearly_the_best(workspace):
    result = iterate(
        workspace, n_iterations=12, stop=tb.RegretBound(eps=0.2, delta=0.2), **TERMINAL
    )
    assert 3 <= len(result.missions) < 12
    assert result.stop_reason.startswith("regret_bound: P(regret <= 0.2) = ")
    # What the rule says, counted by hand: every draw's best of all paths against the recommended.
    planner = Planner(workspace, *ENDS, **TERMINAL)
    draws = params_of(result.posterior)
    drawn = planner.plan_draws(draws, n_draws=500)
    shares = []
    for d in drawn.chosen:
        best = planner.plan(draws.draw(int(d)))
        own = planner.evaluate(result.path, draws.draw(int(d))).value
        shares.append((best.value - own) / best.value <= 0.2)
    campaign = tb.Campaign(workspace, *ENDS, sampler="exact", **TERMINAL)
    for mission in result.missions:
        campaign.tell(mission)
    assert tb.RegretBound(eps=0.2).probability(campaign, len(result.missions)) == np.mean(shares)


def test_it_does_not_stop_while_paths_differ_by_more(workspace):
    result = iterate(
        workspace, n_iterations=3, stop=tb.RegretBound(eps=1e-6, delta=0.01), **TERMINAL
    )
    assert result.stop_reason == "n_iterations"


def test_patience_asks_for_several_missions_in_a_row(workspace):
    campaign = tb.Campaign(workspace, *ENDS, sampler="exact")
    rule = tb.RegretBound(eps=0.9, delta=0.5, patience=2, min_missions=1)
    campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
    assert rule(campaign) is None
    campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=1))
    assert rule(campaign).startswith("regret_bound")


@pytest.mark.parametrize("fails", [True, False])
def test_no_campaign_ends_on_a_path_of_which_a_bound_was_never_completed(workspace, fails):
    """The last bound of the best path may be the robots' end, and no mission came there yet."""
    rule = tb.RegretBound(eps=0.9, delta=0.5, patience=2, min_missions=2)
    campaign = tb.Campaign(workspace, *ENDS, sampler="exact")
    for seed in range(2):
        other = ((3, 0), (2, 1), (1, 2), (0, 2), (0, 3))
        campaign.tell(ModelSimulator(workspace).run(other, seed=seed))
    path = campaign.recommend().path
    assert path == ((3, 0), (2, 1), (1, 2), (0, 3))
    assert min(rule.probability(campaign, n) for n in (1, 2)) == 1.0  # of the regret it is sure
    assert rule(campaign) is None
    driven = ModelSimulator(workspace, fail_at=3 if fails else None)
    campaign.tell(driven.run(path, seed=2))
    assert rule(campaign).startswith("regret_bound")
    assert (campaign.recommend().path == path) is not fails


def test_rules_are_asked_between_missions_only(workspace):
    """A rule may take it that there is a mission."""
    seen = []

    def enough(campaign):
        seen.append(campaign.missions[-1].status)
        return len(seen) == 2

    assert len(iterate(workspace, stop=enough).missions) == 2
    assert seen == ["ok", "ok"]


def test_seconds_and_rules_of_one_s_own_stop_too(workspace):
    def enough(campaign):
        return len(campaign.missions) >= 2

    assert iterate(workspace, stop=enough).stop_reason == "enough"
    limit = tb.TimeLimit(0.001)
    time.sleep(0.01)
    result = iterate(workspace, stop=[lambda campaign: None, limit])
    assert (len(result.missions), result.stop_reason) == (1, "seconds: 0.001")
    assert reason_to_stop([lambda campaign: "rain"], None) == "rain"


def test_bad_rules_are_refused_before_work(workspace):
    for options, message in (
        ({"eps": 0.0}, r"RegretBound.eps must be in \(0, 1\); got 0.0"),
        ({"delta": 1.0}, r"RegretBound.delta must be in \(0, 1\); got 1.0"),
        ({"patience": 0}, "RegretBound.patience must be a whole number from 1 on; got 0"),
    ):
        with pytest.raises(tb.TrustboError, match=message):
            tb.RegretBound(**options)
    with pytest.raises(tb.TrustboError, match=r"TimeLimit.limit must be positive"):
        tb.TimeLimit(-1.0)
    with pytest.raises(tb.TrustboError, match=r"stop must be callables .* got 7"):
        iterate(workspace, stop=[7])


def test_the_generator_gives_each_mission_as_it_is_learned(workspace):
    seen = []
    campaign = tb.Campaign(
        workspace, *ENDS, sampler="exact", callbacks=[lambda c, mission: seen.append(mission)]
    )
    steps = campaign.run(ModelSimulator(workspace), n_iterations=5)
    for plan, mission in itertools.islice(steps, 2):
        assert mission.path == plan.path
        assert campaign.missions[-1].path == plan.path
    assert len(campaign.missions) == len(seen) == 2
    assert campaign.result().stop_reason == "interrupted"
    table = campaign.table()
    assert list(table.index) == [1, 2]
    assert table.loc[2, "path"].startswith("3,0 ")
    assert table.loc[1, "status"] == "ok"


class Steady:
    """Simulator in which a bound has contact as its mean awareness."""

    def __init__(self, workspace):
        self.workspace = workspace

    def run(self, path, *, seed, mission=0):
        z = self.workspace.along(path)
        noise = 1e-3 * np.random.default_rng(seed).normal(size=z.shape[:2])
        return tb.Mission.from_arrays(path, z, np.clip(z.mean(-1) + noise, 0.0, 1.0))


def test_true_regret_goes_into_the_history(workspace):
    simulator = Steady(workspace)
    truth = simulation.Truth.of(simulator)
    result = iterate(workspace, n_iterations=2, simulator=simulator, truth=truth)
    assert result.history["regret"].attrs["units"] == "%"
    regret = result.history["regret"].values
    best = truth.best(*ENDS, max_bounds="shortest+4")
    kept = len(best) - 1 - truth.lost(best)
    for mission, value in zip(result.missions, regret, strict=True):
        lacking = truth.lost(mission.path) - truth.lost(best)
        assert value == pytest.approx(100.0 * lacking / kept, abs=1e-9)
    assert (regret >= -1e-9).all()


def test_progress_is_a_line_and_the_log_has_it_too(workspace, capsys, caplog):
    with caplog.at_level(logging.INFO, logger="trustbo"):
        iterate(workspace, n_iterations=2)
    assert capsys.readouterr() == ("", "")
    assert "mission 2: objective -" in caplog.text
    iterate(workspace, n_iterations=2, progress=True)
    line = capsys.readouterr().err.splitlines()[-1]  # no carriage returns in a file
    assert line.startswith("mission 2/2: objective -")
    assert "k-hat" in line
    assert "ok" in line


def test_no_mission_no_result(workspace):
    campaign = tb.Campaign(workspace, *ENDS)
    with pytest.raises(tb.TrustboError, match="the campaign has no mission yet"):
        campaign.result()
    assert len(campaign.history) == 0
