"""Factors of many small matrices at once are NumPy's, one by one."""

import numpy as np

from trustbo.inference.samplers.small_matrices import backward, forward, small_cholesky


def test_factors_and_solutions_are_numpy_s_and_one_bad_matrix_spoils_no_other():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(6, 4, 4))
    A = roots @ roots.mT + 0.1 * np.eye(4)
    A[2] -= 10.0 * np.eye(4)
    good, b = [0, 1, 3, 4, 5], rng.normal(size=(6, 4))
    with np.errstate(invalid="ignore"):
        L = small_cholesky(np.moveaxis(A, 0, -1))
    assert np.isnan(L[..., 2]).any()
    for i in good:
        np.testing.assert_allclose(L[..., i], np.linalg.cholesky(A[i]), atol=1e-12)
    lower = L[..., good]
    solution = backward(lower, forward(lower, b[good].T)).T
    np.testing.assert_allclose(solution, np.linalg.solve(A[good], b[good, :, None])[..., 0])
