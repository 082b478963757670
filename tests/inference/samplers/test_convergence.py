"""Diagnostics: ArviZ's, of what moves."""

import arviz as az
import numpy as np
import xarray as xr

from trustbo.inference.samplers.convergence import complaints_of, convergence


def chains(seed=0, shift=0.0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(4, 500, 2)) + shift * np.arange(4)[:, None, None]
    return xr.Dataset({"b": (("chain", "draw", "i"), values)})


def test_the_worst_r_hat_and_the_least_ess_are_arviz_s():
    sites = chains()
    worst, fewest = convergence(sites)["b"]
    assert worst == float(az.rhat(sites)["b"].max())
    assert fewest == float(az.ess(sites, method="bulk")["b"].min())


def test_what_never_moves_is_left_out():
    sites = chains()
    sites["b"][..., 1] = 3.0
    assert convergence(sites)["b"][0] == float(az.rhat(chains())["b"][0])
    sites["b"][..., 0] = 3.0
    assert convergence(sites) == {}


def test_chains_that_disagree_are_a_complaint_and_so_are_divergences():
    together = {"b": chains()["b"].values}
    apart = {"b": chains(shift=0.5)["b"].values}
    calm, rough = ({"diverging": np.arange(2000).reshape(4, 500) < n} for n in (0, 3))
    assert complaints_of(together, calm) == []
    assert complaints_of(together, rough) == ["3 divergences"]
    first, second = complaints_of(apart, calm)
    assert first.startswith("R-hat of b is 1.")
    assert second.startswith("bulk ESS of b is ")
