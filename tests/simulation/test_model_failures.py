"""Failures that the model's simulator draws from given chances of bounds."""

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.hazard import Hazard
from trustbo.models import TrustParams
from trustbo.simulation import ModelSimulator, Truth

PARAMS = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
ROW = [(0, 0), (0, 1), (0, 2), (0, 3)]
EAST = 4


@pytest.fixture(scope="module")
def workspace():
    return tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 2, 4, 2)))


def test_missions_end_as_often_as_the_chances_say(workspace):
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
    assert all(m.bounds[-1].status == m.status for m in missions)
    again = simulator.run(ROW, seed=3)
    np.testing.assert_array_equal(again.contact_rate, missions[3].contact_rate)


def test_the_truth_knows_the_chance_to_arrive(workspace):
    chances = Hazard(intercept=(-1.0, 0.1)).prior(workspace).draw(1, seed=2)[0]
    simulator = ModelSimulator(workspace, PARAMS, p_fail=chances)
    value = Truth.of(simulator).value(ROW)
    assert value.p_arrive == pytest.approx(np.prod(1.0 - chances[EAST, 0, 1:]), rel=1e-12)
    assert Truth.of(ModelSimulator(workspace, PARAMS)).value(ROW).p_arrive == 1.0


def test_without_chances_nothing_fails_and_rates_are_the_same(workspace):
    plain = ModelSimulator(workspace, PARAMS)
    sure = ModelSimulator(workspace, PARAMS, p_fail=np.zeros((8, 2, 4)))
    one, other = (simulator.run(ROW, seed=1) for simulator in (plain, sure))
    assert one.status == other.status == "ok"
    np.testing.assert_array_equal(one.contact_rate, other.contact_rate)
    assert "p_fail" not in plain.describe()
    assert "p_fail" in sure.describe()


def test_wrong_chances_are_named(workspace):
    with pytest.raises(ShapeError, match=r"p_fail must be \(move, row, col\) = \(8, 2, 4\)"):
        ModelSimulator(workspace, PARAMS, p_fail=np.zeros((2, 4)))
    with pytest.raises(TrustboError, match=r"a chance in \[0, 1\]; got 1.5"):
        ModelSimulator(workspace, PARAMS, p_fail=np.full((8, 2, 4), 1.5))
