"""The scalar state space against joint normals written out in full."""

import jax
import numpy as np
import pytest
from missions import random_missions, random_params
from references import dense_log_likelihood, dense_posterior_of_trust

from trustbo.data import Mission
from trustbo.errors import ShapeError
from trustbo.models import PooledTrust, TrustParams
from trustbo.stacking import stack_missions


@pytest.mark.parametrize("seed", range(20))
def test_log_likelihood_equals_the_dense_joint_normal(seed):
    rng = np.random.default_rng(seed)
    params, missions = random_params(rng), random_missions(rng, missing=0.3 * (seed % 2))
    expected = [
        sum(
            dense_log_likelihood(*params[:7], mission.awareness[:, i], mission.contact_rate[:, i])
            for i in range(3)
        )
        for mission in missions
    ]
    # Exact maths in float64, apart from the condition of the dense covariance.
    np.testing.assert_allclose(PooledTrust().log_likelihood(params, missions), expected, rtol=1e-9)


def test_log_likelihood_is_vectorised_over_draws_of_parameters():
    rng = np.random.default_rng(0)
    missions = random_missions(rng)
    draws = [random_params(rng) for _ in range(4)]
    stacked = TrustParams(*(np.stack(v) for v in zip(*(d[:7] for d in draws), strict=True)))
    together = PooledTrust().log_likelihood(stacked, missions)
    alone = [PooledTrust().log_likelihood(draw, missions) for draw in draws]
    assert together.shape == (4, 3)
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_padding_changes_nothing():
    rng = np.random.default_rng(1)
    params, missions = random_params(rng), random_missions(rng)
    every = PooledTrust().log_likelihood(params, missions)
    for mission, value in zip(missions, every, strict=True):
        np.testing.assert_allclose(
            PooledTrust().log_likelihood(params, [mission]), [value], rtol=1e-12
        )


def test_an_intercept_may_move_into_a_constant_feature():
    rng = np.random.default_rng(2)
    params, (mission, *_) = random_params(rng), random_missions(rng)
    ones = np.ones((*mission.contact_rate.shape, 1))
    moved = Mission.from_arrays(
        mission.path, np.concatenate([mission.awareness, ones], -1), mission.contact_rate
    )
    with_feature = params._replace(beta=np.append(params.beta, params.b), b=0.0)
    np.testing.assert_allclose(
        PooledTrust().log_likelihood(with_feature, [moved]),
        PooledTrust().log_likelihood(params, [mission]),
        rtol=1e-10,
    )


@jax.jit
def _posterior_of(params, awareness, rates, noise):
    ssm = params.ssm(awareness[None])
    filtered = ssm.filter(rates[:, None])
    return ssm.smooth(filtered), jax.vmap(lambda e: ssm.sample_backward(filtered, e))(noise)


@pytest.mark.parametrize("seed", range(5))
def test_the_smoother_and_backward_sampling_have_the_exact_moments(seed):
    rng = np.random.default_rng(seed)
    params, (mission, *_) = random_params(rng), random_missions(rng, missing=0.3)
    n_draws = 20_000
    with jax.enable_x64(True):
        awareness, rates = mission.awareness, mission.contact_rate
        noise = rng.normal(size=(n_draws, len(rates), 1, 3))
        smoothed, draws = _posterior_of(params, awareness, rates, noise)
        draws = np.asarray(draws)[:, :, 0]
    for i in range(3):
        mean, cov = dense_posterior_of_trust(
            *params[:7], mission.awareness[:, i], mission.contact_rate[:, i]
        )
        np.testing.assert_allclose(smoothed.mean[:, 0, i], mean, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(smoothed.var[:, 0, i], np.diag(cov), rtol=1e-7, atol=1e-12)
        sd = np.sqrt(np.diag(cov))
        # 5 Monte-Carlo standard errors: some 400 comparisons in all, so 4 would fail by chance.
        assert (np.abs(draws[..., i].mean(0) - mean) < 5 * sd / np.sqrt(n_draws)).all()
        sampled = np.cov(draws[..., i].T).reshape(cov.shape)
        se = np.sqrt((np.outer(sd, sd) ** 2 + cov**2) / n_draws)
        assert (np.abs(sampled - cov) < 5 * se).all()


def test_simulated_rates_have_the_joint_normal_s_moments():
    rng = np.random.default_rng(3)
    params = random_params(rng)
    z = rng.uniform(size=(1, 4, 1, 2))
    n_draws = 50_000
    sample = PooledTrust().simulate(
        jax.random.key(0), params, np.broadcast_to(z, (n_draws, 4, 1, 2))
    )
    rates = sample.contact_rate[..., 0]
    # A Gaussian's first two moments fix its density: compare that at the mean.
    cov = np.cov(rates.T)
    mean = rates.mean(0)
    log_density = -0.5 * (np.linalg.slogdet(cov)[1] + 4 * np.log(2 * np.pi))
    expected = dense_log_likelihood(*params[:7], z[0, :, 0], mean)
    # slogdet of a 4 x 4 sample covariance has sd sqrt(2 * 4 / n), halved here: 5 of these.
    assert abs(log_density - expected) < 5 * 0.5 * np.sqrt(8 / n_draws)


def test_simulating_is_for_one_draw_and_a_batch_of_missions():
    params = random_params(np.random.default_rng(6))
    with pytest.raises(ShapeError, match=r"\(mission, bound, robot, feature\) .* got \(4, 3, 2\)"):
        PooledTrust().simulate(jax.random.key(0), params, np.zeros((4, 3, 2)))


def test_weights_must_match_the_features():
    rng = np.random.default_rng(4)
    params, missions = random_params(rng), random_missions(rng)
    with pytest.raises(ShapeError, match="3 weights, but awareness has 2 features"):
        PooledTrust().log_likelihood(params._replace(beta=np.zeros(3)), missions)


def test_stacking_pads_to_buckets_that_grow_seldom():
    rng = np.random.default_rng(5)
    for n_missions, bucket in ((1, 8), (8, 8), (9, 16), (17, 32)):
        shape = stack_missions(random_missions(rng, n_missions)).contact_rate.shape
        assert shape[0] == bucket
        assert shape[1] in (8, 16)
