"""Calibration of the samplers, and of the test itself."""

import numpy as np
import numpyro.distributions as dist
import pytest
import sbc
from missions import N_TICKS
from sbc import rank, uniformity

import trustbo as tb
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
    "censored": PooledTrust(family="censored", effects=(RobotEffect(),)),
    "counts": PooledTrust(family="beta_binomial"),
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
    ranks, n_refused = rank(ROWS[name], design(), 60, 0)
    assert n_refused <= 1
    p = [uniformity(ranks[parameter], sbc.N_RANKED) for parameter in ranks]
    assert min(p) > 0.001 / len(p)  # one chance in a thousand over all parameters (Bonferroni)


def test_every_parameter_and_the_ends_of_effects_are_ranked():
    ranks, _ = rank(PooledTrust(effects=EFFECTS), design(), 3, 0, n_ranked=40)

    names = {"beta0", "beta[0]", "b", "delta_w", "delta_v", "tau_s", "length_scale", "tau_e"}
    names |= {"tau_slow", "tau_mission", "robot_effect[0,0]", "robot_effect[2,1]"}
    names |= {"tau_r", "place[0]", "place_bound[0]", "place_robot[0,0]"}
    assert names < set(ranks)
    assert ranks.min().min() >= 0
    assert ranks.max().max() <= 40


def test_what_people_share_is_ranked():
    ranks, _ = rank(HumanTrust(scale="likert7"), sbc.people(4, 3), 2, 0)
    assert {"beta0", "tau_gain", "beta[1]"} <= set(ranks)


@pytest.mark.slow
def test_a_posterior_of_another_prior_is_found_out(monkeypatch):
    draw = sbc.by_importance

    def of_another_prior(posterior, n, seed):
        prior = posterior.scores.priors
        prior["delta_v"] = dist.HalfNormal(0.02)
        return draw(posterior, n, seed)

    monkeypatch.setattr(sbc, "by_importance", of_another_prior)
    ranks, _ = rank(PooledTrust(), design(), 40, 0)

    assert uniformity(ranks["delta_v"], sbc.N_RANKED) < 1e-6


def test_data_sets_that_the_sampler_refuses_are_counted(monkeypatch):
    tried, draw = [], sbc.by_importance

    def refuses(posterior, n, seed):
        tried.append(seed)
        drawn, stats, summary = draw(posterior, n, seed)
        return drawn, stats, summary | ({"k_hat": 1.0} if len(tried) % 5 == 0 else {})

    monkeypatch.setattr(sbc, "by_importance", refuses)
    ranks, n_refused = rank(PooledTrust(), design(), 10, 0, n_ranked=40)
    assert (len(ranks), n_refused) == (8, 2)


def test_uniform_ranks_pass_and_others_do_not():
    rng = np.random.default_rng(0)
    assert uniformity(rng.integers(0, 400, 5000), 399) > 0.001
    assert uniformity(rng.binomial(399, 0.5, 5000), 399) < 1e-6


def test_the_same_seed_gives_the_same_ranks():
    one, same, other = (rank(PooledTrust(), design(), 2, s, n_ranked=20)[0] for s in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any(axis=None)
