"""Effects of places over a whole grid: draws given those at visited places.

s at the other cells by Matheron's rule: a draw of the prior over the whole grid, corrected by
kriging at the visited cells. Prior draws are made by the fast Fourier transform of a circulant
covariance (Dietrich and Newsam 1997), on a torus so large that the correlation is all but 0 half
way round. e at the other bounds has its prior. Length scales are rounded to steps of 10 %, which
changes the correlation of neighbouring cells by less than .01.

The random part has mean 0 over the draws, so that the mean of the maps is the posterior mean of the
effects, without Monte Carlo error where nothing was measured.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import xarray as xr
from scipy import fft
from scipy.linalg import cho_factor, cho_solve

from trustbo.errors import TrustboError, require_kind
from trustbo.models.visited import N_MOVES, Visited, correlation, matern
from trustbo.parallel import one_blas_thread
from trustbo.workspace.moves import MOVE_NAMES, existing_bounds

_STEP = 0.1  # of the logarithm of length scales
_LARGEST = 4.0  # length scale in units of the grid's longer side
_REACH = 5.0  # length scales at which the correlation is .002
_JITTER = 1e-9
_AXIS = {"place": "cell", "place_bound": "bound"}
_MOMENTS = "mean", "standard deviation of the"
_OF_CELL, _OF_BOUND = ("effect", "row", "col"), ("effect", "move", "row", "col")


Scales = Mapping[str, np.ndarray]
"""Hyperparameters of places by name, each (draw,)."""


def draw_maps(
    scales: Scales, places: Visited, visited: Mapping[str, np.ndarray], seed: int
) -> dict[str, np.ndarray]:
    """Draw the effects of all cells and bounds given those of visited places.

    Args:
        scales: Hyperparameters of each draw.
        places: Visited places, the grid's shape among them.
        visited: Effects `place` (draw, cell) and `place_bound` (draw, unit), as the model has them.
        seed: Seed of the effects of places not visited.

    Returns:
        place (draw, effect, row, col) and place_bound (draw, effect, move, row, col). The axis
        effect is of robots, of length 1 where all share them.
    """
    maps, n_effects = {}, places.n_effects
    if "place" in visited:
        maps["place"] = np.stack(
            [
                _cells(scales, places.shape, cells, s, [seed, i])
                for i, (cells, s) in enumerate(_by_robot(places, visited["place"]))
            ],
            axis=1,
        )
    if "place_bound" in visited:
        shape = len(visited["place_bound"]), n_effects, N_MOVES, *places.shape
        e = np.random.default_rng([seed, n_effects]).standard_normal(shape)
        e *= scales["tau_e"][:, None, None, None, None]
        maps["place_bound"] = _centre(e)
        e[:, *places.units.T] = visited["place_bound"]
    return maps


def _by_robot(places: Visited, s: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Visited cells of each robot, or of all that share effects, and their draws."""
    for i in range(places.n_effects):
        mine = places.cells[:, 0] == i
        yield places.cells[mine], s[:, mine]


@one_blas_thread()
def _cells(
    scales: Scales,
    shape: tuple[int, int],
    cells: np.ndarray,
    values: np.ndarray,
    seed: list[int],
) -> np.ndarray:
    """Effect s over the grid, (draw, row, col), given some cells."""
    flat = cells[:, 1] * shape[1] + cells[:, 2]
    centre = np.zeros((len(values), shape[0] * shape[1]))
    off = np.empty(centre.shape)
    for step, rows, length_scale, weights, _ in _kriging(scales["length_scale"], shape, cells):
        rng = np.random.default_rng([*seed, step + 1000])
        free = _prior(shape, length_scale, int(rows.sum()), rng) * scales["tau_s"][rows, None]
        centre[rows] = values[rows] @ weights
        off[rows] = free - free[:, flat] @ weights
    return (centre + _centre(off)).reshape(-1, *shape)


def _kriging(
    length_scale: np.ndarray, shape: tuple[int, int], cells: np.ndarray
) -> Iterator[tuple[int, np.ndarray, float, np.ndarray, np.ndarray]]:
    """Yield each step of length scales, its draws and length scale, and how s follows from cells.

    That is weights (cell, all) of the effects of `cells` in the mean of s over the grid, and the
    variance (all,) that is left of a prior variance of 1.
    """
    grid = np.column_stack([np.zeros(shape[0] * shape[1]), *np.indices(shape).reshape(2, -1)])
    same_robot = np.column_stack([np.zeros(len(cells)), cells[:, 1:]])
    # Beyond, all cells are nearly equal, and `_prior` would need a far larger grid in memory.
    length_scale = np.minimum(length_scale, _LARGEST * max(shape))
    steps = np.round(np.log(length_scale) / _STEP).astype(int)
    for step in np.unique(steps):
        scale, weights = float(np.exp(_STEP * step)), np.zeros((len(same_robot), len(grid)))
        cross = correlation(same_robot, grid, scale)
        if len(same_robot):
            K = correlation(same_robot, same_robot, scale) + _JITTER * np.eye(len(same_robot))
            weights = cho_solve(cho_factor(K), cross)
        left = np.maximum(1.0 - (weights * cross).sum(0), 0.0)
        yield int(step), steps == step, scale, weights, left


def _prior(
    shape: tuple[int, int], length_scale: float, n: int, rng: np.random.Generator
) -> np.ndarray:
    """Draws of unit variance over the grid, (n, cell)."""
    reach = int(_REACH * length_scale)
    torus = [int(fft.next_fast_len(max(2 * m, m + reach), real=True) or 2 * m) for m in shape]
    down, right = (np.minimum(np.arange(m), m - np.arange(m)) for m in torus)
    kernel = matern(np.hypot(down[:, None], right[None]), length_scale)
    spectrum = np.real(np.asarray(fft.rfft2(kernel), dtype=complex))
    white = fft.rfft2(rng.standard_normal((n, *torus)))
    field = fft.irfft2(np.sqrt(np.maximum(spectrum, 0.0)) * white, s=torus)
    return np.asarray(field)[:, : shape[0], : shape[1]].reshape(n, -1)


def _centre(draws: np.ndarray) -> np.ndarray:
    """Centre draws at mean 0 with unchanged variance, in place; a single one is left alone."""
    n = len(draws)
    if n > 1:
        draws -= draws.mean(0)
        draws *= np.sqrt(n / (n - 1.0))
    return draws


def place_group(draws: Mapping[str, np.ndarray], places: Visited, seed: int) -> xr.Dataset:
    """Lay out the draws at visited places as a group of a posterior.

    Args:
        draws: place (chain, draw, cell) and place_bound (chain, draw, unit), or one of these.
        places: Visited places.
        seed: Seed of the maps that `params_of` draws.
    """
    variables = {name: (("chain", "draw", _AXIS[name]), draws[name]) for name in draws}
    n_chains, n_draws = next(iter(draws.values())).shape[:2]
    coords = {
        "chain": np.arange(n_chains),
        "draw": np.arange(n_draws),
        **{f"cell_{name}": ("cell", places.cells[:, i]) for i, name in enumerate(_OF_CELL)},
        **{f"bound_{name}": ("bound", places.units[:, i]) for i, name in enumerate(_OF_BOUND)},
    }
    attrs = {"shape": list(places.shape), "n_effects": places.n_effects, "seed": seed}
    return xr.Dataset(variables, coords, attrs)


def visited_of(group: xr.Dataset) -> Visited:
    """Visited places of such a group; of its `unit`, only the number of effects is kept."""
    cells = np.column_stack([group[f"cell_{name}"].values for name in _OF_CELL])
    units = np.column_stack([group[f"bound_{name}"].values for name in _OF_BOUND])
    n_effects = int(group.attrs["n_effects"])
    shape = tuple(int(n) for n in group.attrs["shape"])
    nothing = np.zeros((0, 0, n_effects), dtype=int)
    return Visited(shape, cells, units, np.zeros(0, dtype=int), nothing)  # pyright: ignore


def place_maps_of(group: xr.Dataset, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Effects over the whole grid for each draw of a posterior, see `draw_maps`.

    Args:
        group: Group `places` of a posterior.
        sites: Its hyperparameters by name, (draw,), chains joined.
    """
    return draw_maps(sites, visited_of(group), _visited_draws(group), int(group.attrs["seed"]))


def place_maps(posterior: xr.DataTree) -> xr.Dataset:
    """Mean and standard deviation of the effect of every cell and bound, over a posterior.

    Exact given its draws at visited places: what was not visited enters by its conditional mean and
    variance, and is not drawn.

    Args:
        posterior: DataTree from `fit` of a model with effects of places.

    Returns:
        place_mean and place_sd (row, col) of s, the effect of entering a cell, and place_bound_mean
        and place_bound_sd (move, row, col) of e, the further effect of entering it by that move, as
        the model has them. Where robots have separate effects, axis `robot` is first. Effects are
        added to trust at each such bound. Moves have the names of `workspace.awareness`, "n"
        towards row 0; NaN where a move would come from outside the grid.

    Raises:
        TrustboError: No posterior of `fit`, or its model has no effects of places.
    """
    require_kind("posterior", posterior, xr.DataTree, "give one of trustbo.fit")
    if "places" not in posterior.children:
        raise TrustboError(
            f"a posterior of {posterior.attrs.get('model', 'a model')} without effects of places "
            "has no maps of them; fit a model with effects=PlaceEffect()."
        )
    group = posterior["places"].to_dataset()
    sites = posterior["posterior"].to_dataset()
    names = [name for name in ("tau_s", "length_scale", "tau_e") if name in sites]
    scales = {name: sites[name].values.reshape(-1) for name in names}
    places, visited, maps = visited_of(group), _visited_draws(group), xr.Dataset()
    if "place" in visited:
        moments = [
            _moments_of_cells(scales, places.shape, cells, s)
            for cells, s in _by_robot(places, visited["place"])
        ]
        _add(maps, "place", "effect of the cell", ("row", "col"), np.stack(moments, axis=1))
    if "place_bound" in visited:
        e, axes = visited["place_bound"], ("move", "row", "col")
        effects_by_bound = np.zeros((2, places.n_effects, N_MOVES, *places.shape))
        effects_by_bound[1] = np.sqrt((scales["tau_e"] ** 2).mean())
        effects_by_bound[:, *places.units.T] = e.mean(0), e.std(0)
        effects_by_bound[..., ~existing_bounds(np.ones(places.shape, bool))] = np.nan
        _add(maps, "place_bound", "effect of the bound by a move", axes, effects_by_bound)
        maps = maps.assign_coords(move=list(MOVE_NAMES))
    maps = maps.assign_coords({axis: np.arange(maps.sizes[axis]) for axis in ("row", "col")})
    if places.n_effects == 1:
        return maps.isel(robot=0)
    return maps.assign_coords(robot=posterior["observed_data"]["robot"].values)


@one_blas_thread()
def _moments_of_cells(
    scales: Scales, shape: tuple[int, int], cells: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Mean and standard deviation of s over the grid, (2, row, col)."""
    centre = np.zeros((len(draws), shape[0] * shape[1]))
    variance = np.zeros(shape[0] * shape[1])
    for _, rows, _, weights, left in _kriging(scales["length_scale"], shape, cells):
        centre[rows] = draws[rows] @ weights
        variance += (scales["tau_s"][rows] ** 2).sum() * left / len(draws)
    return np.stack([centre.mean(0), np.sqrt(centre.var(0) + variance)]).reshape(2, *shape)


def _add(
    maps: xr.Dataset, name: str, text: str, axes: tuple[str, ...], moments: np.ndarray
) -> None:
    """Add a mean and a standard deviation (2, robot, ...) to some maps."""
    for kind, long, values in zip(("mean", "sd"), _MOMENTS, moments, strict=True):
        attrs = {"long_name": f"{long} {text} on trust", "units": "1"}
        maps[f"{name}_{kind}"] = ("robot", *axes), values, attrs


def _visited_draws(group: xr.Dataset) -> dict[str, np.ndarray]:
    """Draws at visited places by name, chains joined: (draw, cell) and (draw, unit)."""
    return {
        name: group[name].transpose("chain", "draw", ...).values.reshape(-1, group.sizes[axis])
        for name, axis in _AXIS.items()
        if name in group
    }
