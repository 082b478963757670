"""Place effects over a whole grid, drawn given the effects at visited places.

Effects s of unvisited cells are drawn by Matheron's rule: a prior draw over the whole grid is
corrected by kriging at the visited cells. Prior draws use the fast Fourier transform of a circulant
covariance on a torus (Dietrich and Newsam 1997), which is so large that correlations around it are
nearly 0. Length scales are rounded to steps of 10 %, which changes the correlation of neighbouring
cells by less than 0.01. Effects e of unvisited bounds are drawn from the prior.

The random part of the draws is centred at 0. The mean map is therefore the posterior mean of the
effects, without Monte Carlo error in places that were not visited.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import xarray as xr
from scipy import fft
from scipy.linalg import cho_factor, cho_solve

from trustbo.models.effects.place import matern
from trustbo.models.visited import Visited
from trustbo.workspace.moves import MOVE_NAMES

_STEP = 0.1  # step of log length scales
_LARGEST = 4.0  # largest length scale, in units of the grid's longer side
_REACH = 5.0  # distance in length scales at which the correlation is 0.002
_JITTER = 1e-9  # added to the correlation matrix of visited cells
_MAP = "row", "col"


def place_group(draws: Mapping[str, np.ndarray], places: Visited, seed: int) -> xr.Dataset:
    """Build the posterior group `places`, with the effects of visited cells and bounds.

    Args:
        draws: Arrays place (chain, draw, cell) and place_bound (chain, draw, bound).
        places: Visited places.
        seed: Random seed for the maps that `params_of` draws.
    """
    variables = {"place": (("chain", "draw", "cell"), draws["place"])}
    variables["place_bound"] = ("chain", "draw", "bound"), draws["place_bound"]
    n_chains, n_draws = draws["place"].shape[:2]
    coords = {
        "chain": np.arange(n_chains),
        "draw": np.arange(n_draws),
        **{f"cell_{name}": ("cell", places.cells[:, i]) for i, name in enumerate(_MAP)},
        **{f"bound_{n}": ("bound", places.bounds[:, i]) for i, n in enumerate(("move", *_MAP))},
    }
    return xr.Dataset(variables, coords, {"shape": list(places.shape), "seed": seed})


def place_maps_of(group: xr.Dataset, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Draw the effects of all cells and bounds, given the effects at visited places.

    Args:
        group: Posterior group `places`.
        sites: Hyperparameters (draw,) by name, with chains joined.

    Returns:
        Arrays place (draw, effect, row, col) and place_bound (draw, effect, move, row, col). The
        axis `effect` has length 1 because effects are common to all robots.
    """
    (rows, cols), seed = (int(n) for n in group.attrs["shape"]), int(group.attrs["seed"])
    s, e = (
        group[name].transpose("chain", "draw", ...).values.reshape(-1, group.sizes[axis])
        for name, axis in (("place", "cell"), ("place_bound", "bound"))
    )  # (draw, cell) and (draw, bound)
    cells = np.column_stack([group[f"cell_{name}"].values for name in _MAP])
    place = _cells(s, cells, (rows, cols), sites, [seed, 0])
    rng = np.random.default_rng([seed, 1])
    place_bound = rng.standard_normal((len(place), len(MOVE_NAMES), rows, cols))
    place_bound *= sites["tau_e"][:, None, None, None]
    _centre(place_bound)
    place_bound[:, *(group[f"bound_{name}"].values for name in ("move", *_MAP))] = e
    return {"place": place[:, None], "place_bound": place_bound[:, None]}


def _cells(
    s: np.ndarray,
    cells: np.ndarray,
    shape: tuple[int, int],
    sites: Mapping[str, np.ndarray],
    seed: list[int],
) -> np.ndarray:
    """Draw the effect (draw, row, col) over the grid, given the effect s at visited cells."""
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    centre = np.zeros((len(s), shape[0] * shape[1]))
    off = np.empty(centre.shape)
    for step, rows, scale, weights in _kriging(sites["length_scale"], cells, shape):
        rng = np.random.default_rng([*seed, step + 1000])
        free = _prior(shape, scale, int(rows.sum()), rng) * sites["tau_s"][rows, None]
        centre[rows] = s[rows] @ weights
        off[rows] = free - free[:, flat] @ weights
    return (centre + _centre(off)).reshape(-1, *shape)


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
        scale, weights = float(np.exp(_STEP * step)), np.zeros((len(cells), len(grid)))
        cross = _correlation(cells, grid, scale)
        if len(cells):
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
    reach = int(_REACH * length_scale)
    torus = [int(fft.next_fast_len(max(2 * m, m + reach), real=True) or 2 * m) for m in shape]
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
