"""Expected information of a mission about the parameters."""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Cell
from trustbo.models.families import FAMILIES, Family
from trustbo.models.params import CoupledParams, Params
from trustbo.planning.dynamics import roll_trust
from trustbo.workspace.moves import along

GAUSSIAN = FAMILIES["gaussian"]


def information_gain(
    params: Params,
    awareness: np.ndarray,
    paths: Sequence[Sequence[Cell]],
    family: Family = GAUSSIAN,
    lag: float = 0.0,
) -> np.ndarray:
    """Expected reduction of the parameters' entropy by a mission over each path, (path,), in nats.

    Mutual information of the parameters and the contact rates of a mission, both taken as jointly
    normal: 1/2 log det(I + N^-1 C), with C the covariance over draws of the expected rates (bound,
    robot), and N the covariance of the rates' noise at the mean of the draws. Params have the axis
    (draw,), awareness of bounds (robot, move, row, col, feature), or with a leading axis (draw,).
    Rates of `family` measure trust, or, with lag 1, its change over the bound.
    """
    mean = params.mean()
    gains = []
    for path in paths:
        z = np.swapaxes(along(awareness, path), -3, -2)
        levels = _levels(params, roll_trust(params.along(path), z), lag)
        rates, _, _ = family.rate_moments(levels, _noise_sd(params))
        flat = rates.reshape(len(rates), -1)
        L = np.linalg.cholesky(rate_noise(mean, levels.mean(0), family, lag))
        white = np.linalg.solve(L, (flat - flat.mean(0)).T) / np.sqrt(len(flat))
        gains.append(0.5 * np.linalg.slogdet(np.eye(flat.shape[1]) + white @ white.T)[1])
    return np.array(gains)


def rate_noise(
    params: Params, levels: np.ndarray, family: Family = GAUSSIAN, lag: float = 0.0
) -> np.ndarray:
    """Covariance of a mission's contact rates given one draw, (bound * robot, bound * robot).

    Args:
        params: One draw of the parameters.
        levels: Expected trust, or its expected change with lag 1, shape (bound, robot); rates are
            linear in trust around it.
        family: Family of the rates.
        lag: 0 where rates measure trust, 1 where they measure its change.
    """
    n_bounds, n_robots = levels.shape
    _, slope, variance = family.rate_moments(levels, _noise_sd(params))
    covariance = trust_covariance(params, n_bounds, n_robots)
    change = np.eye(n_bounds, n_bounds + 1, 1) - lag * np.eye(n_bounds, n_bounds + 1)
    gain = slope.reshape(-1, 1) * np.kron(change, np.eye(n_robots))
    noise = np.diag(variance.ravel())
    if family is GAUSSIAN and isinstance(params, CoupledParams):
        noise = np.kron(np.eye(n_bounds), np.asarray(params.Delta_v))
    return gain @ covariance @ gain.T + noise


def trust_covariance(params: Params, n_bounds: int, n_robots: int) -> np.ndarray:
    """Covariance of trust before and after each bound given one draw, step by step and robots."""
    B0 = params.transition(n_robots)
    if isinstance(params, CoupledParams):
        Q = np.asarray(params.Delta_w)
    else:
        Q = np.eye(n_robots) * np.asarray(params.delta_w, dtype=float) ** 2
    P = np.eye(n_robots) * np.asarray(params.x0_sd, dtype=float) ** 2
    size = (n_bounds + 1) * n_robots
    covariance = np.zeros((size, size))
    for k in range(n_bounds + 1):
        if k:
            P = B0 @ P @ B0.T + Q
        here, onward = slice(k * n_robots, (k + 1) * n_robots), P
        covariance[here, here] = P
        for j in range(k + 1, n_bounds + 1):
            onward = B0 @ onward
            there = slice(j * n_robots, (j + 1) * n_robots)
            covariance[there, here], covariance[here, there] = onward, onward.T
    return covariance


def _levels(params: Params, trust: np.ndarray, lag: float) -> np.ndarray:
    """Expected trust (draw, bound, robot), or its change."""
    x0 = np.broadcast_to(np.reshape(params.x0_mean, (-1, 1, 1)), (len(trust), 1, trust.shape[2]))
    return trust - lag * np.concatenate([x0, trust[:, :-1]], axis=1)


def _noise_sd(params: Params) -> np.ndarray:
    """Standard deviation of the rates' noise, over (..., bound, robot)."""
    sd = np.asarray(params.delta_v, dtype=float)
    return sd[..., None, :] if params.BY_ROBOT else sd[..., None, None]
