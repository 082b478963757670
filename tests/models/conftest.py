"""One small posterior, sampled once: compiling takes longer than sampling."""

import jax
import numpy as np
import pytest

from trustbo.data import Mission
from trustbo.inference import fit
from trustbo.models import PooledTrust, TrustParams

TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


def simulate_missions(n_missions=6, seed=0, truth=TRUTH, lengths=(7, 5, 8)):
    rng = np.random.default_rng(seed)
    awareness = rng.uniform(size=(n_missions, 8, 3, 2))
    sample = PooledTrust().simulate(jax.random.key(seed), truth, awareness)
    missions = []
    for j in range(n_missions):
        n = lengths[j % len(lengths)]
        rates = np.clip(sample.contact_rate[j, :n], 0.0, 1.0)
        path = [(0, k) for k in range(n + 1)]
        missions.append(Mission.from_arrays(path, awareness[j, :n], rates))
    return missions


@pytest.fixture(scope="session")
def missions():
    return simulate_missions()


@pytest.fixture(scope="session")
def posterior(missions):
    return fit(missions, sampler="nuts", seed=1)
