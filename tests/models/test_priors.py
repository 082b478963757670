"""Priors: the identity of the default ones, and their supports."""

import copy
import pickle
import subprocess
import sys

import pytest

from trustbo.models import HierarchicalTrust, PooledTrust, Priors

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
