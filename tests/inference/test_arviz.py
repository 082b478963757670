"""Groups of a posterior that ArviZ's functions read, against dense normals."""

import itertools

import arviz as az
import numpy as np
import numpyro.distributions as dist
import pytest
import xarray as xr
from scipy import stats

import trustbo as tb
from trustbo.inference import add_latent
from trustbo.inference.tree import parameters_alone
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, Priors

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
    of_model = {"beta0", "beta", "b", "delta_w", "delta_v", "f_v"}
    assert set(posterior["log_prior"].data_vars) == of_model
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


@pytest.mark.parametrize("model", [PooledTrust(), CoupledTrust()], ids=["pooled", "coupled"])
def test_log_prior_of_noise_is_at_the_noise_without_resolution(model):
    """delta_v^2 + 0.1^2 is stored; the prior on delta_v is half-normal with scale 0.2."""
    rng, path = np.random.default_rng(0), [(0, k) for k in range(7)]
    missions = []
    for _ in range(6):
        rates = np.round(10.0 * rng.uniform(0.6, 0.8, (6, 2))) / 10.0
        z = rng.uniform(size=(6, 2, 2))
        missions.append(tb.Mission.from_arrays(path, z, rates, n_ticks=10))
    posterior = tb.fit(missions, model, draws=200, progress=False)
    draws = posterior["posterior"]
    if "delta_v" in draws:
        variance = draws["delta_v"].values[..., None] ** 2
    else:
        variance = np.diagonal(draws["Delta_v"].values, axis1=-2, axis2=-1)
    log_p = 0.5 * np.log(2.0 / (np.pi * 0.2**2)) - (variance - 0.1**2) / (2.0 * 0.2**2)
    found = posterior["log_prior"]["delta_v"].values
    np.testing.assert_allclose(found, log_p.sum(-1), rtol=1e-9, atol=1e-9)


def test_every_draw_has_a_likelihood_and_draws_with_trust_have_predictions(posterior):
    of_draws = posterior["posterior"].sizes
    for group in ("log_likelihood", "log_prior"):
        assert posterior[group].sizes["draw"] == of_draws["draw"]
        assert posterior[group].sizes["chain"] == of_draws["chain"]
    for name in ("chain", "draw"):
        predicted = posterior["posterior_predictive"][name]
        np.testing.assert_array_equal(predicted, posterior["latent"][name])
    assert posterior["posterior_predictive"].sizes["draw"] == 200


def test_the_effective_sample_size_is_that_of_the_weights(missions):
    for draws in (250, 1000):
        posterior = tb.fit(missions, PooledTrust(), draws=draws, latent=False)
        assert posterior["posterior"].sizes["chain"] == 1
        ess = az.ess(posterior, var_names=["beta0", "delta_w", "delta_v"], method="mean")
        least = min(float(values) for values in ess.data_vars.values())
        kish = 1.0 / (1.0 / posterior.attrs["kish"] + 0.25 / draws)
        assert 0.5 * kish < least < 2.0 * kish


def numbered(draws):
    """The same variables, in which every entry has a number of its own in all draws."""
    made, first = {}, 0
    for name, values in draws.data_vars.items():
        size = values[0, 0].size
        numbers = np.arange(first, first + size, dtype=float).reshape(values.shape[2:])
        made[name] = values.copy(data=np.broadcast_to(numbers, values.shape))
        first += size
    return xr.Dataset(made)


@pytest.mark.parametrize("group", ["posterior", "prior"])
@pytest.mark.parametrize("model", [HierarchicalTrust(), CoupledTrust()])
def test_rows_of_a_summary_are_labelled_rightly_in_any_order_of_names(missions, model, group):
    posterior = tb.fit(missions, model, draws=10, latent=False, check=False, progress=False)
    draws = numbered(posterior[group].to_dataset())
    arrays = [name for name in draws.data_vars if draws[name].ndim > 2]
    assert len(arrays) > 3
    for names in itertools.permutations(arrays, 2):
        table = az.summary(draws, var_names=list(names), kind="stats", round_to="none")["mean"]
        for label, value in table.items():
            name, place = label.rstrip("]").split("[")
            where = dict(zip(draws[name].dims[2:], place.split(", "), strict=True))
            assert draws[name].isel(chain=0, draw=0).sel(where).item() == pytest.approx(value)


@pytest.mark.parametrize("model", [tb.models.default_model(), tb.models.CoupledTrust()])
def test_draws_of_the_prior_and_of_its_predictions_belong_together(model):
    """As for the posterior, with one rate and thus nearly the prior."""
    z = np.random.default_rng(0).uniform(size=(6, 2, 1))
    rates = np.full((6, 2), np.nan)
    rates[0, 0] = 0.5
    missions = [tb.Mission.from_arrays([(0, k) for k in range(7)], z, rates)]
    posterior = tb.fit(missions, model, check=False, progress=False)

    b = posterior["prior"]["b"]
    b = b.mean([dim for dim in b.dims if dim not in ("chain", "draw")])
    predicted = posterior["prior_predictive"]["contact_rate"].mean(("mission", "bound", "robot"))
    b = b.sel(draw=predicted["draw"])
    assert stats.spearmanr(b.values.ravel(), predicted.values.ravel()).statistic > 0.3

    part = posterior.isel(draw=slice(100, None, 3))
    again = add_latent(parameters_alone(part), missions)
    for name in ("chain", "draw"):
        assert again["prior_predictive"][name].equals(again["prior"][name])

    del part["prior"]
    assert add_latent(parameters_alone(part), missions)["prior_predictive"].sizes["draw"] == 200
