"""The loop of a campaign: it learns, stops by rules, resumes, and collects a result."""

import itertools
import pickle
import time

import numpy as np
import pytest
import xarray as xr
from missions import TRUTH
from scipy.special import expit
from worlds import ModelSimulator, hillside, random_cells

import trustbo as tb
from trustbo.campaign.folder import MemoryStorage
from trustbo.inference import params_of
from trustbo.planning import Planner
from trustbo.planning.drawn_paths import choose_draws

ENDS = ((3, 0), (0, 3))
QUIET = {"sampler": "importance", "progress": False}


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


def run(workspace, **options):
    usual = {"n_iterations": 3, "simulator": ModelSimulator(workspace), **QUIET}
    return tb.iterate(workspace, *ENDS, **usual | options)


@pytest.fixture(scope="module")
def result(workspace):
    return run(workspace)


def test_an_unknown_argument_is_refused_with_the_closest_one(workspace):
    with pytest.raises(TypeError, match=r"iterate.*'n_iteration'.*'n_iterations'"):
        tb.iterate(workspace, *ENDS, n_iteration=3)
    with pytest.raises(TypeError, match=r"iterate.*'xyz'$"):
        tb.iterate(workspace, *ENDS, xyz=3)


def test_history_has_a_row_for_each_mission(result):
    history, paths = result.history, [mission.path for mission in result.missions]
    assert history["iteration"].values.tolist() == [1, 2, 3]
    for path, steps in zip(paths, history["path"].values.tolist(), strict=True):
        assert path == tuple(tuple(step) for step in steps if step[0] >= 0)
    changed = [False, paths[1] != paths[0], paths[2] != paths[1]]
    assert history["path_changed"].values.tolist() == changed
    assert history["trust_map"].dims == ("iteration", "row", "col")
    assert (history["k_hat"] <= 0.7).all()
    lost = [(1.0 - mission.contact_rate.mean(1)).sum() for mission in result.missions]
    np.testing.assert_allclose(history["contact_lost"], lost)
    assert (result.stop_reason, result.settings["simulator"]) == ("n_iterations", "ModelSimulator")
    table = result.table()
    assert table["path"][2].split() == [f"{row},{col}" for row, col in paths[1]]
    assert table["n_bounds"].tolist() == [len(path) - 1 for path in paths]


def test_result_recommends_the_best_path_under_the_last_posterior(result, workspace):
    params = params_of(result.posterior).mean()
    risk = tb.hazard.risk.BoundRisk(result.posterior["hazard"].to_dataset(), workspace)
    plan = Planner(workspace, *ENDS).with_risk(risk).plan(params)
    assert (result.path, result.plan().value) == (list(plan.path), plan.value)
    np.testing.assert_array_equal(result.plan().trust, plan.trust)
    assert (result.plan().bands[0] < result.plan().bands[-1]).all()
    np.testing.assert_allclose(result.trust_map, Planner(workspace, *ENDS).trust_map(params))


def test_campaign_learns_the_truth_and_finds_the_best_path(workspace):
    result = run(workspace, n_iterations=8, policy="random")
    for name in ("beta0", "b"):
        draws = result.posterior["posterior"][name]
        assert abs(float(draws.mean()) - getattr(TRUTH, name)) < 4 * float(draws.std())
    planner = Planner(workspace, *ENDS)
    best, found = planner.plan(TRUTH), planner.evaluate(result.path, TRUTH)
    assert found.value >= best.value - 0.02 * (len(best.path) - 1 + best.value)


def test_same_seed_gives_the_same_result(result, workspace):
    again = run(workspace)
    assert again.path == result.path
    for a, b in zip(again.posteriors, result.posteriors, strict=True):
        xr.testing.assert_equal(a["posterior"].to_dataset(), b["posterior"].to_dataset())
    other = run(workspace, seed=1, n_iterations=1)
    assert (other.missions[0].contact_rate[0] != result.missions[0].contact_rate[0]).any()


def test_results_follow_the_missions_of_their_campaign(result, workspace):
    shorter, whole = run(workspace, n_iterations=2), result
    assert len(shorter.history["iteration"]) == len(shorter.table()) == 2
    for _ in shorter.run(ModelSimulator(workspace), 3):
        pass
    assert shorter.table().equals(whole.table())
    assert (shorter.path, shorter.plan().value) == (whole.path, whole.plan().value)


def test_maps_are_over_the_posterior_and_lie_in_their_place(tmp_path):
    terrain = hillside(90.0, 120.0)
    workspace = tb.Workspace.from_terrain(terrain, (3, 4))
    result = tb.iterate(workspace, (2, 0), (0, 3), n_iterations=1, **QUIET)
    maps = result.maps(n_draws=50)
    assert {"trust_mean", "trust_sd", "path_probability", "visibility", "place_sd"} <= {*maps}
    assert maps["path_probability"][2, 0] == maps["path_probability"][0, 3] == 1.0
    np.testing.assert_allclose(maps["cost"], 1.0 - expit(maps["trust_mean"]), atol=1e-2)
    known = workspace.awareness.sel(feature="visibility").mean(("robot", "move"))
    np.testing.assert_allclose(maps["visibility"], known)
    assert result.maps(n_draws=50).identical(maps)
    assert maps.rio.crs == terrain.rio.crs
    assert maps["cost"].rio.bounds() == terrain.rio.bounds()
    x, y = workspace.grid.center((1, 2))
    assert maps["cost"].sel(x=x, y=y) == maps["cost"].isel(y=1, x=2)


@pytest.mark.parametrize("options", [{}, {"expected": True}], ids=["drawn", "expected"])
def test_trust_in_a_robot_at_a_place_is_that_of_the_last_posterior(result, workspace, options):
    draws = params_of(result.posterior, workspace, next_mission=not options)
    z = workspace.awareness.values[1, :, 2, 3]  # of r2
    moves = np.flatnonzero(workspace.passable_bounds.values[:, 2, 3])
    drift = z[moves] @ draws.beta[:, 1].T + draws.b[:, 1] + draws.place[:, 0, 2, 3]
    drift = drift + draws.place_bound[:, 0, moves, 2, 3].T
    own = params_of(result.posterior, workspace, next_mission=True).place_robot
    drift = drift + own.everywhere()[:, 1, moves, 2, 3].T
    expected = drift.mean(0) / (1.0 - draws.beta0[:, 1])

    trust = result.trust("r2", (2, 3), **options)
    np.testing.assert_allclose(trust, expected, rtol=1e-9)
    assert trust.dims == ("draw",)
    x, y = workspace.grid.center((2, 3))
    assert result.trust("r2", {"x": x, "y": y}, **options).identical(trust)
    np.testing.assert_allclose(result.trust(**options)[:, 1, 2, 3], expected, rtol=1e-9)
    maps = result.robot_maps(**options)
    np.testing.assert_allclose(maps["trust_mean"].sel(robot="r2")[2, 3], expected.mean())
    np.testing.assert_allclose(maps["trust_sd"].sel(robot="r2")[2, 3], expected.std())


def test_trust_before_anything_is_learned_is_that_of_the_prior(workspace):
    campaign = tb.Campaign(workspace, *ENDS)
    trust = campaign.trust("r2", (2, 3))
    draws = campaign.draw_prior(len(trust))
    moves = np.flatnonzero(workspace.passable_bounds.values[:, 2, 3])
    z = workspace.awareness.values[1, moves, 2, 3]
    without = (draws.beta @ z.T + draws.b[:, None]) / (1.0 - draws.beta0[:, None])

    # Expected effects of robots are 0, so that places are all that is added.
    ahead = campaign.forecast
    places = ahead.place[:, 0, 2, 3, None] + ahead.place_bound[:, 0, moves, 2, 3]
    places = places + ahead.place_robot.everywhere()[:, 1, moves, 2, 3]
    expected = (without + places / (1.0 - draws.beta0[:, None])).mean(1)
    found = campaign.trust("r2", (2, 3), expected=True)
    np.testing.assert_allclose(found, expected, rtol=1e-9)

    # No feature predicts line of sight, so drawn effects have the variance tau_slow^2 +
    # tau_mission^2 + tau_lasting^2, whose expected value is that of the squared prior scales.
    added = (trust - found).values
    assert abs(added.mean()) < 4.0 * added.std() / np.sqrt(len(added))
    np.testing.assert_allclose(added.std(), np.sqrt(2.0 * 0.2**2 + 0.3**2), rtol=0.3)

    # Maps have the largest trust of many paths, and so no effects of unknown places.
    of_prior = campaign.planner.maps(campaign.draw_prior(20))
    xr.testing.assert_equal(campaign.maps(n_draws=20), of_prior)


def test_maps_of_a_result_are_those_of_its_posterior(result):
    for options in ({}, {"expected": True}):
        maps = result.planner.maps(result.posterior, **options)
        xr.testing.assert_allclose(result.maps(**options), maps, rtol=1e-9)


def test_features_named_like_maps_are_renamed_in_maps():
    awareness = np.random.default_rng(3).uniform(size=(2, 4, 4, 2))
    workspace = tb.Workspace.from_awareness(awareness, features=("cost", "x"))
    simulator = tb.simulation.ModelSimulator(workspace, TRUTH)
    maps = run(workspace, n_iterations=1, simulator=simulator).maps(n_draws=20)
    for m, name in enumerate(("awareness_cost", "awareness_x")):
        np.testing.assert_allclose(maps[name], awareness[..., m].mean(0))


# --- stopping and resuming ---


def test_regret_bound_stops_when_the_path_is_nearly_the_best(workspace):
    options = {"objective": "terminal"}
    rule = tb.RegretBound(eps=0.2, delta=0.2)
    result = run(workspace, n_iterations=12, stop=rule, **options)
    assert 3 <= len(result.missions) < 12
    assert result.stop_reason.startswith("regret_bound")
    # By hand: the best of all paths under each draw against the recommended one.
    planner, draws = Planner(workspace, *ENDS, **options), params_of(result.posterior)
    shares = []
    some = choose_draws(draws, 500, seed=0)
    for d in range(500):
        best = planner.plan(some.draw(d)).value
        own = planner.evaluate(result.path, some.draw(d)).value
        shares.append((best - own) / best <= 0.2)
    assert tb.RegretBound(eps=0.2).probability(result, len(result.missions)) == np.mean(shares)
    assert tb.RegretBound(eps=1e-6, delta=0.01)(result) is None


@pytest.mark.parametrize("fails", [True, False])
def test_regret_bound_waits_until_every_bound_was_completed(workspace, fails):
    rule = tb.RegretBound(eps=0.9, delta=0.5)
    campaign = tb.Campaign(workspace, *ENDS, sampler="importance")
    for seed in range(2):
        other = ((3, 0), (2, 1), (1, 2), (0, 2), (0, 3))
        campaign.tell(ModelSimulator(workspace).run(other, seed=seed))
    path = campaign.recommend().path
    assert path == ((3, 0), (2, 1), (1, 2), (0, 3))
    assert min(rule.probability(campaign, n) for n in (1, 2)) == 1.0
    assert rule(campaign) is None
    driven = ModelSimulator(workspace, fail_at=3 if fails else None)
    campaign.tell(driven.run(path, seed=2))
    assert rule(campaign).startswith("regret_bound")
    assert (campaign.recommend().path == path) is not fails


def test_rules_are_callables_that_are_asked_between_missions(workspace):
    seen = []

    def enough(campaign):
        seen.append(campaign.missions[-1].status)
        return len(seen) == 2

    result = run(workspace, stop=enough)
    assert (len(result.missions), result.stop_reason, seen) == (2, "enough", ["ok", "ok"])
    late = time.monotonic() + 0.001
    result = run(workspace, stop=lambda campaign: time.monotonic() > late)
    assert (len(result.missions), result.stop_reason) == (1, "<lambda>")
    for wrong in ({"eps": 0.0}, {"delta": 1.0}):
        with pytest.raises(tb.TrustboError, match=next(iter(wrong))):
            tb.RegretBound(**wrong)
    with pytest.raises(tb.TrustboError, match="stop"):
        run(workspace, stop=7)


def test_generator_gives_each_mission_once_it_is_learned_from(workspace):
    campaign = tb.Campaign(workspace, *ENDS, sampler="importance")
    for plan, mission in itertools.islice(campaign.run(ModelSimulator(workspace), 5), 2):
        assert mission.path == plan.path == campaign.missions[-1].path
    assert len(campaign.missions) == 2
    assert campaign.stop_reason == "interrupted"


class Steady:
    """Simulator in which a bound has contact as its mean awareness."""

    def __init__(self, workspace):
        self.workspace = workspace

    def run(self, path, *, seed, mission=0):
        z = self.workspace.along(path)
        noise = 1e-3 * np.random.default_rng(seed).normal(size=z.shape[:2])
        return tb.Mission.from_arrays(path, z, np.clip(z.mean(-1) + noise, 0.0, 1.0))


def test_regret_against_the_truth_is_in_the_figure_of_the_history(workspace):
    truth = tb.simulation.Truth.from_simulator(Steady(workspace))
    result = run(workspace, n_iterations=2, simulator=Steady(workspace))
    with pytest.raises(tb.TrustboError, match="truth"):
        result.plot_history(Steady(workspace))
    line = result.plot_history(truth)[-1].get_lines()[0]
    best = truth.best(*ENDS, max_bounds="shortest+4")
    kept = len(best) - 1 - truth.lost(best)
    for mission, regret in zip(result.missions, line.get_ydata(), strict=True):
        lacking = truth.lost(mission.path) - truth.lost(best)
        assert regret == pytest.approx(100.0 * lacking / kept, abs=1e-9)
        assert regret >= -1e-9


class Described(ModelSimulator):
    """A simulator with settings that JSON does not have."""

    def __init__(self, workspace, **settings):
        super().__init__(workspace, blind=True)
        self.settings = {"tuple": (1, 2.5), "array": np.arange(3.0), "nan": np.nan} | settings

    def describe(self):
        return self.settings


def test_interrupted_campaign_resumes_with_the_same_simulator(workspace, tmp_path):
    simulator = Described(workspace)
    whole = run(workspace, simulator=simulator, n_iterations=2)
    run(workspace, simulator=simulator, directory=tmp_path, n_iterations=1)
    with pytest.raises(tb.TrustboError, match="simulator"):
        tb.resume(tmp_path, simulator=Described(workspace, tuple=(1, 2.6)), progress=False)
    again = tb.resume(tmp_path, simulator=simulator, n_iterations=2, progress=False)
    assert again.path == whole.path
    for a, b in zip(again.posteriors, whole.posteriors, strict=True):
        xr.testing.assert_equal(a["posterior"].to_dataset(), b["posterior"].to_dataset())


def test_campaign_that_a_rule_has_ended_resumes_only_on_request(workspace, tmp_path):
    options = {"simulator": ModelSimulator(workspace, blind=True), "progress": False}
    rule = tb.RegretBound(eps=0.9, delta=0.9)
    ended = run(
        workspace, objective="mean", n_iterations=5, stop=rule, directory=tmp_path, **options
    )
    n = len(ended.missions)
    assert n < 5
    for more, reason in (
        ({}, ended.stop_reason),
        ({"stop": rule, "n_iterations": 9}, ended.stop_reason),  # asked before it drives
        ({"stop": lambda campaign: "seen enough"}, "seen enough"),
    ):
        again = tb.resume(tmp_path, **options, **more)
        assert (len(again.missions), again.stop_reason) == (n, reason)
        assert tb.load_result(tmp_path).stop_reason == reason
    assert len(tb.resume(tmp_path, n_iterations=n + 1, **options).missions) == n + 1


def test_missions_of_real_robots_are_not_continued_in_a_simulator(workspace, tmp_path):
    with tb.Campaign(workspace, *ENDS, directory=tmp_path) as campaign:
        campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
    with pytest.raises(tb.TrustboError, match="not simulated"):
        tb.resume(tmp_path, n_iterations=2, progress=False)
    simulator = ModelSimulator(workspace)
    more = tb.resume(tmp_path, simulator=simulator, n_iterations=2, progress=False)
    assert len(more.missions) == 2


def test_a_closed_campaign_keeps_its_results_and_can_be_pickled(workspace, tmp_path):
    closed = run(workspace, n_iterations=2, directory=tmp_path)
    before = closed.table()
    for change in (
        lambda: closed.exclude(1, "a test"), lambda: closed.fail("rain"),
        lambda: closed.tell(closed.missions[0]),
    ):  # fmt: skip
        with pytest.raises(tb.TrustboError, match="closed"):
            change()
    assert closed.table().equals(before)
    again = pickle.loads(pickle.dumps(closed))
    assert again.path == closed.path
    assert isinstance(again.storage, MemoryStorage)
    again.fail("rain")  # the copy goes on in memory
    assert closed.table().equals(before)


@pytest.mark.parametrize(
    "options",
    [{"n_iterations": 0}, {"n_iterations": 2.5}, {"simulator": object()}, {"seed": -1},
     {"stop": tb.RegretBound}],
)  # fmt: skip
def test_bad_input_is_refused_before_anything_is_written(workspace, tmp_path, options):
    with pytest.raises(tb.TrustboError, match=next(iter(options))):
        run(workspace, directory=tmp_path / "never", **options)
    assert not (tmp_path / "never").exists()


def test_progress_is_a_line(workspace, capsys, monkeypatch):
    monkeypatch.setattr("trustbo.display.shows_bars", lambda: True)  # as in a terminal
    run(workspace, n_iterations=1)
    assert capsys.readouterr() == ("", "")
    run(workspace, n_iterations=1, progress=True)
    shown = capsys.readouterr().err
    assert "missions: 100%" in shown
    assert "k_hat" in shown
