"""Draws of coefficients and effects of places given hyperparameters, and of cells given bounds."""

import itertools

import numpy as np

from trustbo.inference.evidence import place_prior
from trustbo.models.place import PlaceEffect, Visited


def split_units(
    g: np.ndarray,
    hyper: dict[str, np.ndarray],
    places: Visited,
    place: PlaceEffect,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Effects of cells, place (draw, cell), and bounds, place_bound (draw, unit), given their sums.

    Args:
        g: Effects of units, (draw, unit).
        hyper: Hyperparameters by name, each (draw,).
        places: Visited places.
        place: Effects in the model.
        rng: Random number generator.
    """
    if not place.bounds:
        return {"place": g}
    if not place.cells:
        return {"place_bound": g}
    s = np.empty((len(g), len(places.cells)))
    theta = np.stack([hyper[name] for name in ("tau_s", "length_scale", "tau_e")], axis=1)
    new = np.flatnonzero(np.r_[True, (theta[1:] != theta[:-1]).any(1), True])
    for i, j in itertools.pairwise(new):  # equal neighbours share their factors
        s[i:j] = _cells_given_units(places, theta[i], g[i:j], rng)
    return {"place": s, "place_bound": g - s[:, places.cell_of]}


def _cells_given_units(
    places: Visited, theta: np.ndarray, g: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """S at visited cells given g (draw, unit), by Matheron's rule: a prior draw, corrected."""
    tau_s, length_scale, tau_e = theta
    n_cells, w = len(places.cells), np.sqrt(np.bincount(places.cell_of).astype(float))
    K, M = np.zeros((2, n_cells, n_cells))
    one = np.ones(n_cells)
    place_prior.fill_cells(K, places.cells, places.shape, one, tau_s, length_scale, 1e-5 * tau_s)
    place_prior.fill_cells(M, places.cells, places.shape, w, tau_s, length_scale, tau_e)
    place_prior.factor(K)
    place_prior.factor(M)
    s = rng.standard_normal((len(g), n_cells)) @ K.T  # its upper triangle is 0
    gap = g - s[:, places.cell_of] - tau_e * rng.standard_normal(g.shape)
    of_cells = gap @ np.eye(n_cells)[places.cell_of]
    v = place_prior.solve(M, place_prior.solve(M, of_cells / w), transposed=True) * w
    return s + (v @ K) @ K.T
