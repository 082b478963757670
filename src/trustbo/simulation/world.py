"""Terrain of a mission, with the threats and degradations that act in it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.errors import TerrainError, TrustboError, require_choice
from trustbo.simulation.events import Degradation, Threat, acts_in, require_events
from trustbo.team import Team
from trustbo.terrain.dataset import is_lazy, require_terrain
from trustbo.workspace import Workspace
from trustbo.workspace.sight import Sight
from trustbo.workspace.surface import Surface, surface_of
from trustbo.workspace.ways import Ways


class World(NamedTuple):
    """Terrain, posts and ways of a mission, and what impairs its lidars."""

    surface: Surface
    """True terrain, which decides contact, motion and failure."""
    ways: Ways
    """Posts and ways over the terrain of the workspace."""
    jams: tuple[tuple[np.ndarray, float], ...]
    """Mask of the pixels inside, shape (row, col), and strength of each jam."""
    detection: np.ndarray
    """Factor on the probability of detection by T2's lidars, shape (robot,)."""


class Worlds:
    """Worlds by mission, cached: most missions share one."""

    def __init__(
        self,
        workspace: Workspace,
        sight: Sight,
        team: Team,
        surface: Surface,
        threats: Sequence[Threat] = (),
        degradations: Sequence[Degradation] = (),
    ) -> None:
        """Prepare the true `surface`; see `KinematicSimulator` for the arguments.

        TrustboError: a threat off the terrain, or a robot not in the team.
        """
        require_events("threats", threats, Threat)
        require_events("degradations", degradations, Degradation)
        for degradation in degradations:
            require_choice("robot", degradation.robot, team.names)
        self.surface = surface
        self._workspace, self._sight, self._team = workspace, sight, team
        self._threats, self._degradations = tuple(threats), tuple(degradations)
        for threat in threats:
            if not threat.mask(surface).any():
                left, bottom, right, top = surface.extent
                raise TrustboError(
                    f"{threat} has no pixel of the terrain, which is x from {left:.9g} to "
                    f"{right:.9g} and y from {bottom:.9g} to {top:.9g}; give CRS metres, and a "
                    "region of a pixel at least."
                )
        self._worlds: dict[object, World] = {}
        self._ways: dict[object, Ways] = {}

    def of_mission(self, mission: int) -> World:
        """World of a mission, counted from 0."""
        threats = tuple(t for t in self._threats if acts_in(t, mission))
        worse = tuple(d for d in self._degradations if acts_in(d, mission))
        key = tuple(map(id, (*threats, *worse)))
        if key not in self._worlds:
            self._worlds[key] = self._make(threats, worse)
        return self._worlds[key]

    def _make(self, threats: Sequence[Threat], worse: Sequence[Degradation]) -> World:
        detection = np.array([robot.detection for robot in self._team.robots])
        for degradation in worse:
            detection[self._team.names.index(degradation.robot)] *= degradation.detection
        jams = tuple((t.mask(self.surface), t.strength) for t in threats if t.kind == "jam")
        ways = self._planned([t for t in threats if t.kind == "forbid"])
        return World(self.surface, ways, jams, detection)

    def _planned(self, closing: Sequence[Threat]) -> Ways:
        """Posts and routes, which avoid closed areas; jams and degraded lidars change neither."""
        key = tuple(map(id, closing))
        if key not in self._ways:
            ground = self._workspace.ground
            assert ground is not None  # noqa: S101  # `true_surface` has refused others
            if closing:
                surface = ground.posts.surface
                for threat in closing:
                    surface = surface._replace(passable=surface.passable & ~threat.mask(surface))
                ground = self._workspace.ways_over(surface, self._sight)
            self._ways[key] = ground
        return self._ways[key]


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
    if is_lazy(terrain):
        raise TerrainError("the true terrain must be in memory: read it without lazy=True.")
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
