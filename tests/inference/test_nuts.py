"""The checks of chains of NUTS."""

import numpy as np

from trustbo.inference.diagnostics import complaints_of


def test_a_single_chain_that_never_moved_fails_both_checks():
    stuck = {"weight": np.full((1, 100, 2), 0.3)}
    found, complaints = complaints_of(stuck, np.zeros((1, 100), bool))
    assert np.isnan(found["r_hat"])
    assert np.isnan(found["ess_bulk"])
    assert len(complaints) == 2
