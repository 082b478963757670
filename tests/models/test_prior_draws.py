"""Draws of the parameters from the priors, in NumPy: closed forms, and numpyro's own draws."""

from dataclasses import replace

import jax
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer import Predictive
from scipy import special, stats

from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import prior_predictive, sample_prior
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    Priors,
)
from trustbo.models.backend import own_settings
from trustbo.models.priors_numpy import draw_lkj_cholesky
from trustbo.models.state_space.generate import draw_missions

SIGHTED = ("visibility", "line_of_sight")
BY_FEATURE = Priors(beta=dist.Normal(np.array([1.0, -1.0]), np.array([0.1, 0.2])))
N = 20_000
RANDOM = 5 / np.sqrt(N)
"""Five standard errors of the mean of numbers with sd 1."""


def log_volume(n, eta):
    """Log of the integral of det(R)^(eta - 1) over correlation matrices, equation (16) of LKJ."""
    k = np.arange(1, n)
    half = eta + 0.5 * (n - k - 1)
    power = ((2.0 * eta - 2.0 + n - k) * (n - k)).sum()
    return power * np.log(2.0) + ((n - k) * special.betaln(half, half)).sum()


@pytest.mark.parametrize(("n", "eta"), [(2, 1.0), (3, 2.0), (4, 0.7)])
def test_correlations_have_the_lkj_law(n, eta):
    L = draw_lkj_cholesky(eta, (N, n), np.random.default_rng(n))
    R = L @ np.swapaxes(L, 1, 2)
    np.testing.assert_allclose(np.einsum("dii->di", R), 1.0, rtol=1e-12)
    assert (np.triu(L, 1) == 0.0).all()
    assert (np.einsum("dii->di", L) > 0.0).all()
    own = stats.beta(eta + 0.5 * (n - 2), eta + 0.5 * (n - 2))
    for i, j in zip(*np.triu_indices(n, 1), strict=True):
        # At most 10 of these tests: one chance in ten thousand of a false alarm.
        assert stats.kstest(0.5 * (1.0 + R[:, i, j]), own.cdf).pvalue > 1e-5
    # The mean of the sufficient statistic is the derivative of the log normaliser.
    log_det = np.linalg.slogdet(R)[1]
    expected = (log_volume(n, eta + 1e-5) - log_volume(n, eta - 1e-5)) / 2e-5
    assert abs(log_det.mean() - expected) < RANDOM * log_det.std()


def test_robots_spread_around_a_common_mean():
    p = sample_prior(HierarchicalTrust(), 2, N, 0, n_robots=2)
    b, beta = np.asarray(p.b), np.asarray(p.beta)
    # Mean of sd .5 and 1, spread tau ~ HalfNormal(.3): E[tau^2] = .09. Products of four normals.
    for draws, var in ((b, 0.25), (beta[..., 0], 1.0), (beta[..., 1], 1.0)):
        assert np.abs(draws.mean(0)).max() < RANDOM * np.sqrt(var + 0.09)
        np.testing.assert_allclose(np.cov(draws.T), var + 0.09 * np.eye(2), atol=RANDOM * 2 * var)
    own = HierarchicalTrust().draw_prior((3, 2), N, np.random.default_rng(1))
    off = special.logit(own["beta0"]) - special.logit(own["mean_beta0"])[:, None]
    scores = off / own["tau_beta0"][:, None]
    assert stats.kstest(scores.ravel(), "norm").pvalue > 1e-4
    assert stats.kstest(own["mean_beta0"], stats.beta(2, 2).cdf).pvalue > 1e-4
    assert np.abs(np.corrcoef(scores.T) - np.eye(3)).max() < RANDOM


def test_the_autoregression_stays_on_its_prior_s_support():
    priors = Priors(beta0=dist.Uniform(-0.5, 0.5), tau=dist.HalfNormal(1.0))
    own = HierarchicalTrust(priors).draw_prior((2, 1), 4000, np.random.default_rng(0))
    assert np.abs(own["beta0"]).max() < 0.5
    line = special.logit(own["beta0"] + 0.5) - special.logit(own["mean_beta0"] + 0.5)[:, None]
    assert stats.kstest((line / own["tau_beta0"][:, None]).ravel(), "norm").pvalue > 1e-4


def test_means_of_stationary_trust_go_by_the_mean_autoregression():
    own = HierarchicalTrust().for_features(SIGHTED).draw_prior((2, 2), N, np.random.default_rng(0))
    rest = 1.0 - own["mean_beta0"]
    slopes, level = own["mean_beta"] / rest[:, None], own["mean_b"] / rest
    np.testing.assert_allclose(slopes.mean(0), [0.0, 1.0], atol=RANDOM * 0.3)
    np.testing.assert_allclose(slopes.std(0), [0.25, 0.3], rtol=RANDOM)
    assert level.std() == pytest.approx(0.15, rel=RANDOM)


def test_coupled_matrices_have_the_priors_of_their_entries():
    p = CoupledTrust(replace(BY_FEATURE, concentration=1.5)).draw_prior(
        (3, 2), N, np.random.default_rng(0)
    )
    own, others = np.eye(3, dtype=bool), ~np.eye(3, dtype=bool)
    assert stats.kstest(p["B0"][:, own].ravel(), stats.beta(2, 2).cdf).pvalue > 1e-4
    assert p["B"].shape == (N, 2, 3, 3)
    for m, law in enumerate((stats.norm(1.0, 0.1), stats.norm(-1.0, 0.2))):
        assert stats.kstest(p["B"][:, m][:, own].ravel(), law.cdf).pvalue > 1e-4
        assert stats.kstest(p["B"][:, m][:, others].ravel(), stats.norm(0, 0.1).cdf).pvalue > 1e-4
    assert stats.kstest(p["B0"][:, others].ravel(), stats.norm(0.0, 0.1).cdf).pvalue > 1e-4
    for name in ("Delta_w", "Delta_v"):
        sd = np.sqrt(np.einsum("dii->di", p[name]))
        assert stats.kstest(sd.ravel(), stats.halfnorm(0.0, 0.2).cdf).pvalue > 1e-4
        r = p[name][:, 0, 2] / (sd[:, 0] * sd[:, 2])
        assert stats.kstest(0.5 * (1.0 + r), stats.beta(2.0, 2.0).cdf).pvalue > 1e-4
    counts = CoupledTrust(observation="beta_binomial").draw_prior(
        (3, 2), 10, np.random.default_rng(0)
    )
    assert (counts["Delta_v"][:, others] == 0.0).all()
    assert (counts["Delta_w"][:, others] != 0.0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        PooledTrust(),
        HierarchicalTrust(),
        HierarchicalTrust().for_features(SIGHTED),
        CoupledTrust(BY_FEATURE),
        CoupledTrust(observation="beta_binomial"),
        CoupledTrust().for_features(SIGHTED),
        CoupledTrust(inter_robot="none"),
    ],
    ids=lambda model: model.describe() + "-sighted" * model.priors.stationary,
)
def test_draws_have_the_moments_of_the_numpyro_program(model):
    """Parameters and contact rates of numpyro's Predictive on the model itself."""
    z, ticks = np.random.default_rng(0).uniform(size=(1, 2, 2, 2)), np.full((1, 2, 2), 40.0)
    names = [*model.sizes(2, 2), "contact_rate"]
    with own_settings():
        program = Predictive(model, num_samples=N, return_sites=names, parallel=True)
        theirs = program(jax.random.key(0), z, n_ticks=ticks)
    ours = model.draw_prior((2, 2), N, np.random.default_rng(1))
    assert ours.keys() == model.sizes(2, 2).keys()
    assert {name: value.shape[1:] for name, value in ours.items()} == model.sizes(2, 2)
    theirs = {name: np.asarray(value, dtype=float) for name, value in theirs.items()}
    params, rng = model.params(ours, 2).flat(), np.random.default_rng(2)
    missions = draw_missions(model.family, params, z, ticks, rng)
    ours["contact_rate"] = missions.contact_rate
    both = [
        np.concatenate([each[name].reshape(N, -1) for name in names], axis=1)
        for each in (ours, theirs)
    ]
    for power in (1, 2):
        one, other = both
        if power == 2:
            one, other = ((y[:, :, None] * y[:, None]).reshape(N, -1) for y in both)
        error = np.sqrt((one.var(0) + other.var(0)) / N) + 1e-12
        # Some 600 moments, products of normals with heavy tails among them.
        assert (np.abs(one.mean(0) - other.mean(0)) < 5.5 * error).all()


def test_what_the_prior_cannot_predict_is_refused():
    z = np.full((1, 2, 2, 1), 0.5)
    with pytest.raises(ShapeError, match=r"awareness must be \(mission, bound, robot, feature\)"):
        prior_predictive(PooledTrust(), z[0])
    with pytest.raises(ShapeError, match="features must be 1 names"):
        prior_predictive(PooledTrust(), z, features=("a", "b"))
    with pytest.raises(TrustboError, match="effects of places need the paths of missions"):
        prior_predictive(PooledTrust(place=PlaceEffect()), z)
