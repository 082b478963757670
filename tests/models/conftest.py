"""Missions that tests of models share."""

import pytest
from missions import simulate_missions


@pytest.fixture(scope="session")
def missions():
    return simulate_missions()
