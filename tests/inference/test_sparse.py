"""Sparse factors, their solutions and the entries of the inverse, against dense matrices."""

import numpy as np
import pytest

from trustbo.inference.sparse import Factor, Order


def matrices(n, density, n_points, rng):
    """Positive definite matrices (point, n, n) with a random pattern, and the pattern."""
    coupled = rng.random((n, n)) < density
    coupled |= coupled.T
    np.fill_diagonal(coupled, True)

    A = rng.normal(size=(n_points, n, n)) * coupled
    A = A + np.swapaxes(A, 1, 2)
    return A + 2.0 * n * np.eye(n) * rng.uniform(0.5, 1.5, size=(n_points, 1, 1)), coupled


CASES = {
    "one column": (1, 1.0, 1),
    "diagonal": (30, 0.0, 8),
    "sparse": (60, 0.03, 11),
    "nearly dense": (40, 0.5, 2),
    "dense": (20, 1.0, 3),
}


@pytest.fixture(params=CASES.values(), ids=CASES.keys())
def case(request):
    """Matrices, the entries that are stored of them, and their factor."""
    A, coupled = matrices(*request.param, np.random.default_rng(0))
    order = Order.from_pattern(coupled)
    a, b = np.nonzero(coupled)
    entry = order.entry(a, b)
    kept = entry >= 0

    stored = np.zeros((order.size, len(A)))
    stored[entry[kept]] = A[:, a[kept], b[kept]].T
    factor = Factor.from_precision(order, stored)
    return A, (a[kept], b[kept], entry[kept]), factor


def test_each_pair_of_coupled_columns_is_stored_once(case):
    A, (_, _, entry), _ = case
    n_coupled = np.count_nonzero((A != 0.0).any(0))
    n = A.shape[1]
    assert len(np.unique(entry)) == len(entry) == (n_coupled + n) // 2


def test_determinants_and_solutions_are_those_of_dense_matrices(case):
    A, _, factor = case
    rng = np.random.default_rng(1)
    h = rng.normal(size=A.shape[:2])
    half = factor.forward(h)
    np.testing.assert_allclose(2.0 * factor.log_det, np.linalg.slogdet(A)[1], rtol=1e-10)

    expected = np.linalg.solve(A, h[..., None])[..., 0]
    found = factor.back(np.stack([half, 2.0 * half], axis=1))
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], 2.0 * expected, rtol=1e-9, atol=1e-12)


def test_stored_entries_of_the_inverse_are_those_of_the_dense_inverse(case):
    A, (a, b, entry), factor = case
    expected = np.linalg.inv(A)[:, a, b] * np.where(a == b, 0.5, 1.0)
    np.testing.assert_allclose(factor.covariance()[entry].T, expected, rtol=1e-8, atol=1e-13)


def test_a_matrix_that_is_not_positive_definite_leaves_the_others_valid():
    A = np.stack([np.eye(12), -np.eye(12), 4.0 * np.eye(12)])
    order = Order.from_pattern(np.eye(12, dtype=bool))
    stored = np.zeros((order.size, len(A)))
    stored[order.diagonal] = A[:, order.column, order.column].T
    log_det = Factor.from_precision(order, stored).log_det
    assert np.isnan(log_det[1])
    np.testing.assert_allclose(log_det[[0, 2]], [0.0, 12.0 * np.log(2.0)], atol=1e-12)
