"""The five objectives: value of a path from the team's expected trust along it."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit


class Objective(NamedTuple):
    """An objective by name, and the weight of the path's length in it."""

    name: str
    length_weight: float = 0.0
    """Cost of a metre of the path, in units of trust (or of log probability)."""


class PathTrust(NamedTuple):
    """Trust along a path and the path's length cost; leading axes (...,) such as (draw,)."""

    trust: np.ndarray
    """Expected trust of the team after each bound, shape (..., bound)."""
    steady_state: np.ndarray
    """Limit of the team's trust if it stayed in each cell, u / (1 - beta0), likewise."""
    length_cost: np.ndarray | float = 0.0
    """Length of the path times `length_weight`."""


def softplus(x: ArrayLike) -> np.ndarray:
    """log(1 + exp(x)) without overflow: -log sigma(-x)."""
    return np.logaddexp(0.0, x)


OBJECTIVES: Mapping[str, Callable[[PathTrust], np.ndarray]] = {
    "terminal": lambda path: expit(path.trust[..., -1] - path.length_cost),
    "mean": lambda path: path.trust.mean(-1) - path.length_cost,
    "success": lambda path: np.exp(-softplus(-path.trust).sum(-1)),
    "bottleneck": lambda path: path.trust.min(-1),
    "stationary": lambda path: np.exp(-softplus(-path.steady_state).sum(-1) - path.length_cost),
}
"""Value of a path, to be maximised; the length cost is the path's metres times `length_weight`.

terminal: sigma(x^K - length cost), one minus the paper's cost (6) without length cost. mean: mean
trust over the bounds, less the length cost. success: product of sigma(x^k), the probability that
every bound succeeds. bottleneck: least trust on the path. stationary: the product of sigma of each
cell's steady-state trust, independent of history, times exp(-length cost).
"""
ADDITIVE = ("terminal", "mean", "stationary")
"""Objectives that admit a length weight."""
LABELLED = ("success", "bottleneck")
"""Objectives that depend on the whole history of a path, and need beta0 >= 0."""
