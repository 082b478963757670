"""Whether trust carries over between bounds: evidence against quadrature, and simulated rates."""

from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pytest
from dense_statespace import equations_of_params, mission_of, mission_of_params, noise_scale_of
from missions import draw_rates
from scipy import stats

import trustbo as tb
from trustbo.inference.class_sampling import by_importance
from trustbo.inference.class_target import ClassTarget
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


def with_equal_noise(model):
    """The model whose noise is the same in all bounds."""
    return replace(model, priors=replace(model.priors, f_v=None))


def test_the_evidence_without_memory_is_that_of_quadrature():
    """Over both noises, half-normal a priori."""
    model = with_equal_noise(without_memory(PooledTrust()))
    posterior = ClassTarget(model, model.observations(missions_with(0.3, 1)))
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
    params = tb.inference.params_of(
        posterior, next_mission=True
    )  # with effects of robots in bounds
    assert params.memory == "deviation"
    weights = {"beta": np.tile(draws["beta"].values, (3, 1)), "b": np.full(3, float(draws["b"]))}
    of_draw = params.draw(7).replace(**weights)
    for j, mission in enumerate(deviations):
        form, drift, offset = equations_of_params(of_draw, mission.awareness, mission.path)
        offset = offset + d[j] * mission.awareness[..., 0]
        scale = noise_scale_of(of_draw, mission.awareness)[0]
        expected = mission_of(form, drift, offset, scale).log_density(mission.contact_rate)
        found = posterior["log_likelihood"]["contact_rate"].values[0, 7, j]
        # Effects of robots in bounds are stored in single precision.
        np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_scores_are_of_deviations_that_last(deviations):
    """The log score of a rate ahead, against its marginal normal under each draw."""
    model = PooledTrust(memory="deviation")
    posterior = tb.fit(deviations, model, draws=25, chains=1, progress=False)
    params = tb.inference.params_of(posterior)
    table = tb.inference.score(posterior, deviations)
    dense = mission_of_params(params, deviations[2].awareness)
    sd = np.sqrt(np.diagonal(dense.rate_cov, axis1=1, axis2=2))
    density = stats.norm.pdf(deviations[2].contact_rate.ravel(), dense.mean, sd).mean(0)
    np.testing.assert_allclose(np.ravel(table["log_score"][2]), np.log(density), rtol=1e-9)
