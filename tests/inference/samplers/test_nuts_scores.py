"""The density that NUTS of scores sees, against the exact sampler's."""

import jax
import numpy as np
import pytest
from missions import walking_missions
from numpyro.distributions import LogNormal

from trustbo.inference.samplers.nuts_scores import Ridge, ScoresInJax, Tables
from trustbo.inference.samplers.posterior import Posterior, posterior_of
from trustbo.inference.samplers.scores import beta0_and_noises, quantile
from trustbo.models import HierarchicalTrust, PlaceEffect, PooledTrust, Priors, RobotEffect
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Slots
from trustbo.models.place import bounds_of, visited
from trustbo.models.priors_numpy import half_normal
from trustbo.stacking import stack_missions

WIDE = Priors(delta_w=LogNormal(-2.0, 0.5))


MODELS = {
    "weights": PooledTrust(),
    "places and robots": PooledTrust(effects=[PlaceEffect(), RobotEffect()]),
    "by robot": HierarchicalTrust(),
    "by robot, places": HierarchicalTrust(place=PlaceEffect()),
}


def target_of(missions, model) -> Posterior:
    batch = stack_missions(missions)
    model = model.at_resolution({0.05: 1.0})
    bounds = bounds_of(missions, batch.contact_rate.shape[:2])
    places = visited(bounds, PlaceEffect(), 3)
    return posterior_of(model, Slots.of(batch, len(missions), (), None, places))


@pytest.mark.parametrize("name", MODELS)
def test_the_density_and_its_slope_are_those_of_the_exact_sampler(name):
    """With gaps; the slope by differences of a density that NumPy has."""
    posterior, h = target_of(walking_missions(1, 3, missing=0.2), MODELS[name]), 1e-5
    z = np.random.default_rng(0).standard_normal((4, posterior.n_scores))
    z[:, 1] -= 1.0
    steps = h * np.eye(posterior.n_scores)
    with own_settings():
        density = ScoresInJax.of(posterior, z[0])
        both = jax.jit(jax.value_and_grad(ScoresInJax.log_density, argnums=1))
        for x in z:
            value, slope = both(density, x)
            np.testing.assert_allclose(value, posterior.log_density(x[None])[0], rtol=1e-9)
            ahead, behind = (posterior.log_density(x + s * steps) for s in (1.0, -1.0))
            np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * h), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("priors", [Priors(), Priors().above_resolution(0.05), WIDE])
def test_parameters_of_scores_are_those_of_any_prior(priors):
    z = np.random.default_rng(0).normal(scale=2.0, size=(200, 3))
    z[:, 1] = np.minimum(z[:, 1], 1.0)  # quantiles of few priors are exact farther out
    with own_settings():
        tables = Tables.of(priors, by_robot=True)
        tau = jax.jit(Tables.tau)(tables, z)
        np.testing.assert_allclose(tau, quantile(priors.tau, z), rtol=1e-8)
        at = jax.jit(Tables.core)
        np.testing.assert_allclose(at(tables, z), beta0_and_noises(priors, z), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("priors", [Priors(), Priors().above_resolution(0.05), WIDE])
def test_along_the_ridge_the_noises_keep_their_total(priors):
    through = np.array([0.0, -2.0, 0.3, 1.0])
    ridge = Ridge.of(priors, through)
    x = np.tile(ridge.of_scores(through), (50, 1))
    x[:, 2] = np.linspace(-3.0, 3.0, 50)
    noises = beta0_and_noises(priors, ridge.to_scores(x))[:, 1:]
    expected = np.hypot(*beta0_and_noises(priors, through[None])[0, 1:])
    np.testing.assert_allclose(np.hypot(*noises.T), expected, rtol=1e-6)
    assert np.ptp(noises[:, 0]) > 0.5 * expected
    np.testing.assert_allclose(ridge.of_scores(ridge.to_scores(x)), x, atol=1e-12)


def test_half_normal_variables_in_jax_are_those_in_numpy():
    score = np.linspace(-11.0, 11.0, 301)
    with own_settings():
        found = half_normal(jax.numpy.asarray(score), 0.2)
    np.testing.assert_allclose(found, half_normal(score, 0.2), rtol=1e-9)
