"""Terrain of a mission, with the threats and degradations that act in it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trustbo.errors import TrustboError, require_choice
from trustbo.simulation.events import Degradation, Threat, acts_in, require_events
from trustbo.workspace import Workspace
from trustbo.workspace.positions import Positions, surface_of
from trustbo.workspace.routes import Routes
from trustbo.workspace.sight import Sight, Surface


class World(NamedTuple):
    """Terrain, positions and routes of a mission, and what impairs its lidars."""

    surface: Surface
    positions: Positions
    routes: Routes
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
        formation_radius: float,
        threats: Sequence[Threat] = (),
        degradations: Sequence[Degradation] = (),
    ) -> None:
        """Prepare a terrain; see `KinematicSimulator` for the arguments.

        TrustboError: a workspace without a terrain in memory, a threat off it, or a robot not in
        the team.
        """
        require_events("threats", threats, Threat)
        require_events("degradations", degradations, Degradation)
        if workspace.terrain is None or workspace.pixels is None:
            raise TrustboError(
                "the kinematic simulator needs a terrain in memory; make the workspace with "
                "Workspace.from_terrain (of a lazily read terrain: coarsen it first), or pass your "
                "own simulator."
            )
        for degradation in degradations:
            require_choice("robot", degradation.robot, workspace.team.names)
        self.surface = surface_of(workspace.terrain, workspace.pixels)
        self._workspace, self._sight, self._radius = workspace, sight, formation_radius
        self._traversability = workspace.pixels["traversability"]
        self._threats, self._degradations = tuple(threats), tuple(degradations)
        for threat in threats:
            if not threat.mask(self.surface).any():
                left, bottom, right, top = workspace.terrain.rio.bounds(recalc=True)
                raise TrustboError(
                    f"{threat} has no pixel of the terrain, which is x from {left:.9g} to "
                    f"{right:.9g} and y from {bottom:.9g} to {top:.9g}; give CRS metres, and a "
                    "region of a pixel at least."
                )
        self._known: dict[object, World] = {}
        self._grounds: dict[object, tuple[Surface, Positions, Routes]] = {}

    def at(self, mission: int) -> World:
        """World of a mission, counted from 0."""
        threats = tuple(t for t in self._threats if acts_in(t, mission))
        worse = tuple(d for d in self._degradations if acts_in(d, mission))
        key = tuple(map(id, (*threats, *worse)))
        if key not in self._known:
            self._known[key] = self._make(threats, worse)
        return self._known[key]

    def _make(self, threats: Sequence[Threat], worse: Sequence[Degradation]) -> World:
        team = self._workspace.team
        detection = np.array([robot.detection for robot in team.robots])
        for degradation in worse:
            detection[team.names.index(degradation.robot)] *= degradation.detection
        jams = tuple((t.mask(self.surface), t.strength) for t in threats if t.kind == "jam")
        return World(*self._ground([t for t in threats if t.kind == "forbid"]), jams, detection)

    def _ground(self, closing: Sequence[Threat]) -> tuple[Surface, Positions, Routes]:
        """Surface, positions and routes, which jams and worse lidars leave unchanged."""
        key = tuple(map(id, closing))
        if key not in self._grounds:
            surface = self.surface
            for threat in closing:
                surface = surface._replace(passable=surface.passable & ~threat.mask(surface))
            positions = Positions(
                self._workspace, surface, self._sight, self._traversability, self._radius
            )
            self._grounds[key] = surface, positions, Routes(surface)
        return self._grounds[key]
