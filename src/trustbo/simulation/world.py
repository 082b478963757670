"""World of a mission: true terrain, model of sight and team, as changed by events."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.team import Team
from trustbo.terrain import pixel_size
from trustbo.terrain.read import require_terrain
from trustbo.workspace import Workspace
from trustbo.workspace.sight import Sight
from trustbo.workspace.surface import Surface, surface_of


class World(NamedTuple):
    """True conditions that determine contact, motion and failure in a mission."""

    surface: Surface
    """True terrain."""
    sight: Sight
    """True model of sight."""
    team: Team
    """True properties of the lead and the robots."""
    detection: np.ndarray
    """Probability that T2's lidars detect the lead in clear sight, shape (bound, robot); the last
    row also applies to all later bounds."""
    lead_detection: float
    """Probability that the lead's lidar detects a robot in clear sight."""
    mission: int | None = 0
    """Number of the mission, from 0; None for the long-run mean over missions."""
    jams: tuple[tuple[np.ndarray, float], ...] = ()
    """For each jammer, a mask (row, col) of the pixels in its circle, and its strength."""


def true_surface(workspace: Workspace, terrain: xr.Dataset | None) -> Surface:
    """Return the surface of the true terrain; by default, the surface of the workspace.

    Raises:
        TrustboError: The workspace has no terrain, or `true_terrain` refuses the true terrain.
    """
    planned = workspace.surface
    if planned is None:
        raise TrustboError(
            "the kinematic simulator needs a terrain; make the workspace with "
            "Workspace.from_terrain, or use another simulator."
        )
    return planned if terrain is None else surface_of(true_terrain(workspace, terrain))


def true_terrain(workspace: Workspace, terrain: xr.Dataset) -> xr.Dataset:
    """Check the true terrain of a simulator and return it with north at the top.

    Raises:
        TrustboError: The terrain is not valid, does not cover the grid or has another CRS.
    """
    terrain = require_terrain(terrain)
    planned = workspace.terrain
    if planned is not None and terrain.rio.crs != planned.rio.crs:
        raise TrustboError(
            f"the true terrain has the CRS {terrain.rio.crs}, but the workspace has the CRS "
            f"{planned.rio.crs}; reproject the terrain."
        )

    grid = workspace.grid
    rows, cols = grid.shape
    bottom = grid.top - rows * grid.cell_height
    needed = grid.left, bottom, grid.left + cols * grid.cell_width, grid.top
    pixel = max(pixel_size(terrain))
    if workspace.surface is not None:
        needed = workspace.surface.extent
        pixel = max(pixel, *workspace.surface.pixel)

    extent = surface_of(terrain).extent
    short = max(*np.subtract(extent, needed)[:2], *np.subtract(needed, extent)[2:])
    if short > pixel:
        raise TrustboError(
            f"the true terrain ends {short:.3g} m inside the planning grid; give a terrain that "
            "covers the grid."
        )
    return terrain
