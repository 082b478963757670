"""Recursion of expected trust: one linear form for every model, rolled out along a path."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.models.params import Params, check_params
from trustbo.workspace.moves import bounds_along


class Dynamics(NamedTuple):
    """Expected trust x_k = transition x_{k-1} + drift(bound), x_0 = start; leading axes (...,).

    Fields: transition (..., state, state), drift (..., state, move, row, col), start (..., state)
    and noise_sd (...,), the mean of delta_v over robots. States are the robots, and the team's
    trust is their mean; if all robots have the same beta0, this mean is the only state.

    The drift at (move, row, col) belongs to the bound that enters the cell by that move; NaN if
    none.
    """

    transition: np.ndarray
    drift: np.ndarray
    start: np.ndarray
    noise_sd: np.ndarray

    def flat(self) -> "Dynamics":
        """Return the dynamics with a leading axis (draw,), of length 1 if there was none."""
        return self if self.start.ndim > 1 else Dynamics(*(value[None] for value in self))

    def along(self, path: Sequence[Cell] | np.ndarray) -> "Dynamics":
        """Select the bounds of a path: drift (..., state, 1, 1, bound)."""
        moves, rows, cols = bounds_along(path).T
        return self._replace(drift=self.drift[..., moves, rows, cols][..., None, None, :])

    def settled(self) -> np.ndarray:
        """Return the limit of the team's trust if a bound were repeated, (..., move, row, col)."""
        gain = np.linalg.inv(np.eye(self.start.shape[-1]) - self.transition)
        return np.einsum("...st,...tmrc->...mrc", gain, self.drift) / self.start.shape[-1]


def trust_dynamics(
    params: Params, z: np.ndarray, x0: ArrayLike | None = None, *, by_robot: bool = False
) -> Dynamics:
    """Build the recursion of expected trust under parameters with leading axes (...,).

    Args:
        params: Parameters of any model.
        z: Awareness, shape (robot, move, row, col, feature).
        x0: Expected trust before the first bound, () or (robot,), with leading axes or not; by
            default `params.x0_mean`.
        by_robot: Whether each robot is a state even where the mean would suffice.

    Raises:
        TrustboError: If the parameters have another number of robots or features.
    """
    n_robots, leading = len(z), params.leading
    start = np.asarray(params.x0_mean if x0 is None else x0, dtype=float)
    if x0 is None or not start.ndim:
        start = start[..., None]
    start = np.broadcast_to(start, (*leading, n_robots))
    sd = np.asarray(params.delta_v, dtype=float)
    sd = np.broadcast_to(sd.mean(-1) if params.BY_ROBOT else sd, leading)
    if params.BY_ROBOT or by_robot:
        return Dynamics(params.expected_transition(n_robots), drift(params, z), start, sd)
    # The mean over robots obeys the same equation.
    z = z.mean(0, keepdims=True) if n_robots > 1 else z
    u = drift(params, z).mean(-4, keepdims=True)  # robots may differ in effects of places
    return Dynamics(params.expected_transition(1), u, start.mean(-1, keepdims=True), sd)


def drift(params: Params, awareness: np.ndarray) -> np.ndarray:
    """Compute the drift u = sum_m beta_m z_m + b of each bound, (..., robot, move, row, col).

    It includes the effects of places, or of the bounds of a path, see `ParameterDraws.along`.

    Args:
        params: Parameters of any model, with leading axes (...,).
        awareness: Shape (robot, move, row, col, feature).

    Raises:
        TrustboError: If the numbers of robots, features or cells differ from the parameters.
    """
    check_params(params, None if params.places else len(awareness), awareness.shape[-1])
    u, b = params.increments(awareness), np.asarray(params.b, dtype=float)
    if not params.BY_ROBOT and b.ndim <= len(params.leading):
        b = b[..., None]
    if b.ndim == len(params.leading) + 3:  # (..., 1, bound, robot): of the bounds of a path
        return u + np.swapaxes(b[..., 0, :, :], -1, -2)[..., None, None, :]
    u += b[..., None, None, None]  # in place: over many draws and cells this is large
    for name, effect in params.places.items():
        if effect.shape[-2:] != u.shape[-2:]:
            raise TrustboError(
                f"params.{name} has {effect.shape[-2:]} cells, the awareness of {u.shape[-2:]}. "
                "With the awareness of a path's bounds, give params.along(path)."
            )
        u = u + (effect[..., None, :, :] if name == "place" else effect)
    return u


def roll_trust(params: Params, awareness: ArrayLike, x0: ArrayLike | None = None) -> np.ndarray:
    """Compute expected trust along a path, equations (1) and (3) without their noise.

    Args:
        params: Parameters of any model, with leading axes (...,) such as (draw,). With place
            effects, pass `params.along(path)`.
        awareness: Shape (bound, robot, feature).
        x0: Expected trust before the first bound, shape (), (robot,) or (..., robot); by default
            `params.x0_mean`.

    Returns:
        Shape (..., bound, robot).

    Raises:
        TrustboError: If the number of robots or features differs from the parameters, or place
            effects are given for a map instead of the path's bounds.
    """
    of_robots = np.swapaxes(np.asarray(awareness, dtype=float), 0, 1)
    return roll(trust_dynamics(params, of_robots[:, None, None], x0, by_robot=True))


def roll(along: Dynamics) -> np.ndarray:
    """Roll the recursion along the bounds of a path (see `Dynamics.along`), (..., bound, state)."""
    drift = np.moveaxis(along.drift[..., 0, 0, :], -1, 0)  # (bound, ..., state)
    trust = [along.start]
    for u in drift:
        trust.append((along.transition @ trust[-1][..., None])[..., 0] + u)
    return np.stack(trust[1:], axis=-2)
