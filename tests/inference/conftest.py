"""One small posterior, sampled once: compiling takes longer than sampling."""

import pytest
from missions import simulate_missions

from trustbo.inference import fit
from trustbo.models import PooledTrust


@pytest.fixture(scope="session")
def missions():
    return simulate_missions()


@pytest.fixture(scope="session")
def posterior(missions):
    return fit(missions, PooledTrust(), sampler="nuts", seed=1)
