"""Comparing posteriors of classes, functions and own MCMC, or refusing to."""

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from missions import TRUTH, draw_rates
from numpyro.infer import MCMC, NUTS

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import add_latent, compare, fit, loo
from trustbo.inference.learner import as_learner
from trustbo.models import ContactRate, HierarchicalTrust, PooledTrust, Priors

N_TICKS = 40
PLAIN = PooledTrust(Priors())  # priors that are given do not depend on the features


def copy_of_pooled(awareness, contact_rate=None, n_ticks=None):
    """The model of PLAIN, with the resolution that `fit` adds to the noise."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    beta = numpyro.sample("beta", dist.Normal(0.0, 1.0).expand((2,)).to_event(1))
    b = numpyro.sample("b", dist.Normal(0.0, 0.5))
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.2))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.2))
    noise = jnp.hypot(delta_v, 1.0 / N_TICKS)
    with numpyro.plate("mission", len(awareness)):
        rates = ContactRate(awareness @ beta + b, beta0, delta_w, noise, n_ticks=n_ticks)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def without_ticks(awareness, contact_rate=None):
    copy_of_pooled(awareness, contact_rate)


def counted(n=12, ticks=N_TICKS):
    """Missions of two robots whose rates are shares of ticks."""
    z = np.random.default_rng(3).uniform(size=(n, 6, 2, 2))
    y = np.clip(draw_rates(TRUTH, z, seed=3), 0.0, 1.0)
    path = [(0, k) for k in range(7)]
    return [
        Mission.from_arrays(path, a, np.round(N_TICKS * b) / N_TICKS, n_ticks=ticks)
        for a, b in zip(z, y, strict=True)
    ]


def without_latent(posterior):
    """The posterior that `fit(latent=False)` returns with the same seed."""
    fitted = ("posterior", "sample_stats", "prior", "observed_data", "constant_data")
    bare = xr.DataTree.from_dict({name: posterior[name].to_dataset() for name in fitted})
    bare.attrs = {k: v for k, v in posterior.attrs.items() if k != "log_likelihood_of"}
    return bare


def own_mcmc(posterior):
    """A user's own MCMC given the data of a posterior, in single precision as JAX's default."""
    data = posterior["constant_data"]
    z = jnp.asarray(data["awareness"].values)
    y = jnp.asarray(posterior["observed_data"]["contact_rate"].values)
    n_ticks = jnp.asarray(data["n_ticks"].values)
    mcmc = MCMC(
        NUTS(copy_of_pooled, dense_mass=True, max_tree_depth=7), num_warmup=200, num_samples=500,
        num_chains=2, chain_method="vectorized", progress_bar=False,
    )  # fmt: skip
    mcmc.run(jax.random.key(0), z, y, n_ticks)
    return az.from_numpyro(mcmc, log_likelihood=True)


def changed(tree, log_likelihood=None, **attrs):
    """A copy of an own MCMC with other log-likelihoods or attributes."""
    groups = {name: tree[name].to_dataset() for name in tree.children}
    if log_likelihood is not None:
        groups["log_likelihood"] = groups["log_likelihood"].assign(contact_rate=log_likelihood)
    made = xr.DataTree.from_dict(groups)
    made.attrs = attrs
    return made


@pytest.fixture(scope="module")
def of_class():
    return fit(counted(), PLAIN, progress=False)


@pytest.fixture(scope="module")
def of_function():
    return fit(counted(), copy_of_pooled, progress=False, check=False)


@pytest.fixture(scope="module")
def own(of_class):
    return own_mcmc(of_class)


def test_the_same_model_as_class_function_and_own_mcmc_is_the_same(of_class, of_function, own):
    own = changed(own, log_likelihood_of="ticks")
    table = compare({"own": own, "class": of_class, "function": of_function}, progress=False)
    # Five parameters and 12 missions: p is near 5, and differences are Monte Carlo errors.
    assert table["elpd_diff"].abs().max() < 1.0
    assert table["p"].between(2.0, 9.0).all()
    assert (table["n_missions"] == 12).all()
    assert table["verdict"].str.startswith("undecided").all()


def test_missions_without_a_likelihood_and_later_with_one_are_left_out_alike(of_function):
    bare = without_latent(of_function)
    np.testing.assert_allclose(loo(bare).elpd_i, loo(of_function).elpd_i, atol=1e-8)
    whole = add_latent(bare)
    np.testing.assert_allclose(loo(whole).elpd_i, loo(of_function).elpd_i, atol=1e-8)


def test_densities_and_counts_are_not_compared(of_class, of_function, own):
    """They would differ by the sum of log n_ticks, 531 nats here, and not by the models."""
    source = as_learner(without_ticks).source(of_function, counted())
    assert not source.of_counts
    log_p = source.log_likelihood()
    log_p = of_function["log_likelihood"]["contact_rate"].copy(data=log_p[None])
    attrs = of_function.attrs | {"log_likelihood_of": "contact_rate"}
    densities = changed(of_function, log_p, **attrs)
    with pytest.raises(TrustboError, match="n_ticks"):
        compare({"class": of_class, "function": densities})
    log_p = own["log_likelihood"]["contact_rate"] + 12 * np.log(N_TICKS)  # of 12 rates
    for attrs in ({}, {"log_likelihood_of": "contact_rate"}, {"log_likelihood_of": "ticks"}):
        with pytest.raises(TrustboError, match="n_ticks"):
            compare({"own": changed(own, log_p, **attrs), "class": of_class})


def test_censored_rates_at_a_limit_have_no_density_to_compare():
    """Without ticks, a censored rate of 1 has a probability, but a Gaussian one a density."""
    missions = counted(4, ticks=None)
    limit = np.array([1.0, 1.0])
    rates = np.vstack([limit, missions[0].contact_rate[1:]])
    missions[0] = Mission.from_arrays(missions[0].path, missions[0].awareness, rates)
    fits = {
        family: fit(missions, PooledTrust(family=family), latent=False, check=False)
        for family in ("gaussian", "censored")
    }
    with pytest.raises(TrustboError, match="n_ticks"):
        compare(fits)


def test_an_own_mcmc_that_needs_a_refit_or_lacks_what_loo_reads_is_refused(own, of_class):
    own = changed(own, log_likelihood_of="ticks")
    with pytest.raises(TrustboError, match="refit"):
        loo(own.isel(mission=slice(3)))

    log_p = own["log_likelihood"]["contact_rate"]
    dominant = log_p.copy(data=np.array(log_p))
    dominant[:, :5, 2] -= 30.0
    with pytest.raises(TrustboError, match="k-hat"):
        loo(changed(own, dominant, **own.attrs))
    with pytest.raises(TrustboError, match="mission"):
        loo(changed(own, log_p.expand_dims(bound=6, axis=-1), **own.attrs))

    groups = {name: own[name].to_dataset() for name in own.children}
    alone = xr.DataTree.from_dict({"posterior": groups["posterior"]})
    with pytest.raises(TrustboError, match="log_likelihood"):
        compare({"own": alone, "class": of_class})
    rates = groups["observed_data"]["contact_rate"]
    others = xr.DataTree.from_dict(groups | {"observed_data": (0.5 * rates).to_dataset()})
    others.attrs = own.attrs
    with pytest.raises(TrustboError, match="different"):
        compare({"own": others, "class": of_class})


def test_the_table_says_what_is_decided(of_class):
    wrong = PooledTrust(Priors(beta=dist.Normal(-1.0, 0.01)))
    conflict = fit(counted(), wrong, check=False, progress=False)
    fits = {"wrong": conflict, "right": of_class}
    table = compare(fits, progress=False)
    assert list(table.index) == ["right", "wrong"]
    assert list(table["verdict"]) == ["best", "worse"]
    few = {"wrong": fit(counted(5), wrong, check=False), "right": fit(counted(5), PLAIN)}
    table = compare(few, progress=False)
    assert "10 missions" in table.loc["wrong", "verdict"]
    az.plot_compare(table)


def test_models_of_a_poor_robot_are_told_apart_by_predictions_and_by_loo():
    z = np.random.default_rng(5).uniform(size=(12, 6, 3, 2))
    y = np.clip(draw_rates(TRUTH, z, seed=5), 0.0, 1.0) * [1.0, 0.6, 1.0]
    path = [(0, k) for k in range(7)]
    missions = [Mission.from_arrays(path, a, b) for a, b in zip(z, y, strict=True)]
    models = {"pooled": PooledTrust(), "hierarchical": HierarchicalTrust()}
    fits = {name: fit(missions, model, progress=False) for name, model in models.items()}

    seen = y.mean((0, 1))
    outside = {}
    for name, posterior in fits.items():
        means = posterior["posterior_predictive"]["contact_rate"].mean(("mission", "bound"))
        low, high = means.quantile([0.05, 0.95], ("chain", "draw")).values
        outside[name] = (seen < low) | (seen > high)
    assert outside["pooled"][1]
    assert not outside["hierarchical"].any()

    assert compare(fits, progress=False)["verdict"].to_dict() == {
        "hierarchical": "best",
        "pooled": "worse",
    }
