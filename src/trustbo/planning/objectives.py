"""The six objectives: value of a path from the team's expected trust along it."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from trustbo.models.families import FAMILIES, Family
from trustbo.planning.dynamics import Dynamics


class Objective(NamedTuple):
    """Name of an objective, weight of the path's length in it, and the family of the rates."""

    name: str
    length_weight: float = 0.0
    """Cost of a metre of the path, in units of trust, of lost bounds or of log probability."""
    family: Family = FAMILIES["gaussian"]
    """Family of the contact rates."""
    unseen_cost: float = 0.0
    """Cost of a bound in which nobody sees anybody, in the same units as that of a metre."""

    @property
    def has_toll(self) -> bool:
        """Whether bounds cost something apart from trust, see `tolls`."""
        return self.length_weight > 0.0 or self.unseen_cost > 0.0

    @property
    def has_labels(self) -> bool:
        """Whether it depends on a path's whole history, and needs beta0 >= 0."""
        return self.name in LABELLED or (
            self.name == "lost_contact" and self.family.expected_rate != "identity"
        )

    def capped(self, dynamics: Dynamics) -> Dynamics:
        """Cap drift and start for `lost_contact` where rates are linear in trust.

        u <= 1 - B0 1 and x0 <= 1 for each state (the mean of robots alike in all, else each robot),
        so that trust is at most 1 if B0 >= 0: no bound gains contact, and a loop never pays. Other
        dynamics are returned unchanged.
        """
        if self.name != "lost_contact" or self.has_labels:
            return dynamics
        most = 1.0 - dynamics.transition.sum(-1)[..., None, None, None]
        drift, start = np.minimum(dynamics.drift, most), np.minimum(dynamics.start, 1.0)
        return dynamics._replace(drift=drift, start=start)

    def contact_lost(self, trust: np.ndarray, noise_sd: np.ndarray) -> np.ndarray:
        """Expected contact lost in each bound, 1 - E[rate], shape (..., bound).

        From the team's trust after each bound and the sd of a rate (...,). It is not negative, but
        where a linear rate of uncapped trust exceeds 1.
        """
        return 1.0 - self.family.rate_moments(trust, noise_sd[..., None])[0]


class PathTrust(NamedTuple):
    """Trust along a path and the path's toll; leading axes (...,) such as (draw,)."""

    trust: np.ndarray
    """Expected trust of the team after each bound, shape (..., bound)."""
    steady_state: np.ndarray
    """Limit of the team's trust if each bound were repeated, u / (1 - beta0), (..., bound)."""
    toll: np.ndarray | float = 0.0
    """Cost of its metres and of the time unseen, see `tolls`."""
    contact_lost: np.ndarray | float = np.nan
    """Expected contact lost in each bound, 1 - E[rate given trust], (..., bound)."""


def softplus(x: ArrayLike) -> np.ndarray:
    """log(1 + exp(x)) without overflow: -log sigma(-x)."""
    return np.logaddexp(0.0, x)


SCORES: dict[str, Callable[[PathTrust], np.ndarray]] = {
    "lost_contact": lambda path: -np.sum(path.contact_lost, axis=-1) - path.toll,
    "terminal": lambda path: path.trust[..., -1] - path.toll,
    "mean": lambda path: path.trust.mean(-1) - path.toll,
    "success": lambda path: -softplus(-path.trust).sum(-1) - path.toll,
    "bottleneck": lambda path: path.trust.min(-1),
    "stationary": lambda path: -softplus(-path.steady_state).sum(-1) - path.toll,
}
"""Score of a path, to compare it by: the larger, the better.

The value is this, its sigma (terminal) or its exp (success, stationary): these round to 1 beyond
40, and to 0 below -745, where paths still differ.
"""
OBJECTIVES: Mapping[str, Callable[[PathTrust], np.ndarray]] = SCORES | {
    "terminal": lambda path: expit(SCORES["terminal"](path)),
    "success": lambda path: np.exp(SCORES["success"](path)),
    "stationary": lambda path: np.exp(SCORES["stationary"](path)),
}
"""Value of a path, to be maximised; its toll is `length_weight` times its metres, and `unseen_cost`
times the expected time in which nobody sees anybody, in bounds.

lost_contact: minus the contact that is expected to be lost on the way, in bounds (9 bounds with an
expected rate of .9 lose .9), less the toll; where the planner has a risk, less `failure_cost` times
the chance to fail. terminal: sigma(x^K - toll), one minus the paper's cost (6) without a toll.
mean: mean trust over the bounds, less the toll. success: product of sigma(x^k), an index that
compares paths: every bound counts, and a worse one more; the probability to arrive is another,
`Plan.p_arrive`; times exp(-toll). bottleneck: least trust on the path, without a toll. stationary:
the product of sigma of each bound's steady-state trust, independent of history, times exp(-toll).
"""
ADDITIVE = ("lost_contact", "terminal", "mean", "stationary")
"""Objectives that are sums over bounds, but for `lost_contact` of other than linear rates."""
TOLLED = (*ADDITIVE, "success")
"""Objectives from which a toll is taken; a least trust is no sum that it could be added to."""
LABELLED = ("success", "bottleneck")
"""Objectives that depend on the whole history of a path, for every family of rates."""
DEFAULT_MAX_BOUNDS: Mapping[str, str | None] = {"lost_contact": "shortest+4"} | {
    name: None for name in LABELLED
}
"""Limits of objectives on the number of bounds; that of others is "shortest+2"."""
