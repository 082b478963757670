"""Simulator of another physics: radio contact, by a formula of distance, canopy and a field.

It shares no code with line of sight or with the kinematic simulator, nor with the features of a
model: neither does its truth.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage
from scipy.special import expit
from scipy.stats import t as student

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.simulation.bound_table import BoundTable, table_of
from trustbo.simulation.protocol import DescribedSimulator
from trustbo.terrain.read import digest_of
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, moves_along

FREEDOM, SCALE = 3.0, 0.06
"""Degrees of freedom and scale of the noise of a rate."""
_REACH, _WINDOW, _FIELD = 60.0, 20.0, 35.0
"""Distance that counts as one, width of the window of canopy cover, scale of the field, m."""
_POINTS = 9
"""Points along a bound at which the cover is read."""


class RadioSimulator(DescribedSimulator):
    """Simulator whose contact is a formula of distance, canopy cover, climb and a hidden field.

    The mean contact of robot i in the bound from cell a to b is sigma(2.2 - 3.5 c^1.5 d - 0.1 h +
    0.9 (0.3 + c) tanh(g) + q_i): d, distance of the cells' centres in 60 m; c, mean cover of canopy
    above 1.5 m between them; h, climb in m; g, a smooth Gaussian field at b, in no map; q_i, the
    quality of the robot's radio. Rates have noise of a Student t distribution with 3 degrees of
    freedom and scale 0.06, and are clipped to [0, 1]. No bound fails.
    """

    def __init__(
        self, workspace: Workspace, *, terrain: xr.Dataset | None = None, seed: int | None = None
    ) -> None:
        """Compute the mean contact of every bound.

        Args:
            workspace: A workspace made from a terrain.
            terrain: True DEM and DSM, where they differ from the workspace's.
            seed: Seed of the field and of the radios; by default a hash of the terrain.

        Raises:
            TrustboError: A workspace without terrain.
        """
        terrain = workspace.terrain if terrain is None else terrain
        if terrain is None:
            raise TrustboError(
                "the radio simulator needs a terrain; make the workspace with "
                "Workspace.from_terrain."
            )
        self.workspace, self._terrain, self._digest = workspace, terrain, digest_of(terrain)
        self.seed = int(self._digest[:8], 16) if seed is None else require_whole("seed", seed, 0)
        self.mean = self._mean_contact()

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path; the same seed gives the same mission."""
        cells = [self.workspace.require_cell(f"path[{k}]", cell) for k, cell in enumerate(path)]
        if len(cells) < 2:
            raise TrustboError(f"a path needs at least two cells; got {cells}.")
        mean = self.mean[:, moves_along(cells), *np.array(cells)[1:].T].T  # (bound, robot)
        rng = np.random.default_rng(require_whole("seed", seed, 0))
        rates = np.clip(mean + SCALE * rng.standard_t(FREEDOM, mean.shape), 0.0, 1.0)
        names = self.workspace.features, self.workspace.team.names
        unmeasured = np.full((*rates.shape, len(names[0])), np.nan)
        return Mission.from_arrays(cells, unmeasured, rates, features=names[0], robots=names[1])

    def expected_contact(self) -> BoundTable:
        """Return the expected contact of every bound, in closed form."""
        contact = expected_rate(self.mean)[..., None]  # the same before any bound
        exists = self.workspace.passable_bounds.values
        contact = np.where(exists[..., None], np.repeat(contact, len(MOVES[8]) + 1, -1), np.nan)
        certain = np.where(np.isfinite(contact[:1]), 1.0, np.nan)
        return table_of(self.workspace, contact, certain, 0.0 * certain[0])

    def describe(self) -> dict[str, object]:
        """Return the settings that decide what a mission measures."""
        return {
            "simulator": type(self).__name__,
            "true_terrain": self._digest,
            "seed": self.seed,
            "noise": [FREEDOM, SCALE],
        }

    def _mean_contact(self) -> np.ndarray:
        """Mean contact by the formula, shape (robot, move, row, col), also of absent bounds."""
        terrain, grid = self._terrain, self.workspace.grid
        x, y = terrain["x"].values, terrain["y"].values
        step = abs(float(y[1] - y[0])), abs(float(x[1] - x[0]))
        ground = _filled(terrain["dem"].values)
        height = np.nan_to_num(terrain["dsm"].values - terrain["dem"].values)
        window: Any = [max(1, round(_WINDOW / one)) for one in step]
        cover = ndimage.uniform_filter((height > 1.5).astype(float), window)
        ground = ndimage.uniform_filter(ground, window)
        rng = np.random.default_rng(self.seed)
        field = ndimage.gaussian_filter(
            rng.standard_normal(ground.shape), [_FIELD / one for one in step]
        )
        field = (field - field.mean()) / field.std()
        radios = 0.25 * rng.standard_normal(self.workspace.team.n_robots)

        rows, cols = np.indices(grid.shape)
        b = np.stack([rows, cols], -1)  # (row, col, axis), in cells
        a = b - np.array(MOVES[8])[:, None, None]  # (move, row, col, axis)

        def read(raster: np.ndarray, at: np.ndarray) -> np.ndarray:
            here_x = grid.left + (at[..., 1] + 0.5) * grid.cell_width
            here_y = grid.top - (at[..., 0] + 0.5) * grid.cell_height
            pixels = (y[0] - here_y) / step[0], (here_x - x[0]) / step[1]
            return ndimage.map_coordinates(raster, pixels, order=1, mode="nearest")

        shares = np.linspace(0.0, 1.0, _POINTS)
        c = np.mean([read(cover, a + share * (b - a)) for share in shares], axis=0)
        c = np.clip(c, 0.0, 1.0)  # a running mean has errors of rounding
        way = (b - a) * np.array([grid.cell_height, grid.cell_width])
        d = np.hypot(way[..., 0], way[..., 1]) / _REACH
        h = np.maximum(read(ground, b) - read(ground, a), 0.0)
        eta = 2.2 - 3.5 * c**1.5 * d - 0.1 * h + 0.9 * (0.3 + c) * np.tanh(read(field, b))
        return expit(eta + radios[:, None, None, None])


def expected_rate(mean: np.ndarray) -> np.ndarray:
    """Expectation of a rate with its noise, clipped to [0, 1].

    E[clip(X, 0, 1)] is the integral of P(X > x) over [0, 1]; that of the distribution function F of
    Student's t with density f is u F(u) + (freedom + u^2) / (freedom - 1) f(u).
    """

    def integral(u: np.ndarray) -> np.ndarray:
        tail = (FREEDOM + u**2) / (FREEDOM - 1.0) * student.pdf(u, FREEDOM)
        return u * student.cdf(u, FREEDOM) + tail

    return 1.0 - SCALE * (integral((1.0 - mean) / SCALE) - integral(-mean / SCALE))


def _filled(heights: np.ndarray) -> np.ndarray:
    """Heights with their mean where they are missing."""
    return np.where(np.isfinite(heights), heights, np.nanmean(heights))
