"""Whether trust carries over between bounds: evidence against quadrature, and simulated rates."""

from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pytest
from missions import draw_rates
from references import dense_log_likelihood
from scipy import stats

import trustbo as tb
from trustbo.inference.density import Density
from trustbo.inference.fit import by_importance
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect, TrustParams

FEATURES = ["line_of_sight", "slope"]


def simulated(truth, n=4, seed=0):
    """Missions of a straight path under parameters."""
    rng, path = np.random.default_rng(seed), [(k, 0) for k in range(13)]
    missions = []
    for _ in range(n):
        z = rng.uniform(size=(12, 3, 2))
        y = np.clip(draw_rates(truth, z[None], seed=int(rng.integers(1000)))[0], 0.0, 1.0)
        missions.append(tb.Mission.from_arrays(path, z, y, features=FEATURES))
    return missions


def missions_with(beta0, n=4):
    """Missions whose trust has that memory, and the same level."""
    rest = 1.0 - beta0
    return simulated(
        TrustParams(beta0, rest * np.array([0.6, 0.1]), rest * 0.1, 0.08 * rest, 0.03), n
    )


def without_memory(model):
    """The model with beta0 = 0 but for 1e-6."""
    model = model.for_features(FEATURES)
    return replace(model, priors=replace(model.priors, beta0=dist.Beta(1.0, 1e6)))


def test_the_evidence_without_memory_is_that_of_quadrature():
    """Over both noises, half-normal a priori."""
    model = without_memory(PooledTrust())
    posterior = Density(model, model.observations(missions_with(0.3, 1)))
    found = by_importance(posterior, 1000, 0)[2]["log_evidence"]

    p = (np.arange(80) + 0.5) / 80
    w, v = (x.ravel() for x in np.meshgrid(*[0.2 * stats.halfnorm.ppf(p)] * 2))
    values = {"beta0": 0.0 * w, "delta_w": w, "delta_v": v}
    evidence = posterior.log_evidence(model.theta(values, posterior.observations.resolution))
    expected = np.logaddexp.reduce(evidence) - np.log(len(w))
    assert found == pytest.approx(expected, abs=0.15)


@pytest.mark.parametrize(
    "model",
    [
        PooledTrust(),
        PooledTrust(effects=RobotEffect()),
        PooledTrust(family="censored"),
    ],
    ids=["pooled", "robots", "censored"],
)
def test_memory_is_found_where_it_is_and_not_where_it_is_not(model):
    models = model, without_memory(model)
    for beta0 in (0.5, 0.0):
        missions = missions_with(beta0)
        fits = [tb.fit(missions, m, latent=False) for m in models]
        with_memory, without = (fit.attrs["log_evidence"] for fit in fits)
        if beta0:
            assert with_memory - without > 3.0
            assert abs(float(fits[0]["posterior"]["beta0"].mean()) - 0.5) < 0.25
        else:
            assert with_memory < without


@pytest.fixture(scope="module")
def deviations():
    """Missions whose deviations from expected trust last."""
    return simulated(
        TrustParams(0.8, np.array([0.6, 0.1]), 0.15, 0.08, 0.02, memory="deviation"), 5
    )


def test_deviations_that_last_are_told_from_trust_that_does(deviations):
    models = PooledTrust(memory="deviation"), PooledTrust()
    for missions, sign in ((deviations, 1.0), (missions_with(0.7, 5), -1.0)):
        right, wrong = (tb.fit(missions, model, latent=False) for model in models)
        assert sign * (right.attrs["log_evidence"] - wrong.attrs["log_evidence"]) > 5.0
    fitted = tb.fit(deviations, models[0], latent=False)["posterior"]["beta0"]
    assert abs(float(fitted.mean()) - 0.8) < 4.0 * float(fitted.std())


def test_likelihoods_are_those_of_a_chain_of_deviations(deviations):
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()], memory="deviation")
    posterior = tb.fit(deviations, model, draws=50, seed=1, progress=False)
    draws = posterior["posterior"].isel(chain=0, draw=7)
    d = posterior["robots"]["robot_effect"].values[0, 7]
    params = tb.inference.params_of(posterior)
    assert params.memory == "deviation"
    noises = float(draws["delta_w"]), float(draws["delta_v"])
    for j, mission in enumerate(deviations):
        place = params.draw(7).of_places(tb.workspace.moves.bounds_along(mission.path))
        z, expected = mission.awareness, 0.0
        for i in range(3):
            u = z[:, i] @ draws["beta"].values + float(draws["b"])
            u = u + d[j, i] * z[:, i, 0] + place[0]
            y = mission.contact_rate[:, i] - u
            no = np.zeros((len(y), 1))
            beta0 = float(draws["beta0"])
            expected += dense_log_likelihood(beta0, [0.0], 0.0, *noises, 0.0, 0.5, no, y)
        found = posterior["log_likelihood"]["contact_rate"].values[0, 7, j]
        np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_scores_are_of_deviations_that_last(deviations):
    """The log score of a rate ahead, against its marginal normal under each draw."""
    posterior = tb.fit(deviations, PooledTrust(memory="deviation"), draws=25, progress=False)
    params = tb.inference.params_of(posterior)
    table = tb.inference.score(posterior, deviations)
    k, y = np.arange(1, 13), deviations[2].contact_rate[:, 1]
    beta0, w, v = (x[:, None] for x in (params.beta0, params.delta_w, params.delta_v))
    mean = params.beta @ deviations[2].awareness[:, 1].T + params.b[:, None]
    lasting = beta0 ** (2 * k)
    variance = lasting * 0.5**2 + w**2 * (1.0 - lasting) / (1.0 - beta0**2) + v**2
    density = stats.norm.pdf(y, mean, np.sqrt(variance)).mean(0)
    np.testing.assert_allclose(table["log_score"][2, :, 1], np.log(density), rtol=1e-6)
