"""Calibration of the samplers, and of the test itself."""

import numpy as np
import numpyro.distributions as dist
import pytest

from trustbo.errors import TrustboError
from trustbo.models import PooledTrust, Priors, sbc
from trustbo.models.calibration import _uniformity


def test_the_exact_sampler_is_calibrated():
    ranks = sbc(n_datasets=200, shape=(2, 6, 2, 2), progress=False)
    assert list(ranks["parameter"].values) == [
        "beta0",
        "beta[0]",
        "beta[1]",
        "b",
        "delta_w",
        "delta_v",
    ]
    assert ranks["rank"].dims == ("dataset", "parameter")
    # One chance in a thousand over the six parameters (Bonferroni).
    assert float(ranks["p_value"].min()) > 0.001 / 6


def test_a_posterior_of_another_prior_is_found_out(monkeypatch):
    import trustbo.models.calibration as calibration

    draw = calibration.draw_posterior
    wrong = PooledTrust(Priors(delta_v=dist.HalfNormal(0.02)))

    def of_another_prior(model, *args, **options):
        return draw(wrong, *args, **options)

    monkeypatch.setattr(calibration, "draw_posterior", of_another_prior)
    ranks = sbc(n_datasets=100, shape=(2, 6, 2, 2), progress=False)
    assert float(ranks["p_value"].sel(parameter="delta_v")) < 1e-6


def test_uniform_ranks_pass_and_others_do_not():
    rng = np.random.default_rng(0)
    assert _uniformity(rng.integers(0, 400, 5000), 399) > 0.001
    assert _uniformity(rng.binomial(399, 0.5, 5000), 399) < 1e-6


def test_bad_input():
    with pytest.raises(TrustboError, match="unknown sampler 'gibbs'"):
        sbc(sampler="gibbs")
    with pytest.raises(TrustboError, match="n_datasets must be a whole number from 1 on; got 0"):
        sbc(n_datasets=0)
