"""The simulator of a trust model: its rates by equations (1) and (2), failures by probabilities."""

import numpy as np
import pytest
from dense_statespace import mission_of_params
from every_model import KINDS, draws_of
from scipy import stats
from scipy.special import expit
from unit_noise import Unit, moments_of

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


@pytest.mark.parametrize("family", ["gaussian", "censored"])
@pytest.mark.parametrize("kind", KINDS)
def test_rates_have_the_moments_of_the_joint_normal(workspace, monkeypatch, kind, family):
    """Of unit vectors instead of normal numbers, for which no rate is clipped."""
    params = draws_of(kind, shape=(2, 4)).draw(0)
    simulator = ModelSimulator(workspace, params, PooledTrust(family=family))
    n_noises = 3 * (1 + 3 * 3)  # of the start, then of trust, shared and own, in three bounds
    runs = []
    for index in (None, *range(n_noises)):
        with monkeypatch.context() as patch:
            patch.setattr(np.random, "default_rng", lambda seed, i=index: Unit(i))
            runs.append(simulator.run(ROW, seed=0).contact_rate)

    assert 0.0 < np.min(runs) < np.max(runs) < 1.0
    mean, cov = moments_of(runs)
    dense = mission_of_params(params, workspace.along(ROW), ROW)
    np.testing.assert_allclose(mean, dense.mean, rtol=1e-9)
    np.testing.assert_allclose(cov, dense.rate_cov, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("kind", ["pooled", "robots, deviation, places", "coupled"])
def test_counts_have_the_moments_of_the_beta_binomial(workspace, kind):
    """Of each rate, over its normal trust on the logit scale, within 5 standard errors."""
    n, n_ticks = 150, 20
    params = draws_of(kind, shape=(2, 4)).draw(0)
    model = PooledTrust(family="beta_binomial")
    simulator = ModelSimulator(workspace, params, model, n_ticks=n_ticks)
    rates = np.stack([simulator.run(ROW, seed=seed).contact_rate for seed in range(n)])

    dense = mission_of_params(params, workspace.along(ROW), ROW)
    e, weight = np.polynomial.hermite_e.hermegauss(40)
    trust = dense.mean[:, None] + np.sqrt(np.diag(dense.trust_cov))[:, None] * e
    share = expit(trust)
    sd = np.sqrt(np.diag(dense.rate_cov - dense.trust_cov))[:, None]
    phi = sd**-2.0
    law = stats.betabinom(n_ticks, phi * share, phi * (1.0 - share))
    first, second = ((law.stats("m") / n_ticks), law.var() / n_ticks**2)
    weight = weight / weight.sum()
    mean = first @ weight
    var = (second + first**2) @ weight - mean**2
    flat = rates.reshape(n, -1)
    assert (np.abs(flat.mean(0) - mean) < 5.0 * np.sqrt(var / n)).all()
    np.testing.assert_allclose(flat.var(0), var, rtol=5.0 * np.sqrt(2.0 / n))


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


def test_simulators_with_other_measurements_are_described_differently(workspace):
    counts = PooledTrust(family="beta_binomial")
    few, many = (ModelSimulator(workspace, PARAMS, counts, n_ticks=n) for n in (10, 20))
    assert few.describe() != many.describe()

    awareness = workspace.awareness.values
    plain = ModelSimulator(workspace, PARAMS)
    other = ModelSimulator(workspace, PARAMS, awareness=0.5 * awareness)
    assert plain.describe() != other.describe()
    assert plain.describe() == ModelSimulator(workspace, PARAMS, awareness=awareness).describe()


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
    np.testing.assert_array_equal(simulator.p_fail, np.repeat(p.values[..., None], 9, axis=-1))
    with pytest.raises(TrustboError, match="awareness"):
        ModelSimulator(workspace, PARAMS, awareness=truth.assign_coords(feature=["a", "b"]))


def test_the_description_tells_kinds_of_memory_apart(workspace):
    simulators = [
        ModelSimulator(workspace, PARAMS.replace(memory=memory), model=PooledTrust(memory=memory))
        for memory in ("level", "deviation")
    ]
    level, deviation = (simulator.describe()["truth"] for simulator in simulators)
    assert level != deviation
    assert TrustParams(**deviation).memory == "deviation"


def test_noise_is_scaled_by_the_mean_line_of_sight_of_the_team():
    """Filters that predict the rates expect the same noise."""
    z = np.full((3, 1, 4, 1), 0.5)
    z[:, 0, 2] = 1.0
    z[:, 0, 3, 0] = 0.7, 0.9, 0.8  # mean 0.8
    features = ["line_of_sight"]
    workspace = tb.Workspace.from_awareness(z, features=features)
    params = TrustParams(0.0, np.zeros(1), 0.5, 1e-9, 0.04, x0_sd=0.0, f_v=0.3, features=features)
    simulator = ModelSimulator(workspace, params)
    rates = np.stack([simulator.run(ROW, seed=seed).contact_rate for seed in range(1500)])
    g = np.sqrt(0.3**2 + (1.0 - 0.3**2) * 4.0 * np.array([0.25, 0.0, 0.16]))
    np.testing.assert_allclose(rates.std(0), 0.04 * g[:, None] * np.ones(3), rtol=0.1)

    trust = tb.inference.TrustFilter(params.draw(np.zeros(4000, int)), 3, max_draws=4000)
    ahead = trust.predict(workspace.along(ROW), ROW)
    np.testing.assert_allclose(ahead.draws.std(0), 0.04 * g[:, None] * np.ones(3), rtol=0.05)


def test_scaled_noise_needs_a_feature_of_line_of_sight(workspace):
    params = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05, f_v=0.3)
    with pytest.raises(TrustboError, match="f_v needs the names of the features"):
        ModelSimulator(workspace, params).run(ROW, seed=0)
