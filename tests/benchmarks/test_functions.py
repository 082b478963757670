"""The benchmark of functions: simulated rates reach the fits of simulation-based calibration."""

import numpy as np
from functions import with_rates

from trustbo.models.observations import Observations


def test_simulated_rates_may_leave_the_interval_of_measured_ones():
    rates = np.array([[1.2, -0.1], [0.3, 0.4]])
    mission = with_rates(np.zeros((2, 2, 1)), rates, ["slope"])
    np.testing.assert_array_equal(Observations.from_missions([mission]).contact_rate, rates[None])
