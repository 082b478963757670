"""Objectives: the value of a path, computed from the team's expected trust along it."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from trustbo.models.families import Family
from trustbo.planning.dynamics import Dynamics

Array = np.ndarray


def _ones(n: Array) -> Array:
    return np.ones(len(n))


def _same(score: Array) -> Array:
    return score


class Objective(NamedTuple):
    """A row of `OBJECTIVES`: how trust along a path and its tolls become its value.

    The score of a path of K bounds, with trust x_k after bound k, is

        (sum_k credit(K - k) x_k - tolls) / scale(K),

    or, for objectives `of_contact`, minus the expected lost contact and the tolls. To add an
    objective, add a row; searches and tests need no change.
    """

    name: str
    credit: Callable[[Array], Array] = _ones
    """Weight of trust after a bound as a function of the number of bounds left, both (left,)."""
    scale: Callable[[Array], Array] = _ones
    """Divisor of the sum as a function of the number of bounds of the path, both (length,)."""
    value: Callable[[Array], Array] = _same
    """Increasing function from the score to the reported value."""
    of_contact: bool = False
    """Whether the value is the expected contact given trust, which a failure reduces."""
    max_bounds: str = "shortest+2"
    """Default limit on the number of bounds."""


LOST_CONTACT = Objective("lost_contact", of_contact=True, max_bounds="shortest+4")
TERMINAL = Objective("terminal", credit=lambda left: np.where(left == 0, 1.0, 0.0), value=expit)
MEAN = Objective("mean", scale=lambda n_bounds: np.maximum(n_bounds, 1.0))
OBJECTIVES: Mapping[str, Objective] = {row.name: row for row in (LOST_CONTACT, TERMINAL, MEAN)}
"""Objectives by name; values are to be maximised.

lost_contact: minus the expected lost contact, in bounds (9 bounds with an expected rate of .9 lose
.9), minus the tolls and, where the planner has a risk, `failure_cost` times the failure
probability. terminal: sigma(trust at the goal - tolls), one minus the paper's cost (6)
without tolls. mean: mean over the bounds of trust minus the toll.
"""


class Weights(NamedTuple):
    """Weights of the drift in a score that is a sum; leading axis (draw,)."""

    per_bound: Array
    """w_j by the bounds left after a bound, (draw, left, state)."""
    constant: Array
    """Term that depends only on the number of bounds, (draw, length)."""
    scale: Array
    """Divisor of a path's sum, (length,)."""


def weights_of(objective: Objective, dynamics: Dynamics, view: Array, longest: int) -> Weights:
    """Compute the weights of the drift for paths of up to `longest` bounds.

    Unrolled, x_k = B0^k x_0 + sum_{i <= k} B0^(k - i) u_i. The team's trust is view . x, so that a
    bound with j bounds left after it has w_j = sum_{i <= j} credit(i) view . B0^(j - i), and x_0
    adds sum_k credit(K - k) view . B0^k x_0 to the sum of a path of K bounds.

    Args:
        objective: Row of `OBJECTIVES`; contact is assumed to equal trust.
        dynamics: Recursion of trust with leading axis (draw,).
        view: Weights of the states in the team's trust, (state,).
        longest: Largest number of bounds.
    """
    n = np.arange(longest + 1)
    credit = objective.credit(n)
    powers = np.empty((len(dynamics.start), longest + 1, len(view)))  # view . B0^k
    powers[:, 0] = view
    for k in range(longest):
        powers[:, k + 1] = np.einsum("ds,dst->dt", powers[:, k], dynamics.transition)
    of_start = np.einsum("dks,ds->dk", powers, dynamics.start)
    of_start[:, 0] = 0.0  # trust counts after bounds
    lags = np.tril(credit[n[:, None] - n])  # (left, lag): credit(left - lag)
    constant = of_start @ lags.T - (n if objective.of_contact else 0.0)
    return Weights(lags @ powers, constant, objective.scale(n.astype(float)))


def has_history(objective: Objective, family: Family) -> bool:
    """Return whether the loss of a bound depends on the trust with which it is entered.

    Otherwise the score is a weighted sum of drifts. B0 must be >= 0.
    """
    return objective.of_contact and family.expected_rate != "identity"


def capped(objective: Objective, family: Family, dynamics: Dynamics) -> Dynamics:
    """Cap drift and start where rates are linear in trust, so that no bound gains contact.

    u <= 1 - B0 1 and x_0 <= 1 for each state, so that trust is at most 1 if B0 >= 0, and a loop
    never increases the value. Other dynamics are returned unchanged.
    """
    if not objective.of_contact or has_history(objective, family):
        return dynamics
    most = 1.0 - dynamics.transition.sum(-1)[..., None, None, None]
    drift, start = np.minimum(dynamics.drift, most), np.minimum(dynamics.start, 1.0)
    return dynamics._replace(drift=drift, start=start)
