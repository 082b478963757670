"""The density that NUTS of scores sees, against the exact sampler's."""

import jax
import numpy as np
import pytest
from missions import walking_missions
from numpyro.distributions import LogNormal

from trustbo.inference.samplers.nuts_scores import Core, Ridge, in_jax
from trustbo.inference.samplers.posterior import Posterior
from trustbo.inference.samplers.run import _by_evidence
from trustbo.inference.samplers.scores import beta0_and_noises
from trustbo.models import PlaceEffect, PooledTrust, Priors, RobotEffect
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Slots
from trustbo.models.place import bounds_of, visited
from trustbo.models.priors_numpy import half_normal
from trustbo.stacking import stack_missions

WIDE = Priors(delta_w=LogNormal(-2.0, 0.5))


def posterior_of(missions) -> Posterior:
    batch = stack_missions(missions)
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()]).at_resolution({0.05: 1.0})
    bounds = bounds_of(missions, batch.contact_rate.shape[:2])
    places = visited(bounds, PlaceEffect(), 3)
    return _by_evidence(model, Slots.of(batch, len(missions), (), None, places))


def test_the_density_and_its_slope_are_those_of_the_exact_sampler():
    posterior, h = posterior_of(walking_missions(1, 3)), 1e-5
    z = np.random.default_rng(0).standard_normal((4, posterior.n_scores))
    z[:, 1] -= 1.0
    steps = h * np.eye(posterior.n_scores)
    with own_settings():
        density = jax.jit(jax.value_and_grad(in_jax(posterior, z[0]).log_density))
        for x in z:
            value, slope = density(x)
            np.testing.assert_allclose(value, posterior.log_density(x[None])[0], rtol=1e-9)
            ahead, behind = (posterior.log_density(x + s * steps) for s in (1.0, -1.0))
            np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * h), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("priors", [Priors(), Priors().above_resolution(0.05), WIDE])
def test_parameters_of_scores_are_those_of_any_prior(priors):
    z = np.random.default_rng(0).normal(scale=2.0, size=(200, 3))
    z[:, 1] = np.minimum(z[:, 1], 1.0)  # quantiles of few priors are exact farther out
    with own_settings():
        at = jax.jit(jax.vmap(Core.of(priors).at))
        np.testing.assert_allclose(at(z), beta0_and_noises(priors, z), rtol=1e-8, atol=1e-9)


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
