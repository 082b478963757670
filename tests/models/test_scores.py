"""Normal scores of hyperparameters: their prior density, with the Jacobian of the conversion."""

import jax
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from trustbo.data import Mission
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect
from trustbo.models.effects.place import matern
from trustbo.models.scores import NormalScores

STEP = 1e-6


SIGHT, FLOOR = 0.9, 0.4


@pytest.fixture(scope="module")
def observations():
    """Missions whose bounds all have the same predicted line of sight."""
    sight = np.full((6, 2, 1), SIGHT)
    path = [(0, k) for k in range(7)]
    features = ["line_of_sight"]
    mission = Mission.from_arrays(path, sight, sight[..., 0], features=features)
    effects = (PlaceEffect(f_e=FLOOR), RobotEffect())
    return PooledTrust(effects=effects).observations([mission])


@pytest.fixture(scope="module")
def scores(observations):
    """NormalScores of the two noises and of the hyperparameters of a place effect."""
    noises = {"delta_w": dist.HalfNormal(0.2), "delta_v": dist.HalfNormal(0.1)}
    place = PlaceEffect(f_e=FLOOR)
    return NormalScores(noises | place.hyperpriors(), place.pairs(observations))


def log_prior_of_values(scores, z):
    """Log density (point,) of independent priors, times the Jacobian by finite differences."""
    values = scores.values(z)
    total = np.zeros(len(z))
    for name, prior in scores.priors.items():
        with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):
            total += np.asarray(prior.log_prob(values[name]))

    def stacked(z):
        return np.stack([scores.values(z)[name] for name in scores.priors], axis=1)

    axes = STEP * np.eye(z.shape[1])
    slopes = [(stacked(z + axis) - stacked(z - axis)) / (2.0 * STEP) for axis in axes]
    return total + np.linalg.slogdet(np.stack(slopes, axis=2))[1]


def test_log_prior_is_that_of_independent_priors_in_other_coordinates(scores):
    z = 0.7 * np.random.default_rng(0).standard_normal((50, scores.n_scores))
    np.testing.assert_allclose(scores.log_prior(z), log_prior_of_values(scores, z), atol=1e-5)


def test_sizes_and_angles_of_a_half_normal_pair_give_back_the_pair(scores):
    rng = np.random.default_rng(1)
    first, second = np.abs(rng.standard_normal((2, 100)))
    z = np.zeros((100, scores.n_scores))
    z[:, scores.at["tau_s"].start] = np.log(np.hypot(first, second))
    z[:, scores.at["tau_e"].start] = stats.norm.ppf(2.0 / np.pi * np.arctan2(first, second))

    values = scores.values(z)
    of_neighbour = matern(1.0, 2.0)  # the median length scale
    sd = np.sqrt(1.0 - of_neighbour**2)
    g = np.sqrt(FLOOR**2 + (1.0 - FLOOR**2) * 4.0 * SIGHT * (1.0 - SIGHT))  # of the effects e
    np.testing.assert_allclose(values["tau_s"], 0.2 * first * g / sd, rtol=1e-9)
    np.testing.assert_allclose(values["tau_e"], 0.2 * second, rtol=1e-9)


def test_each_effect_with_two_standard_deviations_has_a_size(observations):
    effects = (PlaceEffect(), RobotEffect())
    pairs = [(one.first, one.second) for effect in effects for one in effect.pairs(observations)]
    assert pairs == [("tau_s", "tau_e"), ("tau_slow", "tau_mission")]
