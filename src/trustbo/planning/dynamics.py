"""Recursion of expected trust: one linear form for every model, and its roll along a path."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import ShapeError
from trustbo.models.params import Params, check_params
from trustbo.parallel import plain
from trustbo.workspace.moves import move_indices, moves_along

TEAMS = ("mean", "min")
"""Trust of the team: mean or least of the trust of its robots."""


class Dynamics(NamedTuple):
    """Expected trust x_k = transition x_{k-1} + drift(bound), x_0 = start; leading axes (...,).

    Fields: transition (..., state, state), drift (..., state, move, row, col), start (..., state),
    views (view, state): trust of the team is the least of `views @ x`; and noise_sd (...,), delta_v
    as the mean over robots. States are the robots; one state, their mean, suffices where all have
    one beta0 and trust of the team is the mean.

    Drift is that of the bound into (row, col) by a move of `MOVES`, of 4 or 8; the axis of moves
    has length 1 where all bounds into a cell are alike. NaN where there is no bound.
    """

    transition: np.ndarray
    drift: np.ndarray
    start: np.ndarray
    views: np.ndarray
    noise_sd: np.ndarray

    @property
    def is_scalar(self) -> bool:
        """True if the state is a single number, trust of the team."""
        return self.views.shape == (1, 1)

    def take(self, which: int | slice | np.ndarray) -> "Dynamics":
        """Select some of the draws; one, by its index, without its leading axis."""
        transition, drift, start, views, sd = self
        return Dynamics(transition[which], drift[which], start[which], views, sd[which])

    def flat(self) -> "Dynamics":
        """Reshape to exactly one leading axis (draw,), of length 1 if there is none."""

        def one(value: np.ndarray, core: int) -> np.ndarray:
            return np.reshape(value, (-1, *np.shape(value)[np.ndim(value) - core :]))

        transition, drift, start, views, sd = self
        return Dynamics(one(transition, 2), one(drift, 4), one(start, 1), views, one(sd, 0))

    def along(self, path: Sequence[Cell] | np.ndarray) -> "Dynamics":
        """Select the bounds of a path: drift (..., state, 1, 1, bound)."""
        rows, cols = np.asarray(path)[1:].T
        moves, n_moves = 0, self.drift.shape[-3]
        if n_moves > 1:
            moves = np.searchsorted(move_indices(n_moves), moves_along(path))
        return self._replace(drift=self.drift[..., moves, rows, cols][..., None, None, :])

    def steady_state(self) -> np.ndarray:
        """Limit of the team's trust if a bound were repeated, shape (..., move, row, col)."""
        if self.is_scalar:
            return self.drift[..., 0, :, :, :] / (1.0 - self.transition[..., None])
        n_states = self.start.shape[-1]
        gain = np.linalg.inv(np.eye(n_states) - self.transition)
        levels = np.einsum("vs,...st,...tmrc->...vmrc", self.views, gain, self.drift)
        return levels.min(-4)


def trust_dynamics(
    params: Params,
    awareness: ArrayLike,
    team: str = "mean",
    x0: ArrayLike | None = None,
    moves: np.ndarray | None = None,
) -> Dynamics:
    """Build the recursion of expected trust under parameters with leading axes (...,).

    Awareness has shape (robot, move, row, col, feature). Its moves are those of the drift, or
    `moves`, their indices in `MOVES[8]` (by default all), where awareness is that of cells and
    places have effects. `x0`, expected trust before the first bound, () or (robot,), with leading
    axes or not, is by default `params.x0_mean`.
    ShapeError: other numbers of robots or features.
    """
    z = np.asarray(awareness, dtype=float)
    n_robots, leading = z.shape[-5], params.leading
    start = np.asarray(params.x0_mean if x0 is None else x0, dtype=float)
    if x0 is None:
        start = start[..., None]
    elif not start.ndim:
        start = start[None]
    start = np.broadcast_to(start, (*leading, n_robots))
    sd = np.asarray(params.delta_v, dtype=float)
    sd = np.broadcast_to(sd.mean(-1) if params.BY_ROBOT else sd, leading)
    if params.BY_ROBOT or team == "min":
        views = np.eye(n_robots) if team == "min" else np.full((1, n_robots), 1.0 / n_robots)
        transition = params.expected_transition(n_robots)
        return Dynamics(transition, drift(params, z, moves), start, views, sd)
    # The mean over robots obeys the same equation.
    z = z.mean(-5, keepdims=True) if n_robots > 1 else z
    u = drift(params, z, moves).mean(-4, keepdims=True)  # robots may differ in effects of places
    start = start.mean(-1, keepdims=True)
    return Dynamics(params.expected_transition(1), u, start, np.eye(1), sd)


def drift(params: Params, awareness: ArrayLike, moves: np.ndarray | None = None) -> np.ndarray:
    """Increment of trust by one bound, u = sum_m beta_m z_m + b, (..., robot, move, row, col).

    Awareness (robot, move, row, col, feature), or with a leading axis (draw,) like the parameters'.
    Effects of places are added, those of bounds for the given `moves`, by default all; or those of
    the bounds of a path, see `Params.along`. ShapeError: other numbers of robots, features, cells
    or draws than the parameters'.
    """
    z = np.asarray(awareness, dtype=float)
    check_params(params, None if params.places else z.shape[-5], z.shape[-1])
    if z.ndim == 6 and params.leading != z.shape[:1]:
        raise ShapeError(
            f"{z.shape[0]} maps of awareness need as many draws of the parameters; got "
            f"{params.leading}."
        )
    u, b = params.increments(z), np.asarray(params.b, dtype=float)
    if not params.BY_ROBOT and b.ndim <= len(params.leading):
        b = b[..., None]
    if b.ndim == len(params.leading) + 3:  # (..., 1, bound, robot): of the bounds of a path
        return u + np.swapaxes(b[..., 0, :, :], -1, -2)[..., None, None, :]
    u += b[..., None, None, None]  # in place: over many draws and cells this is large
    for name, effect in params.places.items():
        if effect.shape[-2:] != u.shape[-2:]:
            raise ShapeError(
                f"params.{name} is of {effect.shape[-2:]} cells, the awareness of {u.shape[-2:]}. "
                "With the awareness of a path's bounds, give params.along(path)."
            )
        if name == "place":
            effect = effect[..., None, :, :]
        elif moves is not None:
            effect = effect[..., moves, :, :]
        u = u + effect
    return u


def roll_trust(params: Params, awareness: ArrayLike, x0: ArrayLike | None = None) -> np.ndarray:
    """Expected trust along a path, equations (1) and (3) without their noise.

    Args:
        params: Parameters of any model, with leading axes (...,) such as (draw,). Where places have
            effects, those of the path, `params.along(path)`.
        awareness: Shape (bound, robot, feature), or (draw, bound, robot, feature) with one for each
            draw of the parameters.
        x0: Expected trust before the first bound, shape (), (robot,) or (..., robot); by default
            `params.x0_mean`.

    Returns:
        Shape (..., bound, robot).

    Raises:
        ShapeError: The number of robots or features differs from that of the parameters, or effects
            of places are of a map, not of the path's bounds.
    """
    z = np.asarray(awareness, dtype=float)
    return roll(trust_dynamics(params, as_map(z), "min", x0))


def as_map(awareness: np.ndarray) -> np.ndarray:
    """Convert awareness of a path's bounds, (..., bound, robot, feature), to a map of one row."""
    return np.swapaxes(awareness, -3, -2)[..., None, None, :, :]


def roll(along: Dynamics) -> np.ndarray:
    """Roll the recursion along the bounds of a path (see `Dynamics.along`), (..., bound, state)."""
    transition, drift, start, *_ = along
    leading, (n_states, _, _, n_bounds) = drift.shape[:-4], drift.shape[-4:]
    trust = np.empty((*leading, n_bounds, n_states))
    _roll(
        np.broadcast_to(transition, (*leading, n_states, n_states)).reshape(-1, n_states, n_states),
        np.ascontiguousarray(drift).reshape(-1, n_states, n_bounds),
        plain(np.broadcast_to(start, (*leading, n_states)).reshape(-1, n_states)),
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
