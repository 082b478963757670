"""Posteriors with two modes: each has its share, or the posterior is refused."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from trustbo.errors import PosteriorError
from trustbo.inference import fit
from trustbo.inference.samplers.convergence import complaints_of_means
from trustbo.models import PooledTrust

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


LEFT_OUT = (136, 235)
"""Data sets, constant but once, of which all draws of NUTS were on one mode, R-hat below 1.01."""


@pytest.mark.slow  # its program compiles for this alone
def test_chains_of_nuts_on_one_of_two_modes_are_refused():
    missions = modes.odd_missions("constant", np.random.default_rng(163))
    with pytest.raises(PosteriorError, match=r"sd from that of importance sampling|R-hat"):
        fit(missions, PooledTrust(modes.REAL), "nuts")


@pytest.mark.slow  # eight runs of NUTS
@pytest.mark.parametrize("seed", LEFT_OUT)
def test_nuts_gives_each_mode_its_share_or_is_refused(seed):
    missions = modes.odd_missions("constant", np.random.default_rng(seed))
    truth = modes.marginal(missions, "real")
    valley = truth.valley()
    try:
        posterior = fit(missions, PooledTrust(modes.REAL), "nuts")
    except PosteriorError:
        return
    found = float((posterior["posterior"]["beta0"] < valley).mean())
    assert abs(found - truth.below(valley)) < 0.03


def test_a_mode_that_all_chains_left_is_a_complaint():
    """A second mode of 10 % of the mass, 10 sd away, is .3 / sqrt(.09) = 1 / 3 sd of the mean."""
    rng = np.random.default_rng(0)
    points = np.where(np.arange(2000) < 200, -0.5, 0.5) + 0.01 * rng.standard_normal(2000)
    at_points, weight = {"beta0": points, "beta": rng.normal(size=(2000, 2))}, np.full(2000, 5e-4)

    def complaints(share):
        second = rng.uniform(size=(4, 1000)) < share
        beta0 = np.where(second, -0.5, 0.5) + 0.01 * rng.standard_normal((4, 1000))
        params = {"beta0": beta0, "beta": rng.normal(size=(4, 1000, 2))}
        return complaints_of_means(params, at_points, weight)

    (said,) = complaints(0.0)
    assert said == "the mean of beta0 is 0.33 sd from that of importance sampling (limit 0.3)"
    assert complaints(0.1) == []
    assert complaints(0.9)[0].startswith("the mean of beta0 is 2.")
