"""`add_latent`: what a posterior of parameters alone lacks, the same whenever it is computed."""

import jax
import numpy as np
import pytest
import xarray as xr
from missions import simulate_missions
from numpyro.distributions import HalfCauchy, Normal

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import add_latent, fit, loo, sample_prior
from trustbo.inference.tree import parameters_alone
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, Priors


@pytest.fixture(scope="module")
def missions():
    return simulate_missions(seed=2, n_missions=3)


def same(one, other):
    assert set(one.children) == set(other.children)
    for group in one.children:
        xr.testing.assert_identical(one[group].to_dataset(), other[group].to_dataset())


@pytest.mark.parametrize("model", [PooledTrust(), CoupledTrust()])
def test_it_adds_what_fit_adds_at_once(missions, model, tmp_path):
    whole = fit(missions, model, seed=4, draws=250, check=False)
    bare = fit(missions, model, seed=4, draws=250, check=False, latent=False)
    assert "latent" not in bare.children
    assert add_latent(whole) is whole
    same(add_latent(bare), whole)
    bare.to_netcdf(tmp_path / "bare.nc")
    with xr.open_datatree(tmp_path / "bare.nc") as read:
        same(add_latent(read.load()), whole)
    # As a campaign keeps its earlier ones.
    alone = xr.DataTree.from_dict(
        {name: bare[name].to_dataset() for name in ("posterior", "sample_stats", "prior")}
    )
    alone.attrs = bare.attrs
    with pytest.raises(TrustboError):
        add_latent(alone)
    xr.testing.assert_identical(
        add_latent(alone, missions)["latent"].to_dataset(), whole["latent"].to_dataset()
    )


def test_part_of_the_draws_keep_their_labels(missions):
    part = fit(missions, PooledTrust(), draws=75, latent=False).isel(draw=slice(100, None, 2))
    whole = add_latent(part)
    labels = part["posterior"]["draw"].values
    for group in ("log_likelihood", "log_prior"):
        np.testing.assert_array_equal(whole[group]["draw"], labels)
    for group in ("latent", "posterior_predictive"):
        assert np.isin(whole[group]["draw"], labels).all()


def test_missions_may_have_their_features_in_another_order():
    """The default priors depend on the names of the features."""
    features = ("traversability", "line_of_sight")
    missions = [
        Mission.from_arrays(one.path, one.awareness, one.contact_rate, features=features)
        for one in simulate_missions(3)
    ]
    turned = [one.in_order(one.robots, features[::-1], ()) for one in missions]
    whole = fit(missions, PooledTrust(), draws=25)
    alone = parameters_alone(whole)
    for group in ("log_likelihood", "log_prior", "latent"):
        xr.testing.assert_identical(
            add_latent(alone, turned)[group].to_dataset(), whole[group].to_dataset()
        )


@pytest.mark.parametrize(
    "other",
    [
        PooledTrust(Priors(b=Normal(0.0, 0.7)), memory="deviation"),
        PooledTrust(Priors(b=Normal(3.0, 0.1))),
        HierarchicalTrust(),
    ],
)
def test_another_model_than_that_of_the_posterior_is_refused(missions, other):
    posterior = fit(missions, PooledTrust(Priors(b=Normal(0.0, 0.7))), draws=25, latent=False)
    for evaluate in (add_latent, loo):
        with pytest.raises(TrustboError):
            evaluate(posterior, model=other)


def test_the_caller_s_jax_flags_do_not_matter(missions):
    plain = fit(missions, PooledTrust(), draws=25)
    shared = HierarchicalTrust(Priors(tau=HalfCauchy(0.3)))  # whose draws are JAX's
    drawn = sample_prior(shared, 2, 5, seed=1, n_robots=3)
    with jax.enable_x64(True), jax.default_prng_impl("rbg"), jax.threefry_partitionable(False):
        same(fit(missions, PooledTrust(), draws=25), plain)
        again = sample_prior(shared, 2, 5, seed=1, n_robots=3)
    for name, values in drawn.values.items():
        np.testing.assert_array_equal(values, again.values[name])
