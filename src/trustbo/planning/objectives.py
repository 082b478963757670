"""What a path is worth: expected trust along it, and the five objectives made of that."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from trustbo.models import TrustParams
from trustbo.models.params import check_params


def roll_trust(
    params: TrustParams, awareness: ArrayLike, x0: ArrayLike | None = None
) -> np.ndarray:
    """Expected trust along a path, equation (3) without its noise.

    Args:
        params: Parameters, each with leading axes (...,) such as (draw,).
        awareness: Shape (bound, robot, feature).
        x0: Expected trust before the first bound, shape () or (...,); by default `params.x0_mean`.

    Returns:
        Shape (..., bound, robot).

    Raises:
        ShapeError: The number of features differs from that of `params.beta`.
    """
    u = drift(params, awareness)
    x = np.asarray(params.x0_mean if x0 is None else x0, dtype=float)[..., None]
    beta0 = np.asarray(params.beta0, dtype=float)[..., None]
    trust = np.empty(u.shape)
    for k in range(u.shape[-2]):
        x = beta0 * x + u[..., k, :]
        trust[..., k, :] = x
    return trust


def drift(params: TrustParams, awareness: ArrayLike) -> np.ndarray:
    """U = beta . z + b, what one bound adds to trust.

    Args:
        params: Parameters with leading axes (...,).
        awareness: Shape (*place, feature).

    Returns:
        Shape (..., *place).

    Raises:
        ShapeError: The number of features differs from that of `params.beta`.
    """
    z, beta = np.asarray(awareness, dtype=float), np.asarray(params.beta, dtype=float)
    check_params(params, None, z.shape[-1])
    b = np.asarray(params.b, dtype=float)
    return np.tensordot(beta, z, (-1, -1)) + b.reshape(b.shape + (1,) * (z.ndim - 1))


class PathTrust(NamedTuple):
    """What the value of a path is computed from, each of shape (bound,)."""

    trust: np.ndarray
    """The team's expected trust after each bound."""
    stationary: np.ndarray
    """The level that trust would settle at in each cell, u / (1 - beta0)."""


def softplus(x: ArrayLike) -> np.ndarray:
    """log(1 + exp(x)) without overflow: -log sigma(-x)."""
    return np.logaddexp(0.0, x)


OBJECTIVES: Mapping[str, Callable[[PathTrust], float]] = {
    "terminal": lambda path: float(expit(path.trust[-1])),
    "mean": lambda path: float(path.trust.mean()),
    "success": lambda path: float(np.exp(-softplus(-path.trust).sum())),
    "bottleneck": lambda path: float(path.trust.min()),
    "stationary": lambda path: float(np.exp(-softplus(-path.stationary).sum())),
}
"""Value of a path, to be maximised.

terminal: sigma(x^K), one minus the paper's cost (6). mean: mean trust over the bounds. success:
product of sigma(x^k), the probability that every bound succeeds. bottleneck: least trust on the
way. stationary: as success, with the level trust would settle at in each cell, free of history.
"""
