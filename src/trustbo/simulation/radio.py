"""Simulator of radio contact, which is given by a formula without line of sight."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage
from scipy.special import expit
from scipy.stats import t as student

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_kind, require_whole
from trustbo.identity import fingerprint
from trustbo.simulation.protocol import DescribedSimulator, require_path
from trustbo.simulation.replicates import table_of
from trustbo.simulation.world import true_terrain
from trustbo.terrain import pixel_size
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, cells_along, moves_along

FREEDOM = 3.0
"""Degrees of freedom of the noise on contact rates."""
SCALE = 0.06
"""Scale of the noise on contact rates."""
_REACH = 60.0
"""Unit of distance, m."""
_WINDOW = 20.0
"""Width of the window for canopy cover, m."""
_CANOPY = 1.5
"""Height above which vegetation is canopy, m."""
_FIELD = 35.0
"""Length scale of the hidden field, m."""
_QUALITY = 0.25
"""Standard deviation of the quality of the radios."""
_N_BETWEEN = 9
"""Number of points between two cells at which the cover is read."""


class RadioSimulator(DescribedSimulator):
    """Simulator whose contact depends on distance, canopy cover, climb and a hidden field.

    The mean contact of robot i in the bound from cell a to cell b is ::

        sigma(2.2 - 3.5 c^1.5 d - 0.1 h + 0.9 (0.3 + c) tanh(g) + q_i)

    The distance d between the centres of the cells is in units of 60 m. The cover c is the fraction
    of ground between the cells with a canopy above 1.5 m, and h is the climb in metres. The value g
    at b comes from a smooth Gaussian field, which is not on any map. The quality of the robot's
    radio is q_i. Rates have Student t noise with 3 degrees of freedom and scale 0.06, and are
    clipped to [0, 1]. No bound fails.

    Example:
        >>> simulator = tb.simulation.RadioSimulator(workspace, seed=0)
        >>> simulator.run(path, seed=0).contact_rate
    """

    def __init__(
        self, workspace: Workspace, *, terrain: xr.Dataset | None = None, seed: int | None = None
    ) -> None:
        """Compute the mean contact of every bound.

        Args:
            workspace: A workspace made from a terrain.
            terrain: True DEM and DSM, which must cover the workspace; by default the workspace's.
            seed: Seed of the field and the radio qualities; by default a hash of the terrain. The
                last bits of a synthetic terrain, and so its hash, depend on the processor.

        Raises:
            TrustboError: The workspace has no terrain, and no other terrain is given; or the given
                terrain does not cover the grid or has another CRS.
        """
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        terrain = workspace.terrain if terrain is None else true_terrain(workspace, terrain)
        if terrain is None:
            raise TrustboError("the radio simulator needs a workspace made from a terrain.")

        rasters = [terrain[name].values.astype(float) for name in ("y", "x", "dem", "dsm")]
        self.workspace = workspace
        self._terrain = fingerprint(rasters)
        own = int(self._terrain[:8], 16)
        self.seed = own if seed is None else require_whole("seed", seed, 0)
        self.mean = _mean_contact(workspace, terrain, self.seed)

    def run(
        self,
        path: Sequence[Cell],
        *,
        seed: int,
        mission: int = 0,
        post_sets: Sequence[str] = (),
    ) -> Mission:
        """Run a path; the result depends on the seed, but not on the number of the mission."""
        cells = require_path(self.workspace, path, post_sets)
        entered = cells_along(cells)[1:].T
        mean = self.mean[:, moves_along(cells), *entered].T  # (bound, robot)
        rng = np.random.default_rng(require_whole("seed", seed, 0))
        rates = np.clip(mean + SCALE * rng.standard_t(FREEDOM, mean.shape), 0.0, 1.0)

        z = self.workspace.along(cells)
        features = self.workspace.features
        robots = self.workspace.team.names
        return Mission.from_arrays(cells, z, rates, features=features, robots=robots)

    def expected_contact(self) -> xr.Dataset:
        """Compute the expected contact of every bound in closed form; see `Truth.bounds`."""
        contact = np.repeat(expected_rate(self.mean).mean(0)[..., None], len(MOVES) + 1, -1)
        contact = np.where(self.workspace.passable_bounds.values[..., None], contact, np.nan)
        return table_of(contact, np.where(np.isfinite(contact), 1.0, np.nan))

    def describe(self) -> dict[str, object]:
        """Return the settings that affect the measurements of a mission."""
        name = type(self).__name__
        return {"simulator": name, "true_terrain": self._terrain, "seed": self.seed}


def expected_rate(mean: np.ndarray) -> np.ndarray:
    """Compute the expected value of a noisy contact rate that is clipped to [0, 1].

    E[clip(X, 0, 1)] is the integral of P(X > x) over [0, 1]. For Student's t with nu degrees of
    freedom, distribution function F and density f, the antiderivative of F is u F(u) + (nu + u^2) /
    (nu - 1) f(u).
    """
    u = np.stack([-mean, 1.0 - mean]) / SCALE
    tail = (FREEDOM + u**2) / (FREEDOM - 1.0) * student.pdf(u, FREEDOM)
    below, above = u * student.cdf(u, FREEDOM) + tail
    return 1.0 - SCALE * (above - below)


def _mean_contact(workspace: Workspace, terrain: xr.Dataset, seed: int) -> np.ndarray:
    """Compute the mean contact of all moves, (robot, move, row, col), possible or not."""
    grid = workspace.grid
    step = pixel_size(terrain)
    x = terrain["x"].values
    y = terrain["y"].values
    dem = terrain["dem"].values
    dsm = terrain["dsm"].values

    window: Any = [max(1, round(_WINDOW / size)) for size in step]
    cover = ndimage.uniform_filter((np.nan_to_num(dsm - dem) > _CANOPY).astype(float), window)
    ground = ndimage.uniform_filter(np.where(np.isfinite(dem), dem, np.nanmean(dem)), window)

    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(ground.shape)
    field = ndimage.gaussian_filter(noise, [_FIELD / size for size in step])
    field = (field - field.mean()) / field.std()
    radios = _QUALITY * rng.standard_normal(workspace.team.n_robots)

    b = np.stack(np.indices(grid.shape), -1)  # (row, col, axis), in cells  # pyright: ignore[reportArgumentType, reportCallIssue]
    a = b - np.array(MOVES)[:, None, None]  # (move, row, col, axis)
    sides = np.array([grid.cell_height, grid.cell_width])

    def read(raster: np.ndarray, at: np.ndarray) -> np.ndarray:
        south, east = np.moveaxis((at + 0.5) * sides, -1, 0)  # distance from the grid's corner, m
        pixels = (y[0] - grid.top + south) / step[0], (grid.left + east - x[0]) / step[1]
        return ndimage.map_coordinates(raster, pixels, order=1, mode="nearest")

    shares = np.linspace(0.0, 1.0, _N_BETWEEN)
    c = np.mean([read(cover, a + share * (b - a)) for share in shares], axis=0)
    c = np.clip(c, 0.0, 1.0)  # the running mean has rounding errors
    d = np.hypot(*np.moveaxis((b - a) * sides, -1, 0)) / _REACH
    h = np.maximum(read(ground, b) - read(ground, a), 0.0)

    # The formula in the docstring of `RadioSimulator`.
    eta = 2.2 - 3.5 * c**1.5 * d - 0.1 * h + 0.9 * (0.3 + c) * np.tanh(read(field, b))
    return expit(eta + radios[:, None, None, None])
