"""Effects of places over a whole grid, drawn given the effects at visited places.

s at the other cells by Matheron's rule: a draw of the prior over the whole grid, corrected by
kriging at the visited cells. Prior draws are made by the fast Fourier transform of a circulant
covariance (Dietrich and Newsam 1997), on a torus so large that the correlation nearly vanishes half
way round. e at the other bounds is drawn from its prior. Length scales are rounded to steps of 10
%, which changes the correlation of neighbouring cells by less than .01.

The random part has mean 0 over the draws, so that the mean of the maps is the posterior mean of the
effects, without Monte Carlo error where nothing was measured.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import xarray as xr
from scipy import fft
from scipy.linalg import cho_factor, cho_solve

from trustbo.models.effects.place import matern
from trustbo.models.visited import Visited
from trustbo.parallel import one_blas_thread
from trustbo.workspace.moves import MOVE_NAMES

_STEP = 0.1  # of the logarithm of length scales
_LARGEST = 4.0  # length scale in units of the grid's longer side
_REACH = 5.0  # length scales at which the correlation is .002
_JITTER = 1e-9
_MAP = "row", "col"


def place_group(draws: Mapping[str, np.ndarray], places: Visited, seed: int) -> xr.Dataset:
    """Lay out the draws at visited places as a group of a posterior.

    Args:
        draws: place (chain, draw, cell) and place_bound (chain, draw, bound).
        places: Visited places.
        seed: Seed of the maps that `params_of` draws.
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


class _Visited:
    """Visited places of a group `places`, and their effects with chains joined."""

    def __init__(self, group: xr.Dataset) -> None:
        rows, cols = (int(n) for n in group.attrs["shape"])
        self.shape = rows, cols
        self.cells = np.column_stack([group[f"cell_{name}"].values for name in _MAP])
        self.bounds = tuple(group[f"bound_{name}"].values for name in ("move", *_MAP))
        self.s, self.e = (
            group[name].transpose("chain", "draw", ...).values.reshape(-1, group.sizes[axis])
            for name, axis in (("place", "cell"), ("place_bound", "bound"))
        )  # (draw, cell) and (draw, bound)


def place_maps_of(group: xr.Dataset, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Draw the effects of all cells and bounds, given the effects at visited places.

    Args:
        group: Group `places` of a posterior.
        sites: Hyperparameters by name, (draw,), with chains joined.

    Returns:
        place (draw, effect, row, col) and place_bound (draw, effect, move, row, col); the axis
        `effect` has length 1, as effects are common to all robots.
    """
    visited, seed = _Visited(group), int(group.attrs["seed"])
    place = _cells(visited, sites, [seed, 0])
    rng = np.random.default_rng([seed, 1])
    place_bound = rng.standard_normal((len(place), len(MOVE_NAMES), *visited.shape))
    place_bound *= sites["tau_e"][:, None, None, None]
    _centre(place_bound)
    place_bound[:, *visited.bounds] = visited.e
    return {"place": place[:, None], "place_bound": place_bound[:, None]}


@one_blas_thread()
def _cells(visited: _Visited, sites: Mapping[str, np.ndarray], seed: list[int]) -> np.ndarray:
    """Draw the effect s over the grid, (draw, row, col), given the effect at visited cells."""
    s, shape = visited.s, visited.shape
    flat = visited.cells[:, 0] * shape[1] + visited.cells[:, 1]
    centre = np.zeros((len(s), shape[0] * shape[1]))
    off = np.empty(centre.shape)
    for step, rows, scale, weights in _kriging(sites["length_scale"], visited):
        rng = np.random.default_rng([*seed, step + 1000])
        free = _prior(shape, scale, int(rows.sum()), rng) * sites["tau_s"][rows, None]
        centre[rows] = s[rows] @ weights
        off[rows] = free - free[:, flat] @ weights
    return (centre + _centre(off)).reshape(-1, *shape)


def _kriging(
    length_scale: np.ndarray, visited: _Visited
) -> Iterator[tuple[int, np.ndarray, float, np.ndarray]]:
    """Yield draws, length scale and kriging weights for each step of length scales.

    Weights (cell, all) give the mean of s over the grid from the effects at visited cells.
    """
    cells, grid = visited.cells, np.indices(visited.shape).reshape(2, -1).T
    # Beyond, all cells are nearly equal, and `_prior` would need a far larger grid in memory.
    length_scale = np.minimum(length_scale, _LARGEST * max(visited.shape))
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
    """Draw fields of unit variance over the grid, (n, cell)."""
    reach = int(_REACH * length_scale)
    torus = [int(fft.next_fast_len(max(2 * m, m + reach), real=True) or 2 * m) for m in shape]
    down, right = (np.minimum(np.arange(m), m - np.arange(m)) for m in torus)
    kernel = matern(np.hypot(down[:, None], right[None]), length_scale)
    spectrum = np.real(np.asarray(fft.rfft2(kernel), dtype=complex))
    white = fft.rfft2(rng.standard_normal((n, *torus)))
    field = fft.irfft2(np.sqrt(np.maximum(spectrum, 0.0)) * white, s=torus)
    return np.asarray(field)[:, : shape[0], : shape[1]].reshape(n, -1)


def _centre(draws: np.ndarray) -> np.ndarray:
    """Centre draws at mean 0 with unchanged variance, in place; a single draw is unchanged."""
    n = len(draws)
    if n > 1:
        draws -= draws.mean(0)
        draws *= np.sqrt(n / (n - 1.0))
    return draws
