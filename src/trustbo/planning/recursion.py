"""The linear recursion for expected trust, shared by all models, and its values along a path."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled, require_numbers
from trustbo.data import Cell
from trustbo.errors import TrustboError, require_kind
from trustbo.models.params import Params, check_params, require_values
from trustbo.statespace import kalman
from trustbo.workspace.moves import bounds_along


class Recursion(NamedTuple):
    """Recursion x_k = transition x_{k-1} + drift(bound) for expected trust, with x_0 = start.

    The shapes are transition (..., state, state), drift (..., state, move, row, col), start
    (..., state) and noise_sd (...,), where noise_sd is the mean over robots of the standard
    deviation of a rate given trust, including noise that robots share. Each robot
    is a state, and the team's trust is the mean of the states. If all robots have the same beta0,
    the mean trust is the only state. The drift at (move, row, col) belongs to the bound that enters
    the cell by that move; the drift is NaN if there is no such bound.
    """

    transition: np.ndarray
    drift: np.ndarray
    start: np.ndarray
    noise_sd: np.ndarray

    def flat(self) -> "Recursion":
        """Return the recursion with a leading axis (draw,), of length 1 for a single draw."""
        return self if self.start.ndim > 1 else Recursion(*(value[None] for value in self))

    def along(self, path: Sequence[Cell] | np.ndarray) -> "Recursion":
        """Return the recursion with the drift of a path's bounds, (..., state, 1, 1, bound)."""
        moves, rows, cols = bounds_along(path).T
        return self._replace(drift=self.drift[..., moves, rows, cols][..., None, None, :])

    def steady_state(self) -> np.ndarray:
        """Return the limit of the team's trust if a bound is repeated, (..., move, row, col)."""
        gain = np.linalg.inv(np.eye(self.start.shape[-1]) - self.transition)
        return np.einsum("...st,...tmrc->...mrc", gain, self.drift) / self.start.shape[-1]


def trust_recursion(
    params: Params, z: np.ndarray, x0: ArrayLike | None = None, *, by_robot: bool = False
) -> Recursion:
    """Build the recursion for expected trust from parameters with leading axes (...,).

    Args:
        params: Parameters of any model.
        z: Awareness, shape (robot, move, row, col, feature).
        x0: Expected trust before the first bound, shape (), (robot,) or (..., robot); by default
            `params.x0_mean`.
        by_robot: Whether to use one state per robot even if the team's mean would suffice.

    Raises:
        TrustboError: If the number of robots or features does not match the parameters.
    """
    n_robots = len(z)
    leading = params.leading
    space = params.state_space(n_robots)

    def of_draws(values: np.ndarray) -> np.ndarray:
        """Give values (draw, ...) the leading axes of the parameters."""
        return values.reshape((*leading, *values.shape[1:]))

    # Expected trust is x_k = A (x_{k-1} - o_{k-1}) + u_k + o_k. Inputs either all are a drift u, or
    # all are an offset o, in which case the expected state d = x - o stays 0.
    transition = of_draws(space.over_robots(n_robots))
    if not params.carried:
        transition = np.zeros_like(transition)

    start = np.asarray(params.x0_mean if x0 is None else x0, dtype=float)
    if x0 is None or not start.ndim:
        start = start[..., None]

    try:
        start = np.broadcast_to(start, (*leading, n_robots))
    except ValueError:
        raise TrustboError(
            f"x0 must be one number or have the shape {(*leading, n_robots)}, one for each robot; "
            f"got shape {start.shape}."
        ) from None

    noise_sd = of_draws(space.rate_sd.mean((1, 2)))
    if params.BY_ROBOT or by_robot:
        return Recursion(transition, drift(params, z), start, noise_sd)

    # With a common beta0, the mean trust of the robots obeys the same equation.
    if n_robots > 1:
        z = z.mean(0, keepdims=True)
    return Recursion(
        transition=transition[..., :1, :1],
        drift=drift(params, z).mean(-4, keepdims=True),  # place effects may differ between robots
        start=start.mean(-1, keepdims=True),
        noise_sd=noise_sd,
    )


def drift(params: Params, awareness: np.ndarray) -> np.ndarray:
    """Compute the drift u = sum_m beta_m z_m + b of each bound, (..., robot, move, row, col).

    The drift includes any place effects. For a path, pass parameters from `params.along(path)`.

    Args:
        params: Parameters of any model, with leading axes (...,).
        awareness: Situational awareness, shape (robot, move, row, col, feature).

    Raises:
        TrustboError: If the number of robots, features or cells does not match the parameters.
    """
    check_params(params, None if params.places else len(awareness), awareness.shape[-1])
    u = params.increments(awareness)
    b = np.asarray(params.b, dtype=float)
    if not params.BY_ROBOT and b.ndim <= len(params.leading):
        b = b[..., None]
    if b.ndim == len(params.leading) + 3:  # (..., 1, bound, robot), along a path
        return u + np.swapaxes(b[..., 0, :, :], -1, -2)[..., None, None, :]

    u += b[..., None, None, None]  # in place, because the array can be large
    for name, effect in params.places.items():
        if effect.shape[-2:] != u.shape[-2:]:
            raise TrustboError(
                f"params.{name} has the grid shape {effect.shape[-2:]}, but the awareness has "
                f"{u.shape[-2:]}. For the awareness along a path, use params.along(path)."
            )
        if name == "place":  # the effect of a cell is the same for all moves that enter it
            effect = effect[..., None, :, :]
        u = u + effect

    return u


def expected_trust(params: Params, awareness: ArrayLike, x0: ArrayLike | None = None) -> np.ndarray:
    """Compute expected trust along a path from equations (1) and (3) without noise.

    Args:
        params: Parameters of any model, with leading axes (...,) such as (draw,). With place
            effects, pass `params.along(path)`.
        awareness: Situational awareness along the path, shape (bound, robot, feature).
        x0: Expected trust before the first bound, shape (), (robot,) or (..., robot); by default
            `params.x0_mean`.

    Returns:
        Expected trust after each bound, shape (..., bound, robot).

    Raises:
        TrustboError: If the number of robots or features does not match the parameters, or place
            effects are given for the grid instead of the path.
    """
    require_kind("params", params, Params, "give parameters, such as TrustParams(...)")
    require_values(params)

    dims = ("bound", "robot", "feature")
    unnamed = {"robot": None, "feature": None}
    z = read_labelled("awareness", awareness, dims, unnamed).values
    if z.ndim != len(dims) or not z.size:
        raise TrustboError(f"awareness must have the shape (bound, robot, feature); got {z.shape}.")
    if x0 is not None:
        x0 = require_numbers("x0", x0)

    of_robots = np.swapaxes(z, 0, 1)
    return states_along(trust_recursion(params, of_robots[:, None, None], x0, by_robot=True))


def states_along(along: Recursion) -> np.ndarray:
    """Compute expected trust (..., bound, state) after each bound of `Recursion.along(path)`."""
    drift = np.moveaxis(along.drift[..., 0, 0, :], -1, 0)  # (bound, ..., state)
    trust = [along.start]
    for u in drift:
        trust.append(kalman.step(along.transition, trust[-1], u))
    return np.stack(trust[1:], axis=-2)
