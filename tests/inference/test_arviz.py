"""Groups of a posterior that ArviZ's functions read, against dense normals."""

import arviz as az
import jax
import numpy as np
import numpyro.distributions as dist
import pytest

import trustbo as tb
from trustbo.models import CoupledTrust, PlaceEffect, PooledTrust, Priors, RobotEffect
from trustbo.models.backend import own_settings

FEATURES = ("traversability", "line_of_sight")


def campaign(n_missions=5, seed=0):
    rng = np.random.default_rng(seed)
    missions = []
    for _ in range(n_missions):
        path = [(k, int(rng.integers(2)) + 1) for k in range(7)]
        z = rng.uniform(size=(6, 2, 2))
        rates = np.clip(0.2 + 0.3 * z.sum(-1) + 0.05 * rng.standard_normal((6, 2)), 0.0, 1.0)
        rates[rng.random(rates.shape) < 0.15] = np.nan
        missions.append(tb.Mission.from_arrays(path, z, rates, features=FEATURES))
    return missions


@pytest.fixture(scope="module")
def missions():
    return campaign()


@pytest.fixture(scope="module")
def posterior(missions):
    return tb.fit(missions, PooledTrust())


def test_sensitivity_flags_a_prior_in_conflict_with_the_data(missions, posterior):
    """The data put the intercept at a half below; the prior says 3 +- .2."""
    assert set(posterior["log_prior"].data_vars) == {"beta0", "beta", "b", "delta_w", "delta_v"}
    wrong = PooledTrust(Priors(b=dist.Normal(3.0, 0.2)))
    conflict = tb.fit(missions, wrong, check=False)
    calm = PooledTrust(Priors(b=dist.Normal(0.0, 5.0)))
    vague = tb.fit(missions, calm)
    verdict, other = (
        az.psense_summary(p, var_names=["b"], prior_var_names=["b"]) for p in (conflict, vague)
    )
    assert "conflict" in verdict.loc["b", "diagnosis"]
    assert float(verdict.loc["b", "prior"]) > 0.1
    assert "✓" in other.loc["b", "diagnosis"]
    assert float(other.loc["b", "prior"]) < 0.02


# --- predictions and likelihoods, rate by rate ---


def test_the_view_by_rate_is_the_mission_s_likelihood_in_pieces(missions, posterior):
    view = tb.inference.by_rate(posterior)
    pieces = view["log_likelihood"]["contact_rate"]
    rates = np.concatenate([m.contact_rate[np.isfinite(m.contact_rate)] for m in missions])
    np.testing.assert_array_equal(view["observed_data"]["contact_rate"].values, rates)
    whole = posterior["log_likelihood"]["contact_rate"].values
    summed = pieces.groupby("mission").sum("rate").transpose("chain", "draw", "mission")
    np.testing.assert_allclose(summed.values, whole, rtol=0, atol=1e-10)
    assert view["posterior_predictive"]["contact_rate"].shape == pieces.shape
    alone = tb.fit(missions, PooledTrust(), whole=False)
    again = tb.inference.by_rate(alone, missions)["log_likelihood"]["contact_rate"]
    np.testing.assert_array_equal(again.values, pieces.values)


def test_each_rate_is_predicted_by_dense_conditioning_on_those_before(missions, posterior):
    view = tb.inference.by_rate(posterior)
    draw = tb.inference.params_of(posterior).draw(7)
    robot, mission = 1, missions[2]
    y = mission.contact_rate[:, robot]
    u = mission.awareness[:, robot] @ draw.beta + draw.b
    n = len(y)
    # x = M + L e: trust as a linear map of x_0 and process noise
    L = np.array([[draw.beta0 ** (k - j) if j <= k else 0.0 for j in range(n)] for k in range(n)])
    start = draw.beta0 ** np.arange(1, n + 1)
    mean = start * draw.x0_mean + L @ u
    cov = np.outer(start, start) * draw.x0_sd**2 + L @ L.T * draw.delta_w**2
    cov += np.eye(n) * draw.delta_v**2
    seen = np.flatnonzero(np.isfinite(y))
    expected = []
    for i, k in enumerate(seen):
        past = seen[:i]
        gain = np.linalg.solve(cov[np.ix_(past, past)], cov[past, k]) if i else np.zeros(0)
        m, v = mean[k] + gain @ (y[past] - mean[past]), cov[k, k] - gain @ cov[past, k]
        expected.append(-0.5 * (y[k] - m) ** 2 / v - 0.5 * np.log(2.0 * np.pi * v))
    pieces = view["log_likelihood"]["contact_rate"].stack(sample=("chain", "draw"))
    rates = pieces.coords
    own = (rates["mission"].values == 2) & (rates["robot"].values == "r2")
    np.testing.assert_allclose(pieces.values[own, 7], expected, rtol=1e-9, atol=1e-9)


def test_the_view_by_rate_has_the_priors(posterior):
    sensitivity = az.psense_summary(tb.inference.by_rate(posterior), var_names=["b"])
    expected = az.psense_summary(posterior, var_names=["b"])
    columns = ["prior", "likelihood"]
    np.testing.assert_allclose(sensitivity[columns], expected[columns], atol=2e-3)  # rounded
    within = float(posterior["posterior"]["b"].median())
    factor, same = (
        az.bayes_factor(tree, var_names=["b"], ref_vals=within)["b"]
        for tree in (tb.inference.by_rate(posterior), posterior)
    )
    np.testing.assert_allclose(factor, same)
    view = tb.inference.by_rate(posterior)
    measured = np.isfinite(posterior["observed_data"]["contact_rate"].values)
    np.testing.assert_array_equal(
        view["prior_predictive"]["contact_rate"],
        posterior["prior_predictive"]["contact_rate"].values[..., measured],
    )
    with pytest.raises(tb.TrustboError, match="by rate"):
        tb.inference.loo(view)


@pytest.mark.parametrize(
    "model",
    [
        CoupledTrust(),
        PooledTrust(shared_noise=True, effects=(PlaceEffect(), RobotEffect())),
        PooledTrust(memory="deviation"),
    ],
    ids=["coupled", "shared noise", "deviation"],
)
def test_pieces_of_every_gaussian_model_add_up(missions, model):
    posterior = tb.fit(missions, model, draws=25, check=False, progress=False)
    pieces = tb.inference.by_rate(posterior)["log_likelihood"]["contact_rate"]
    summed = pieces.groupby("mission").sum("rate").transpose("chain", "draw", "mission")
    whole = posterior["log_likelihood"]["contact_rate"].values
    np.testing.assert_allclose(summed.values, whole, atol=1e-9)


def test_predictions_by_rate_are_calibrated_under_the_model():
    """Under the model PIT values are uniform; the mean of 60 missions' is 1/2 within 4 sd."""
    rng, z = np.random.default_rng(0), np.random.default_rng(1).uniform(size=(60, 6, 2, 2))
    truth = tb.models.TrustParams(0.5, np.array([0.2, 0.1]), 0.2, 0.05, 0.05)
    with own_settings():
        sample = PooledTrust().simulate(jax.random.key(0), truth, z)
    path = [(k, 0) for k in range(7)]
    rates = np.clip(sample, 0.0, 1.0)
    missions = [tb.Mission.from_arrays(path, *pair) for pair in zip(z, rates, strict=True)]
    view = tb.inference.by_rate(tb.fit(missions, PooledTrust()))
    drawn = view["posterior_predictive"]["contact_rate"]
    pit = (drawn < view["observed_data"]["contact_rate"]).mean(("chain", "draw")).values
    assert abs(pit.mean() - 0.5) < 4.0 / np.sqrt(12.0 * len(pit))
    assert 0.07 < np.mean(pit < 0.1) + rng.uniform(0.0, 1e-9) < 0.13


def test_every_draw_has_predictions(posterior):
    sizes = posterior["posterior"].sizes
    for group in ("posterior_predictive", "log_likelihood", "log_prior"):
        assert posterior[group].sizes["draw"] == sizes["draw"]
        assert posterior[group].sizes["chain"] == sizes["chain"]


def test_what_has_no_single_predictions_is_named(missions):
    posterior = tb.fit(missions, PooledTrust(observation="censored"), draws=25, whole=False)
    with pytest.raises(tb.TrustboError, match="censored"):
        tb.inference.by_rate(posterior)
