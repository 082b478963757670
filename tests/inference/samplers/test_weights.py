"""Importance weights: what smoothing keeps, how far it warns, and resampling without noise."""

import numpy as np
from scipy import stats

from trustbo.inference.samplers.weights import smoothed_weights, systematic


def weights_of(sd, n=20_000):
    """Raw log weights of N(0, 1) under a proposal N(0, sd^2)."""
    z = sd * np.random.default_rng(0).standard_normal(n)
    return stats.norm.logpdf(z) - stats.norm.logpdf(z, scale=sd), z


def test_a_wide_proposal_gives_moments_evidence_and_a_small_k_hat():
    raw, z = weights_of(1.5)
    log_w, k_hat, log_evidence = smoothed_weights(raw)
    w = np.exp(log_w)
    np.testing.assert_allclose(w.sum(), 1.0, rtol=1e-12)
    np.testing.assert_allclose(log_evidence, 0.0, atol=0.02)  # a density integrates to one
    np.testing.assert_allclose([w @ z, w @ z**2], [0.0, 1.0], atol=0.03)
    assert k_hat < 0.0  # its weights are bounded


def test_a_narrow_proposal_is_found_out_by_k_hat():
    # Weights of a proposal of sd s have a Pareto tail of shape 1 - s^2: 0.84 at s = .4.
    raw, _ = weights_of(0.4)
    assert 0.7 < smoothed_weights(raw)[1] < 1.0


def test_equal_weights_have_no_tail_and_points_without_density_no_weight():
    log_w, k_hat, log_evidence = smoothed_weights(np.zeros(500))
    assert k_hat == -np.inf
    np.testing.assert_allclose([log_w[0], log_evidence], [-np.log(500.0), 0.0], atol=1e-12)
    raw, _ = weights_of(1.5, 1000)
    raw[::2] = -np.inf
    assert np.exp(smoothed_weights(raw)[0][::2]).max() < 1e-30


def test_systematic_resampling_draws_each_point_as_often_as_its_weight_rounded():
    rng = np.random.default_rng(0)
    for _ in range(20):
        w = rng.dirichlet(np.full(30, 0.3))
        counts = np.bincount(systematic(w, 1000, rng), minlength=30)
        assert (np.abs(counts - 1000 * w) < 1.0).all()
