"""Modes and Gaussian fits there: exact on Gaussians, and one of two modes from each start."""

import jax
import jax.numpy as jnp
import numpy as np

from trustbo.inference.samplers.laplace import inverse_hessian, laplace, newton, newton_direction

MEAN = np.array([1.0, -2.0])
COV = np.array([[0.5, 0.2], [0.2, 0.4]])


def gaussian(z):
    off = z - MEAN
    return -0.5 * np.einsum("...i,ij,...j->...", off, np.linalg.inv(COV), off)


def test_of_a_gaussian_the_mode_and_the_covariance_are_exact():
    modes, values, scales = laplace(gaussian, np.array([[0.0, 0.0], [5.0, 3.0]]))
    np.testing.assert_allclose(modes, [MEAN, MEAN], atol=1e-6)
    np.testing.assert_allclose(values, 0.0, atol=1e-9)
    # Central differences with a step of 1e-3 leave rounding of some 1e-9.
    np.testing.assert_allclose(scales @ scales.mT, [COV, COV], rtol=1e-6)


def test_each_start_climbs_to_the_mode_on_its_side():
    def log_density(z):
        return np.logaddexp(-2.0 * (z[:, 0] - 2.0) ** 2, -8.0 * (z[:, 0] + 2.0) ** 2)

    modes, _, scales = laplace(log_density, np.array([[1.5], [-1.8]]))
    np.testing.assert_allclose(modes[:, 0], [2.0, -2.0], atol=1e-4)
    np.testing.assert_allclose(scales[:, 0, 0] ** 2, [0.25, 0.0625], rtol=1e-3)


def test_a_start_without_density_stays_where_it_is():
    def log_density(z):
        return np.where(z[:, 0] > 0.0, -0.5 * (z[:, 0] - 1.0) ** 2, -np.inf)

    modes, values, scales = laplace(log_density, np.array([[-3.0], [0.5]]))
    np.testing.assert_allclose(modes[:, 0], [-3.0, 1.0], atol=1e-6)
    assert values[0] == -np.inf
    assert scales[0, 0, 0] == 1.0


def test_the_mode_in_jax_is_that_of_a_convex_potential():
    # cosh along one axis, a quartic along the other: minimum at (0.3, -0.7), Hessian by hand.
    def potential(z):
        return jnp.cosh(z[0] - 0.3) + 0.5 * (z[1] + 0.7) ** 2 + 0.25 * (z[1] + 0.7) ** 4

    with jax.enable_x64(True):
        z, hessian = newton(potential, jnp.array([3.0, 2.0]))
    np.testing.assert_allclose(z, [0.3, -0.7], atol=1e-6)
    np.testing.assert_allclose(hessian, np.eye(2), atol=1e-5)


def test_a_saddle_s_direction_descends_and_flat_directions_get_the_floor():
    hessian, gradient = np.diag([2.0, -0.5]), np.array([1.0, 1.0])
    np.testing.assert_allclose(newton_direction(np, gradient, hessian, 1e-3), [0.5, 2.0])
    np.testing.assert_allclose(
        inverse_hessian(np, np.diag([4.0, 0.0]), 0.05), np.diag([0.25, 20.0])
    )
