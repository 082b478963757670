"""Expected information of a mission about the parameters."""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Cell
from trustbo.models.params import CoupledParams, Params
from trustbo.planning.dynamics import roll_trust, transition


def information_gain(
    params: Params, awareness: np.ndarray, paths: Sequence[Sequence[Cell]]
) -> np.ndarray:
    """Expected reduction of the parameters' entropy by a mission over each path, (path,), in nats.

    Mutual information of the parameters and the contact rates of a mission, both taken as jointly
    normal: 1/2 log det(I + N^-1 C), with C the covariance over draws of the expected rates (bound,
    robot), and N the covariance of the rates' noise at the mean of the draws. Params have the axis
    (draw,), awareness (robot, row, col, feature), or with a leading axis (draw,).
    """
    n_robots = awareness.shape[-4]
    mean = params.mean()
    longest = max(map(len, paths)) - 1
    noise = rate_noise(mean, longest, n_robots)
    gains = []
    for path in paths:
        along = awareness[..., *np.array(path[1:]).T, :]
        rates = roll_trust(params, np.swapaxes(along, -3, -2))
        flat = rates.reshape(len(rates), -1)
        n = flat.shape[1]
        # The noise of a shorter mission is the leading block of that of a longer one.
        L = np.linalg.cholesky(noise[:n, :n])
        white = np.linalg.solve(L, (flat - flat.mean(0)).T) / np.sqrt(len(flat))
        gains.append(0.5 * np.linalg.slogdet(np.eye(n) + white @ white.T)[1])
    return np.array(gains)


def rate_noise(params: Params, n_bounds: int, n_robots: int) -> np.ndarray:
    """Covariance of a mission's contact rates given one draw, (bound * robot, bound * robot)."""
    B0 = transition(params, n_robots)
    if isinstance(params, CoupledParams):
        Q, R = np.asarray(params.Delta_w), np.asarray(params.Delta_v)
    else:
        Q, R = (
            np.eye(n_robots) * np.asarray(sd, dtype=float) ** 2
            for sd in (params.delta_w, params.delta_v)
        )
    P = np.eye(n_robots) * np.asarray(params.x0_sd, dtype=float) ** 2
    size = n_bounds * n_robots
    covariance = np.zeros((size, size))
    for k in range(n_bounds):
        P = B0 @ P @ B0.T + Q
        here, onward = slice(k * n_robots, (k + 1) * n_robots), P
        covariance[here, here] = P + R
        for j in range(k + 1, n_bounds):
            onward = B0 @ onward
            there = slice(j * n_robots, (j + 1) * n_robots)
            covariance[there, here], covariance[here, there] = onward, onward.T
    return covariance
