"""Refusals of the entry to the searches, and upper limits on values from gaps."""

import math

import numpy as np
import pytest

from trustbo.errors import TrustboError
from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.planning.search.solve import value_limit
from trustbo.workspace import Workspace


def make_planner(objective):
    awareness = np.random.default_rng(0).uniform(size=(1, 4, 4, 2))
    return Planner(Workspace.from_awareness(awareness), (3, 0), (0, 3), objective)


def params(beta0):
    return TrustParams(beta0, np.array([0.4, -0.2]), -0.1, 0.1, 0.1)


@pytest.mark.parametrize("objective", ["success", "bottleneck", "lost_contact"])
def test_objectives_of_the_history_refuse_a_negative_autoregression(objective):
    with pytest.raises(TrustboError, match=r"needs beta0 >= 0; got -0.5"):
        make_planner(objective).plan(params(-0.5))


def test_stationary_refuses_an_autoregression_that_settles_nowhere():
    with pytest.raises(TrustboError, match=r"needs abs\(beta0\) < 1; got 1"):
        make_planner("stationary").plan(params(1.0))


@pytest.mark.parametrize(
    ("objective", "value", "best"),
    [
        ("terminal", 0.6, 1.0 / (1.0 + 2.0 / 3.0 * math.exp(-0.4))),
        ("success", 0.25, 0.25 * math.exp(0.4)),
    ]
    + [(objective, -1.5, -1.1) for objective in ("mean", "lost_contact", "bottleneck")],
)
def test_a_gap_in_trust_or_in_log_probability_is_an_upper_limit_on_values(objective, value, best):
    # terminal adds to the logit of .6, whose odds are 3 to 2; success multiplies.
    np.testing.assert_allclose(value_limit(objective, value, 0.4), best, rtol=1e-12)
    assert value_limit(objective, value, 1e-13) == value
