"""Expectation propagation against quadrature over all linear predictors of small cases."""

import numpy as np
import pytest
from scipy.special import logsumexp

from trustbo.inference import ep
from trustbo.inference.density import Density, at
from trustbo.models import HumanTrust, PooledTrust
from trustbo.models.observations import Observations

FEATURES = ("vegetation",)


def small(family, y):
    """One robot, one mission, two bounds."""
    y = np.array(y, dtype=float).reshape(1, 2, 1)
    z = np.array([0.3, 0.8]).reshape(1, 2, 1, 1)
    model = PooledTrust(family=family).for_features(FEATURES)
    return Density(model, Observations(y, z, np.full(y.shape, 40.0), FEATURES))


def by_quadrature(posterior, theta):
    """Log p(rates | theta) by a grid over both linear predictors, coefficients integrated out."""
    predictor, prior = posterior._at(theta)
    U = posterior.blocks.U.toarray()
    c_cov = np.diag(1.0 / np.concatenate([part[0] for part in prior.parts]))
    T = predictor.response[0, 0]
    mean = predictor.mean[0, 0] + T @ U @ prior.mean[0]
    cov = predictor.covariance[0, 0] + T @ U @ c_cov @ U.T @ T.T
    L, e = np.linalg.cholesky(cov), np.linspace(-8.0, 8.0, 801)
    a, b = np.meshgrid(e, e, indexing="ij")
    f = mean[:, None, None] + np.stack([L[0, 0] * a, L[1, 0] * a + L[1, 1] * b])
    rates, total = posterior.rates, -0.5 * (a**2 + b**2) - np.log(2.0 * np.pi)
    for k in range(2):
        if not np.isnan(rates.y[0, k]):
            sd = predictor.noise_sd[0, 0, 0]
            total = total + rates.likelihood.log_prob(rates.y[0, k], 40.0, f[k], sd)
    return logsumexp(total) + 2.0 * np.log(e[1] - e[0])


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
@pytest.mark.parametrize("y", [(1.0, 0.6), (1.0, 1.0), (0.0, 1.0), (0.4, np.nan)])
def test_the_evidence_and_the_mean_weight_are_those_of_quadrature(family, y):
    posterior = small(family, y)
    theta = posterior.theta(np.array([[0.0, -0.5, 0.2]]))
    posterior.run_ep(theta)
    wanted = by_quadrature(posterior, theta)
    found, _ = ep.log_evidence(posterior._joint(theta), posterior.sites, 10)
    assert abs(found[0] - wanted) < 0.05  # EP's own error
    many = at(theta, np.zeros(20_000, int))
    joint = posterior._joint(many)
    sites = ep.Sites(*(np.repeat(s, 20_000, axis=0) for s in posterior.sites)).at(
        posterior.rates, joint.predictor.noise_sd
    )
    _, _, log_weight = ep.draw(joint, sites, np.random.default_rng(0))
    weight = np.exp(log_weight - wanted)
    assert abs(weight.mean() - 1.0) < 5.0 * weight.std() / np.sqrt(len(weight)) + 2e-3


def test_gaussian_terms_alone_leave_the_evidence_exact():
    exact = small("gaussian", (0.4, 0.6))
    censored = small("censored", (0.4, 0.6))
    z = np.random.default_rng(0).standard_normal((5, 3))
    theta = exact.theta(z)
    np.testing.assert_allclose(
        censored.log_evidence(theta), exact.log_evidence(theta), rtol=0, atol=1e-9
    )


def test_parts_of_persons_have_their_joint_law():
    """Their sum of squares in trust is a term of the block's covariance."""
    y = np.full((3, 4, 1), np.nan)
    z = np.random.default_rng(0).integers(0, 2, (3, 4, 1, 2)).astype(float)
    features = ("success", "failure")
    model = HumanTrust(scale="likert7").for_features(features)
    observations = Observations(y, z, np.full(y.shape, 6.0), features)
    posterior = Density(model, observations)
    theta = posterior.theta(np.zeros((1, posterior.n_scores)))
    with_parts = model.linear_predictor(theta, observations, posterior.layout).trust_cov
    effects = model.random_effects(theta, observations)
    parts = model.state_space(theta, 1).response(4) @ effects.drift + effects.offset
    rest = with_parts - parts @ np.swapaxes(parts, 2, 3)
    beta0, delta_w = theta["beta0"][0], theta["delta_w"][0]
    lag = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    var = delta_w**2 * np.cumsum(beta0 ** (2 * np.arange(4)))
    wanted = beta0**lag * np.minimum.outer(var, var)
    np.testing.assert_allclose(rest[0], np.broadcast_to(wanted, rest[0].shape), rtol=1e-9)
