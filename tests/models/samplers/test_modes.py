"""Posteriors with two modes: each has its share, or the posterior is refused."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from trustbo.models import PooledTrust, diagnostics, fit

SPEC = importlib.util.spec_from_file_location(
    "modes", Path(__file__).parents[3] / "benchmarks" / "modes.py"
)
assert SPEC is not None
assert SPEC.loader is not None
modes = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(modes)

ONE_OF_MODES = (163, 556, 643)
"""Data sets, constant but once, of which all draws were on one mode with k-hat < 0.5."""


@pytest.mark.parametrize("seed", ONE_OF_MODES)
def test_the_exact_sampler_gives_each_mode_its_share(seed):
    missions = modes.odd_missions("constant", np.random.default_rng(seed))
    truth = modes.marginal(missions, "real")
    valley = truth.valley()
    share = truth.below(valley)
    assert 0.05 < share < 0.95
    posterior = fit(missions, PooledTrust(modes.REAL), "exact")
    assert posterior.attrs["sampler"] == "exact"
    found = float((posterior["posterior"]["beta0"] < valley).mean())
    assert abs(found - share) < 0.03


def test_chains_of_nuts_start_at_both_modes():
    missions = modes.odd_missions("constant", np.random.default_rng(163))
    posterior = fit(missions, PooledTrust(modes.REAL), check=False)
    assert diagnostics(posterior)["r_hat"] > 1.1
    middle = posterior["posterior"]["beta0"].median("draw")
    assert float(middle.min()) < -0.1
    assert float(middle.max()) > 0.1
