"""World of a mission: terrain, sight and lidars, with the events that act in it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.errors import TerrainError, TrustboError
from trustbo.files import to_json
from trustbo.simulation.events import Event, Fouling, Threat
from trustbo.team import Team
from trustbo.terrain.read import require_terrain
from trustbo.workspace import Workspace
from trustbo.workspace.sight import Sight
from trustbo.workspace.surface import Surface, surface_of
from trustbo.workspace.ways import Ways


class World(NamedTuple):
    """Terrain, sight, posts and ways of a mission, and what impairs its lidars."""

    surface: Surface
    """True terrain, which decides contact, motion and failure."""
    ways: Ways
    """Posts and ways over the terrain of the workspace."""
    sight: Sight
    """True model of sight."""
    robots: tuple[str, ...]
    """Names of T2's robots."""
    detection: np.ndarray
    """Probability of detection by T2's lidars in clear sight, shape (robot,)."""
    lead_detection: float
    """The same of the lead's lidar."""
    jams: tuple[tuple[np.ndarray, float], ...] = ()
    """Mask of the pixels inside, shape (row, col), and strength of each jam."""
    closed: tuple[Threat, ...] = ()
    """Regions that no route leads through."""
    fouling: tuple[Fouling, ...] = ()
    """Further factors on T2's detection, which vary within the mission."""


class Worlds:
    """Worlds by mission, cached: most missions share one."""

    def __init__(
        self,
        workspace: Workspace,
        sight: Sight,
        team: Team,
        surface: Surface,
        events: Sequence[Event] = (),
    ) -> None:
        """Prepare the true `surface`, sight and team, and the events that change them.

        TrustboError: an event off the terrain, or of a robot not in the team.
        """
        ground = workspace.ground
        assert ground is not None  # noqa: S101  # `true_surface` has refused others
        for event in events:
            event.check(team, surface)
        self.surface = surface
        self._workspace, self._events, self._planned = workspace, tuple(events), ground
        detection = np.array([robot.detection for robot in team.robots])
        self._usual = World(surface, ground, sight, team.names, detection, team.lead.detection)
        self._worlds: dict[str, World] = {}
        self._ways: dict[str, Ways] = {}

    def of_mission(self, mission: int) -> World:
        """World of a mission, counted from 0."""
        acting = [event for event in self._events if event.acts_in(mission)]
        key = _key(acting)
        if key not in self._worlds:
            world = self._usual
            for event in acting:
                world = event.change(world)
            self._worlds[key] = world._replace(ways=self._ways_around(world.closed))
        return self._worlds[key]

    def _ways_around(self, closed: Sequence[Threat]) -> Ways:
        """Posts and routes, which avoid closed areas; other events change neither."""
        key = _key(closed)
        if key not in self._ways:
            ways = self._planned
            if closed:
                surface = ways.posts.surface
                for threat in closed:
                    surface = surface._replace(passable=surface.passable & ~threat.mask(surface))
                ways = self._workspace.ways_over(surface, self._usual.sight)
            self._ways[key] = ways
        return self._ways[key]


def _key(events: Sequence[Event]) -> str:
    return to_json([event.effect for event in events])


def true_surface(workspace: Workspace, terrain: xr.Dataset | None) -> Surface:
    """Surface that robots are simulated on: the workspace's, or of another terrain.

    TerrainError: it does not cover the grid, has another CRS, or is read lazily. TrustboError: the
    workspace has no terrain in memory.
    """
    planned = workspace.surface
    if planned is None:
        raise TrustboError(
            "the kinematic simulator needs a terrain in memory; make the workspace with "
            "Workspace.from_terrain (of a lazily read terrain: coarsen it first), or pass your "
            "own simulator."
        )
    if terrain is None:
        return planned
    terrain = require_terrain(terrain)
    if terrain.rio.crs != workspace.terrain.rio.crs:  # pyright: ignore[reportOptionalMemberAccess]
        raise TerrainError(
            f"the true terrain has CRS {terrain.rio.crs}, the workspace's another; reproject it."
        )
    surface = surface_of(terrain, np.isfinite(terrain["dem"].values))
    extent, needed, pixel = surface.extent, planned.extent, max(*surface.pixel, *planned.pixel)
    short = max(*np.subtract(extent, needed)[:2], *np.subtract(needed, extent)[2:])
    if short > pixel:
        raise TerrainError(
            f"the true terrain ends {short:.3g} m inside the planning grid; give one that "
            "covers it."
        )
    return surface
