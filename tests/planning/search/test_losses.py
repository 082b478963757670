"""Losses of a bound against the expected rates of the families and numerical derivatives."""

import numpy as np
import pytest
from numba import njit
from references import expected_rate

from trustbo.planning.search.losses import (
    CLIPPED,
    LEAST,
    LINEAR,
    LOGISTIC,
    NONE,
    SOFTPLUS,
    joined,
    least_slope,
    loss_of,
)

SD = 0.3
X = np.linspace(-2.0, 2.5, 901)
DEFINITIONS = {
    LOGISTIC: lambda x: 1.0 - expected_rate("beta_binomial", x, SD),
    CLIPPED: lambda x: 1.0 - expected_rate("censored", x, SD),
    SOFTPLUS: lambda x: np.logaddexp(0.0, -x),
    LEAST: lambda x: -x,
    NONE: np.zeros_like,
    LINEAR: lambda x: -x,
}


@njit(nogil=True, error_model="numpy")
def compiled(loss, x, lo, hi, sd):
    """All three of `losses`, which only compiled functions can call."""
    return loss_of(loss, x, sd), least_slope(loss, lo, hi, sd), joined(loss, lo, hi)


@pytest.mark.parametrize("loss", DEFINITIONS)
def test_a_loss_is_its_definition_and_falls_in_trust(loss):
    values = np.array([compiled(loss, x, 0.0, 1.0, SD)[0] for x in X])
    np.testing.assert_allclose(values, DEFINITIONS[loss](X), rtol=1e-9, atol=1e-14)
    assert (np.diff(values) <= 1e-15).all()


@pytest.mark.parametrize("loss", DEFINITIONS)
def test_the_least_slope_is_that_of_the_flattest_secant_between_both_ends(loss):
    slopes = -np.diff(DEFINITIONS[loss](X)) / np.diff(X)
    for lo, hi in ((0, 900), (0, 300), (500, 900), (380, 420), (650, 660)):
        slope = compiled(loss, 0.0, X[lo], X[hi], SD)[1]
        # Secants are chords of some 0.005: the derivative at an end is within a share of them.
        np.testing.assert_allclose(slope, slopes[lo:hi].min(), rtol=0.04, atol=1e-4)
        assert slope <= slopes[lo:hi].min() + 1e-9


def test_losses_add_up_but_the_largest_alone_counts_for_a_bottleneck():
    assert [compiled(loss, 0.0, 0.25, 0.5, SD)[2] for loss in (SOFTPLUS, LEAST)] == [0.75, 0.5]
