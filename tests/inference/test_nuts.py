"""The coordinates that NUTS samples: one-to-one, with the right Jacobian, and nearly normal."""

import numpy as np
import pytest
from scipy import stats

from trustbo.inference.diagnostics import complaints_of
from trustbo.inference.nuts import Whitened


@pytest.fixture(scope="module")
def scores():
    """Points of a skewed, correlated distribution, like those of the scores of small noises."""
    rng = np.random.default_rng(0)
    gumbel = -rng.gumbel(size=(2000, 3))
    return -2.0 + gumbel @ np.array([[0.4, 0.2, 0.0], [0.0, 0.5, 0.1], [0.0, 0.0, 0.4]])


@pytest.fixture(scope="module")
def coordinates(scores):
    return Whitened.from_scores(scores)


def test_scores_invert_whiten(scores, coordinates):
    back, _ = coordinates.scores(coordinates.whiten(scores))
    np.testing.assert_allclose(back, scores, atol=1e-8)


def test_the_log_jacobian_is_that_of_finite_differences_up_to_a_constant(scores, coordinates):
    x, step = coordinates.whiten(scores[:20]), 1e-5
    axes = step * np.eye(3)
    columns = [(coordinates.scores(x + e)[0] - coordinates.scores(x - e)[0]) for e in axes]
    numeric = np.linalg.slogdet(np.stack(columns, axis=2) / (2.0 * step))[1]
    np.testing.assert_allclose(np.ptp(numeric - coordinates.scores(x)[1]), 0.0, atol=1e-6)


def test_points_are_less_skewed_and_uncorrelated_in_these_coordinates(scores, coordinates):
    x = coordinates.whiten(scores)
    assert abs(stats.skew(x)).max() < 0.3 * abs(stats.skew(scores)).max()
    np.testing.assert_allclose(np.cov(x.T), np.eye(3), atol=1e-4)


def test_a_single_chain_that_never_moved_fails_both_checks():
    stuck = {"weight": np.full((1, 100, 2), 0.3)}
    found, complaints = complaints_of(stuck, np.zeros((1, 100), bool))
    assert np.isnan(found["r_hat"])
    assert np.isnan(found["ess_bulk"])
    assert len(complaints) == 2
