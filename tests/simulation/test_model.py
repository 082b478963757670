"""The simulator of a trust model: its rates by equations (1) and (2), failures by probabilities."""

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.models import PooledTrust, TrustParams
from trustbo.simulation import ModelSimulator, Truth

PARAMS = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
ROW = [(0, 0), (0, 1), (0, 2), (0, 3)]
EAST = 4


@pytest.fixture(scope="module")
def workspace():
    return tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 2, 4, 2)))


def test_rates_have_the_moments_of_the_state_space(workspace):
    simulator = ModelSimulator(workspace, PARAMS)
    rates = np.stack([simulator.run(ROW, seed=seed).contact_rate for seed in range(400)])
    z = workspace.along(ROW)
    mean, variance = PARAMS.x0_mean, PARAMS.x0_sd**2
    for k in range(3):
        mean = 0.6 * mean + z[k] @ np.array([0.3, 0.2]) + 0.05
        variance = 0.36 * variance + 0.05**2
        sd = np.sqrt(variance + 0.05**2)
        if k:  # the first rates are clipped
            np.testing.assert_allclose(rates[:, k].mean(0), mean, atol=5.0 * sd / 20.0)
            np.testing.assert_allclose(rates[:, k].std(0), sd, rtol=0.2)


def test_missions_end_as_often_as_the_probabilities_say(workspace):
    p = np.zeros((8, 2, 4))
    p[EAST, 0] = np.nan, 0.2, 0.5, 0.0
    simulator = ModelSimulator(workspace, PARAMS, p_fail=p)
    missions = [simulator.run(ROW, seed=seed) for seed in range(400)]
    ends = np.array([len(m.bounds) if m.status != "ok" else 0 for m in missions])
    shares = np.bincount(ends, minlength=4) / len(missions)
    expected = np.array([0.8 * 0.5, 0.2, 0.8 * 0.5, 0.0])
    # 4 standard errors of a share of 400.
    assert (np.abs(shares - expected) < 4.0 * np.sqrt(0.25 / 400)).all()
    assert {m.status for m in missions} == {"ok", "stuck"}
    again = simulator.run(ROW, seed=3)
    np.testing.assert_array_equal(again.contact_rate, missions[3].contact_rate)


def test_without_failures_rates_are_the_same(workspace):
    plain = ModelSimulator(workspace, PARAMS)
    sure = ModelSimulator(workspace, PARAMS, p_fail=np.zeros((8, 2, 4)))
    one, other = (simulator.run(ROW, seed=1) for simulator in (plain, sure))
    assert one.status == other.status == "ok"
    np.testing.assert_array_equal(one.contact_rate, other.contact_rate)


@pytest.mark.parametrize(
    "options",
    [
        {"p_fail": np.zeros((2, 4))},
        {"p_fail": np.full((8, 2, 4), 1.5)},
        {"n_ticks": 5},
        {"model": PooledTrust(family="beta_binomial")},
        {"awareness": np.zeros((3, 2, 4, 3))},
    ],
)
def test_impossible_settings_are_refused(workspace, options):
    with pytest.raises(TrustboError):
        ModelSimulator(workspace, PARAMS, **options)


def test_a_model_has_no_table_of_bounds(workspace):
    with pytest.raises(TrustboError):
        Truth.from_simulator(ModelSimulator(workspace, PARAMS))


def test_true_awareness_and_probabilities_are_read_by_name(workspace):
    truth = workspace.awareness.copy(data=workspace.awareness.values**2)
    turned = truth.transpose().isel(robot=[2, 0, 1], feature=[1, 0], col=[3, 2, 1, 0])
    np.testing.assert_array_equal(
        ModelSimulator(workspace, PARAMS, awareness=turned).awareness, truth
    )
    p = workspace.passable_bounds.astype(float)
    simulator = ModelSimulator(workspace, PARAMS, p_fail=p.isel(move=slice(None, None, -1)))
    np.testing.assert_array_equal(simulator.p_fail, p)
    with pytest.raises(TrustboError, match="awareness"):
        ModelSimulator(workspace, PARAMS, awareness=truth.assign_coords(feature=["a", "b"]))
