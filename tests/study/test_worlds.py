"""Worlds: what is true and what is assumed, the comparison on them, and what is refused."""

import dataclasses
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.models import PlaceEffect, PooledTrust
from trustbo.planning.paths import AdmissiblePaths, PathClass
from trustbo.planning.policies import ucb
from trustbo.simulation import Dust, KinematicSimulator, Threat, Truth
from trustbo.study import load_study, run_worlds, worlds_table
from trustbo.study.calls import identity_of
from trustbo.study.kept import expected_loss, least_loss
from trustbo.study.methods import cases_of
from trustbo.study.world import COURSES, World, aged
from trustbo.workspace.sight import Sight

TINY = World("tiny", "aged", "synthetic-0", aged=True, shape=(3, 3), cell=20.0)
ROWS = ("corner", "random path", "shortest path", "paper")


def corner(key, posterior, planner):
    """Policy of a user: along two sides."""
    (row, col), (up, right) = planner.start, planner.goal
    path = [
        *((r, col) for r in range(row, up - 1, -1)),
        *((up, c) for c in range(col + 1, right + 1)),
    ]
    return planner.evaluate(path, posterior.mean())


def blind(workspace, **true):
    """Simulator of a user: scans detect half as often."""
    team = true["team"]
    robots = tuple(dataclasses.replace(robot, detection=0.5) for robot in team.robots)
    lead = dataclasses.replace(team.lead, detection=0.5)
    return KinematicSimulator(workspace, **true | {"team": tb.Team(robots=robots, lead=lead)})


@pytest.fixture
def tiny(monkeypatch, tmp_path_factory):
    """A benchmark of one small world, and the cache of its truth."""
    cache = tmp_path_factory.getbasetemp() / "cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr("trustbo.study.benchmark.worlds", lambda data=None: {"tiny": TINY})


def cases(models, policies, baselines=(), methods=None):
    return cases_of(models, policies, baselines, methods or {}, "mean", 9, "exact")


def run(folder, **changes):
    options = {"policies": corner, "courses": ["sw-ne"], "n_iterations": 2, "progress": False}
    options["baselines"] = "random", "shortest", "paper"
    return run_worlds(folder, **options | changes)


def test_an_old_survey_has_lower_canopy_clearings_and_errors_of_the_ground():
    now = tb.terrain.synthetic_terrain((80.0, 80.0), seed=0)
    old = aged(now)
    error = (old["dem"] - now["dem"]).values
    assert error.std() == pytest.approx(0.3, rel=0.05)
    assert np.abs(np.diff(error, axis=0)).max() < 0.15  # smooth
    canopy, before = ((t["dsm"] - t["dem"]).values for t in (now, old))
    wooded = canopy > 0.1
    cleared = wooded & (before < 1e-9)
    assert 0.02 < cleared.sum() / wooded.sum() < 0.4
    np.testing.assert_allclose(
        before[wooded & ~cleared], 0.7 * canopy[wooded & ~cleared], atol=1e-9
    )
    assert old.rio.crs == now.rio.crs


def test_the_true_world_differs_from_the_assumed_one_as_stated():
    climbing, usual = tb.Robot(max_slope=0.3), tb.Team()
    world = World(
        "w", "canopy", "synthetic-0", Sight("wall"), Sight(),
        tb.Team(robots=(climbing,) * 3), usual, shape=(3, 3), cell=20.0,
    )  # fmt: skip
    workspace = world.workspace()
    simulator = world.simulator(workspace)
    assert (workspace.sights[0].mode, simulator.sight.mode) == ("transmittance", "wall")
    assert workspace.team == usual
    assert simulator.team == world.team
    np.testing.assert_array_equal(TINY.true_terrain()["dem"], simulator.terrain["dem"])
    assert not np.allclose(TINY.workspace().terrain["dem"], TINY.true_terrain()["dem"])
    for course in COURSES:
        start, goal = world.ends(course)
        assert max(abs(start[0] - goal[0]), abs(start[1] - goal[1])) == 2


def test_worlds_that_differ_in_what_happens_alone_share_their_workspace():
    one = dataclasses.replace(TINY, name="one", events=(Dust(0.5, 1),), connectivity=4)
    assert one.workspace() is TINY.workspace()
    assert one.identity() != TINY.identity()


def test_centres_of_events_are_shares_of_the_terrain():
    world = dataclasses.replace(TINY, events=(Threat("jam", (0.25, 0.75), 9.0), Dust(0.5)))
    x, y = (world.true_terrain()[axis].values for axis in ("x", "y"))
    jam, dust = world.true_events()
    # Pixels of 1 m have centres half a metre inside.
    assert jam.center == pytest.approx((x.min() - 0.5 + 15.0, y.min() - 0.5 + 45.0))
    assert dust is world.events[1]
    assert world.simulator(world.workspace()).events == (jam, dust)


def test_a_simulator_that_takes_no_events_is_refused_where_something_happens(tiny, tmp_path):
    world = dataclasses.replace(TINY, events=(Dust(0.5),))

    def deaf(workspace, *, terrain, sight, team): ...

    with pytest.raises(TrustboError, match=r"'tiny' has .*, events, and .* keyword argument 'ev"):
        world.simulator(world.workspace(), deaf)


def test_methods_run_on_worlds_and_their_recommendations_are_judged(tiny, tmp_path):
    results = run(tmp_path)
    assert results["method"].values.tolist() == list(ROWS)
    assert set(results["status"].values.ravel()) <= {"ok", "stuck"}
    truth = Truth.of(TINY.simulator(TINY.workspace()))
    best = truth.value(truth.best((2, 0), (0, 2))).lost
    np.testing.assert_allclose(results["oracle"], best)
    side = ((2, 0), (1, 0), (0, 0), (0, 1), (0, 2))
    own = results.sel(run=results["method"] == "corner")
    np.testing.assert_allclose(own["regret_followed"], truth.regret(side))
    # The baselines recommend what they do next; the paper's, what it has learned.
    for name in ROWS[1:3]:
        row = results.sel(run=results["method"] == name)
        assert row["recommended"].values[0, 0].tolist() == row["path"].values[0, 1].tolist()
    short = results.sel(run=results["method"] == "shortest path")["path"].values
    assert (short[0, :, 3:] == -1).all()
    table = worlds_table(results)
    assert table.index.tolist() == list(ROWS)
    assert (table["arrive", "value"] <= 1.0).all()
    assert (table["regret after 0", "low"] <= table["regret after 0", "high"]).all()
    kept = results.sel(run=results["method"] == "paper")
    assert table.loc["paper", ("regret after 1", "value")] == kept["regret"].values[0, 0]
    assert table.loc["paper", ("lost after 0", "value")] == kept["lost_before"].values[0] - best
    by_kind = worlds_table(results, ["kind", "method"])
    assert ("aged", "paper") in by_kind.index
    before = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "runs").iterdir()}
    run(tmp_path)
    assert {f.name: f.stat().st_mtime_ns for f in (tmp_path / "runs").iterdir()} == before


def test_recommendations_are_judged_in_the_world_of_the_next_mission(tiny, tmp_path, monkeypatch):
    """Mission 1 of 0, 1, 2 is in dust, and mission 2 with a jam in the middle."""
    happens = Dust(0.7, 1, 1), Threat("jam", (0.5, 0.5), 12.0, first_mission=2)
    world = dataclasses.replace(TINY, events=happens)
    monkeypatch.setattr("trustbo.study.benchmark.worlds", lambda data=None: {"tiny": world})
    results = run(tmp_path, baselines=["shortest"], n_iterations=3)
    truth = Truth.of(world.simulator(world.workspace()))
    at = [truth.at(mission) for mission in range(4)]
    assert at[3] is at[2] is not at[1] is not at[0]
    best = [one.value(one.best((2, 0), (0, 2))).lost for one in at]
    assert len({*best[:3]}) == 3
    admitted = PathClass(8, "shortest+4")
    admissible = AdmissiblePaths(truth.workspace, (2, 0), (0, 2), admitted)
    for j in range(2):
        one = results.isel(run=j)
        np.testing.assert_allclose(one["best"], best[1:])
        np.testing.assert_allclose(one["best_followed"], best[:3])
        assert float(one["oracle"]) == pytest.approx(best[0])
        paths = {
            name: [[tuple(c) for c in path.tolist() if c[0] >= 0] for path in one[name].values]
            for name in ("path", "recommended")
        }
        for name, first, suffix in (("path", 0, "_followed"), ("recommended", 1, "")):
            for k, path in enumerate(paths[name]):
                now, value = at[first + k], at[first + k].value(path)
                assert float(one[f"lost{suffix}"][k]) == pytest.approx(value.lost)
                assert float(one[f"regret{suffix}"][k]) == pytest.approx(now.regret(path))
                loss = expected_loss(now, path) - least_loss(now, admissible)
                assert float(one[f"loss{suffix}"][k]) == pytest.approx(loss, abs=1e-12)


def test_a_world_of_four_ways_has_paths_and_an_oracle_of_four_ways(tiny, tmp_path, monkeypatch):
    world = dataclasses.replace(TINY, connectivity=4)
    monkeypatch.setattr("trustbo.study.benchmark.worlds", lambda data=None: {"tiny": world})
    results = run(tmp_path, policies="greedy", baselines=["random"], n_iterations=1)
    truth = Truth.of(world.simulator(world.workspace()))
    best = truth.best((2, 0), (0, 2), connectivity=4)
    np.testing.assert_allclose(results["oracle"], truth.value(best).lost)
    paths = np.concatenate([results[name].values[:, 0] for name in ("path", "recommended")])
    for path in paths:
        steps = np.abs(np.diff(path[path[:, 0] >= 0], axis=0)).sum(1)
        assert len(steps) >= 4
        assert (steps == 1).all()


def test_worlds_are_chosen_by_kind(tiny, tmp_path, monkeypatch):
    other = dataclasses.replace(TINY, name="other", kind="days", events=(Dust(0.5, 1),))
    both = {"tiny": TINY, "other": other}
    monkeypatch.setattr("trustbo.study.benchmark.worlds", lambda data=None: both)
    results = run(tmp_path, kinds=["days"], baselines=[], n_iterations=1)
    assert np.unique(results["world"]).tolist() == ["other"]
    assert np.unique(results["case"]).tolist() == ["other"]
    with pytest.raises(TrustboError, match="unknown kind of world 'night'; choose one of aged"):
        run(tmp_path, kinds=["night"])
    with pytest.raises(TrustboError, match="no world of tiny is of kind days"):
        run(tmp_path, only=["tiny"], kinds=["days"])


def test_a_user_s_policy_model_and_simulator_enter_by_one_argument(tiny, tmp_path):
    changes = {"baselines": (), "n_iterations": 1}
    own = run(
        tmp_path / "own", models=tb.models.PooledTrust(), simulator=blind,
        policies=["greedy", corner], **changes,
    )  # fmt: skip
    assert own["method"].values.tolist() == ["greedy", "corner"]
    plain = run(tmp_path / "plain", **changes)
    assert float(own["oracle"][1]) > float(plain["oracle"][0]) + 0.5  # half is lost
    assert len({*own["key"].values.tolist(), *plain["key"].values.tolist()}) == 3


def test_a_policy_may_be_named(tmp_path, monkeypatch):
    (tmp_path / "my_policies.py").write_text("def best(key, posterior, planner): ...")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", list(sys.path))
    ((name, case),) = cases("pooled", "my_policies:best").items()
    assert (name, case.policy) == ("best", "my_policies:best")


def test_every_model_and_policy_has_a_row_and_a_key_of_its_own():
    """Of three models of one class, two would have been left out without a word."""
    models = [PooledTrust(place=PlaceEffect()), PooledTrust(observation="censored"), PooledTrust()]
    policies = [partial(ucb, kappa=1.0), partial(ucb, kappa=2.0)]
    names = list(cases(models, policies))
    assert names[:3] == [
        "PooledTrust(places) ucb(kappa=1.0)",
        "PooledTrust(places) ucb(kappa=2.0)",
        "PooledTrust(censored) ucb(kappa=1.0)",
    ]
    assert len(set(names)) == 6
    assert identity_of(policies[0]) != identity_of(policies[1])
    assert identity_of(Lucky(1)) == identity_of(Lucky(1)) != identity_of(Lucky(2))
    with pytest.raises(TrustboError, match="two policies have the name 'Lucky'"):
        cases("pooled", [Lucky(1), Lucky(2)])


class Lucky:
    """A policy with a setting."""

    def __init__(self, number):
        self.number = number

    def __call__(self, key, posterior, planner): ...


def test_absent_files_are_named_with_where_to_put_them(tmp_path):
    with pytest.raises(tb.TrustboError, match=r"'tahoe' needs tahoe/dem\.tif and tahoe/dsm\.tif"):
        run_worlds(tmp_path, only=["tahoe"])
    with pytest.raises(
        tb.TrustboError, match=r"lacks .*/wellington/dem\.tif and .*: put a DEM and"
    ):
        run_worlds(tmp_path, data=tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"only": ["atlantis"]}, "unknown world 'atlantis'; choose one of"),
        ({"courses": ["up"]}, "unknown course 'up'; choose one of sw-ne"),
        ({"policies": "gredy"}, "unknown policy .* 'gredy'; choose one of greedy"),
        ({"policies": "nowhere:policy"}, "policy 'nowhere:policy' cannot be imported: No module"),
        ({"policies": 3}, "policy must be a name or a callable; got 3"),
        ({"models": "pool"}, "unknown model 'pool'; choose one of"),
        ({"models": "math:pi"}, "model must be a trust model, .* got 3.14"),
        ({"baselines": ["best"]}, "unknown baseline .* 'best'; choose one of random"),
        (
            {"simulator": "math:tau"},
            "simulator 'math:tau' must be a function that makes",
        ),
    ],
)
def test_impossible_comparisons_are_refused(tiny, tmp_path, changes, message):
    with pytest.raises(tb.TrustboError, match=message):
        run(tmp_path, **changes)


class Counting:
    """Policy that learns by itself: it counts missions, and recommends by their number."""

    def __init__(self):
        self.n_missions = 0

    def __call__(self, key, posterior, planner):
        return corner(key, posterior, planner)

    def learn(self, campaign, mission):
        self.n_missions += 1

    def recommend(self, campaign):
        paths = ((2, 0), (1, 1), (0, 2)), ((2, 0), (1, 0), (0, 1), (0, 2))
        return paths[min(self.n_missions, 1)]


def test_a_factory_of_methods_makes_a_new_one_for_each_campaign(tiny, tmp_path):
    changes = {"baselines": [], "methods": {"counting": Counting}, "courses": ["sw-ne", "w-e"]}
    results = run(tmp_path, n_iterations=1, **changes)
    assert results["method"].values.tolist() == ["corner", "counting"] * 2
    own = results.sel(run=(results["method"] == "counting") & (results["course"] == "sw-ne"))
    truth = Truth.of(TINY.simulator(TINY.workspace()))
    before, after = (Counting.recommend(SimpleNamespace(n_missions=n), None) for n in (0, 1))
    np.testing.assert_allclose(own["regret_before"], truth.regret(before, max_bounds="shortest+4"))
    np.testing.assert_allclose(own["regret"][:, 0], truth.regret(after, max_bounds="shortest+4"))


def test_factories_that_differ_in_a_constant_alone_have_rows_of_their_own(tiny, tmp_path):
    methods = {"one": lambda: Lucky(1), "two": lambda: Lucky(2)}
    one, two = cases("pooled", [], [], methods).values()
    assert one.identity() != two.identity()
    assert one.identity() == cases("pooled", [], [], methods)["one"].identity()


class Informed:
    """Policy that is given the truth."""

    def __init__(self, truth):
        self.truth = truth

    def __call__(self, key, posterior, planner):
        return planner.evaluate(self.truth.best(planner.start, planner.goal), posterior.mean())

    def recommend(self, campaign):
        return self.truth.at(0).best(campaign.planner.start, campaign.planner.goal)


def test_a_factory_with_a_parameter_truth_is_given_that_of_the_scene(tiny, tmp_path):
    changes = {"policies": [], "baselines": [], "methods": {"informed": Informed}}
    results = run(tmp_path, **changes)
    np.testing.assert_array_equal(results["regret"], 0.0)
    np.testing.assert_array_equal(results["regret_before"], 0.0)


def test_a_method_may_have_the_settings_of_a_case():
    """Models, policies and baselines are shorthands of it, of the same identity."""
    methods = {
        "mine": {"model": "places", "policy": "greedy"},
        "as the paper": {
            "policy": "greedy", "objective": "terminal", "bounds": False,
            "options": {"initial": "prior_draw", "max_bounds": "shortest+2"},
        },
    }  # fmt: skip
    rows = cases("places", "greedy", ["paper"], methods)
    assert list(rows) == ["greedy", "paper", "mine", "as the paper"]
    assert rows["mine"].identity() == rows["greedy"].identity()
    assert rows["as the paper"].identity() == rows["paper"].identity()
    assert rows["mine"].labels == {"method": "mine", "policy": "mine"}
    with pytest.raises(TrustboError, match="unknown setting of method 'bad' 'polcy'; choose one"):
        cases([], [], [], {"bad": {"polcy": "greedy"}})


def test_a_method_whose_package_is_absent_is_refused_before_any_work(tiny, tmp_path):
    def absent():
        import no_such_package  # noqa: F401

    with pytest.raises(TrustboError, match=r"method=absent, .*No module named 'no_such_package'"):
        run(tmp_path, methods={"absent": absent})
    assert not list(tmp_path.iterdir())


OUTSIDERS = (
    "line_of_sight:LineOfSight",
    "running_mean:optimistic",
    "residual_process:ResidualProcess",
    "oracle:Oracle",
)


def test_outsiders_learn_and_recommend_in_campaigns(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    monkeypatch.setattr("sys.path", list(sys.path))
    baselines = [f"benchmarks.baselines.{name}" for name in OUTSIDERS]
    results = run(tmp_path, policies=[], baselines=baselines, n_iterations=3)
    assert results["method"].values.tolist() == [name.partition(":")[2] for name in OUTSIDERS]
    assert np.isfinite(results["regret"]).all()
    by_method = results.set_index(run="method")
    np.testing.assert_array_equal(by_method["regret"].sel(run="Oracle"), 0.0)
    sight = by_method["path"].sel(run="LineOfSight").values
    assert (sight == sight[0]).all()


def test_results_of_version_0_2_are_read_under_the_new_name_of_their_rows(tiny, tmp_path):
    results = run(tmp_path, baselines=[], n_iterations=1)
    file = tmp_path / "study.json"
    file.write_text(file.read_text().replace('"method"', '"contender"'))
    assert load_study(tmp_path)["method"].values.tolist() == results["method"].values.tolist()


def survey(folder, missing):
    """A survey of 700 m x 20 m on disk, its first rows missing; the folder's name."""
    made = tb.terrain.synthetic_terrain((700.0, 20.0), seed=0)
    (folder / "tahoe").mkdir(parents=True)
    for name in ("dem", "dsm"):
        known = made[name].where(np.arange(700)[:, None] >= missing)
        known.rio.write_crs(made.rio.crs).rio.to_raster(folder / "tahoe" / f"{name}.tif")
    return str(folder)


def test_of_a_long_survey_the_part_with_most_data_is_taken(tmp_path):
    world = World("long", "right", "tahoe", data=survey(tmp_path / "one", 330))
    kept = world.true_terrain()
    assert kept.sizes["y"] == 250  # of pixels of 1 m
    assert np.isfinite(kept["dem"].values).all()
    moved = dataclasses.replace(world, data=survey(tmp_path / "two", 330))
    assert moved.identity() == world.identity()  # by contents, not by place
    other = dataclasses.replace(world, data=survey(tmp_path / "three", 100))
    assert other.identity() != world.identity()
    assert "wellington" in World("here", "right", "wellington").files()[0]
