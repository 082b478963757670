"""Replication between logs: tables of scores, and baselines against what they are made of."""

import importlib.util

import numpy as np
import pytest
from scipy import stats
from scipy.special import expit

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.models import HierarchicalTrust, PooledTrust
from trustbo.study import replicate
from trustbo.study.replicate import BASELINES, _intervals, persistence, ridge, unobserved_components

FEATURES = ("expected",)


def log_of(seed, n=2, n_bounds=32):
    """Missions of an AR(1) around an expectation, counted in 20 ticks."""
    rng, missions = np.random.default_rng(seed), []
    for _ in range(n):
        z = rng.normal(0.0, 1.5, (n_bounds, 2, 1))
        deviation = np.zeros(2)
        y = np.empty((n_bounds, 2))
        for k in range(n_bounds):
            deviation = 0.8 * deviation + 0.4 * rng.standard_normal(2)
            y[k] = rng.binomial(20, expit(z[k, :, 0] + deviation)) / 20.0
        y[3, 1] = np.nan
        missions.append(Mission.from_arrays(None, z, y, n_ticks=np.full(y.shape, 20),
                                            features=FEATURES))  # fmt: skip
    return missions


@pytest.fixture(scope="module")
def logs():
    return {"one": log_of(1), "other": log_of(2)}


def test_the_model_that_the_logs_are_made_of_is_first_both_ways(logs):
    models = {
        "deviation": PooledTrust(observation="beta_binomial", memory="deviation"),
        "level": PooledTrust(observation="beta_binomial"),
    }
    table = replicate(logs, models, baselines=["persistence", "ridge"])
    assert table.shape == (8, 10)
    assert (table["n"] == 2 * (2 * 31 - 1)).all()
    assert table["mean_log_score"].is_monotonic_decreasing
    for direction in (("one", "other"), ("other", "one")):
        of_one = table.xs(direction, level=("fitted to", "scored on"))
        assert of_one.index[0] == "deviation"
        assert of_one.index[-1] == "persistence"
        assert of_one.loc["deviation", "r2"] > of_one.loc["level", "r2"]
        assert 0.8 < of_one.loc["deviation", "coverage_90"] < 0.97
        assert (of_one["low"] < of_one["mean_log_score"]).all()
        assert (of_one["mean_log_score"] < of_one["high"]).all()
        assert (of_one.iloc[0][["behind", "behind_low", "behind_high"]] == 0.0).all()
        assert of_one.loc["persistence", "behind_low"] > 0.0


def test_intervals_of_independent_scores_are_those_of_their_mean():
    rng = np.random.default_rng(3)
    scores = rng.standard_normal((2, 400, 3))
    scores[0, 5:9, 1] = np.nan
    pair = {"one": scores, "less": scores - 0.1 + 0.02 * rng.standard_normal(scores.shape)}
    found = _intervals(pair, 0)
    wide = 2 * 1.96 / np.sqrt(np.isfinite(scores).sum())
    assert abs((found["one"]["high"] - found["one"]["low"]) / wide - 1.0) < 0.25
    assert 0.09 < found["less"]["behind_low"] < 0.1 < found["less"]["behind_high"] < 0.11


def test_forecasts_of_counts_have_the_mass_around_them(logs):
    ahead = logs["other"]
    table = replicate(logs, [PooledTrust()], baselines=["persistence"])
    found = table.loc[("persistence", "one", "other")]
    error = np.concatenate([np.diff(m.contact_rate, axis=0).ravel() for m in logs["one"]])
    sd, total, n, square, rates = np.sqrt(np.nanmean(error**2)), 0.0, 0, 0.0, []
    for mission in ahead:
        y = mission.contact_rate.copy()
        measured = np.isfinite(y[1:])
        y[3, 1] = y[2, 1]  # not measured: the one before it lasts
        for k, i in zip(*np.nonzero(measured), strict=True):
            law, at = stats.norm(y[k, i], sd), y[k + 1, i]
            low = -np.inf if at == 0.0 else at - 0.025
            high = np.inf if at == 1.0 else at + 0.025
            total, n = total + np.log(law.cdf(high) - law.cdf(low)), n + 1
            square += (at - y[k, i]) ** 2
            rates.append(at)
    assert found["n"] == n
    np.testing.assert_allclose(found["mean_log_score"], total / n, rtol=1e-9)
    np.testing.assert_allclose(found["r2"], 1.0 - square / n / np.var(rates), rtol=1e-9)


def test_features_may_be_learned_from_the_log_fitted_to(logs):
    asked = []

    def of(name):
        def missions(learned):
            asked.append((name, learned))
            return logs[name]

        return missions

    options = {"baselines": ["persistence"]}
    found = replicate({n: of(n) for n in logs}, [PooledTrust()], **options)
    assert set(asked) == {(a, b) for a in logs for b in logs}
    assert found.equals(replicate(logs, [PooledTrust()], **options))


def test_ridge_finds_a_line_and_forecasts_with_its_error():
    rng = np.random.default_rng(0)

    def missions(n):
        made = []
        for _ in range(n):
            z = rng.uniform(size=(50, 2, 1))
            y = np.empty((50, 2))
            y[0] = 0.4
            for k in range(1, 50):
                y[k] = 0.1 + 0.3 * z[k, :, 0] + 0.4 * y[k - 1] + 0.02 * rng.standard_normal(2)
            made.append(Mission.from_arrays(None, z, y, features=FEATURES))
        return made

    learned, (ahead,) = missions(20), missions(1)
    for baseline in (ridge, unobserved_components):
        if baseline is unobserved_components and not importlib.util.find_spec("statsmodels"):
            continue
        (forecast,) = baseline(learned, [ahead])
        assert forecast.mean.shape == (50, 2)
        error = (ahead.contact_rate - forecast.mean)[2:]
        assert np.sqrt(np.nanmean(error**2)) < (0.025 if baseline is ridge else 0.09)
    expected = 0.1 + 0.3 * ahead.awareness[1:, :, 0] + 0.4 * ahead.contact_rate[:-1]
    (forecast,) = ridge(learned, [ahead])
    np.testing.assert_allclose(forecast.mean[1:], expected, atol=0.01)  # of 2000 rates of sd .02
    np.testing.assert_allclose(forecast.sd, 0.02, rtol=0.1)
    assert np.isnan(forecast.mean[0]).all()
    last = persistence(learned, [ahead])[0]
    np.testing.assert_array_equal(last.mean[1:], ahead.contact_rate[:-1])


def test_replications_that_cannot_be_made_are_refused(logs):
    for call, message in (
        (lambda: replicate({"one": logs["one"]}, [PooledTrust()]), "two logs at least"),
        (lambda: replicate(logs, ["pooled"]), "must be a trust model"),
        (lambda: replicate(logs, [PooledTrust()], baselines=["arima"]), "arima"),
    ):
        with pytest.raises(TrustboError, match=message):
            call()
    other = {**logs, "third": [Mission.from_arrays(None, np.zeros((3, 1, 1)), np.zeros((3, 1)))]}
    with pytest.raises(tb.errors.ShapeError, match="all must agree"):
        replicate(other, [HierarchicalTrust()], baselines=list(BASELINES)[:1])
