"""Proposals: densities by SciPy, draws that have them, mixtures that integrate to one."""

import numpy as np
import pytest
from scipy import stats

from trustbo.inference.samplers.student import Spanning, Student, log_mixture

SCALE = np.array([[0.8, 0.0, 0.0], [0.3, 0.5, 0.0], [-0.2, 0.1, 1.1]])
CENTER = np.array([0.5, -1.0, 0.2])
POINTS = np.random.default_rng(0).normal(size=(50, 3))


def test_the_density_is_scipy_s_multivariate_t():
    theirs = stats.multivariate_t(CENTER, SCALE @ SCALE.T, df=8.0).logpdf(POINTS)
    np.testing.assert_allclose(Student(CENTER, SCALE).log_density(POINTS), theirs, rtol=1e-12)


def test_draws_have_the_mean_and_the_covariance_of_the_density():
    draws = Student(CENTER, SCALE).draw(2**13, seed=1)
    covariance = 8.0 / 6.0 * SCALE @ SCALE.T  # nu / (nu - 2) times the squared scale
    np.testing.assert_allclose(draws.mean(0), CENTER, atol=0.01)  # Sobol: far below 1 / sqrt(n)
    np.testing.assert_allclose(np.cov(draws.T), covariance, atol=0.03)


def test_weighted_points_give_their_mean_and_covariance_as_center_and_scale():
    w = np.random.default_rng(1).uniform(size=50)
    w /= w.sum()
    fit = Student.of(POINTS, np.log(w))
    np.testing.assert_allclose(fit.center, np.average(POINTS, axis=0, weights=w), rtol=1e-12)
    covariance = np.cov(POINTS.T, aweights=w, bias=True)
    np.testing.assert_allclose(fit.scale @ fit.scale.T, covariance, rtol=1e-10)


def test_a_skewed_density_integrates_to_one_and_its_draws_have_its_moments():
    skewed = Student(CENTER[:2], SCALE[:2, :2], skew=np.array([0.6, -0.3]))
    side = np.linspace(-30.0, 30.0, 2401)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    share = np.exp(skewed.log_density(grid)) * (side[1] - side[0]) ** 2
    np.testing.assert_allclose(share.sum(), 1.0, atol=1e-6)
    draws, mean = skewed.draw(2**13, seed=1), share @ grid
    np.testing.assert_allclose(draws.mean(0), mean, atol=0.01)  # Sobol: far below 1 / sqrt(n)
    np.testing.assert_allclose(np.cov(draws.T), (grid * share[:, None]).T @ grid
                               - np.outer(mean, mean), atol=0.03)  # fmt: skip


def test_skewed_axes_keep_mean_and_covariance_and_take_the_skewness_of_the_points():
    normal = np.random.default_rng(2).normal(size=(4000, 3))
    z = CENTER + np.exp(0.3 * normal) @ SCALE.T  # each whitened axis has a skewness of .95
    log_w = np.full(len(z), -np.log(len(z)))
    plain = Student.of(z, log_w)._replace(nu=1e9)  # normal: its moments are those of the points
    skewed = plain.skewed(z, log_w)
    draws, half = skewed.draw(2**14, seed=3), np.linalg.inv(plain.scale)
    np.testing.assert_allclose(draws.mean(0), plain.center, atol=0.01)
    np.testing.assert_allclose(np.cov(draws.T), plain.scale @ plain.scale.T, atol=0.02)
    # Of a skewness estimated from 16384 draws 5 standard errors, sqrt(15 / 16384) each, at most.
    np.testing.assert_allclose(
        stats.skew((draws - plain.center) @ half.T), stats.skew((z - plain.center) @ half.T),
        atol=0.15,
    )  # fmt: skip


@pytest.mark.parametrize("axis", [0, 1])
def test_a_proposal_that_spans_a_score_s_prior_integrates_to_one(axis):
    two = Student(CENTER[:2], SCALE[:2, :2])
    spanning = Spanning.of(two, axis)
    sides = np.linspace(-9.0, 9.0, 721), np.linspace(-30.0, 30.0, 2401)
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 2)
    if axis == 1:
        grid = grid[:, ::-1]
    cell = (sides[0][1] - sides[0][0]) * (sides[1][1] - sides[1][0])
    # Of a t with 8 degrees of freedom less than 1e-9 is beyond 30.
    np.testing.assert_allclose(np.exp(spanning.log_density(grid)).sum() * cell, 1.0, atol=1e-6)
    draws = spanning.draw(2**12, seed=2)
    np.testing.assert_allclose(draws[:, axis].std(), 1.3, rtol=0.01)


def test_a_mixture_weighs_its_components_by_the_points_drawn_from_each():
    a, b = Student(CENTER, SCALE), Student(-CENTER, 2.0 * SCALE)
    by_hand = 0.25 * np.exp(a.log_density(POINTS)) + 0.75 * np.exp(b.log_density(POINTS))
    np.testing.assert_allclose(np.exp(log_mixture([a, b], [100, 300], POINTS)), by_hand, rtol=1e-12)
