"""Calibration of the samplers, and of the test itself."""

from importlib import import_module

import numpy as np
import numpyro.distributions as dist
import pytest
from missions import N_TICKS

import trustbo as tb
from trustbo.errors import PosteriorError, TrustboError
from trustbo.inference import sbc
from trustbo.inference.sbc import uniformity
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    HumanTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
)

EFFECTS = (PlaceEffect(), RobotEffect())
ROWS = {
    "pooled": PooledTrust(),
    "deviation": PooledTrust(memory="deviation"),
    "shared noise": PooledTrust(shared_noise=True),
    "places and robots": PooledTrust(effects=EFFECTS),
    "hierarchical": HierarchicalTrust(effects=(RobotEffect(),)),
    "coupled": CoupledTrust(),
    "censored": PooledTrust(observation="censored", effects=(RobotEffect(),)),
    "counts": PooledTrust(observation="beta_binomial"),
}


def design(n_missions=3, n_bounds=5, features=("line_of_sight",)):
    """Missions over a line of cells with gaps, whose rates are replaced."""
    rng, path = np.random.default_rng(0), [(0, k) for k in range(n_bounds + 1)]
    missions = []
    for _ in range(n_missions):
        z, y = rng.uniform(size=(n_bounds, 2, len(features))), np.full((n_bounds, 2), 0.5)
        y[rng.integers(n_bounds), 0] = np.nan
        ticks = np.full(y.shape, float(N_TICKS))
        missions.append(tb.Mission.from_arrays(path, z, y, n_ticks=ticks, features=list(features)))
    return missions


@pytest.mark.slow  # many data sets
@pytest.mark.parametrize("name", ROWS)
def test_a_model_is_calibrated(name):
    ranks = sbc(ROWS[name], design(), n_datasets=60, max_refused=0.02, progress=False)
    # One chance in a thousand over all parameters (Bonferroni).
    assert float(ranks["p_value"].min()) > 0.001 / ranks.sizes["parameter"]


def test_every_parameter_and_the_ends_of_effects_are_ranked():
    ranks = sbc(PooledTrust(effects=EFFECTS), design(), n_datasets=3, n_ranked=40, progress=False)

    names = {"beta0", "beta[0]", "b", "delta_w", "delta_v", "tau_s", "length_scale", "tau_e"}
    names |= {"tau_slow", "tau_day", "robot_effect[0,0]", "robot_effect[2,1]"}
    assert names < set(ranks["parameter"].values)
    assert {"place[0]", "place_bound[0]"} < set(ranks["parameter"].values)
    assert ranks["rank"].dims == ("dataset", "parameter")
    assert ranks["rank"].min() >= 0
    assert ranks["rank"].max() <= 40


def test_people_are_ranked_without_their_own_parts():
    people = []
    for _ in range(4):
        z = np.random.default_rng(len(people)).uniform(size=(3, 1, 2))
        y, ticks = np.full((3, 1), 0.5), np.full((3, 1), 6.0)
        features = ["success", "failure"]
        people.append(tb.Mission.from_arrays(None, z, y, n_ticks=ticks, features=features))
    ranks = sbc(HumanTrust(scale="likert7"), people, n_datasets=2, max_refused=1.0, progress=False)

    assert {"beta0", "tau_gain", "beta[1]"} <= set(ranks["parameter"].values)


def test_a_posterior_of_another_prior_is_found_out(monkeypatch):
    calibration = import_module("trustbo.inference.sbc")  # the package's `sbc` is the function
    draw = calibration.by_importance

    def of_another_prior(posterior, n, seed):
        prior = posterior.scores.priors
        prior["delta_v"] = dist.HalfNormal(0.02)
        return draw(posterior, n, seed)

    monkeypatch.setattr(calibration, "by_importance", of_another_prior)
    ranks = sbc(PooledTrust(), design(), n_datasets=40, max_refused=0.5, progress=False)

    assert float(ranks["p_value"].sel(parameter="delta_v")) < 1e-6


def test_data_sets_that_the_sampler_refuses_are_counted(monkeypatch):
    calibration = import_module("trustbo.inference.sbc")
    tried, draw = [], calibration.by_importance

    def refuses(posterior, n, seed):
        tried.append(seed)
        drawn, stats, summary = draw(posterior, n, seed)
        return drawn, stats, summary | ({"k_hat": 1.0} if len(tried) % 5 == 0 else {})

    monkeypatch.setattr(calibration, "by_importance", refuses)
    few = {"n_datasets": 10, "n_ranked": 40, "progress": False}
    ranks = sbc(PooledTrust(), design(), max_refused=0.2, **few)
    assert ranks.attrs["n_refused"] == 2
    assert ranks.sizes["dataset"] == 8
    with pytest.raises(PosteriorError):
        sbc(PooledTrust(), design(), max_refused=0.1, **few)


def test_uniform_ranks_pass_and_others_do_not():
    rng = np.random.default_rng(0)
    assert uniformity(rng.integers(0, 400, 5000), 399) > 0.001
    assert uniformity(rng.binomial(399, 0.5, 5000), 399) < 1e-6


def test_the_same_seed_gives_the_same_ranks():
    few = {"n_datasets": 2, "n_ranked": 20, "progress": False}
    one, same, other = (sbc(PooledTrust(), design(), seed=s, **few)["rank"] for s in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_bad_input():
    with pytest.raises(TrustboError, match="n_datasets"):
        sbc(PooledTrust(), design(), n_datasets=0)
