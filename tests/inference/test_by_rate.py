"""Contact rates one by one, against dense normals and against the likelihoods of missions."""

import importlib

import arviz as az
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from dense_statespace import mission_of_params
from missions import counted_missions, simulate_missions, walking_missions
from scipy import stats

from trustbo.errors import TrustboError
from trustbo.inference import add_latent, by_rate, fit
from trustbo.inference.tree import parameters_alone
from trustbo.models import (
    ContactRate,
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
    TrustParams,
)
from trustbo.models.families import FAMILIES
from trustbo.statespace import kalman


def of_missions(rates):
    """Sums (chain, draw, mission) of the log-likelihoods of rates."""
    return rates["log_likelihood"]["contact_rate"].groupby("mission").sum("rate")


def coupled(awareness, contact_rate=None):
    """Two or more robots that influence each other."""
    n = awareness.shape[2]
    beta = numpyro.sample("beta", dist.Normal(0.0, 0.5).expand((2,)).to_event(1))
    own = numpyro.sample("own", dist.Beta(2.0, 2.0))
    other = numpyro.sample("other", dist.Normal(0.0, 0.1))
    B0 = own * np.eye(n) + other * (1.0 - np.eye(n))
    with numpyro.plate("mission", len(awareness)):
        rates = ContactRate(awareness @ beta, B0, 0.3, 0.2)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def robots_apart(awareness, contact_rate=None):
    """Robots with noise of their own, and an input that is not carried over."""
    n = awareness.shape[2]
    beta = numpyro.sample("beta", dist.Normal(0.0, 0.5).expand((2,)).to_event(1))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    delta_v = numpyro.deterministic("delta_v", np.linspace(0.1, 0.3, n))
    with numpyro.plate("mission", len(awareness)):
        rates = ContactRate(
            awareness[..., 0] * beta[0], beta0, 0.3, delta_v, offset=awareness[..., 1] * beta[1]
        )
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def test_each_rate_is_predicted_from_the_earlier_ones_of_its_robot():
    missions = simulate_missions(3)
    posterior = fit(missions, PooledTrust(), draws=20, progress=False, check=False)
    rates = by_rate(posterior)
    draws = posterior["posterior"].isel(chain=0, draw=7)
    parameters = [draws[n].values for n in ("beta0", "beta", "b", "delta_w", "delta_v")]
    found = rates["log_likelihood"]["contact_rate"].isel(chain=0, draw=7)
    x0 = [posterior.attrs[name] for name in ("x0_mean", "x0_sd")]
    robots = missions[0].robots
    for mission, bound, i in ((0, 1, 0), (0, 4, 2), (2, 8, 1)):
        z = missions[mission].awareness[:, [i]]
        y = missions[mission].contact_rate[:, [i]]
        params = TrustParams(*parameters, *x0)
        upto = [
            mission_of_params(params, z[:k]).log_density(y[:k]) if k else 0.0
            for k in (bound, bound - 1)
        ]
        is_it = (found["mission"] == mission) & (found["bound"] == bound)
        is_it &= found["robot"] == robots[i]
        assert float(found[is_it.values].item()) == pytest.approx(upto[0] - upto[1], abs=1e-9)


def test_predicted_rates_have_the_dense_conditional_moments():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((4, 4))
    cov = root @ root.T
    mean = rng.standard_normal(4)
    y = mean + 1.5
    before = np.tile(mean, (3, 1, 1)), cov[None, None], np.full((1, 1, 1), 0.3)
    ahead = kalman.one_step_ahead(*before, y[None], np.ones((1, 4)), FAMILIES["gaussian"])
    in_pairs = kalman.one_step_ahead(*before, y[None], np.ones((1, 4)), FAMILIES["gaussian"], 2)
    whole = cov + 0.3**2 * np.eye(4)
    for k in range(4):
        gain = np.linalg.solve(whole[:k, :k], whole[:k, k]) if k else np.zeros(0)
        m = mean[k] + gain @ (y - mean)[:k]
        sd = np.sqrt(whole[k, k] - gain @ whole[:k, k])
        np.testing.assert_allclose(ahead.mean[:, 0, k], m, atol=1e-9)
        np.testing.assert_allclose(ahead.var[:, 0, k], sd**2 - 0.3**2, atol=1e-9)
        np.testing.assert_allclose(ahead.log_p[:, 0, k], stats.norm.logpdf(y[k], m, sd), atol=1e-9)
        np.testing.assert_allclose(in_pairs.log_p, ahead.log_p)
    gain = np.linalg.solve(whole[:2, :2], whole[:2, 2:])
    np.testing.assert_allclose(in_pairs.mean[:, 0, 2:], [mean[2:] + (y - mean)[:2] @ gain] * 3)
    left = np.diagonal(cov[2:, 2:] - gain.T @ whole[:2, 2:])
    np.testing.assert_allclose(in_pairs.var[:, 0, 2:], [left] * 3)
    np.testing.assert_allclose(in_pairs.mean[:, 0, :2], [mean[:2]] * 3)


def test_rates_of_the_first_bound_are_drawn_with_trust_and_noise():
    missions = simulate_missions(3)
    posterior = fit(missions, PooledTrust(), draws=500, progress=False, check=False)
    rates = by_rate(posterior)
    draws = {n: v.values[0] for n, v in posterior["posterior"].to_dataset().items()}
    parameters = [draws[n] for n in ("beta0", "beta", "b", "delta_w", "delta_v")]
    x0 = [posterior.attrs[name] for name in ("x0_mean", "x0_sd")]
    dense = mission_of_params(TrustParams(*parameters, *x0), missions[0].awareness[:1])
    sd = np.sqrt(np.diagonal(dense.rate_cov, axis1=1, axis2=2))
    predicted = rates["posterior_predictive"]["contact_rate"]
    first = ((predicted["mission"] == 0) & (predicted["bound"] == 1)).values
    white = (predicted.values[0, :, first].T - dense.mean) / sd
    assert abs(white.mean(0)).max() < 5.0 / np.sqrt(len(white))
    assert abs(white.std(0) - 1.0).max() < 5.0 / np.sqrt(2.0 * len(white))


@pytest.mark.parametrize(
    "model",
    [
        CoupledTrust(),
        HierarchicalTrust(),
        PooledTrust(shared_noise=True),
        PooledTrust(memory="deviation"),
        PooledTrust(effects=[PlaceEffect(), RobotEffect()]),
        coupled,
        robots_apart,
    ],
    ids=["coupled", "hierarchical", "shared noise", "deviation", "effects", "function", "apart"],
)
def test_gaussian_rates_sum_to_their_missions(model):
    missions = walking_missions(1)
    posterior = fit(missions, model, draws=25, progress=False, check=False)
    rates = by_rate(posterior)
    assert (
        rates["observed_data"].sizes["rate"] == posterior["observed_data"]["contact_rate"].count()
    )
    expected = posterior["log_likelihood"]["contact_rate"]
    np.testing.assert_allclose(of_missions(rates).values, expected.values, rtol=1e-7, atol=1e-6)
    assert np.isfinite(rates["posterior_predictive"]["contact_rate"]).all()


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
def test_other_rates_sum_to_their_missions_up_to_moment_matching(family):
    _, y, missions = counted_missions(family)
    posterior = fit(missions, PooledTrust(family=family), draws=100, progress=False, check=False)
    rates = by_rate(posterior)
    assert rates.attrs["log_likelihood_of"] == posterior.attrs["log_likelihood_of"] == "ticks"
    assert rates["observed_data"].sizes["rate"] == np.isfinite(y).sum()
    over = ("chain", "draw")
    gap = of_missions(rates) - posterior["log_likelihood"]["contact_rate"]
    # Four particles a mission have an error of their own, which the mean over draws reduces.
    assert float(abs(gap.mean(over)).max()) < 0.1


def test_counts_of_gaussian_rates_sum_to_their_missions():
    _, _, missions = counted_missions("gaussian")
    posterior = fit(missions, PooledTrust(), draws=25, progress=False, check=False)
    rates = by_rate(posterior)
    assert rates.attrs["log_likelihood_of"] == "ticks"
    expected = posterior["log_likelihood"]["contact_rate"].values
    np.testing.assert_allclose(of_missions(rates).values, expected, rtol=1e-9)


@pytest.mark.filterwarnings("ignore:Estimated shape parameter")
def test_values_stand_at_their_labels_and_a_posterior_is_not_larger():
    missions = walking_missions(1)
    posterior = fit(missions, PooledTrust(), draws=25, progress=False, check=False)
    groups = set(posterior.children)
    rates = by_rate(posterior)
    assert set(posterior.children) == groups
    assert az.loo(posterior).n_data_points == len(missions)
    observed = rates["observed_data"]["contact_rate"]
    for one in observed[::7]:
        where = {name: one[name].item() for name in ("mission", "bound", "robot")}
        assert posterior["observed_data"]["contact_rate"].sel(where).item() == one.item()
        z = posterior["constant_data"]["awareness"].sel(where)
        here = rates["constant_data"].sel(rate=one["rate"].item())
        assert [here[str(name)].item() for name in z["feature"].values] == z.values.tolist()


def test_many_rates_have_fewer_draws(monkeypatch):
    module = importlib.import_module("trustbo.inference.by_rate")  # the package's is the function
    monkeypatch.setattr(module, "_NUMBERS", 10)
    monkeypatch.setattr(module, "_FEWEST_DRAWS", 12)
    posterior = fit(simulate_missions(3), PooledTrust(), draws=25, progress=False, check=False)
    rates = by_rate(posterior)
    for group in ("posterior", "sample_stats", "log_likelihood", "posterior_predictive"):
        assert rates[group].sizes["draw"] == 12
    kept = rates["posterior"]["draw"].values
    xr.testing.assert_equal(rates["posterior"]["b"], posterior["posterior"]["b"].isel(draw=kept))
    expected = posterior["log_likelihood"]["contact_rate"].isel(draw=kept)
    np.testing.assert_allclose(of_missions(rates).values, expected.values, rtol=1e-9)


def test_parameters_alone_have_no_rates():
    missions = simulate_missions(3)
    alone = parameters_alone(fit(missions, PooledTrust(), draws=25, check=False))
    with pytest.raises(TrustboError, match="missions"):
        by_rate(alone)
    assert by_rate(add_latent(alone, missions))["observed_data"].sizes["rate"] == 60
