"""Predictions of people's reports: conditional frequencies, and what own reports add."""

import numpy as np
import pytest
from dense_coefficients import DenseRates

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.inference import fit, loo, predict_reports
from trustbo.models import HumanTrust, PooledTrust
from trustbo.models.observations import Observations

FEATURES = ["success", "failure", "demand"]
DIMS = ("chain", "draw")


def simulated(n=40, steps=6, scale="likert7", seed=0):
    """Persons whose trust rises by .15 after a success and falls by .3 after a failure."""
    rng, missions = np.random.default_rng(seed), []
    for _ in range(n):
        success = (rng.random((steps, 1)) < 0.6).astype(float)
        z = np.stack([success, 1.0 - success, rng.uniform(size=(steps, 1))], axis=-1)
        gains = np.array([0.15, -0.3]) + 0.1 * rng.standard_normal(2)
        d, trust = 0.2 * rng.standard_normal(), np.empty((steps, 1))
        level = 0.6 + 0.1 * rng.standard_normal()
        for k in range(steps):
            d = 0.7 * d + gains @ z[k, 0, :2]
            trust[k] = level + d
        noisy = trust + 0.1 * rng.logistic(scale=np.sqrt(3.0) / np.pi, size=trust.shape)
        if scale == "unit":
            y, ticks = np.clip(trust + 0.1 * rng.standard_normal(trust.shape), 0.0, 1.0), None
        else:
            y, ticks = np.clip(np.round(6.0 * noisy), 0, 6) / 6.0, np.full((steps, 1), 6.0)
        missions.append(tb.Mission.from_arrays(None, z, y, n_ticks=ticks, features=FEATURES))
    return missions


@pytest.fixture(scope="module")
def persons():
    return simulated()


@pytest.fixture(scope="module")
def posterior(persons):
    return fit(persons, HumanTrust(scale="likert7"), draws=250, progress=False)


def test_gains_are_found_and_failures_weigh_more(posterior):
    beta = posterior["posterior"]["beta"].values.reshape(-1, 3)
    for value, truth in zip(beta.T, (0.15, -0.3), strict=False):
        assert abs(value.mean() - truth) < 3.0 * value.std()
    assert (beta[:, 1] < -beta[:, 0]).mean() > 0.9


@pytest.mark.slow
def test_persons_left_out_have_even_weights(posterior):
    assert (loo(posterior).pareto_k < 0.7).all()


def test_predictions_are_those_of_the_joint_normal_of_draws():
    """On the unit scale within the limits: Gaussian conditioning of a person under each draw."""
    persons = simulated(n=8, scale="unit")
    posterior = fit(persons, HumanTrust(), draws=100, progress=False, latent=False, check=False)
    new = simulated(n=1, scale="unit", seed=9)[0]
    y = np.full((6, 1), np.nan)
    y[:4, 0] = 0.5, 0.6, 0.45, 0.55
    new = tb.Mission.from_arrays(None, new.awareness, y, features=FEATURES)
    found = predict_reports(posterior, [new], n_draws=400)

    # The weights of each draw are known, and the parts of the person are not.
    draws = {
        name: array.values.reshape(-1, *array.shape[2:])
        for name, array in posterior["posterior"].to_dataset().items()
    }
    observations = Observations.from_missions([new])
    dense = DenseRates(HumanTrust().for_features(FEATURES), observations, draws)
    known = len(FEATURES) + 1
    dense.prior_mean[:, :known] = np.column_stack([draws["beta"], draws["b"]])
    dense.prior_cov[:, :known] = 0.0
    dense.prior_cov[:, :, :known] = 0.0

    log_w = dense.log_density()
    mean, _ = dense.new_rates()
    w = np.exp(log_w - log_w.max())
    expected = (w / w.sum()) @ mean[:, 4]
    assert float(found["mean"][0, 4, 0]) == pytest.approx(expected, abs=0.04)


def test_own_reports_help(persons, posterior):
    persons = persons[:12]
    with_own = predict_reports(posterior, persons)
    answers = np.array([1.0 + 6.0 * mission.contact_rate for mission in persons])
    np.testing.assert_allclose(with_own["report"], answers)  # on the scale that was answered
    mean = with_own["probability"].dot(with_own["answer"])
    np.testing.assert_allclose(with_own["mean"], mean, atol=1e-6)  # answers have six places
    without = predict_reports(posterior, persons, given="none")
    assert with_own.attrs["mean_log_score"] > without.attrs["mean_log_score"]
    np.testing.assert_allclose(with_own["probability"].sum("answer"), 1.0)
    assert with_own.attrs["coverage_90"] > 0.8


def test_numbers_at_the_ends_are_limits():
    people = simulated(n=20, scale="unit", seed=4)
    found = predict_reports(fit(people, HumanTrust(), progress=False, latent=False), people)
    assert found.attrs["mae"] < 0.2
    assert np.isfinite(found["log_score"].values).all()


def test_what_is_not_of_these_people_is_refused(posterior, persons):
    ticks = np.full((2, 1), 6.0)
    other = tb.Mission.from_arrays(None, np.zeros((2, 1, 1)), [[0.5], [0.5]], n_ticks=ticks)
    with pytest.raises(TrustboError, match="inputs"):
        predict_reports(posterior, [other])
    with pytest.raises(TrustboError, match="at least one mission"):
        predict_reports(posterior, [])
    with pytest.raises(TrustboError):
        predict_reports(fit(persons, PooledTrust(), progress=False, latent=False), persons)
    with pytest.raises(TrustboError, match="levels"):
        fit(persons, HumanTrust(scale="likert5"), progress=False, latent=False)
    with pytest.raises(TrustboError):
        tb.check(posterior, persons)
