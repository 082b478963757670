"""Exposure of bounds to a threat at a place, and the feature `threat`."""

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import MOVES

REACHES = (20.0, 40.0, 80.0)
"""Reaches of a threat, in metres: its effect at the distance d is exp(-d^2 / (2 reach^2))."""
_SHARES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Fractions of the line between two cells at which the exposure of a bound is averaged."""


def exposures(grid: Grid) -> np.ndarray:
    """Compute the exposure of each bound to a threat at the centre of each cell.

    Returns:
        Exposure (reach, cell, move, row, col), the mean along the line between the centres of the
        cells that the lead leaves and enters.
    """
    x, y = np.meshgrid(grid.x, grid.y)
    centre = np.stack([x, y], axis=-1)  # (row, col, 2)
    steps = np.array([(right * grid.cell_width, -down * grid.cell_height) for down, right in MOVES])
    left = centre - steps[:, None, None]  # (move, row, col, 2)
    on_way = left + _SHARES[:, None, None, None, None] * (centre - left)

    found = np.empty((len(REACHES), centre[..., 0].size, *left.shape[:3]), np.float32)
    for number, place in enumerate(centre.reshape(-1, 2)):
        d2 = ((on_way - place) ** 2).sum(-1)
        for k, reach in enumerate(REACHES):
            found[k, number] = np.exp(-0.5 * d2 / reach**2).mean(0)
    return found


def exposure_of(grid: Grid, threat: xr.Dataset) -> np.ndarray:
    """Average the exposure (move, row, col) of bounds over a threat map; see `threat_map`.

    Raises TrustboError if the map is not one of this grid.
    """
    shape = (len(REACHES), *grid.shape)
    probability = threat["probability"].values if "probability" in threat else np.empty(0)
    if probability.shape != shape:
        raise TrustboError(
            f"threat must be a map of planning.threat_map with probability (reach, row, col) = "
            f"{shape}; got {probability.shape}."
        )
    flat = probability.reshape(len(REACHES), -1)
    return np.tensordot(flat, exposures(grid), ((0, 1), (0, 1)))
