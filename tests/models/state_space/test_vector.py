"""Both state spaces, level and change, against joint normals and statsmodels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from missions import random_covariance
from references import dense_coupled
from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

from trustbo.models.state_space import dense
from trustbo.models.state_space.scalar import ScalarSSM
from trustbo.models.state_space.vector import VectorSSM


def random_vector_ssm(rng, n_bounds=6, n_missions=3, n_robots=3):
    return VectorSSM(
        rng.normal(0.0, 0.3, (n_robots, n_robots)) + 0.4 * np.eye(n_robots),
        rng.normal(0.0, 0.3, (n_bounds, n_missions, n_robots)),
        random_covariance(rng, n_robots, 0.2),
        random_covariance(rng, n_robots, 0.1),
        0.4,
        rng.uniform(0.1, 0.6),
    )


def random_rates(rng, ssm, missing):
    y = rng.uniform(size=ssm.drift.shape)
    y[rng.uniform(size=y.shape) < missing] = np.nan
    return y


# Compiled whole: step by step, each operation would be a program of its own.
@jax.jit
def posterior_of(ssm, y):
    """Filter, smoother, and the affine map from noise to draws: its centre and its slope."""
    filtered = ssm.filter(y)

    def draw(noise):
        return ssm.sample_backward(filtered, noise)

    zero = jnp.zeros(y.shape)
    return filtered, ssm.smooth(filtered), draw(zero), jax.jacfwd(draw)(zero)


@jax.jit
def of_complete(ssm, y):
    return ssm.filter(y, complete=True).log_likelihood, dense.log_likelihood(ssm, y)


def by_hand(ssm, y, j):
    args = [np.asarray(a) for a in (ssm.B0, ssm.drift[:, j], ssm.Q, ssm.R)]
    return dense_coupled(*args, float(ssm.x0_mean), float(ssm.x0_sd), y[:, j])


@pytest.mark.parametrize("seed", range(4))
def test_coupled_filter_smoother_and_sampling_are_the_joint_normal_s(seed):
    rng = np.random.default_rng(seed)
    ssm = random_vector_ssm(rng)
    y = random_rates(rng, ssm, missing=0.25 * (seed % 2))
    with jax.enable_x64(True):
        filtered, smoothed, centre, spread = jax.tree.map(np.asarray, posterior_of(ssm, y))
    spread = spread.reshape(*y.shape, -1)
    for j in range(y.shape[1]):
        log_density, mean, covariance = by_hand(ssm, y, j)
        np.testing.assert_allclose(filtered.log_likelihood[:, j].sum(), log_density, rtol=1e-9)
        np.testing.assert_allclose(smoothed.mean[:, j], mean, rtol=1e-8, atol=1e-9)
        variance = np.diag(covariance).reshape(mean.shape)
        np.testing.assert_allclose(smoothed.var[:, j], variance, rtol=1e-8, atol=1e-10)
        # A draw is affine in standard normal noise: its exact moments, no Monte Carlo.
        np.testing.assert_allclose(centre[:, j], mean, rtol=1e-8, atol=1e-9)
        factor = spread[:, j].reshape(mean.size, -1)
        np.testing.assert_allclose(factor @ factor.T, covariance, rtol=1e-7, atol=1e-10)


def test_complete_missions_of_any_length_need_one_factor_or_one_covariance():
    rng = np.random.default_rng(0)
    ssm = random_vector_ssm(rng, n_bounds=7)
    y = random_rates(rng, ssm, missing=0.0)
    y[5:, 1] = np.nan
    with jax.enable_x64(True):
        log_likelihood, at_once = (np.asarray(a) for a in of_complete(ssm, y))
    expected = [by_hand(ssm, y[:n], j)[0] for j, n in ((0, 7), (2, 7))]
    short = VectorSSM(*ssm)._replace(drift=ssm.drift[:5])
    expected.insert(1, by_hand(short, y[:5], 1)[0])
    np.testing.assert_allclose(log_likelihood.sum((0, 2)), expected, rtol=1e-9)
    np.testing.assert_allclose(at_once[:, 0], expected, rtol=1e-9)


@pytest.mark.parametrize("own", [False, True])
def test_robots_apart_are_coupled_ones_with_diagonal_matrices(own):
    rng = np.random.default_rng(5)
    shape = (3,) if own else ()
    beta0, w, v = (rng.uniform(0.1, 0.8, shape) for _ in range(3))
    drift = rng.normal(size=(6, 4, 3))
    y = rng.uniform(size=drift.shape)
    y[rng.uniform(size=y.shape) < 0.2] = np.nan
    apart = ScalarSSM(beta0, drift, w, v, 0.5, 0.3)
    matrices = (np.diag(np.broadcast_to(p, 3)) for p in (beta0, w**2, v**2))
    B0, Q, R = matrices
    coupled = VectorSSM(B0, drift, Q, R, 0.5, 0.3)
    with jax.enable_x64(True):
        results = []
        for ssm in (apart, coupled):
            filtered, smoothed, *drawn = posterior_of(ssm, y)
            found = (filtered.log_likelihood, filtered.mean, *smoothed, *drawn)
            results.append(jax.tree.map(np.asarray, found))
    for one, other in zip(*results, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10)


def test_log_likelihood_equals_statsmodels():
    rng = np.random.default_rng(3)
    ssm = random_vector_ssm(rng, n_bounds=9)
    y = random_rates(rng, ssm, missing=0.3)
    with jax.enable_x64(True):
        found = np.asarray(posterior_of(ssm, y)[0].log_likelihood.sum((0, 2)))
    for j in range(y.shape[1]):
        reference = KalmanFilter(k_endog=3, k_states=3)
        reference.bind(np.ascontiguousarray(y[:, j]))
        reference["design"], reference["transition"] = np.eye(3), ssm.B0
        reference["selection"], reference["state_cov"] = np.eye(3), ssm.Q
        reference["obs_cov"] = ssm.R
        # statsmodels starts from the prediction of x_1, and adds c_{t+1} on the way from x_t.
        later = np.concatenate([ssm.drift[1:, j], np.zeros((1, 3))])
        reference["state_intercept"] = np.ascontiguousarray(later.T)
        start = ssm.B0 @ np.full(3, ssm.x0_mean) + ssm.drift[0, j]
        reference.initialize_known(start, ssm.B0 @ ssm.B0.T * ssm.x0_sd**2 + ssm.Q)
        np.testing.assert_allclose(found[j], reference.loglike(), rtol=1e-9)


def test_simulated_missions_have_the_right_moments():
    rng = np.random.default_rng(1)
    ssm = random_vector_ssm(rng, n_bounds=3, n_missions=1, n_robots=2)
    n = 40_000
    with jax.enable_x64(True):
        many = ssm._replace(drift=np.repeat(ssm.drift, n, axis=1))
        simulate = jax.jit(VectorSSM.simulate)
        trust, y = (np.asarray(a) for a in simulate(many, jax.random.key(0)))
    nothing = np.full((3, 1, 2), np.nan)
    _, mean, covariance = by_hand(ssm, nothing, 0)
    flat = np.swapaxes(trust, 0, 1).reshape(n, -1)
    sd = np.sqrt(np.diag(covariance))
    assert (np.abs(flat.mean(0) - mean.ravel()) < 5 * sd / np.sqrt(n)).all()
    se = np.sqrt((np.outer(sd, sd) ** 2 + covariance**2) / n)
    assert (np.abs(np.cov(flat.T) - covariance) < 5 * se).all()
    # Log densities of rates under their own law: on average 3 nats, half their number, below the
    # one at the mean.
    sample = [by_hand(ssm, y[:, i : i + 1], 0)[0] for i in range(1000)]
    at_mean = by_hand(ssm, y.mean(1, keepdims=True), 0)[0]
    assert abs(np.mean(sample) - (at_mean - 3.0)) < 5 * np.std(sample) / np.sqrt(1000) + 0.01
