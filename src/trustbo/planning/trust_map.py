"""Trust map: the largest expected trust on arrival at each cell."""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.special import expit

from trustbo.data import path_text
from trustbo.models.draws import Draws
from trustbo.planning.objectives import TERMINAL, Weights, weights_of
from trustbo.planning.paths import SIMPLE_EXTRA, STEPS, AdmissiblePaths
from trustbo.planning.problem import Problem
from trustbo.planning.recursion import Recursion, states_along
from trustbo.planning.sums import best_sums
from trustbo.workspace.moves import pairs_along


def trust_map(
    problem: Problem,
    params: Draws,
    *,
    per_robot: bool = False,
    x0: ArrayLike | None = None,
    led: bool = False,
) -> xr.DataArray:
    """Compute the trust map with the axis (draw,); see `Planner.trust_map`.

    If `led`, all draws reach a cell on the path that is best under the mean of the draws. The mean
    over draws is then what is expected, while that of largest values would be too high.
    """
    recursion = problem.recursion(params, x0, by_robot=per_robot)
    if led:
        of_mean = problem.recursion(params.mean(), x0, by_robot=per_robot)
        arrays = zip(Recursion._fields[:-1], of_mean[:-1], recursion[:-1], strict=True)
        both = {name: np.concatenate([first, others]) for name, first, others in arrays}
        recursion = recursion._replace(**both)

    like = problem.paths.workspace.awareness.isel(move=0, feature=0, drop=True)
    n_states = recursion.start.shape[-1]
    if per_robot:
        robots = [_largest(problem.paths, recursion, of_one, led) for of_one in np.eye(n_states)]
        values = np.stack(robots, axis=1)
    else:
        values = _largest(problem.paths, recursion, np.full(n_states, 1.0 / n_states), led)
        like = like.isel(robot=0, drop=True)

    values = values[int(led) :]
    trust = like.expand_dims(draw=len(values)).copy(data=values)
    start = path_text([problem.paths.start])  # cell in which trust is assumed; see `plots`
    return trust.rename("trust").assign_attrs(long_name="expected trust", start=start)


def cost_of(trust: xr.DataArray) -> xr.DataArray:
    """Compute the cost f = 1 - sigma(trust) of the paper from a trust map."""
    cost = trust.copy(data=1.0 - expit(trust.values)).rename("cost")
    return cost.assign_attrs(long_name="cost 1 - sigma(trust)")


def _largest(
    paths: AdmissiblePaths, recursion: Recursion, state_weights: np.ndarray, led: bool
) -> np.ndarray:
    """Compute the largest trust, state_weights . x, on arrival at each cell, (draw, row, col).

    If `led`, it is the trust on the path that is best under the first draw.
    """
    extra = min(SIMPLE_EXTRA, paths.longest - paths.shortest)

    weights = state_weights @ recursion.transition  # (draw, state)
    beta0 = np.divide(weights, state_weights, out=np.zeros_like(weights), where=state_weights > 0.0)
    # Check whether the scalar state_weights . x has its own recursion.
    scalar = (weights == beta0.max(-1, keepdims=True) * state_weights).all()
    if scalar and (beta0 >= 0.0).all():
        drift = np.einsum("s,dsmrc->dmrc", state_weights, recursion.drift)
        sets = drift.reshape(len(drift), -1, *paths.bounds.shape).swapaxes(0, 1)
        sets = np.where(paths.bounds, sets, -np.inf)
        drift = _taken(sets, _chosen(sets, led))  # of the best posts
        start = recursion.start @ state_weights
        return best_trust(paths, extra, drift, beta0.max(-1), start, led=led)

    # Otherwise, search once for each cell.
    drift = recursion.drift.reshape(*recursion.start.shape, -1)
    values = np.full((len(drift), *paths.bounds.shape[1:]), np.nan)
    no_cost = np.zeros(drift.shape[-1])
    some = slice(1 if led else None)  # draws that choose their paths
    for row, col in np.argwhere(paths.bounds_from_start > 0).tolist():
        graph_paths = paths.to((row, col), extra)
        graph = graph_paths.graph
        weights = weights_of(TERMINAL, recursion, state_weights, graph.longest)
        searched = Weights(weights.per_bound[some], weights.constant[some], weights.scale)
        scores, found = best_sums(graph, drift[some], searched, no_cost)
        if led:
            path = graph_paths.cells(found[0])
            ways = pairs_along(path, paths.workspace.n_posts)[:, :3].T
            along = recursion._replace(drift=recursion.drift[:, :, *ways])
            scores = states_along(along)[:, -1] @ state_weights
        values[:, row, col] = scores

    values[:, *paths.start] = recursion.start @ state_weights
    return values


def _chosen(values: np.ndarray, led: bool) -> np.ndarray:
    """Return the index on the first axis of the largest values, of each draw or of the first.

    The values have the shape (choice, draw, ...).
    """
    best = values.argmax(0)
    return np.broadcast_to(best[:1], best.shape) if led else best


def _taken(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the chosen values on the first axis."""
    return np.take_along_axis(values, chosen[None], 0)[0]


def best_trust(
    paths: AdmissiblePaths,
    extra: int,
    drift: np.ndarray,
    beta0: np.ndarray,
    x0: np.ndarray,
    *,
    led: bool = False,
) -> np.ndarray:
    """Find the largest trust on arrival at each cell, for beta0 >= 0; NaN if it is unreachable.

    Paths grow by one bound per iteration. To exclude U-turns, each cell stores the largest trust,
    the move that attains it, and the largest trust after any other move.

    Args:
        paths: Admissible paths.
        extra: Number of bounds that a path to a cell may have beyond the shortest path.
        drift: Drift of each bound, shape (draw, move, row, col); NaN or minus infinity where there
            is no bound.
        beta0: Autoregressive coefficient, shape (draw,).
        x0: Trust at the start, shape (draw,).
        led: Whether all draws take the paths that are best under the first draw.

    Returns:
        Largest trust, shape (draw, row, col).
    """
    fewest = paths.bounds_from_start
    margin = ((0, 0), (0, 0), (1, 1), (1, 1))  # one cell wide, so that no index is out of range
    u = np.pad(np.where(np.isnan(drift), -np.inf, drift), margin, constant_values=-np.inf)
    n_draws, n_moves, rows, cols = u.shape
    reach = np.pad(np.where(fewest < 0, -1, fewest + extra), 1, constant_values=-1)

    start_row = paths.start[0] + 1
    start_col = paths.start[1] + 1
    top = np.full((n_draws, rows, cols), -np.inf)
    top[:, start_row, start_col] = x0
    second = top.copy()
    best = top.copy()
    by = np.full((n_draws, rows, cols), -1)
    entered = np.empty((n_moves, n_draws, rows, cols))

    for k in range(1, int(fewest.max()) + extra + 1):
        for m, step in enumerate(STEPS):
            before = np.where(by == n_moves - 1 - m, second, top)  # the reverse move is forbidden
            before = np.roll(before, step, axis=(1, 2))  # only the margin wraps around
            with np.errstate(invalid="ignore"):  # 0 times -inf, which is not used
                kept = beta0[:, None, None] * before
            carried = np.where(np.isneginf(before), before, kept)
            entered[m] = carried + u[:, m]
        entered[:, :, k > reach] = -np.inf

        by = _chosen(entered, led)
        top = _taken(entered, by)
        np.put_along_axis(entered, by[None], -np.inf, 0)
        second = _taken(entered, _chosen(entered, led))
        of_all = np.stack([best, top])
        best = _taken(of_all, _chosen(of_all, led))

    return np.where(np.isfinite(best), best, np.nan)[:, 1:-1, 1:-1]
