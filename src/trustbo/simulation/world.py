"""World of a mission: true terrain, model of sight and team, as changed by events."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.team import Team
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
        TrustboError: The terrain does not cover the grid or has another CRS, or the workspace has
            no terrain.
    """
    planned = workspace.surface
    if planned is None or workspace.terrain is None:
        raise TrustboError(
            "the kinematic simulator needs a terrain; make the workspace with "
            "Workspace.from_terrain, or use another simulator."
        )
    if terrain is None:
        return planned
    terrain = require_terrain(terrain)
    if terrain.rio.crs != workspace.terrain.rio.crs:
        raise TrustboError(
            f"the true terrain has the CRS {terrain.rio.crs}, but the workspace has the CRS "
            f"{workspace.terrain.rio.crs}; reproject the terrain."
        )

    surface = surface_of(terrain)
    extent = surface.extent
    needed = planned.extent

    pixel = max(*surface.pixel, *planned.pixel)
    short = max(*np.subtract(extent, needed)[:2], *np.subtract(needed, extent)[2:])
    if short > pixel:
        raise TrustboError(
            f"the true terrain ends {short:.3g} m inside the planning grid; give a terrain that "
            "covers the grid."
        )
    return surface
