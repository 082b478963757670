"""What a path is worth: the five objectives, from the team's expected trust along it."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit


class Aim(NamedTuple):
    """What a path should be best at."""

    objective: str
    length_weight: float = 0.0
    """What a metre of the path costs, in units of trust (or of log probability)."""


class PathTrust(NamedTuple):
    """What the value of a path is computed from; leading axes (...,) such as (draw,)."""

    trust: np.ndarray
    """The team's expected trust after each bound, shape (..., bound)."""
    settled: np.ndarray
    """The level that trust would settle at in each cell, u / (1 - beta0), likewise."""
    toll: np.ndarray | float = 0.0
    """The path's length times `length_weight`."""


def softplus(x: ArrayLike) -> np.ndarray:
    """log(1 + exp(x)) without overflow: -log sigma(-x)."""
    return np.logaddexp(0.0, x)


OBJECTIVES: Mapping[str, Callable[[PathTrust], np.ndarray]] = {
    "terminal": lambda path: expit(path.trust[..., -1] - path.toll),
    "mean": lambda path: path.trust.mean(-1) - path.toll,
    "success": lambda path: np.exp(-softplus(-path.trust).sum(-1)),
    "bottleneck": lambda path: path.trust.min(-1),
    "stationary": lambda path: np.exp(-softplus(-path.settled).sum(-1) - path.toll),
}
"""Value of a path, to be maximised; the toll is the path's metres times `length_weight`.

terminal: sigma(x^K - toll), one minus the paper's cost (6) where there is none. mean: mean trust
over the bounds, less the toll. success: product of sigma(x^k), the probability that every bound
succeeds. bottleneck: least trust on the way. stationary: as success, with the level trust would
settle at in each cell, free of history, times exp(-toll).
"""
ADDITIVE = ("terminal", "mean", "stationary")
"""The objectives that can take a length weight."""
LABELLED = ("success", "bottleneck")
"""The objectives that need the whole history of a path, and beta0 >= 0."""
