"""The terrain as it is for a mission: with the threats that are there then."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trustbo.errors import TrustboError, require_choice
from trustbo.simulation.events import Degradation, Threat
from trustbo.simulation.motion import Routes
from trustbo.simulation.positions import Positions, surface_of
from trustbo.simulation.sight import Sight, Surface
from trustbo.terrain import Workspace


class World(NamedTuple):
    """Where robots can go, stand and see."""

    surface: Surface
    positions: Positions
    routes: Routes
    jams: tuple[tuple[np.ndarray, float], ...]
    """Pixels, shape (row, col), and strength."""
    detection: np.ndarray
    """Quality of T2's lidars, shape (robot,)."""


class Worlds:
    """Made when they are needed, and kept: most missions see the same."""

    def __init__(
        self,
        workspace: Workspace,
        sight: Sight,
        formation_radius: float,
        threats: Sequence[Threat] = (),
        degradations: Sequence[Degradation] = (),
    ) -> None:
        """Prepare; see `KinematicSimulator`.

        Raises:
            TrustboError: A workspace without a terrain in memory, or a robot not in the team.
        """
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
        self._ease = workspace.pixels["traversability"]
        self._threats, self._degradations = tuple(threats), tuple(degradations)
        self._known: dict[object, World] = {}
        self._grounds: dict[object, tuple[Surface, Positions, Routes]] = {}

    def at(self, mission: int) -> World:
        """As it is for a mission, counted from 0."""
        threats = tuple(t for t in self._threats if t.is_there(mission))
        worse = tuple(d for d in self._degradations if d.is_there(mission))
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
        """Where robots can go; jams and worse lidars leave it as it is, and its routes known."""
        key = tuple(map(id, closing))
        if key not in self._grounds:
            surface = self.surface
            for threat in closing:
                surface = surface._replace(passable=surface.passable & ~threat.mask(surface))
            positions = Positions(self._workspace, surface, self._sight, self._ease, self._radius)
            self._grounds[key] = surface, positions, Routes(surface)
        return self._grounds[key]
