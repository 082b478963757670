"""One small posterior for all tests."""

import pytest
from missions import simulate_missions

from trustbo.inference import fit
from trustbo.models import PooledTrust


@pytest.fixture(scope="session")
def missions():
    return simulate_missions()


@pytest.fixture(scope="session")
def posterior(missions):
    return fit(missions, PooledTrust(), seed=1)
