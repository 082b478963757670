"""Place effects over a whole grid, drawn given the effects at visited places.

Effects s of unvisited cells are drawn by Matheron's rule: a prior draw over the whole grid is
corrected by kriging at the visited cells. Prior draws use the fast Fourier transform of a circulant
covariance on a torus (Dietrich and Newsam 1997). The torus is so large that correlations around it
are nearly 0. Length scales are rounded to steps of 10 %, which changes the correlation of
neighbouring cells by less than 0.01.

Effects e of unvisited bounds are drawn from the prior, except for a small share. Maps are simply
wrong about a few bounds, even where they predict no contact or whole contact. The fit cannot learn
this from the bounds that were visited, because its prior is Gaussian.

The random part of the draws is centred at 0. Therefore, the mean map is the posterior mean of the
effects, without Monte Carlo error in places that were not visited.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import xarray as xr
from scipy import fft
from scipy.linalg import cho_factor, cho_solve

from trustbo.arrays import joined_draws
from trustbo.data import is_line_of_sight
from trustbo.models.effects.effect import LEAST
from trustbo.models.effects.place import BETWEEN_POSTS, floor_of_robots, matern
from trustbo.models.robots_in_bounds import RobotsInBounds
from trustbo.models.sight_scale import scale_at, variation
from trustbo.models.visited import Visited
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVE_NAMES, for_sets

_STEP = 0.1
"""Step of log length scales."""
_LARGEST = 4.0
"""Largest length scale, in units of the grid's longer side."""
_REACH = 5.0
"""Distance in length scales at which the correlation is 0.002."""
_JITTER = 1e-9
"""Added to the correlation matrix of visited cells."""
_SHARE_WRONG = 0.05
"""Share of the draws of e in which the map is wrong about a bound."""
_SD_WRONG = 3.0
"""Scale of the half-normal size of e in these draws, in units of tau_e."""
_FIRST_SEED = 1000
"""Seed of the length scale 1. Steps of the scale can be negative, but seeds cannot."""
_CELL = ("row", "col")
"""Axes of a cell."""
_BOUND = ("move", "row", "col")
"""Axes of a bound."""


def place_group(
    draws: Mapping[str, np.ndarray],
    places: Visited,
    robots: Sequence[str],
    *,
    f_e: float,
    seed: int,
) -> xr.Dataset:
    """Build the posterior group `places`, with the effects of visited cells and bounds.

    Args:
        draws: Arrays place (chain, draw, cell), place_bound (chain, draw, bound) and place_robot
            (chain, draw, bound, robot).
        places: Visited places. If some are not on the map of the workspace, the coordinates
            `cell_map` and `bound_map` contain the numbers of the maps, 0 for the workspace.
        robots: Names of the robots.
        f_e: Floor of the scale of effects e; see `PlaceEffect`.
        seed: Random seed for the maps that `params_of` draws.
    """
    variables = {
        "place": (("chain", "draw", "cell"), draws["place"]),
        "place_bound": (("chain", "draw", "bound"), draws["place_bound"]),
        "place_robot": (("chain", "draw", "bound", "robot"), draws["place_robot"]),
    }

    n_chains, n_draws = draws["place"].shape[:2]
    coords = {
        "chain": np.arange(n_chains),
        "draw": np.arange(n_draws),
        "robot": list(robots),
        **{f"cell_{name}": ("cell", places.cells[:, i]) for i, name in enumerate(_CELL)},
        **{f"bound_{name}": ("bound", places.bounds[:, i]) for i, name in enumerate(_BOUND)},
    }
    if places.bound_map.any():
        coords["cell_map"] = "cell", places.cell_map
        coords["bound_map"] = "bound", places.bound_map
    attrs = {"shape": list(places.shape), "n_posts": places.n_posts, "f_e": f_e, "seed": seed}
    return xr.Dataset(variables, coords, attrs)


def place_maps_of(
    group: xr.Dataset, parameters: Mapping[str, np.ndarray], workspace: Workspace | None
) -> dict[str, np.ndarray]:
    """Draw the effects of all cells and bounds on the team, given the effects at visited places.

    Args:
        group: Posterior group `places`.
        parameters: Hyperparameters (draw,) by name, with chains joined.
        workspace: Workspace that predicts line of sight; without it, the scale of effects in bounds
            that were not visited is 1, and the map is not wrong about any of them.

    Returns:
        Arrays place (draw, effect, row, col) and place_bound (draw, effect, move, row, col). The
        axis `effect` has length 1. The effects of robots in bounds, which are 0 on average over the
        team, are not included; see `robots_in_bounds_of`.
    """
    group = of_workspace(group)
    rows, cols = (int(n) for n in group.attrs["shape"])
    seed = int(group.attrs["seed"])

    s = joined_draws(group["place"], ["cell"])
    cells = np.column_stack([group[f"cell_{name}"].values for name in _CELL])
    place = _cells(s, cells, (rows, cols), parameters, [seed, 0])

    # Effects of different bounds are independent, so only those of visited bounds change.
    sight = _sight(group, workspace)
    visited = _bounds(group)
    tau_e = parameters["tau_e"][:, None, None, None]
    rng = np.random.default_rng([seed, 1])
    place_bound = _of_bounds(tau_e, group.attrs["f_e"], sight, visited, rng)
    _centre(place_bound)

    e = joined_draws(group["place_bound"], ["bound"])
    if len(sight) > len(MOVE_NAMES):
        sd = np.maximum(scale_at(variation(sight), group.attrs["f_e"]) * tau_e, LEAST)
        _learn_from_other_posts(place_bound, visited, e, sd)
    place_bound[:, *visited] = e
    return {"place": place[:, None], "place_bound": place_bound[:, None]}


def robots_in_bounds_of(
    group: xr.Dataset,
    parameters: Mapping[str, np.ndarray],
    robots: Sequence[str],
    workspace: Workspace | None,
) -> RobotsInBounds:
    """Return the effects of robots in all bounds, given the effects in visited bounds.

    Args:
        group: Posterior group `places`.
        parameters: Hyperparameters (draw,) by name, with chains joined.
        workspace: See `place_maps_of`.
        robots: Names of the robots of the result. If some of them were not in the fitted missions,
            no effect is known.
    """
    group = of_workspace(group)
    rows, cols = (int(n) for n in group.attrs["shape"])
    tau_r = parameters["tau_r"]
    sight = _sight(group, workspace)

    column = np.full((len(sight), rows, cols), -1)
    known = np.zeros((len(tau_r), len(robots), 0))
    if set(robots) <= set(group["robot"].values.tolist()):
        column[*_bounds(group)] = np.arange(group.sizes["bound"])
        known = joined_draws(group["place_robot"].sel(robot=list(robots)), ["robot", "bound"])

    seed = int(group.attrs["seed"])
    return RobotsInBounds(
        known=known,
        column=column,
        tau_r=tau_r,
        scale=scale_at(variation(sight), floor_of_robots(group.attrs["f_e"])),
        number=np.arange(len(tau_r)),
        seed=seed,
    )


def _sight(group: xr.Dataset, workspace: Workspace | None) -> np.ndarray:
    """Return the mean line of sight of the robots, shape (way, row, col).

    It is 0.5, where the scale is 1, if line of sight is not predicted.
    """
    rows, cols = (int(n) for n in group.attrs["shape"])
    n_posts = int(group.attrs["n_posts"]) if workspace is None else workspace.n_posts
    n_ways = len(MOVE_NAMES) * n_posts

    sight = [] if workspace is None else [*filter(is_line_of_sight, workspace.features)]
    if workspace is None or not sight:
        return np.full((n_ways, rows, cols), 0.5)

    mean = workspace.awareness.sel(feature=sight).mean(("robot", "feature"), skipna=False)
    return np.nan_to_num(mean.values, nan=0.5)


def _of_bounds(
    tau_e: np.ndarray,
    f_e: float,
    sight: np.ndarray,
    visited: tuple[np.ndarray, ...],
    rng: np.random.Generator,
) -> np.ndarray:
    """Draw effects e (draw, way, row, col) of unvisited bounds, given the mean line of sight.

    They are normal with standard deviation g tau_e for the scale g; tau_e has one value for each
    draw. A small share of them, for which the map is wrong, are half-normal with scale 3 tau_e, and
    positive if the line of sight is below 0.5, otherwise negative. If f_e is 1, all are normal, and
    so are all in bounds that were `visited` with any set of posts.
    """
    e = rng.standard_normal((len(tau_e), *sight.shape))
    n_posts = len(sight) // len(MOVE_NAMES)
    if n_posts > 1:
        of_all = rng.standard_normal((len(tau_e), len(MOVE_NAMES), *sight.shape[1:]))
        e *= np.sqrt(1.0 - BETWEEN_POSTS)
        e += np.sqrt(BETWEEN_POSTS) * for_sets(of_all, n_posts)
    scale = scale_at(variation(sight), f_e)

    if f_e < 1.0:
        to_middle = 0.5 - sight  # 0 where line of sight is not predicted
        ways, rows, cols = visited
        is_known = np.zeros((len(MOVE_NAMES), *sight.shape[1:]), bool)
        is_known[ways % len(MOVE_NAMES), rows, cols] = True
        share = np.where(to_middle == 0.0, 0.0, _SHARE_WRONG)
        share[for_sets(is_known, n_posts)] = 0.0
        is_wrong = rng.random(e.shape, dtype=np.float32) < share
        scale = np.where(is_wrong, _SD_WRONG, scale)
        np.copysign(e, to_middle, out=e, where=is_wrong)

    e *= scale
    e *= tau_e
    return e


def _learn_from_other_posts(
    free: np.ndarray,
    visited: tuple[np.ndarray, ...],
    e: np.ndarray,
    sd: np.ndarray,
) -> None:
    """Add, in place, what visited sets of posts teach about the other sets of their bounds.

    By Matheron's rule, the draws `free` (draw, way, row, col) of unvisited ways get the kriged
    difference of the posterior draws `e` (draw, visited) from the free draws of visited ways.
    """
    _, n_ways, *grid = sd.shape
    shape = len(MOVE_NAMES), *grid
    more = np.zeros((len(e), *shape))
    n_visited = np.zeros(shape)
    for k, (way, row, col) in enumerate(zip(*visited, strict=True)):
        bound = way % len(MOVE_NAMES), row, col
        more[:, *bound] += (e[:, k] - free[:, way, row, col]) / sd[:, way, row, col]
        n_visited[bound] += 1.0

    more *= BETWEEN_POSTS / (1.0 + (n_visited - 1.0) * BETWEEN_POSTS)
    free += sd * for_sets(more, n_ways // len(MOVE_NAMES))


def in_order_of_places(group: xr.Dataset) -> xr.Dataset:
    """Return the posterior group `places` with its places in the order of `models.Visited`."""
    order = {}
    for axis, names in {"cell": _CELL, "bound": _BOUND}.items():
        keys = [group[f"{axis}_{name}"].values for name in names]
        if f"{axis}_map" in group.coords:
            keys.insert(0, group[f"{axis}_map"].values)
        by_place = np.lexsort(keys[::-1])
        if (by_place[1:] < by_place[:-1]).any():
            order[axis] = by_place
    return group.isel(order) if order else group


def of_workspace(group: xr.Dataset) -> xr.Dataset:
    """Return the posterior group `places` without places on other maps."""
    if "cell_map" not in group.coords:
        return group
    return group.isel(cell=group["cell_map"].values == 0, bound=group["bound_map"].values == 0)


def _bounds(group: xr.Dataset) -> tuple[np.ndarray, ...]:
    """Return the moves, rows and columns of the visited bounds."""
    return tuple(group[f"bound_{name}"].values for name in _BOUND)


def _cells(
    s: np.ndarray,
    cells: np.ndarray,
    shape: tuple[int, int],
    parameters: Mapping[str, np.ndarray],
    seed: list[int],
) -> np.ndarray:
    """Draw the effect (draw, row, col) over the grid, given the effect s at visited cells."""
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    mean = np.zeros((len(s), shape[0] * shape[1]))
    off = np.empty(mean.shape)
    for step, is_step, scale, weights in _kriging(parameters["length_scale"], cells, shape):
        rng = np.random.default_rng([*seed, step + _FIRST_SEED])
        free = _prior(shape, scale, int(is_step.sum()), rng) * parameters["tau_s"][is_step, None]

        # Matheron's rule: both s and a free draw are kriged from the visited cells.
        mean[is_step] = s[is_step] @ weights
        off[is_step] = free - free[:, flat] @ weights

    return (mean + _centre(off)).reshape(-1, *shape)


def _kriging(
    length_scale: np.ndarray, cells: np.ndarray, shape: tuple[int, int]
) -> Iterator[tuple[int, np.ndarray, float, np.ndarray]]:
    """Yield the index, mask of draws, length scale and kriging weights of each step of the scale.

    The weights (visited cell, grid cell) convert s at visited cells to the mean of s everywhere.
    """
    grid = np.indices(shape).reshape(2, -1).T

    # For larger length scales, the effects of all cells are nearly equal, and `_prior` is slow.
    length_scale = np.minimum(length_scale, _LARGEST * max(shape))
    steps = np.round(np.log(length_scale) / _STEP).astype(int)

    for step in np.unique(steps):
        scale = float(np.exp(_STEP * step))
        weights = np.zeros((len(cells), len(grid)))
        if len(cells):
            cross = _correlation(cells, grid, scale)
            K = _correlation(cells, cells, scale) + _JITTER * np.eye(len(cells))
            weights = cho_solve(cho_factor(K), cross)

        yield int(step), steps == step, scale, weights


def _correlation(cells: np.ndarray, others: np.ndarray, length_scale: float) -> np.ndarray:
    """Compute the correlation of s between cells (cell, 2) and others (other, 2)."""
    gap = cells[:, None].astype(float) - others[None]
    return matern(np.hypot(gap[..., 0], gap[..., 1]), length_scale)


def _prior(
    shape: tuple[int, int], length_scale: float, n: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw n random fields (n, cell) with unit variance over the grid."""
    # Around the torus, cells are at least one grid and at least the reach apart.
    reach = int(_REACH * length_scale)
    torus = [int(fft.next_fast_len(max(2 * m, m + reach), real=True) or 2 * m) for m in shape]

    # Eigenvalues of the circulant covariance (Dietrich and Newsam 1997).
    down, right = (np.minimum(np.arange(m), m - np.arange(m)) for m in torus)
    kernel = matern(np.hypot(down[:, None], right[None]), length_scale)
    spectrum = np.real(np.asarray(fft.rfft2(kernel), dtype=complex))

    white = fft.rfft2(rng.standard_normal((n, *torus)))
    field = fft.irfft2(np.sqrt(np.maximum(spectrum, 0.0)) * white, s=torus)
    return np.asarray(field)[:, : shape[0], : shape[1]].reshape(n, -1)


def _centre(draws: np.ndarray) -> np.ndarray:
    """Centre draws at 0 in place, keeping the expected variance; a single draw is unchanged."""
    n = len(draws)
    if n > 1:
        draws -= draws.mean(0)
        draws *= np.sqrt(n / (n - 1.0))
    return draws
