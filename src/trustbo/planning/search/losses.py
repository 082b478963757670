"""Losses of a bound given the trust after it: they fall in trust."""

import math

from numba import njit

from trustbo.parallel import PART
from trustbo.planning.objectives import Objective

_part = njit(nogil=True, error_model="numpy", **PART)
LOGISTIC, CLIPPED, SOFTPLUS, LEAST, NONE, LINEAR = range(6)
"""Losses l(x) of a bound that leaves trust x: 1 - sigma(x); 1 - E[y | x], y normal around x and cut
to [0, 1]; -log sigma(x); -x, of which the largest counts and not the sum; none; and -x."""
_EXPECTED = {"identity": LINEAR, "logistic": LOGISTIC, "clipped": CLIPPED}
_LOSSES = {"success": SOFTPLUS, "bottleneck": LEAST, "terminal": NONE, "mean": LINEAR}
TINY_SD = 1e-9
"""Least sd of a rate, instead of 0."""


def loss_for(objective: Objective) -> int:
    """Loss of a bound for an objective; that of linear rates is less by 1, see `Family`."""
    if objective.name == "lost_contact":
        return _EXPECTED[objective.family.expected_rate]
    return _LOSSES[objective.name]


@_part
def loss_of(loss: int, x: float, sd: float) -> float:
    """Loss of a bound after which trust is x, of rates with that sd."""
    if loss == NONE:
        return 0.0
    if loss == LEAST or loss == LINEAR:
        return -x
    if loss == SOFTPLUS:
        return max(-x, 0.0) + math.log1p(math.exp(-abs(x)))
    return expected_loss(loss, x, sd)


@_part
def expected_loss(loss: int, x: float, sd: float) -> float:
    """1 - E[rate] of a bound with trust x: `Family.rate_moments`, one number at a time."""
    if loss == LOGISTIC:
        return 1.0 / (1.0 + math.exp(x)) if x < 700.0 else 0.0
    low, high = -x / sd, (1.0 - x) / sd
    below, above = _normal_cdf(low), _normal_cdf(-high)
    mean = x * (1.0 - below - above) + sd * (_normal_pdf(low) - _normal_pdf(high)) + above
    return 1.0 - mean


@_part
def least_slope(loss: int, lo: float, hi: float, sd: float) -> float:
    """Least fall of a loss with trust, between lo and hi: at one end, as -l' has a single mode."""
    if loss == NONE:
        return 0.0
    if loss == LEAST or loss == LINEAR:
        return 1.0
    if loss == SOFTPLUS:
        return 1.0 / (1.0 + math.exp(hi)) if hi < 700.0 else 0.0
    middle = 0.0 if loss == LOGISTIC else 0.5
    x = lo if middle - lo > hi - middle else hi
    if loss == LOGISTIC:
        p = expected_loss(loss, x, sd)
        return p * (1.0 - p)
    return max(0.0, 1.0 - _normal_cdf(-x / sd) - _normal_cdf((x - 1.0) / sd))


@_part
def joined(loss: int, so_far: float, to_come: float) -> float:
    """Losses so far and to come, together."""
    return max(so_far, to_come) if loss == LEAST else so_far + to_come


@_part
def _normal_cdf(z):
    return 0.5 * math.erfc(-z * math.sqrt(0.5))


@_part
def _normal_pdf(z):
    return math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
