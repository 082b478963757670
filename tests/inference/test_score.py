"""NormalScores of predictions against joint normals written out, and against simulation."""

import numpy as np
import pytest
from dense_coefficients import DenseRates
from dense_statespace import mission_of_params
from missions import (
    N_TICKS,
    OF_FAMILY,
    counted_missions,
    draw_rates,
    simulate_missions,
    walking_missions,
)
from scipy import stats

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import fit, params_of, score
from trustbo.models import CoupledTrust, HierarchicalTrust, PlaceEffect, PooledTrust
from trustbo.models.observations import Observations
from trustbo.workspace.moves import bounds_along

SHAPE = (5, 5)


def conditioned(missions, theta):
    """Mean and sd (point, bound, robot) of the rates of the last mission given the others."""
    observations = Observations.from_missions(missions)
    last = np.arange(len(missions)) == len(missions) - 1
    observations.contact_rate[last] = np.nan
    bounds = np.full((*observations.contact_rate.shape[:2], 3), -1)
    for j, mission in enumerate(missions):
        bounds[j, : len(mission.bounds)] = bounds_along(mission.path)

    joint = DenseRates(PooledTrust(effects=PlaceEffect()), observations, theta, bounds)
    mean, cov = joint.new_rates()
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    n_bounds = len(missions[-1].bounds)
    shape = len(mean), *observations.contact_rate.shape
    return [moment.reshape(shape)[:, -1, :n_bounds] for moment in (mean, sd)]


@pytest.fixture(scope="module")
def placed():
    """Missions, the last to be predicted, a posterior of the others, and the exact prediction."""
    missions, place = walking_missions(2, n_bounds=(4, 9), missing=0.0), PlaceEffect()
    workspace = tb.Workspace.from_awareness(np.zeros((3, *SHAPE, 2)))
    posterior = fit(missions[:-1], PooledTrust(effects=place), workspace=workspace)
    draws = posterior["posterior"].to_dataset()
    names = ("beta0", "delta_w", "delta_v", "tau_s", "length_scale", "tau_e", "tau_r")
    theta = {name: draws[name].values.ravel()[::10] for name in names}
    return missions, posterior, *conditioned(missions, theta)


def test_a_prediction_is_the_joint_normal_given_earlier_missions_averaged_over_draws(placed):
    missions, posterior, mean, sd = placed
    scores = score(posterior, missions[-1:])
    y = missions[-1].contact_rate
    # 4000 draws, coefficients and effects among them, against 400 of the hyperparameters alone.
    spread = np.sqrt((sd**2 + mean**2).mean(0) - mean.mean(0) ** 2)
    np.testing.assert_allclose(scores["mean"][0], mean.mean(0), atol=6.0 * spread.max() / 4000**0.5)
    pit = stats.norm.cdf(y, mean, sd).mean(0)
    np.testing.assert_allclose(scores["pit"][0], pit, atol=6.0 * 0.5 / 4000**0.5)
    density = np.log(stats.norm.pdf(y, mean, sd).mean(0))
    np.testing.assert_allclose(scores["log_score"][0], density, atol=0.15)
    low, high = (scores["quantile"].sel(level=level, mission=0).values for level in (0.05, 0.95))
    for limit, level in ((low, 0.05), (high, 0.95)):
        below = stats.norm.cdf(limit, mean, sd).mean(0)
        # Draws repeat, so fewer are independent; few of them are in the tails.
        np.testing.assert_allclose(below, level, atol=6.0 * 0.22 / 2000**0.5)


@pytest.mark.parametrize("family", sorted(OF_FAMILY))
def test_log_scores_are_shares_of_simulated_rates(family):
    """Counts and limits have probabilities; rates inside, a density in bins around them."""
    z, _, missions = counted_missions(family)
    posterior = fit(missions[:3], PooledTrust(family=family), progress=False)
    mission = missions[4]
    scores = score(posterior, [mission])
    params, rng, n = params_of(posterior), np.random.default_rng(1), 100
    z, y = mission.awareness, mission.contact_rate
    measured, drawn = tb.models.families.FAMILIES[family], []
    for _ in range(n):
        x = params.x0_mean + params.x0_sd * rng.standard_normal(len(params.b))
        path = []
        for k in range(len(z)):
            x = params.beta0 * x + params.beta @ z[k, 0] + params.b
            x = x + params.delta_w * rng.standard_normal(len(x))
            path.append(measured.sample(x, params.delta_v, np.full(len(x), N_TICKS), rng))
        drawn.append(path)
    drawn = np.moveaxis(np.array(drawn), 1, 0).reshape(len(z), -1)
    assert scores.attrs["log_score_of"] == "ticks"
    for k, rate in enumerate(y[:, 0]):
        near = np.abs(drawn[k] - rate) < 0.5 / N_TICKS  # the width of one tick, or one count
        if family == "censored" and 0.0 < rate < 1.0:
            near &= (drawn[k] > 0.0) & (drawn[k] < 1.0)
        elif family == "censored":
            near = drawn[k] == rate
        share = near.mean()
        # A share of 400000 draws that are alike in their parameters; bins curve the density.
        assert float(scores["log_score"][0, k, 0]) == pytest.approx(np.log(share), abs=0.1)
        below, equal = (drawn[k] < rate - 1e-9).mean(), (np.abs(drawn[k] - rate) < 1e-9).mean()
        # 6 standard errors of the 4000 draws that the score compares with.
        assert below - 0.05 <= float(scores["pit"][0, k, 0]) <= below + equal + 0.05


@pytest.mark.parametrize("model", [HierarchicalTrust(), CoupledTrust()], ids=["apart", "coupled"])
@pytest.mark.filterwarnings("ignore")
def test_log_scores_of_robots_that_differ_are_marginals_of_their_joint_normal(model):
    missions = simulate_missions(5)
    posterior = fit(missions[:4], model, chains=2, draws=100, check=False, progress=False)
    scores, z = score(posterior, missions[4:]), missions[4].awareness
    params = params_of(posterior)
    dense = mission_of_params(params, z)
    sd = np.sqrt(np.diagonal(dense.rate_cov, axis1=1, axis2=2))
    y = missions[4].contact_rate
    expected = np.log(stats.norm.pdf(y.ravel(), dense.mean, sd).mean(0)).reshape(y.shape)
    np.testing.assert_allclose(scores["log_score"][0], expected, rtol=1e-9)


def test_pit_of_rates_that_the_model_draws_are_uniform_with_limits_of_censored_ones():
    """Parameters and rates from one posterior: coverage is exact, point masses among them."""
    truth = OF_FAMILY["censored"].replace(delta_w=0.4)
    z = np.random.default_rng(0).uniform(size=(60, 5, 1, 2))
    model = PooledTrust(family="censored")
    y = draw_rates(truth, z, family="censored")
    assert 0.2 < np.isin(y, (0.0, 1.0)).mean() < 0.8
    path = [(0, k) for k in range(6)]
    missions = [Mission.from_arrays(path, a, b) for a, b in zip(z, y, strict=True)]
    posterior = fit(missions[:20], model, progress=False)
    scores = score(posterior, missions[20:])
    # Of 200 rates, those of a mission alike: 4 standard errors of some 80 that are independent.
    assert float(scores["coverage_50"]) == pytest.approx(0.5, abs=0.22)
    assert float(scores["coverage_90"]) == pytest.approx(0.9, abs=0.13)
    again = score(posterior, missions[20:])
    assert again.identical(scores)
    other = score(posterior, missions[20:], seed=1)
    assert (np.abs(other["pit"] - scores["pit"]) > 0.01).any()


def test_posteriors_of_a_campaign_predict_the_next_mission():
    missions = walking_missions(3, n_bounds=(4, 9), missing=0.0)
    gap = missions[2].contact_rate.copy()
    gap[1, 0] = np.nan
    missions[2] = Mission.from_arrays(missions[2].path, missions[2].awareness, gap)
    posteriors = [fit(missions[: j + 1], PooledTrust(), seed=j) for j in range(4)]
    scores = score(posteriors, missions)
    assert scores["mission"].values.tolist() == [1, 2, 3]
    one = score(posteriors[1], missions[2:3])
    for name in ("mean", "log_score"):
        here = scores[name].sel(mission=2, bound=one["bound"])
        np.testing.assert_allclose(here, one[name][0], atol=0.05)
        assert np.isnan(here[1, 0])
    y, mean = scores["contact_rate"].values, scores["mean"].values
    y, mean = y[np.isfinite(y)], mean[np.isfinite(y)]
    r2 = 1.0 - ((y - mean) ** 2).sum() / ((y - y.mean()) ** 2).sum()
    assert float(scores["r2"]) == pytest.approx(r2)
    assert int(scores["n"]) == len(y)


def test_what_cannot_be_scored_is_refused(placed):
    missions, posterior, *_ = placed
    with pytest.raises(TrustboError, match="2 posteriors and 4 missions"):
        score([posterior, posterior], missions)
    with pytest.raises(TrustboError, match="missions"):
        score([posterior], missions[:1])
    away = Mission.from_arrays([(0, 0), (0, 9)], *(np.zeros((1, 3, 2)), np.zeros((1, 3))))
    with pytest.raises(TrustboError, match=r"\(0, 9\)"):
        score(posterior, [away])
