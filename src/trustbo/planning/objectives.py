"""Objectives, which compute the value of a path from the team's expected trust along it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from trustbo.models.families import Family
from trustbo.planning.recursion import Recursion

Array = np.ndarray


def _ones(n: Array) -> Array:
    return np.ones(len(n))


def _same(score: Array) -> Array:
    return score


class Objective(NamedTuple):
    """Definition of a path's value from the trust along the path and the costs of its bounds.

    The score of a path of K bounds, with trust x_k after bound k, is

        (sum_k credit(K - k) x_k - bound costs) / scale(K),

    or, if `of_contact` is True, minus the sum of the expected lost contact and the bound costs. To
    add an objective, add an entry to `OBJECTIVES`; the searches need no change.
    """

    name: str
    credit: Callable[[Array], Array] = _ones
    """Weight of the trust after a bound, as a function of the number of bounds left."""
    scale: Callable[[Array], Array] = _ones
    """Divisor of the sum, as a function of the number of bounds of the path."""
    value: Callable[[Array], Array] = _same
    """Increasing function that maps the score to the reported value."""
    of_contact: bool = False
    """Whether the value measures expected contact. If so, failures have a cost in bounds."""
    max_bounds: str = "shortest+2"
    """Default limit on the number of bounds."""


LOST_CONTACT = Objective("lost_contact", of_contact=True, max_bounds="shortest+4")
TERMINAL = Objective("terminal", credit=lambda left: np.where(left == 0, 1.0, 0.0), value=expit)
MEAN = Objective("mean", scale=lambda n_bounds: np.maximum(n_bounds, 1.0))
OBJECTIVES: dict[str, Objective] = {row.name: row for row in (LOST_CONTACT, TERMINAL, MEAN)}
"""Objectives, keyed by name; larger values are better.

lost_contact: minus the sum of the expected lost contact in bounds, the bound costs and, if the
planner has a risk, `failure_cost` times the failure probability. With an expected contact rate of
0.9, a path of 9 bounds loses 0.9 bounds. terminal: sigma(trust at the goal - bound costs); without
bound costs, the value is one minus the cost (6) of the paper. mean: the mean over bounds of trust
minus bound costs.
"""


class Weights(NamedTuple):
    """Weights of the drifts in the score of a path, if the score is a sum over bounds."""

    per_bound: Array
    """Weight w_j of a bound with j bounds left after it, shape (draw, n_bounds_left, state)."""
    constant: Array
    """Term of the score that depends only on the number of bounds, shape (draw, length)."""
    scale: Array
    """Divisor of the sum over the bounds of a path, shape (length,)."""


def weights_of(
    objective: Objective, recursion: Recursion, state_weights: Array, longest: int
) -> Weights:
    """Compute the weights of the drifts in the score of paths of up to `longest` bounds.

    The recursion unrolls to x_k = B0^k x_0 + sum_{i <= k} B0^(k - i) u_i, and the team's trust is
    s . x, where s are the `state_weights`. Therefore, w_j = sum_{i <= j} credit(i) s . B0^(j - i)
    for a bound with j bounds left after it. In a path of K bounds, x_0 adds
    sum_{1 <= k <= K} credit(K - k) s . B0^k x_0.

    Args:
        objective: One of the objectives in `OBJECTIVES`. For lost_contact, the expected contact
            rate is assumed to equal trust.
        recursion: Recursion for trust, with leading axis (draw,).
        state_weights: Weights of the states in the team's trust, shape (state,).
        longest: Largest number of bounds of a path.
    """
    n = np.arange(longest + 1)
    n_draws = len(recursion.start)
    powers = np.empty((n_draws, longest + 1, len(state_weights)))  # s . B0^k
    powers[:, 0] = state_weights
    for k in range(longest):
        powers[:, k + 1] = np.einsum("ds,dst->dt", powers[:, k], recursion.transition)

    of_start = np.einsum("dks,ds->dk", powers, recursion.start)
    of_start[:, 0] = 0.0  # trust counts only after a bound

    credit = objective.credit(n)
    lags = np.tril(credit[n[:, None] - n])  # (n_bounds_left, lag): credit(n_bounds_left - lag)
    constant = of_start @ lags.T
    if objective.of_contact:  # lost contact is one minus the contact rate of each bound
        constant = constant - n

    return Weights(lags @ powers, constant, objective.scale(n.astype(float)))


def has_history(objective: Objective, likelihood: Family) -> bool:
    """Return whether the objective is a nonlinear function of trust.

    If so, the search has to keep track of trust and requires B0 >= 0. Otherwise, the score of a
    path is a weighted sum of the drifts of its bounds.
    """
    return objective.of_contact and likelihood.expected_rate != "identity"


def capped(objective: Objective, recursion: Recursion) -> Recursion:
    """Cap the drift and the initial trust, so that trust never exceeds 1 and no rate exceeds 1.

    If the drift of each state is at most 1 minus the row sum of B0, B0 >= 0 and x_0 <= 1, trust is
    at most 1. A loop then never increases the value. The cap is needed only for lost_contact with
    rates that are linear in trust; otherwise, the recursion is returned unchanged.
    """
    if not objective.of_contact or has_history(objective, recursion.likelihood):
        return recursion

    most = 1.0 - recursion.transition.sum(-1)
    most = np.expand_dims(most, tuple(range(2, recursion.drift.ndim)))  # axes of bounds
    return recursion._replace(
        drift=np.minimum(recursion.drift, most),
        start=np.minimum(recursion.start, 1.0),
    )
