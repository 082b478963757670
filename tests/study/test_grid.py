"""Grids of campaigns: what a row says, processes, and going on after a failure or a kill."""

import dataclasses
import importlib
import os
import sys
import threading
import types
from functools import partial

import numpy as np
import numpyro.distributions as dist
import pandas as pd
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.identity import fingerprint
from trustbo.models.backend import VERSIONS
from trustbo.simulation import Truth
from trustbo.study import Scene, lost_in, run_grid
from trustbo.study.grid import _PARTS as PARTS

POOLED = tb.models.PooledTrust()
CASES = {"greedy": {"model": POOLED}, "random": {"model": POOLED, "policy": "random"}}


class Steady:
    """Simulator in which a bound has contact as its mean awareness, and no mission starts twice."""

    def __init__(self, workspace, breaks=None):
        self.workspace, self.breaks = workspace, breaks

    def run(self, path, *, seed, mission=0):
        if self.breaks is not None and self.breaks.exists():
            raise RuntimeError("broken")
        z = self.workspace.along(path)
        noise = 0.02 * np.random.default_rng(seed).normal(size=z.shape[:2])
        return tb.Mission.from_arrays(path, z, np.clip(z.mean(-1) + noise, 0.0, 1.0))


def scene(seed, breaks=None):
    z = np.random.default_rng(seed).uniform(size=(2, 3, 3, 2))
    workspace = tb.Workspace.from_awareness(z)
    truth = Truth.from_simulator(Steady(workspace), n_replicates=1)
    simulator, labels = Steady(workspace, breaks), {"ground": f"made {seed}"}
    return Scene(workspace, simulator, (2, 0), (0, 2), truth, labels=labels)


SCENES = {f"made {seed}": partial(scene, seed) for seed in (0, 1)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("grid")


@pytest.fixture(scope="module")
def table(folder):
    return run_grid(CASES, SCENES, folder, seeds=(0, 1), n_missions=2, n_jobs=1)


def test_a_row_is_of_a_run_and_mission(table):
    assert len(table) == 2 * 2 * 2 * 3
    assert set(table["ground"]) == set(SCENES)
    before = table["mission"] == 0
    assert table.loc[before, "status"].isna().all()
    assert (table.loc[~before, "status"] == "ok").all()
    assert (table["regret"] >= -1e-9).all()
    np.testing.assert_allclose(table.loc[~before, "failed_driven"],
                               (table["driven"] - table["best_driven"])[~before])  # fmt: skip


def test_regret_is_that_of_the_campaign_itself(table):
    where = scene(1)
    with tb.Campaign(where.workspace, (2, 0), (0, 2), model=POOLED, seed=1) as campaign:
        expected = [where.truth.regret(campaign.recommend().path)]
        for _ in campaign.run(where.simulator, 2):
            expected.append(where.truth.regret(campaign.recommend().path))
    run = table[(table["case"] == "greedy") & (table["scene"] == "made 1") & (table["seed"] == 1)]
    np.testing.assert_allclose(run["regret"], expected, atol=1e-9)


def test_called_again_it_reads_what_is_there(table, folder, monkeypatch):
    """Without making the scenes again."""
    monkeypatch.setattr(tb.Workspace, "from_awareness", None)
    again = run_grid(CASES, SCENES, folder, seeds=(0, 1), n_missions=2)
    pd.testing.assert_frame_equal(again, table)


def test_stored_runs_of_an_edited_case_are_refused(table, folder):
    edited = CASES | {"greedy": {"model": POOLED, "policy": "greedy"}}
    with pytest.raises(TrustboError, match="case 'greedy'"):
        run_grid(edited, SCENES, folder, seeds=(0, 1), n_missions=2)

    priors = dataclasses.replace(POOLED.priors, beta0=dist.Beta(3.0, 2.0))
    edited = CASES | {"random": CASES["random"] | {"model": tb.models.PooledTrust(priors)}}
    with pytest.raises(TrustboError, match="hash of case"):
        run_grid(edited, SCENES, folder, seeds=(0, 1), n_missions=2)


def test_earlier_campaigns_count_as_their_missions():
    where = scene(0)
    with tb.Campaign(where.workspace, (2, 0), (0, 2), model=POOLED) as campaign:
        for _ in campaign.run(where.simulator, 1):
            before = fingerprint({"earlier": [campaign]}, PARTS)
            campaign.planner  # noqa: B018  (which the campaign keeps)
            assert fingerprint({"earlier": [campaign]}, PARTS) == before
        campaign.tell(where.simulator.run(campaign.ask().path, seed=1))
        assert fingerprint({"earlier": [campaign]}, PARTS) != before


def test_values_that_no_other_process_can_get_are_refused(tmp_path):
    case = {"own": {"model": POOLED, "reporter": threading.Lock()}}
    with pytest.raises(TrustboError, match="n_jobs"):
        run_grid(case, SCENES, tmp_path / "out", n_jobs=2)
    assert not (tmp_path / "out").exists()


def test_stored_runs_of_an_edited_scene_are_refused(table, folder):
    swapped = {"made 0": SCENES["made 1"], "made 1": SCENES["made 1"]}
    moved = {name: lambda: scene(0)._replace(goal=(0, 1)) for name in SCENES}
    for edited in (swapped, moved):
        with pytest.raises(TrustboError, match="hash of scene"):
            run_grid(CASES, edited, folder, seeds=(0, 1), n_missions=2, n_jobs=1)


@pytest.mark.parametrize("which", ["object", "function"])
def test_an_edited_policy_is_refused(tmp_path, which):
    """Also if only a method that the policy calls was edited."""

    def case(path_of):
        class Own:
            best = path_of

            def __call__(self, rng, draws, planner):
                return planner.evaluate(self.best(planner, draws), draws.mean())

        options = {"model": POOLED, "policy": Own()}
        return {"own": options if which == "object" else lambda scene: options}

    scenes = {"made 0": SCENES["made 0"]}

    def best(self, planner, draws):
        return planner.plan(draws.mean()).path

    def first(self, planner, draws):
        return planner.plan(draws.flat().draw(0)).path

    table = run_grid(case(best), scenes, tmp_path, n_missions=1, n_jobs=1)
    again = run_grid(case(best), scenes, tmp_path, n_missions=1, n_jobs=1)
    pd.testing.assert_frame_equal(again, table)
    with pytest.raises(TrustboError, match="hash of case"):
        run_grid(case(first), scenes, tmp_path, n_missions=1, n_jobs=1)


def test_an_edited_simulator_is_refused(tmp_path):
    """Also if the function of the scene, which uses the class, is the same."""

    def scenes(noise):
        class Noisy(Steady):
            def run(self, path, *, seed, mission=0):
                return noise(super().run(path, seed=seed))

        def made():
            where = scene(0)
            return where._replace(simulator=Noisy(where.workspace))

        return {"made 0": made}

    def steady(mission):
        return mission

    def poor(mission):
        return tb.Mission.from_arrays(mission.path, mission.awareness, 0.5 * mission.contact_rate)

    case = {"random": CASES["random"]}
    run_grid(case, scenes(steady), tmp_path, n_missions=1, n_jobs=1)
    run_grid(case, scenes(steady), tmp_path, n_missions=1, n_jobs=1)
    with pytest.raises(TrustboError, match="hash of scene"):
        run_grid(case, scenes(poor), tmp_path, n_missions=1, n_jobs=1)


def test_runs_of_another_version_and_other_files_are_refused(tmp_path, monkeypatch):
    arguments = {"random": CASES["random"]}, {"made 0": SCENES["made 0"]}, tmp_path
    made = run_grid(*arguments, n_missions=1, n_jobs=1)
    monkeypatch.setitem(VERSIONS, "trustbo", "0.4.9")
    with pytest.raises(TrustboError, match="trustbo"):
        run_grid(*arguments, n_missions=1, n_jobs=1)

    monkeypatch.undo()
    (file,) = tmp_path.glob("*.csv")
    made.to_csv(file, index=False)  # as version 0.5 wrote it
    with pytest.raises(TrustboError, match="hash of case"):
        run_grid(*arguments, n_missions=1, n_jobs=1)
    file.write_text("")
    with pytest.raises(TrustboError, match="damaged"):
        run_grid(*arguments, n_missions=1, n_jobs=1)


def test_names_that_are_one_file_in_two_calls_are_not_mixed(tmp_path):
    scenes = {"made 0": SCENES["made 0"]}
    run_grid({"tau=0.1": CASES["random"]}, scenes, tmp_path, n_missions=1, n_jobs=1)
    with pytest.raises(TrustboError, match=r"tau=0\.1"):
        run_grid({"tau 0.1": CASES["random"]}, scenes, tmp_path, n_missions=1, n_jobs=1)


def test_a_run_that_fails_does_not_stop_the_others_and_is_run_again(tmp_path, table):
    switch = tmp_path / "switch"
    switch.touch()
    scenes = SCENES | {"made 1": partial(scene, 1, switch)}
    options = {"seeds": (1,), "n_missions": 2, "n_jobs": 1}
    with pytest.raises(TrustboError, match="2 of 4 runs"):
        run_grid(CASES, scenes, tmp_path / "out", **options)
    assert len(list((tmp_path / "out").glob("*.csv"))) == 2
    switch.unlink()
    found = run_grid(CASES, scenes, tmp_path / "out", **options)
    expected = table[table["seed"] == 1].reset_index(drop=True)
    pd.testing.assert_frame_equal(found, expected.assign(seconds=found["seconds"]))


class Counting:
    """Policy that learns by itself, and recommends the path of its last mission."""

    def __init__(self):
        self.paths = []

    def __call__(self, key, posterior, planner):
        return planner.plan(posterior.mean())

    def learn(self, campaign, mission):
        self.paths.append(mission.path)

    def recommend(self, campaign):
        return self.paths[-1] if self.paths else campaign.recommend().path


def test_seconds_leave_out_the_evaluation_of_paths(tmp_path, monkeypatch):
    """On a clock that only evaluations advance."""
    now = [0.0]
    monkeypatch.setattr(
        "trustbo.study.grid.time", types.SimpleNamespace(process_time=lambda: now[0])
    )

    class Slow(Truth):
        def lost(self, path):
            now[0] += 1.0
            return super().lost(path)

    def slow_scene():
        where = scene(0)
        return where._replace(truth=Slow(where.workspace, where.truth.bounds))

    cases = {"random": CASES["random"]}
    table = run_grid(cases, {"slow": slow_scene}, tmp_path, n_missions=2, n_jobs=1)
    assert (table["seconds"][1:] == 0.0).all()
    assert now[0] > 0.0


def test_contact_is_the_mean_of_what_was_measured(tmp_path):
    class Blinking(Steady):
        def run(self, path, **options):
            mission = super().run(path, **options)
            rates = mission.contact_rate.copy()
            rates[0, 0] = np.nan
            return tb.Mission.from_arrays(path, mission.awareness, rates)

    def blinking():
        where = scene(0)
        return where._replace(simulator=Blinking(where.workspace))

    cases = {"random": CASES["random"]}
    table = run_grid(cases, {"one": blinking}, tmp_path, n_missions=1, n_jobs=1)
    assert 0.0 < table["contact_rate"][1] < 1.0


def test_a_policy_that_learns_by_itself_is_told_and_is_new_in_each_run(tmp_path):
    case = {"own": {"policy": Counting(), "model": POOLED}, "made": lambda scene: CASES["greedy"]}
    table = run_grid(case, SCENES, tmp_path, n_missions=2, n_jobs=1)
    own = table[(table["case"] == "own") & (table["mission"] > 0)]
    np.testing.assert_allclose(own["lost"], own["driven"])
    assert not case["own"]["policy"].paths


def test_names_are_texts_whatever_they_look_like(tmp_path):
    cases = {name: CASES["random"] for name in ("None", "01")}
    made = run_grid(cases, {"NA": SCENES["made 0"]}, tmp_path, n_missions=1, n_jobs=1)
    assert made["case"].tolist() == ["None", "None", "01", "01"]
    assert set(made["scene"]) == {"NA"}
    assert made["status"].isna().tolist() == [True, False] * 2


def test_names_and_seeds_that_are_one_file_are_refused(tmp_path):
    with pytest.raises(TrustboError):
        run_grid({"a b": {}, "a-b": {}}, SCENES, tmp_path)
    with pytest.raises(TrustboError):
        run_grid({"a": {}, "A": {}}, SCENES, tmp_path)
    with pytest.raises(TrustboError, match="seeds"):
        run_grid(CASES, SCENES, tmp_path, seeds=[0, 0])


OWN = {"seed": 7, "directory": "here", "overwrite": True, "start": (0, 0)}
"""Arguments of `Campaign` that `run_grid` sets."""


@pytest.mark.parametrize("name", OWN)
def test_cases_cannot_set_what_the_grid_sets(tmp_path, name):
    own = {name: OWN[name]}
    with pytest.raises(TrustboError, match=name):
        run_grid({"own": own}, SCENES, tmp_path / "out", n_jobs=1)
    with pytest.raises(TrustboError, match=name):
        run_grid({"own": lambda scene: own}, SCENES, tmp_path / "out", n_jobs=1)

    scenes = {"made 0": lambda: scene(0)._replace(options=own)}
    with pytest.raises(TrustboError, match=name):
        run_grid({"own": {}}, scenes, tmp_path / "out", n_jobs=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow  # processes that import JAX
def test_processes_give_the_same_table(table, tmp_path):
    found = run_grid(CASES, SCENES, tmp_path, seeds=(0, 1), n_missions=2, n_jobs=2)
    pd.testing.assert_frame_equal(found, table.assign(seconds=found["seconds"]))


@pytest.mark.slow  # processes that import JAX
def test_dask_gives_the_same_table(table, tmp_path, monkeypatch):
    joblib = pytest.importorskip("joblib")
    distributed = pytest.importorskip("distributed")
    here = os.path.dirname(__file__)
    monkeypatch.setenv("PYTHONPATH", here)  # the workers import this module
    with (
        distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):
        found = run_grid(CASES, SCENES, tmp_path, seeds=(0, 1), n_missions=2)
    pd.testing.assert_frame_equal(found, table.assign(seconds=found["seconds"]))


MODULE = """
import numpy as np
import trustbo as tb


def level():
    return {level}


def scene():
    with open("level.txt") as file:
        rate = float(file.read())
    workspace = tb.Workspace.from_awareness(np.full((2, 3, 3, 1), 0.5))
    truth = tb.models.TrustParams(0.0, np.zeros(1), rate + level(), 1e-3, 1e-3)
    return tb.study.Scene(workspace, tb.simulation.ModelSimulator(workspace, truth), (2, 0), (0, 2))
"""


def test_processes_see_the_present_code_and_folder(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    module = tmp_path / "scenes_that_change.py"
    rates = []
    for site, rate, level in (("a", 0.1, 0.0), ("b", 0.5, 0.0), ("b", 0.5, 0.3)):
        (tmp_path / site).mkdir(exist_ok=True)
        (tmp_path / site / "level.txt").write_text(str(rate))
        monkeypatch.chdir(tmp_path / site)
        module.write_text(MODULE.format(level=level))
        importlib.invalidate_caches()
        scenes = importlib.reload(importlib.import_module("scenes_that_change"))

        table = run_grid({"a": {"model": POOLED}}, {"s": scenes.scene}, f"out {level}",
                         n_missions=1, n_jobs=2, seeds=2)  # fmt: skip
        rates.append(table["contact_rate"].mean())
    np.testing.assert_allclose(rates, [0.1, 0.5, 0.8], atol=0.05)


def test_numbers_are_names_and_a_number_of_seeds_counts_from_0(tmp_path):
    cases = {0.5: {"model": POOLED}, 1: {"model": POOLED}}
    table = run_grid(cases, SCENES, tmp_path, seeds=np.int64(2), n_missions=1, n_jobs=1)
    assert {*table["case"]} == {"0.5", "1"}
    assert {*table["seed"]} == {0, 1}


@pytest.mark.parametrize(
    ("cases", "seeds"),
    [
        ({1: {}, "1": {}}, 1),
        ([{}], 1),
        ({"a": {}}, "12"),
        ({"a": {}}, 0),
        ({"a": {}}, True),
        ({"a": {}}, [0.5]),
        ({"a": {}}, [-1]),
        ({"a": {}}, None),
    ],
)
def test_names_and_seeds_that_are_unclear_are_refused(cases, seeds, tmp_path):
    with pytest.raises(TrustboError):
        run_grid(cases, SCENES, tmp_path, seeds=seeds, n_missions=1, n_jobs=1)
    assert not list(tmp_path.iterdir())


def test_contact_lost_counts_what_was_not_completed_as_lost():
    path = [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4)]
    rates = np.array([[0.5, 0.7], [np.nan, np.nan], [0.9, np.nan], [1.0, 1.0]])
    awareness = np.zeros((4, 2, 1))

    whole = tb.Mission.from_arrays(path, awareness, rates)
    assert lost_in(whole) == pytest.approx(0.4 + (1.0 - 2.5 / 3.0) + 0.1 + 0.0)

    failed = tb.Mission.from_arrays(path, awareness[:3], rates[:3], status="stuck")
    assert failed.bound_status == ("ok", "ok", "stuck")
    assert lost_in(failed) == pytest.approx(0.4 + 0.4 + 1.0 + 1.0)

    unknown = tb.Mission.from_arrays(path, awareness, np.full((4, 2), np.nan))
    assert np.isnan(lost_in(unknown))


def test_a_policy_of_its_own_runs_on_changing_courses_without_a_truth(tmp_path):
    courses = (((2, 0), (0, 2)), ((0, 0), (2, 2)))
    where = SCENES["made 0"]()._replace(start=None, goal=None, courses=courses)

    class Own:
        def __call__(self, rng, draws, planner):
            return planner.plan(draws)

        def recommend(self, campaign):
            return campaign.planner.plan(campaign.belief).path

    cases = {"own": {"model": POOLED, "policy": Own()}}
    table = run_grid(cases, {"made": lambda: where._replace(truth=None)}, tmp_path, seeds=1,
                     n_missions=3, n_jobs=1)  # fmt: skip
    assert "regret" not in table
    assert table["measured"].notna().sum() == 3
    with pytest.raises(TrustboError, match="one course, or without a truth"):
        run_grid(cases, {"made": lambda: where}, tmp_path / "truth", n_missions=1, n_jobs=1)
