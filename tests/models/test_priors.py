"""Priors: the identity of the default ones, and their supports."""

import copy
import pickle
import subprocess
import sys

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import special

from trustbo.errors import TrustboError
from trustbo.models import HierarchicalTrust, HumanTrust, PooledTrust, Priors
from trustbo.models.record import model_from_record, model_to_record
from trustbo.models.scores import quantile

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
    expected = Priors.from_features(FEATURES, family).describe()
    assert model.for_features(FEATURES).priors.describe() == expected


def test_copies_of_own_priors_are_not_replaced():
    model = copy.deepcopy(PooledTrust(Priors()))
    assert model.for_features(FEATURES).priors.describe() == Priors().describe()


THREADS = """
import sys, threading
from trustbo.models import PooledTrust

sys.setswitchinterval(1e-5)
barrier = threading.Barrier(8)
models = []

def make():
    barrier.wait()
    models.append(PooledTrust())

threads = [threading.Thread(target=make) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len({id(model.priors) for model in models}) == 1
"""


def test_threads_share_the_default_priors():
    subprocess.run([sys.executable, "-c", THREADS], check=True)


def test_records_tell_truncated_priors_apart():
    """A resumed campaign would otherwise accept a model with another prior."""
    one, other = (
        PooledTrust(Priors(delta_w=dist.TruncatedNormal(mean, 0.1, low=0.0))) for mean in (0.1, 0.3)
    )
    record = model_to_record(one)
    assert model_from_record(record, one) is one
    with pytest.raises(TrustboError, match="model"):
        model_from_record(record, other)


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
    assert model_from_record(model_to_record(HumanTrust())) == HumanTrust()
