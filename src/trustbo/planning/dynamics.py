"""Recursion of expected trust: one linear form for every model, and its roll along a path."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from trustbo.errors import ShapeError
from trustbo.models.params import CoupledParams, Params, RobotParams, check_params

TEAMS = ("mean", "min")
"""Trust of the team: mean or least of the trust of its robots."""


class Dynamics(NamedTuple):
    """Expected trust x_k = transition x_{k-1} + drift(cell), x_0 = start; leading axes (...,).

    Fields: transition (..., state, state), drift (..., state, row, col), start (..., state), and
    views (view, state): trust of the team is the least of `views @ x`. States are the robots; one
    state, their mean, suffices where all have one beta0 and trust of the team is the mean.
    """

    transition: np.ndarray
    drift: np.ndarray
    start: np.ndarray
    views: np.ndarray

    @property
    def is_scalar(self) -> bool:
        """True if the state is a single number, trust of the team."""
        return self.views.shape == (1, 1)

    def take(self, which: int | slice | np.ndarray) -> "Dynamics":
        """Select some of the draws; one, by its index, without its leading axis."""
        return Dynamics(self.transition[which], self.drift[which], self.start[which], self.views)

    def flat(self) -> "Dynamics":
        """Reshape to exactly one leading axis (draw,), of length 1 if there is none."""

        def one(value: np.ndarray, core: int) -> np.ndarray:
            return value.reshape(-1, *value.shape[value.ndim - core :])

        return Dynamics(one(self.transition, 2), one(self.drift, 3), one(self.start, 1), self.views)

    def steady_state(self) -> np.ndarray:
        """Limit of the team's trust if it stayed in each cell, shape (..., row, col)."""
        if self.is_scalar:
            return self.drift[..., 0, :, :] / (1.0 - self.transition)
        n_states = self.start.shape[-1]
        gain = np.linalg.inv(np.eye(n_states) - self.transition)
        levels = np.einsum("vs,...st,...trc->...vrc", self.views, gain, self.drift)
        return levels.min(-3)


def trust_dynamics(
    params: Params, awareness: ArrayLike, team: str = "mean", x0: ArrayLike | None = None
) -> Dynamics:
    """Build the recursion of expected trust under parameters with leading axes (...,).

    Awareness has shape (robot, row, col, feature), or (draw, robot, row, col, feature) with one map
    for each draw. `x0`, expected trust before the first bound, () or (robot,), with leading axes or
    not, is by default `params.x0_mean`. ShapeError: other numbers of robots or features.
    """
    z = np.asarray(awareness, dtype=float)
    n_robots, leading = z.shape[-4], params.leading
    start = np.asarray(params.x0_mean if x0 is None else x0, dtype=float)
    if x0 is None:
        start = start[..., None]
    elif not start.ndim:
        start = start[None]
    start = np.broadcast_to(start, (*leading, n_robots))
    if isinstance(params, RobotParams | CoupledParams) or team == "min":
        views = np.eye(n_robots) if team == "min" else np.full((1, n_robots), 1.0 / n_robots)
        return Dynamics(transition(params, n_robots), drift(params, z), start, views)
    beta0 = np.asarray(params.beta0, dtype=float)[..., None, None]
    # The mean over robots obeys the same equation.
    u = drift(params, z.mean(-4, keepdims=True) if n_robots > 1 else z)
    return Dynamics(
        np.broadcast_to(beta0, (*leading, 1, 1)), u, start.mean(-1, keepdims=True), np.eye(1)
    )


def transition(params: Params, n_robots: int) -> np.ndarray:
    """B0 of equation (1), shape (..., robot, robot); diagonal where robots do not interact."""
    if isinstance(params, CoupledParams):
        return np.asarray(params.B0, dtype=float)
    beta0 = np.asarray(params.beta0, dtype=float)
    if not isinstance(params, RobotParams):
        beta0 = beta0[..., None]
    return np.broadcast_to(beta0, (*params.leading, n_robots))[..., None] * np.eye(n_robots)


def drift(params: Params, awareness: ArrayLike) -> np.ndarray:
    """Increment of trust by one bound, u = sum_m beta_m z_m + b, shape (..., robot, row, col).

    Awareness (robot, row, col, feature), or with a leading axis (draw,) like the parameters'.
    ShapeError: other numbers of robots, features or draws than the parameters'.
    """
    z = np.asarray(awareness, dtype=float)
    check_params(params, z.shape[-4], z.shape[-1])
    if z.ndim == 5 and params.leading != z.shape[:1]:
        raise ShapeError(
            f"{z.shape[0]} maps of awareness need as many draws of the parameters; got "
            f"{params.leading}."
        )
    b = np.asarray(params.b, dtype=float)
    if isinstance(params, CoupledParams):
        u = np.einsum("...mai,...ircm->...arc", np.asarray(params.B, dtype=float), z)
    elif isinstance(params, RobotParams):
        u = np.einsum("...im,...ircm->...irc", np.asarray(params.beta, dtype=float), z)
    else:
        beta = np.asarray(params.beta, dtype=float)
        u = np.tensordot(beta, z, (-1, -1)) if z.ndim == 4 else np.einsum("dm,dircm->dirc", beta, z)
        b = b[..., None]
    u += b[..., None, None]  # in place: over many draws and cells this is large
    return u


def roll_trust(params: Params, awareness: ArrayLike, x0: ArrayLike | None = None) -> np.ndarray:
    """Expected trust along a path, equations (1) and (3) without their noise.

    Args:
        params: Parameters of any model, with leading axes (...,) such as (draw,).
        awareness: Shape (bound, robot, feature), or (draw, bound, robot, feature) with one for each
            draw of the parameters.
        x0: Expected trust before the first bound, shape (), (robot,) or (..., robot); by default
            `params.x0_mean`.

    Returns:
        Shape (..., bound, robot).

    Raises:
        ShapeError: The number of robots or features differs from that of the parameters.
    """
    z = np.asarray(awareness, dtype=float)
    along = np.moveaxis(z, -3, -2)[..., None, :]  # (..., robot, bound, 1, feature): a map, one wide
    dynamics = trust_dynamics(params, along, "min", x0)
    return roll(dynamics.transition, dynamics.drift[..., 0], dynamics.start)


def roll(transition: np.ndarray, drift: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Roll the recursion: drift (..., state, bound) to x of shape (..., bound, state)."""
    leading, (n_states, n_bounds) = drift.shape[:-2], drift.shape[-2:]
    trust = np.empty((*leading, n_bounds, n_states))
    _roll(
        np.broadcast_to(transition, (*leading, n_states, n_states)).reshape(-1, n_states, n_states),
        np.ascontiguousarray(drift).reshape(-1, n_states, n_bounds),
        np.broadcast_to(start, (*leading, n_states)).reshape(-1, n_states),
        trust.reshape(-1, n_bounds, n_states),
    )
    return trust


@njit(cache=True, nogil=True)
def _roll(transition, drift, start, trust):
    for d in range(len(drift)):
        for k in range(drift.shape[2]):
            for s in range(drift.shape[1]):
                total = drift[d, s, k]
                for r in range(drift.shape[1]):
                    x = start[d, r] if k == 0 else trust[d, k - 1, r]
                    total += transition[d, s, r] * x
                trust[d, k, s] = total
