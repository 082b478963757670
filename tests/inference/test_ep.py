"""Expectation propagation against quadrature over the linear predictors of small cases."""

from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pytest
from dense_coefficients import DenseRates
from dense_families import by_quadrature, of_one_report, with_one_limit
from every_model import FEATURES, GRID, models_of

from trustbo.inference.class_target import ClassTarget
from trustbo.models import HumanTrust, PooledTrust, Priors
from trustbo.models.observations import Observations
from trustbo.models.visited import visited

N_TICKS = 40
OUTCOMES = ("success", "failure", "demand")
PAIRS = [(1.0, 0.6), (1.0, 1.0), (0.0, 1.0), (0.4, np.nan)]
MODELS = {
    "pooled": (1, 2, 1),  # two bounds of a robot
    "pooled, deviation, robots": (1, 2, 1),
    "hierarchical": (1, 1, 2),  # two robots in a bound
    "coupled, places": (1, 1, 2),
}


def small(name, family, y):
    """Density of two rates, its only scores, and the log evidence there by quadrature."""
    shape = MODELS[name]
    rng = np.random.default_rng(2)
    bounds = np.stack([rng.integers(0, n, shape[:2]) for n in (8, *GRID)], axis=-1)
    observations = Observations(
        np.reshape(y, shape), rng.uniform(size=(*shape, 2)), np.full(shape, float(N_TICKS)),
        FEATURES, visited(bounds, GRID),
    )  # fmt: skip
    model = models_of(family)[name].for_features(FEATURES)
    posterior = ClassTarget(model, observations)
    z = np.full((1, posterior.n_scores), -0.2)
    dense = DenseRates(model, observations, posterior.theta(z), bounds)
    moments = dense.mean[0], dense.cov[0], dense.noise[0]
    return posterior, z, by_quadrature(family, *moments, dense.y, N_TICKS)


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
@pytest.mark.parametrize("y", PAIRS)
@pytest.mark.parametrize("name", MODELS)
def test_the_evidence_is_that_of_quadrature(name, family, y):
    posterior, z, wanted = small(name, family, y)
    theta = posterior.theta(z)
    posterior.run_ep(theta)
    assert abs(posterior.log_evidence(theta)[0] - wanted) < 0.05  # EP's own error


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
@pytest.mark.parametrize(("name", "y"), [("pooled", PAIRS[0]), ("coupled, places", PAIRS[2])])
def test_the_mean_weight_of_draws_is_that_of_quadrature(name, family, y):
    n = 2000
    posterior, z, wanted = small(name, family, y)
    posterior.run_ep(posterior.theta(z))
    many = np.repeat(z, n, axis=0)
    log_p = posterior.scores.log_prior(many) + wanted

    rng = np.random.default_rng(0)
    _, coefficients = posterior.visit(many, rng)
    c, log_q = coefficients.propose(np.arange(n), rng)
    weight = np.exp(posterior.log_joint(many, c, rng) - log_q - log_p)
    assert abs(weight.mean() - 1.0) < 5.0 * weight.std() / np.sqrt(n) + 2e-3


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
@pytest.mark.parametrize("name", MODELS)
def test_the_density_near_the_theta_of_ep_is_that_of_ep(name, family):
    posterior, z, _ = small(name, family, PAIRS[0])
    posterior.run_ep(posterior.theta(z))

    shift = np.random.default_rng(1).standard_normal((8, z.shape[1]))
    for size, error in (0.0, 0.01), (0.3, 0.03):
        near = z + size * shift
        ep_density = posterior.log_evidence(posterior.theta(near)) + posterior.scores.log_prior(
            near
        )
        np.testing.assert_allclose(posterior.log_density(near), ep_density, atol=error)


def test_counts_far_below_their_prediction_keep_the_density_finite():
    """There, the term of the counts is convex in trust, so a site has almost no precision."""
    priors = replace(
        Priors.default("beta_binomial"),
        beta=dist.Normal(0.0, 0.01),
        b=dist.Normal(10.0, 0.05),
        stationary=True,
    )
    model = PooledTrust(family="beta_binomial", priors=priors)
    rates = np.full((1, 1, 1), 0.8562)
    observations = Observations(rates, np.zeros((1, 1, 1, 1)), np.full((1, 1, 1), 146.0), ("a",))
    posterior = ClassTarget(model, observations)

    z = np.zeros((40, posterior.n_scores))
    z[:, posterior.scores.noises] = np.linspace(-2.5, 1.0, 40)[:, None]
    posterior.run_ep(posterior.theta(z[20:21]))
    assert (posterior.density.near.lam < 1e-8).any()
    ep_density = posterior.log_evidence(posterior.theta(z)) + posterior.scores.log_prior(z)
    np.testing.assert_allclose(posterior.log_density(z), ep_density, atol=0.4)


def people(scale, change=None):
    """Density of reports of persons, three thetas, and the dense reference."""
    rng = np.random.default_rng(0)
    z = rng.integers(0, 2, (3, 4, 2, 3)).astype(float)
    z[..., 2] = rng.uniform(size=z.shape[:3])
    y = rng.uniform(0.1, 0.9, (3, 4, 2))
    y[rng.random(y.shape) < 0.2] = np.nan
    if change is not None:
        change(y)

    model = HumanTrust(scale=scale).for_features(OUTCOMES)
    observations = Observations(y, z, np.full(y.shape, 6.0), OUTCOMES)
    posterior = ClassTarget(model, observations)
    theta = posterior.theta(0.5 * rng.standard_normal((3, posterior.n_scores)))
    return posterior, theta, DenseRates(model, observations, theta)


def test_the_evidence_of_reports_inside_the_scale_is_the_density_of_the_joint_normal():
    """Outcomes are carried over, the base level is not, and each person has parts of their own."""
    posterior, theta, dense = people("unit")
    found = posterior.log_evidence(theta)
    np.testing.assert_allclose(found, dense.log_density(), rtol=1e-9)


@pytest.mark.parametrize("limit", [0.0, 1.0])
def test_the_evidence_with_one_report_at_an_end_has_the_normal_tail_beyond_it(limit):
    def change(y):
        y[1, 2, 0] = limit

    posterior, theta, dense = people("unit", change)
    cov = dense.cov + dense.noise
    expected = [with_one_limit(*moments, dense.y) for moments in zip(dense.mean, cov, strict=True)]
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-9)


@pytest.mark.parametrize("level", [0, 2, 6])
def test_the_evidence_of_one_report_on_a_scale_of_levels_is_its_probability(level):
    def change(y):
        y[:] = np.nan
        y[1, 2, 0] = level / 6.0

    posterior, theta, dense = people("likert7", change)
    [at] = np.flatnonzero(~np.isnan(dense.y))
    expected = [
        of_one_report(dense.mean[p, at], dense.cov[p, at, at], level, 7, theta["delta_v"][p])
        for p in range(3)
    ]
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-9)
