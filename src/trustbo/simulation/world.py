"""World of a mission: true terrain, sight and team after the mission's events."""

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
    """True conditions that decide contact, motion and failure in a mission."""

    surface: Surface
    """True terrain."""
    sight: Sight
    """True model of sight."""
    team: Team
    """True lead and robots."""
    detection: np.ndarray
    """Probability of detection by T2's lidars in clear sight, shape (bound, robot); the last
    row also applies to later bounds."""
    lead_detection: float
    """Probability of detection by the lead's lidar in clear sight."""
    mission: int | None = 0
    """Number of the mission, from 0; None for the long-run mean over missions."""
    jams: tuple[tuple[np.ndarray, float], ...] = ()
    """Mask of the pixels inside, shape (row, col), and strength of each jammer."""


def world_of(surface: Surface, sight: Sight, team: Team) -> World:
    """Make a world without events."""
    detection = np.array([[robot.detection for robot in team.robots]])
    return World(surface, sight, team, detection, team.lead.detection)


def true_surface(workspace: Workspace, terrain: xr.Dataset | None) -> Surface:
    """Return the surface used for the simulation: the workspace's or another terrain's.

    Raises:
        TrustboError: The terrain does not cover the grid or has another CRS, or the workspace has
            no terrain.
    """
    planned = workspace.surface
    if planned is None or workspace.terrain is None:
        raise TrustboError(
            "the kinematic simulator needs a terrain; make the workspace with "
            "Workspace.from_terrain, or give your own simulator."
        )
    if terrain is None:
        return planned
    terrain = require_terrain(terrain)
    if terrain.rio.crs != workspace.terrain.rio.crs:
        raise TrustboError(
            f"the true terrain has CRS {terrain.rio.crs}, but the workspace has "
            f"{workspace.terrain.rio.crs}; reproject the terrain."
        )
    surface = surface_of(terrain, np.isfinite(terrain["dem"].values))
    extent, needed, pixel = surface.extent, planned.extent, max(*surface.pixel, *planned.pixel)
    short = max(*np.subtract(extent, needed)[:2], *np.subtract(needed, extent)[2:])
    if short > pixel:
        raise TrustboError(
            f"the true terrain ends {short:.3g} m inside the planning grid; give one that "
            "covers it."
        )
    return surface
