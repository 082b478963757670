"""Stationary trust in each robot at each cell, from posterior draws of any model.

If a bound were repeated without end, expected trust x_k = B0 x_{k-1} + u would converge to the
stationary trust (I - B0)^-1 u. This is the trust that the place itself justifies: the trust with
which the path arrives no longer has any influence. The stationary trust of a robot at a cell is the
mean over the bounds that enter the cell.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import POST_SETS
from trustbo.errors import TrustboError, require_choice, warn
from trustbo.models.draws import Draws
from trustbo.planning.recursion import trust_recursion
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Location
from trustbo.workspace.moves import MOVE_NAMES

_NUMBERS = 2_000_000
"""Largest number of values (draw, robot, bound) that are computed at once."""


class Bounds(NamedTuple):
    """Bounds over which trust is averaged.

    Attributes:
        workspace: Workspace of the bounds.
        which: Ways, rows and columns, shape (bound, 3).
        awareness: Awareness of the bounds, shape (robot, bound, feature).
        target: Index of the place to which the mean over bounds is assigned, shape (bound,).
        n_targets: Number of places, such as the cells of the map.
    """

    workspace: Workspace
    which: np.ndarray
    awareness: np.ndarray
    target: np.ndarray
    n_targets: int

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Average values (..., bound) over the bounds of each place; NaN where there is none."""
        count = np.bincount(self.target, minlength=self.n_targets)
        total = np.zeros((*values.shape[:-1], self.n_targets))
        for move in np.unique(self.which[:, 0]):  # no two bounds of a move enter the same cell
            of_move = self.which[:, 0] == move
            total[..., self.target[of_move]] += values[..., of_move]

        with np.errstate(invalid="ignore"):
            return total / count


def robot_trust(
    workspace: Workspace,
    draws: Draws,
    robot: str | None = None,
    cell: Location | None = None,
    *,
    move: str | None = None,
    posts: str = POST_SETS[0],
    as_rate: bool = False,
) -> xr.DataArray:
    """Compute stationary trust in robots at cells; see `Planner.trust`."""
    names = workspace.team.names
    if robot is not None:
        require_choice("robot", robot, names)
    bounds = _bounds_of(workspace, cell, move, posts)

    chosen = list(names) if robot is None else [robot]
    index = [names.index(name) for name in chosen]
    means = []
    for part, trust in _stationary(bounds, draws):
        of_bounds = _rate_of(trust, part) if as_rate else trust
        means.append(bounds.mean(of_bounds)[:, index])
    values = np.concatenate(means)
    _warn_of_draws(np.isnan(values).all((1, 2)))

    like = workspace.passable
    if cell is None:
        values = values.reshape(*values.shape[:2], *like.shape)
        coords = dict(like.coords)
        dims = ("draw", "robot", "row", "col")
    else:
        values = values[..., 0]
        row, col = bounds.which[0, 1:].tolist()
        coords = dict(like[row, col].coords)
        dims = ("draw", "robot")

    trust = xr.DataArray(values, {"robot": chosen, **coords}, dims)
    if draws.n_draws == 1:
        trust = trust.isel(draw=0)
    if robot is not None:
        trust = trust.sel(robot=robot)
    if as_rate:
        return trust.rename("contact_rate").assign_attrs(long_name="expected contact rate")
    return trust.rename("trust").assign_attrs(long_name="stationary trust")


def robot_maps(workspace: Workspace, draws: Draws) -> xr.Dataset:
    """Summarise stationary trust in each robot over draws; see `Planner.robot_maps`."""
    bounds = _bounds_of(workspace, None, None, POST_SETS[0])
    shape = (workspace.team.n_robots, bounds.n_targets)
    first = None
    total = np.zeros(shape)
    squares = np.zeros(shape)
    rates = np.zeros(shape)
    diverging = []

    # Sums of deviations from the first draw need one map per robot in memory, and avoid
    # cancellation.
    for part, of_bounds in _stationary(bounds, draws):
        trust = bounds.mean(of_bounds)
        rate = bounds.mean(_rate_of(of_bounds, part))

        is_diverging = np.isnan(trust).all((1, 2))
        diverging.append(is_diverging)
        kept = trust[~is_diverging]
        if first is None and len(kept):
            first = kept[0]
        if len(kept):
            total += (kept - first).sum(0)
            squares += ((kept - first) ** 2).sum(0)
            rates += rate[~is_diverging].sum(0)

    is_diverging = np.concatenate(diverging)
    _warn_of_draws(is_diverging)  # raises an error if no draws are left
    n = (~is_diverging).sum()
    shift = total / n
    maps = {
        "trust_mean": (first + shift, "mean stationary trust"),
        "trust_sd": (np.sqrt(np.maximum(squares / n - shift**2, 0.0)), "sd of stationary trust"),
        "contact_rate": (rates / n, "mean expected contact rate"),
    }

    like = workspace.passable
    dims = ("robot", *like.dims)
    coords = {"robot": list(workspace.team.names), **like.coords}
    dataset = xr.Dataset(coords=coords)
    for name, (values, text) in maps.items():
        dataset[name] = dims, values.reshape(-1, *like.shape), {"long_name": text}
    return workspace.grid.place(dataset)


def _bounds_of(workspace: Workspace, cell: Location | None, move: str | None, posts: str) -> Bounds:
    """Find the bounds that enter a cell (or any cell) by a move (or by any move).

    Raises:
        TrustboError: If the move or the set of posts is unknown, the cell is off the grid or
            impassable, or no such bound enters the cell.
    """
    require_choice("posts", posts, workspace.post_sets)
    exists = workspace.passable_bounds.values
    if move is not None:
        require_choice("move", move, MOVE_NAMES)
        is_move = np.array(MOVE_NAMES) == move
        exists = exists & is_move[:, None, None]

    entered = "any cell"
    if cell is not None:
        row, col = workspace.locate(cell, "cell")
        entered = f"the cell {(row, col)}"
        is_entered = np.zeros(exists.shape[1:], bool)
        is_entered[row, col] = True
        exists = exists & is_entered

    which = np.argwhere(exists)
    if not len(which):
        by = "" if move is None else f" by the move {move!r}"
        raise TrustboError(f"no bound enters {entered}{by}.")

    target = np.zeros(len(which), int)
    n_targets = 1
    if cell is None:
        target = which[:, 1] * exists.shape[2] + which[:, 2]  # flat index of the cell
        n_targets = exists[0].size

    which[:, 0] += len(MOVE_NAMES) * POST_SETS.index(posts)
    awareness = workspace.awareness.values[:, *which.T]
    return Bounds(workspace, which, awareness, target, n_targets)


def _stationary(bounds: Bounds, draws: Draws) -> Iterator[tuple[Draws, np.ndarray]]:
    """Yield chunks of draws with the stationary trust (draw, robot, bound) under these draws.

    Trust is NaN for draws in which it diverges.
    """
    draws.require_grid(bounds.workspace.grid.shape)
    size = max(1, _NUMBERS // bounds.awareness[..., 0].size)
    for first in range(0, draws.n_draws, size):
        part = draws.draw(slice(first, first + size))
        recursion = trust_recursion(part, bounds.awareness, bounds=bounds.which, by_robot=True)

        radius = np.abs(np.linalg.eigvals(recursion.transition)).max(-1)
        diverges = (radius >= 1.0)[:, None, None]
        recursion = recursion._replace(transition=np.where(diverges, 0.0, recursion.transition))
        yield part, np.where(diverges, np.nan, recursion.steady_states())


def _rate_of(trust: np.ndarray, draws: Draws) -> np.ndarray:
    """Compute the expected contact rate, limited to [0, 1], at trust (draw, robot, bound)."""
    space = draws.state_space(trust.shape[1])
    sd = space.rate_sd.reshape(len(trust), -1)  # (draw, robot), or one for all robots
    return np.clip(draws.likelihood.mean_rate(trust, sd[:, :, None]), 0.0, 1.0)


def _warn_of_draws(diverging: np.ndarray) -> None:
    """Warn about draws without stationary trust; raise TrustboError if there are no others."""
    n = int(diverging.sum())
    if not n:
        return

    reason = "abs(beta0) >= 1, or an eigenvalue of B0 outside the unit circle"
    if n == len(diverging):
        raise TrustboError(f"there is no stationary trust: all draws have {reason}.")
    warn(
        f"{n} of {len(diverging)} draws have no stationary trust ({reason}); they are NaN or, in "
        "maps, left out."
    )
