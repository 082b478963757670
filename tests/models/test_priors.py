"""Priors: the identity of the default ones, and their supports."""

import copy
import dataclasses
import json
import pickle

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import special

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import add_latent, fit
from trustbo.models import HierarchicalTrust, HumanTrust, PooledTrust, Priors
from trustbo.models.record import model_from_record, model_to_record
from trustbo.models.scores import log_density, quantile

FEATURES = ("visibility", "line_of_sight")
COPIES = {
    "pickle": lambda model: pickle.loads(pickle.dumps(model)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("family", ["gaussian", "beta_binomial"])
def test_copies_of_a_model_keep_priors_by_feature(copied, family):
    model = copied(HierarchicalTrust(family=family))
    expected = Priors.from_features(FEATURES, family).in_order_of(FEATURES).describe()
    assert model.for_features(FEATURES).priors.describe() == expected


def test_copies_of_own_priors_are_not_replaced():
    model = copy.deepcopy(PooledTrust(Priors()))
    assert model.for_features(FEATURES).priors.describe() == Priors().describe()


def test_priors_of_named_features_follow_the_names():
    priors = dataclasses.replace(Priors.from_features(FEATURES), x0_sd=0.2)
    for features in (FEATURES, FEATURES[::-1]):
        ordered = PooledTrust(priors).for_features(features).priors
        mean, sd = ordered.moments("beta")
        sight = features.index("line_of_sight")
        assert (mean[sight], sd[sight]) == (1.0, 0.3)
        assert (mean[1 - sight], sd[1 - sight]) == (0.0, 0.25)
        assert ordered.x0_sd == 0.2


def test_a_posterior_and_an_own_model_agree_on_named_features():
    z = np.random.default_rng(0).uniform(size=(4, 2, 2))
    missions = [Mission.from_arrays(None, z, 0.5 * z[..., 0], features=FEATURES[::-1])]
    model = PooledTrust(dataclasses.replace(Priors.from_features(FEATURES), x0_sd=0.2))
    posterior = fit(missions, model, draws=25, check=False, latent=False)
    assert "loc=[1, 0]" in posterior.attrs["prior_beta"]
    assert "log_likelihood" in add_latent(posterior, missions, model=model).children
    record = model_to_record(model)
    assert record["priors"]["features"] == list(FEATURES)
    assert model_from_record(record, model) is model


def test_priors_of_other_features_are_refused():
    scalar = dataclasses.replace(Priors(), features=("a", "b", "c"))
    for priors in (Priors.from_features(FEATURES), scalar):
        with pytest.raises(TrustboError, match="the data have slope, canopy"):
            PooledTrust(priors).for_features(("slope", "canopy"))
    with pytest.raises(TrustboError, match="priors for 2 features, but there are 3"):
        dataclasses.replace(Priors.from_features(FEATURES), features=("a", "b", "c"))


def test_records_tell_truncated_priors_apart():
    """A resumed campaign would otherwise accept a model with another prior."""
    one, other = (
        PooledTrust(Priors(delta_w=dist.TruncatedNormal(mean, 0.1, low=0.0))) for mean in (0.1, 0.3)
    )
    record = model_to_record(one)
    assert model_from_record(record, one) is one
    with pytest.raises(TrustboError, match="model"):
        model_from_record(record, other)


@pytest.mark.parametrize(
    "prior",
    [
        dist.LogNormal(-1.0, 0.5),
        dist.TruncatedNormal(0.1, 0.2, low=0.0),
        dist.TruncatedNormal(0.1, 0.2, low=0.0, high=2.0),
        dist.Gamma(2.0, 10.0),
        dist.HalfCauchy(0.3),
    ],
)
def test_priors_are_rebuilt_from_their_record(prior):
    beta = dist.Normal(np.array([0.1, 0.7]), np.array([0.2, 0.3]))
    model = PooledTrust(Priors(delta_w=prior, beta=beta, features=FEATURES))
    record = json.loads(json.dumps(model_to_record(model)))
    found = model_from_record(record)
    assert model_to_record(found) == record
    values = np.linspace(0.1, 1.0, 5)
    own, rebuilt = (log_density(one.priors.delta_w, values) for one in (model, found))
    np.testing.assert_array_equal(rebuilt, own)
    np.testing.assert_array_equal(found.priors.moments("beta"), model.priors.moments("beta"))


class Own(dist.HalfNormal):
    """A prior of the user's own class, of which a file has only the name."""


@pytest.mark.parametrize(
    "prior",
    [
        Own(0.3),
        dist.TransformedDistribution(dist.Normal(0.0, 1.0), [dist.transforms.ExpTransform()]),
    ],
)
def test_priors_that_cannot_be_rebuilt_are_given(prior):
    model = PooledTrust(Priors(delta_w=prior))
    record = model_to_record(model)
    assert model_from_record(record, model) is model
    with pytest.raises(TrustboError, match="model="):
        model_from_record(record)


def test_the_text_of_a_log_normal_prior_has_its_own_parameters_only():
    text = Priors(tau=dist.LogNormal(-1.0, 0.5)).describe()["tau"]
    assert text == "LogNormal(loc=-1, scale=0.5)"


def test_a_uniform_prior_of_beta0_is_the_beta_prior_of_equal_density():
    uniform = Priors(beta0=dist.Uniform(0.0, 1.0)).beta0
    score = np.linspace(-4.0, 4.0, 9)
    np.testing.assert_allclose(quantile(uniform, score, "beta0"), special.ndtr(score), rtol=1e-9)
    with pytest.raises(TrustboError, match="beta0"):
        Priors(beta0=dist.Uniform(0.0, 1.5))


def test_beta_must_have_a_prior_for_each_feature():
    with pytest.raises(TrustboError, match="beta"):
        Priors(beta=dist.Normal(np.zeros(3), 1.0)).coefficients(2)


@pytest.mark.parametrize("option", [{"family": "beta_binomial"}, {"memory": "level"}])
def test_options_that_human_trust_cannot_use_are_refused(option):
    [name] = option
    with pytest.raises(TrustboError, match=name):
        HumanTrust(**option)
    record = model_to_record(HumanTrust())
    assert model_to_record(model_from_record(record)) == record
