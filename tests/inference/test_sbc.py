"""Calibration of the samplers, and of the test itself."""

from importlib import import_module
from pathlib import Path

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist
import pytest
import xarray as xr

from trustbo.errors import PosteriorError, TrustboError
from trustbo.inference import sbc
from trustbo.inference.sbc import _uniformity
from trustbo.models import CoupledTrust, PlaceEffect, PooledTrust, Priors


@pytest.mark.slow  # many data sets; others rank a few
def test_the_exact_sampler_is_calibrated():
    ranks = sbc(n_datasets=200, shape=(2, 4, 2, 2), progress=False)
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
    calibration = import_module("trustbo.inference.sbc")  # the package's `sbc` is the function
    draw = calibration.draw_posterior
    wrong = PooledTrust(Priors(delta_v=dist.HalfNormal(0.02)))

    def of_another_prior(model, *args, **options):
        return draw(wrong, *args, **options)

    monkeypatch.setattr(calibration, "draw_posterior", of_another_prior)
    ranks = sbc(n_datasets=50, shape=(2, 6, 2, 2), progress=False)
    assert float(ranks["p_value"].sel(parameter="delta_v")) < 1e-6


def test_effects_of_places_are_ranked_as_parameters_are(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    walks = import_module("sbc_places").Walks.random((2, 5), seed=0)
    model = PooledTrust(place=PlaceEffect())
    options = {"shape": (2, 5, 2, 1), "n_datasets": 12, "n_ranked": 40, "progress": False}
    with pytest.raises(TrustboError, match=r"design=None and place=PlaceEffect.*needs a design"):
        sbc(model, "exact", **options)
    options["design"] = walks
    with pytest.raises(TrustboError, match=r"and place=None: .* one without takes none"):
        sbc(PooledTrust(), "exact", **options)
    ranks = sbc(model, "exact", **options)
    names = ["beta0", "beta[0]", "b", "delta_w", "delta_v", "tau_s", "length_scale", "tau_e"]
    effects = ["place[first]", "place[last]", "place_bound[first]", "place_bound[second]"]
    assert sorted(ranks["parameter"].values) == sorted(names + effects)
    # In twelve data sets no true effect leaves all draws on one side each time: 2 / 41^11.
    assert (np.ptp(ranks["rank"].values, axis=0) > 10).all()
    one_kind = PooledTrust(place=PlaceEffect(cells=False))
    options["n_datasets"] = 1
    assert not {"tau_s", "place[last]"} & set(sbc(one_kind, "exact", **options)["parameter"].values)


def test_data_sets_that_the_sampler_refuses_are_counted(monkeypatch):
    calibration = import_module("trustbo.inference.sbc")
    tried, draw = [], calibration.draw_posterior

    def refuses(model, sampler, settings, seed, *args, **kwargs):
        tried.append(seed)
        if seed % 5 == 0:
            raise PosteriorError("weights are too uneven.")
        return draw(model, sampler, settings, seed, *args, **kwargs)

    monkeypatch.setattr(calibration, "draw_posterior", refuses)
    few = {"n_datasets": 10, "progress": False}
    ranks = sbc(PooledTrust(), seed=1, max_refused=0.2, **few)
    assert ranks.attrs["n_refused"] == 2
    assert ranks.sizes["dataset"] == 8
    with pytest.raises(PosteriorError, match="too uneven"):
        sbc(PooledTrust(), seed=1, max_refused=0.1, **few)
    assert len(tried) == 10 + 10  # the second run ends at its second refusal


def test_uniform_ranks_pass_and_others_do_not():
    rng = np.random.default_rng(0)
    assert _uniformity(rng.integers(0, 400, 5000), 399) > 0.001
    assert _uniformity(rng.binomial(399, 0.5, 5000), 399) < 1e-6


def test_a_run_goes_on_where_it_stopped(tmp_path):
    file = tmp_path / "ranks.json"
    options = {"shape": (2, 4, 2, 2), "progress": False, "n_ranked": 40}
    sbc(n_datasets=3, checkpoint=file, **options)
    kept = file.read_text()
    resumed = sbc(n_datasets=6, checkpoint=file, **options)
    np.testing.assert_array_equal(resumed["rank"], sbc(n_datasets=6, **options)["rank"])
    assert kept[:-2] in file.read_text()  # the first three were not sampled again
    with pytest.raises(TrustboError, match="holds ranks of other arguments"):
        sbc(seed=1, n_datasets=6, checkpoint=file, **options)


def test_arviz_draws_the_ranks_and_their_coverage():
    ranks = sbc(n_datasets=60, shape=(2, 4, 2, 2), progress=False)
    assert ranks["pit"].dims == ("dataset", "parameter")
    tree = xr.DataTree.from_dict({"prior_sbc": ranks[["pit"]]})
    az.plot_ecdf_pit(tree, sample_dims="dataset")
    plt.close("all")
    inside = (np.abs(ranks["pit"] - 0.5) < 0.45).mean("dataset")
    np.testing.assert_allclose(ranks["coverage"].sel(interval=0.9), inside)
    # 360 intervals of 90 %: 4 standard errors, were they independent.
    assert abs(float(inside.mean()) - 0.9) < 4 * np.sqrt(0.09 / 360)


def test_models_and_families_are_ranked_too():
    ranks = sbc(
        CoupledTrust(inter_robot="none"),
        n_datasets=3,
        shape=(2, 4, 2, 1),
        progress=False,
    )
    names = list(ranks["parameter"].values)
    assert names[:4] == ["beta0[0]", "beta0[1]", "beta[0,0]", "beta[1,0]"]


def test_bad_input():
    with pytest.raises(TrustboError, match="unknown sampler 'gibbs'"):
        sbc(sampler="gibbs")
    with pytest.raises(TrustboError, match="n_datasets must be a whole number from 1 on; got 0"):
        sbc(n_datasets=0)
