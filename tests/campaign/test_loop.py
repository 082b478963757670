"""The loop: it learns, repeats itself, survives failures, and is saved as it goes."""

import json

import numpy as np
import pytest
import xarray as xr
from missions import TRUTH
from worlds import ModelSimulator, hillside, random_cells

import trustbo as tb
from trustbo.planning import Planner

ENDS = ((3, 0), (0, 3))


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


def run(workspace, **options):
    options = {
        "n_iterations": 3,
        "simulator": ModelSimulator(workspace),
        "progress": False,
    } | options
    return tb.iterate(workspace, *ENDS, **options)


@pytest.fixture(scope="module")
def result(workspace):
    return run(workspace)


@pytest.fixture(scope="module")
def on_terrain():
    terrain = hillside()
    return from_corner_to_corner(tb.Workspace.from_terrain(terrain, (3, 3)))


def from_corner_to_corner(workspace):
    return tb.iterate(
        workspace, (2, 0), (0, 2), n_iterations=2, sampler="exact", progress=False
    )  # fmt: skip


def test_the_history_has_one_row_per_mission(result):
    history = result.history
    assert list(history["iteration"].values) == [1, 2, 3]
    assert len(result.missions) == len(result.posteriors) == 3
    for i, mission in enumerate(result.missions):
        steps = [tuple(step) for step in history["path"].values[i].tolist() if step[0] >= 0]
        assert tuple(steps) == mission.path
    changed = [bool(c) for c in history["path_changed"].values]
    paths = [mission.path for mission in result.missions]
    assert changed == [False, paths[1] != paths[0], paths[2] != paths[1]]
    assert (history["k_hat"] <= 0.7).all()
    assert history["trust_map"].dims == ("iteration", "row", "col")
    assert (history["seconds_fit"] > 0).all()
    assert result.stop_reason == "n_iterations"
    assert result.settings["simulator"] == "ModelSimulator"


def test_the_result_recommends_the_best_path_under_the_last_posterior(result, workspace):
    params = tb.inference.params_of(result.posterior).mean()
    risk = tb.hazard.risk.BoundRisk.of(result.posterior["hazard"].to_dataset(), workspace)
    assert {mission.status for mission in result.missions} == {"ok"}  # so that no failure is priced
    plan = Planner(workspace, *ENDS, failure_cost=0.0).with_risk(risk.mean).plan(params)
    assert result.path == list(plan.path)
    assert result.value == plan.value
    np.testing.assert_allclose(result.trust_map, Planner(workspace, *ENDS).trust_map(params))


def test_it_learns_the_truth_and_finds_the_oracle_s_path(workspace):
    result = run(workspace, n_iterations=8, policy="random", sampler="exact")
    posterior = result.posterior["posterior"]
    for name, truth in zip(("beta0", "b"), (TRUTH.beta0, TRUTH.b), strict=True):
        draws = posterior[name]
        assert abs(float(draws.mean()) - truth) < 4 * float(draws.std())
    planner = Planner(workspace, *ENDS)
    oracle = planner.plan(TRUTH)
    found = planner.evaluate(result.path, TRUTH)
    assert found.value >= oracle.value - 0.02 * (len(oracle.path) - 1 + oracle.value)  # kept


def test_the_same_seed_gives_the_same_result(result, workspace):
    again = run(workspace)
    assert again.path == result.path
    for a, b in zip(again.posteriors, result.posteriors, strict=True):
        xr.testing.assert_equal(a["posterior"].to_dataset(), b["posterior"].to_dataset())
    other = run(workspace, seed=1, n_iterations=1)
    assert (other.missions[0].contact_rate[0] != result.missions[0].contact_rate[0]).any()


def test_the_exact_sampler_runs_the_loop_too(workspace, capsys):
    result = run(workspace, sampler="exact", n_iterations=2, progress=True)
    assert (result.history["k_hat"] < 0.7).all()
    assert "k-hat" in capsys.readouterr().err
    assert result.settings["sampler"] == "exact"


@pytest.mark.parametrize("policy", ["thompson", "random"])
def test_other_policies_run(workspace, policy):
    result = run(workspace, policy=policy, sampler="exact", n_iterations=2)
    assert result.settings["policy"] == policy


def test_failed_missions_are_learned_from(workspace):
    result = run(
        workspace, simulator=ModelSimulator(workspace, fail_at=2), sampler="exact", n_iterations=2
    )
    assert list(result.history["status"].values) == ["stuck", "stuck"]
    assert result.posterior["observed_data"].sizes["bound"] == 2


def test_the_progress_bar_shows_objective_and_k_hat_and_can_be_silenced(workspace, capsys):
    run(workspace, n_iterations=1, progress=True)
    shown = capsys.readouterr().err
    assert "1/1" in shown
    assert "objective -" in shown
    assert "k-hat " in shown
    run(workspace, n_iterations=1)
    assert capsys.readouterr() == ("", "")


def test_callbacks_see_each_mission(workspace):
    seen = []
    run(
        workspace, n_iterations=2, callbacks=[lambda c, m: seen.append((len(c.missions), m.status))]
    )
    assert seen == [(1, "ok"), (2, "ok")]


def test_a_result_is_saved_and_read_back(result, tmp_path):
    result.save(tmp_path / "kept")
    back = tb.load_result(tmp_path / "kept")
    assert back.path == result.path
    assert back.value == result.value
    assert back.settings == result.settings
    np.testing.assert_array_equal(back.trust, result.trust)
    xr.testing.assert_equal(back.trust_map, result.trust_map)
    xr.testing.assert_equal(back.history, result.history)
    assert back.missions[1].path == result.missions[1].path
    np.testing.assert_array_equal(back.missions[1].awareness, result.missions[1].awareness)
    for a, b in zip(back.posteriors, result.posteriors, strict=True):
        xr.testing.assert_equal(a, b)
        assert a.attrs["sampler"] == b.attrs["sampler"]
    lines = (tmp_path / "kept" / "history.csv").read_text().splitlines()
    assert len(lines) == 4
    assert lines[0].startswith("mission,status,state,reason,where,contact_rate,objective")
    hidden = [f.name for f in (tmp_path / "kept").rglob(".*")]
    assert hidden == [".trustbo.lock"]  # no temporary file is left


def test_a_result_on_terrain_is_read_back_with_ticks_and_maps(on_terrain, tmp_path):
    on_terrain.save(tmp_path)
    back = tb.load_result(tmp_path)
    for ours, kept in zip(on_terrain.missions, back.missions, strict=True):
        for a, b in zip(ours.bounds, kept.bounds, strict=True):
            np.testing.assert_array_equal(a.poses, b.poses)
            np.testing.assert_array_equal(a.contact, b.contact)
            assert (a.cell, a.status, a.t0) == (b.cell, b.status, b.t0)
    assert back.workspace.grid == on_terrain.workspace.grid
    assert back.workspace.team == on_terrain.workspace.team
    assert back.workspace.terrain.rio.crs == on_terrain.workspace.terrain.rio.crs
    np.testing.assert_array_equal(
        back.workspace.pixels["visibility"], on_terrain.workspace.pixels["visibility"]
    )
    assert on_terrain.settings["sight"] == "transmittance"
    # What was read back can be run again, to the same end.
    assert from_corner_to_corner(back.workspace).path == on_terrain.path


def test_saving_over_another_result_leaves_nothing_of_it(result, workspace, tmp_path):
    result.save(tmp_path)
    shorter = run(workspace, n_iterations=2, seed=5)
    shorter.save(tmp_path)
    back = tb.load_result(tmp_path)
    assert len(back.missions) == len(list((tmp_path / "posteriors").glob("*.nc"))) == 2
    xr.testing.assert_equal(back.posteriors[0], shorter.posteriors[0])


def test_a_run_that_dies_has_saved_its_missions(workspace, tmp_path):
    class Dies(ModelSimulator):
        def run(self, path, *, seed, mission=0):
            if len(list((tmp_path / "run" / "posteriors").glob("*.nc"))) == 2:
                raise OSError("radio lost")
            return super().run(path, seed=seed)

    with pytest.raises(OSError, match="radio lost"):
        run(workspace, simulator=Dies(workspace), checkpoint=tmp_path / "run")
    kept = tb.load_result(tmp_path / "run")
    assert len(kept.missions) == 2
    assert kept.stop_reason == "interrupted"


def test_settings_of_any_simulator_are_kept(workspace, tmp_path):
    class Describes(ModelSimulator):
        def describe(self):
            return {"gains": np.array([1.0, 2.0]), "n": np.int64(3), "path": tmp_path}

    result = run(workspace, simulator=Describes(workspace), n_iterations=1, max_bounds=np.int64(5))
    result.save(tmp_path)
    settings = tb.load_result(tmp_path).settings
    assert (settings["gains"], settings["n"], settings["max_bounds"]) == ([1.0, 2.0], 3, 5)


@pytest.mark.parametrize("n", [0, -3, 2.5, None, True])
def test_a_number_of_iterations_must_be_whole_and_positive(workspace, n):
    with pytest.raises(tb.TrustboError, match=f"whole number from 1 on; got {n}"):
        run(workspace, n_iterations=n)


def test_bad_input_is_refused_before_anything_is_written(workspace, tmp_path):
    with pytest.raises(tb.TrustboError, match="goal"):
        tb.iterate(workspace, (3, 0), (0, 9), checkpoint=tmp_path / "never")
    with pytest.raises(tb.TrustboError, match=r"a simulator needs run\(path"):
        run(workspace, simulator=object(), checkpoint=tmp_path / "never")
    with pytest.raises(tb.TrustboError, match="seed must be a whole number from 0 on; got -1"):
        run(workspace, seed=-1, checkpoint=tmp_path / "never")
    with pytest.raises(tb.TrustboError, match="needs a terrain"):
        tb.iterate(workspace, *ENDS, checkpoint=tmp_path / "never")
    assert not (tmp_path / "never").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(tb.TrustboError, match=r"cannot write to '.*': '.*file' is a file"):
        run(workspace, checkpoint=tmp_path / "file" / "deep")
    with pytest.raises(tb.TrustboError, match="holds no result"):
        tb.load_result(tmp_path)


def test_the_record_is_plain_json(result, tmp_path):
    result.save(tmp_path)
    record = json.loads((tmp_path / "result.json").read_text())
    assert record["settings"]["policy"] == "greedy"
    assert record["settings"]["start"] == [3, 0]


def test_a_simulator_that_swaps_row_and_col_is_refused(workspace):
    class Swapped(ModelSimulator):
        def run(self, path, *, seed, mission=0):
            mission, swapped = super().run(path, seed=seed), [(col, row) for row, col in path]
            return tb.Mission.from_arrays(swapped, mission.awareness, mission.contact_rate)

    with pytest.raises(tb.TrustboError, match=r"starts at \(0, 3\), not at \(3, 0\)"):
        run(workspace, simulator=Swapped(workspace))
