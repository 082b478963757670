"""The linear recursion for expected trust, shared by all models, and its values along a path."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled, require_numbers
from trustbo.data import Cell
from trustbo.errors import TrustboError, require_kind
from trustbo.models.draws import Draws
from trustbo.models.families import Family
from trustbo.statespace import kalman
from trustbo.workspace.moves import bounds_along


class Recursion(NamedTuple):
    """Recursion x_k = transition x_{k-1} + drift(bound) for expected trust, with x_0 = start.

    The shapes are transition (draw, state, state), drift (draw, state, move, row, col) for a map or
    (draw, state, bound) for a path, start (draw, state) and noise_sd (draw,). Here, noise_sd is the
    mean over robots of the standard deviation of a rate given trust, including the noise that
    robots share. Each robot is a state, and the team's trust is the mean of the states. If all
    robots have the same beta0, the mean trust is the only state. The drift at (move, row, col)
    belongs to the bound that enters the cell by that move; the drift is NaN if there is no such
    bound. `likelihood` is the observation family of the rates.
    """

    transition: np.ndarray
    drift: np.ndarray
    start: np.ndarray
    noise_sd: np.ndarray
    likelihood: Family

    def of_team(self) -> "Recursion":
        """Return the recursion of the mean trust of robots that obey the same equation."""
        return self._replace(
            transition=self.transition[:, :1, :1],
            drift=self.drift.mean(1, keepdims=True),
            start=self.start.mean(1, keepdims=True),
        )

    def steady_state(self) -> np.ndarray:
        """Return the limit of the team's trust if a bound is repeated, (draw, move, row, col)."""
        return self.steady_states().mean(1)

    def steady_states(self) -> np.ndarray:
        """Return the limit (I - transition)^-1 drift of each state if a bound is repeated."""
        gain = np.linalg.inv(np.eye(self.start.shape[-1]) - self.transition)
        drift = self.drift.reshape(*self.start.shape, -1)
        return (gain @ drift).reshape(self.drift.shape)


def trust_recursion(
    draws: Draws,
    awareness: np.ndarray,
    x0: ArrayLike | None = None,
    *,
    bounds: np.ndarray | None = None,
    by_robot: bool = False,
) -> Recursion:
    """Build the recursion for expected trust from draws.

    Args:
        draws: Draws of the parameters of any model.
        awareness: Awareness of all bounds of a map, or of `bounds` (see `Draws.inputs`).
        x0: Expected trust before the first bound, shape (), (robot,) or (draw, robot); by default
            `draws.x0_mean`.
        bounds: Moves, rows and columns (bound, 3) of the bounds of a path, or None for a map.
        by_robot: Whether to use one state per robot even if the team's mean would suffice.

    Raises:
        TrustboError: If the number of robots or features does not match the parameters.
    """
    n_robots = len(awareness)
    n_draws = draws.n_draws
    draws.require_valid(n_robots, awareness.shape[-1])
    if bounds is None:
        draws.require_grid(awareness.shape[-3:-1])
    space = draws.state_space(n_robots)

    # Expected trust is x_k = A (x_{k-1} - o_{k-1}) + u_k + o_k. Either all inputs are drifts u, or
    # all inputs are offsets o. In the second case, the expected state d = x - o stays 0.
    transition = space.over_robots(n_robots)
    if not draws.carried:
        transition = np.zeros_like(transition)

    if x0 is not None:
        start = np.asarray(x0, dtype=float)
    elif draws.carried:  # the robots of a NumPyro function may differ
        start = space.initial_mean.reshape(n_draws, -1)
    else:
        start = draws.initial_offset[:, None]

    try:
        start = np.broadcast_to(start, (n_draws, n_robots))
    except ValueError:
        raise TrustboError(
            f"x0 must be one number or have the shape {(n_draws, n_robots)}, one for each robot; "
            f"got shape {start.shape}."
        ) from None

    noise_sd = space.rate_sd.mean((1, 2))
    if draws.by_robot or by_robot:
        drift = draws.inputs(awareness, bounds)
        drift = np.broadcast_to(drift, (n_draws, n_robots, *drift.shape[2:]))
        return Recursion(transition, drift, start, noise_sd, draws.likelihood)

    # With a common beta0, the mean trust of the robots obeys the same equation.
    return Recursion(
        transition=transition[:, :1, :1],
        drift=draws.team_inputs(awareness, bounds),
        start=start.mean(-1, keepdims=True),
        noise_sd=noise_sd,
        likelihood=draws.likelihood,
    )


def expected_trust(
    params: Draws,
    awareness: ArrayLike,
    x0: ArrayLike | None = None,
    *,
    path: Sequence[Cell] | np.ndarray | None = None,
) -> np.ndarray:
    """Compute expected trust along a path from equations (1) and (3) without noise.

    Args:
        params: Parameters of any model.
        awareness: Situational awareness along the path, shape (bound, robot, feature).
        x0: Expected trust before the first bound, shape (), (robot,) or (draw, robot); by default
            `params.x0_mean`.
        path: Cells of the path, beginning with the start; needed with place effects.

    Returns:
        Expected trust after each bound, shape (draw, bound, robot).

    Raises:
        TrustboError: If the number of robots or features does not match the parameters; the path
            has the wrong length; or there are place effects but no path is given.

    Example:
        >>> awareness = workspace.along(path)
        >>> tb.planning.expected_trust(params, awareness, path=path).mean(axis=0)  # (bound, robot)
    """
    require_kind("params", params, Draws, "give parameters, such as TrustParams(...)")
    dims = ("bound", "robot", "feature")
    names = {"robot": params.robots or None, "feature": params.features or None}
    z = read_labelled("awareness", awareness, dims, names).values
    if z.ndim != len(dims) or not z.size:
        raise TrustboError(f"awareness must have the shape (bound, robot, feature); got {z.shape}.")
    if x0 is not None:
        x0 = require_numbers("x0", x0)

    bounds = np.full((len(z), 3), -1)
    if path is not None:
        bounds = bounds_along(path)
    elif params.grid_shape is not None:
        raise TrustboError("the parameters have place effects; give the cells with path=.")
    if len(bounds) != len(z):
        raise TrustboError(
            f"path must have {len(z) + 1} cells for {len(z)} bounds; got {len(bounds) + 1}."
        )

    of_robots = np.swapaxes(z, 0, 1)
    return states_along(trust_recursion(params, of_robots, x0, bounds=bounds, by_robot=True))


def states_along(along: Recursion) -> np.ndarray:
    """Compute expected trust (draw, bound, state) after each bound of a path."""
    drift = np.moveaxis(along.drift, -1, 0)  # (bound, draw, state)
    trust = [along.start]
    for u in drift:
        trust.append(kalman.step(along.transition, trust[-1], u))
    return np.stack(trust[1:], axis=1)
