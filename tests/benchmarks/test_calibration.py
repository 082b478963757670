"""The benchmark of certainty: its data, its measures, and a whole run on a small world."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from groups import KINDS
from world_set import worlds

import trustbo as tb
from trustbo.workspace.moves import MOVE_NAMES

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "calibration.py"


@pytest.fixture(scope="module")
def calibration():
    """The script; its name is also that of a module of these tests."""
    spec = importlib.util.spec_from_file_location("benchmark_of_certainty", FILE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_worlds_of_every_kind_have_stored_paths(calibration):
    known = worlds()
    assert {known[name].kind for name in calibration.WORLDS} == set(KINDS)
    stored = pd.read_csv(calibration.PATHS)
    n_paths = stored.groupby(["world", "course"]).size()
    expected = {(name, course) for name in calibration.WORLDS for course in calibration.COURSES}
    assert set(n_paths.index) == expected
    assert (n_paths == calibration.MISSIONS + calibration.N_RANDOM).all()
    for text in stored["path"]:
        assert calibration.text_of(calibration.path_of(text)) == text


def test_probabilities_of_all_ticks_sum_to_1(calibration):
    rng = np.random.default_rng(0)
    trust = rng.normal(0.8, 0.3, (50, 2, 3))
    sd = rng.uniform(0.02, 0.2, (50, 1, 3))
    y = np.broadcast_to((np.arange(8.0) / 7.0)[:, None, None], (8, 2, 3))
    score = calibration.tick_score(trust, sd, y, np.full(y.shape, 7.0))
    np.testing.assert_allclose(np.exp(score).sum(0), 1.0)


def test_intervals_of_the_distribution_that_drew_the_rates_hold_their_share(calibration):
    rng = np.random.default_rng(1)
    center = rng.uniform(0.3, 0.7, (1, 400, 3))
    trust = center + 0.05 * rng.standard_normal((300, 400, 3))
    truth = center[0] + 0.05 * rng.standard_normal((400, 3))
    y = np.clip(truth + 0.03 * rng.standard_normal((20, 400, 3)), 0.0, 1.0)
    n = np.full(y.shape, 500.0)
    y = np.round(y * n) / n
    held_out = calibration.HeldOut(np.zeros((400, 3), int), y, n)
    sd = np.full((300, 1, 1), 0.03)
    _, measures = calibration.compare(np.swapaxes(trust, 1, 2), sd, held_out)
    means = {name: values.mean() for name, values in measures.items()}
    assert [means["rate50"], means["rate90"]] == pytest.approx([0.5, 0.9], abs=0.03)
    assert [means["trust50"], means["trust90"]] == pytest.approx([0.5, 0.9], abs=0.05)
    assert means["width"] == pytest.approx(2 * 1.645 * 0.05, rel=0.03)

    wide = calibration.compare(np.swapaxes(trust, 1, 2), 3 * sd, held_out)[1]
    assert wide["score"].mean() < means["score"] - 0.1


def test_a_small_world_is_measured_and_reported(calibration, monkeypatch, tmp_path, capsys):
    for name, value in {
        "PATHS": tmp_path / "paths.csv", "MISSIONS": 2, "N_RANDOM": 2, "N_OF_RANDOM": 2,
        "N_OF_PLANNED": 3, "LEAST": 1,
    }.items():  # fmt: skip
        monkeypatch.setattr(calibration, name, value)
    world = replace(worlds()["synthetic-1-one-poor"], shape=(4, 4), cell=40.0)
    courses = ["sw-ne"]
    calibration.store_paths([world], courses)
    rows = calibration.measure([world], courses, calibration.MODELS, tmp_path / "out")
    assert set(rows["model"]) == set(calibration.MODELS)
    assert set(rows["set"]) == {"driven", "undriven", calibration.FIRST}
    assert rows.loc[rows["set"] == "driven", "poor_bias"].notna().any()

    again = calibration.measure([world], courses, calibration.MODELS, tmp_path / "out")
    pd.testing.assert_frame_equal(rows, again)
    calibration.report(rows)
    assert "default minus without effects" in capsys.readouterr().out


def test_trust_is_that_of_the_planner(calibration):
    workspace = replace(worlds()["synthetic-1"], shape=(4, 4), cell=40.0).workspace()
    campaign = tb.Campaign(workspace, (3, 0), (0, 3))
    draws = campaign.draw_prior(20)
    bounds = np.argwhere(workspace.passable_bounds.values)
    trust = calibration.trust_of(draws, workspace.awareness.values[:, *bounds.T], bounds)
    for move, name in enumerate(MOVE_NAMES):
        entered = bounds[:, 0] == move
        expected = campaign.planner.trust(draws, move=name).values
        found = trust[:, :, entered]
        np.testing.assert_allclose(found, expected[:, :, *bounds[entered, 1:].T])
