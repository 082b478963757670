"""Bounding overwatch, simulated: who moves where, who sees whom, bound by bound."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trustbo.data import Bound, Cell, Mission, Robot
from trustbo.errors import TrustboError, require_positive, require_whole
from trustbo.simulation.motion import drive, find_route
from trustbo.simulation.positions import SPACING, Positions, surface_of
from trustbo.simulation.sight import Sight, in_view, transmittance
from trustbo.terrain import Workspace


class Simulator(Protocol):
    """Whatever runs a path: this package's simulator, yours, or real robots."""

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path from its first cell to its last, or as far as it goes."""
        ...


@dataclass(eq=False)
class _State:
    """Where everybody is; positions in CRS metres, headings in rad."""

    cell: Cell
    poses: np.ndarray  # (1 + robot, 3), the lead first
    time: float
    seed: int


class KinematicSimulator:
    """Unicycle robots on a DEM and DSM, in contact while their lidar has a line of sight.

    One bound: the lead drives to its waypoint in the next cell while T2 watches from its positions
    in the last; then T2 closes up to positions around the lead, chosen for sight of the waypoint
    after, while the lead watches. Each tick, each robot of T2 is in contact with the lead or not;
    its contact rate is the share of the bound's ticks, both phases, with contact.

    `run` runs a path; `reset`, `run_bound` and `close` run it bound by bound.
    """

    def __init__(
        self,
        workspace: Workspace,
        *,
        sight: Sight | str = "transmittance",
        tick: float = 0.5,
        formation_radius: float = 8.0,
        bound_timeout: float = 600.0,
        lost_contact_after: float | None = None,
    ) -> None:
        """Prepare a terrain for simulation.

        Args:
            workspace: A workspace made from a terrain.
            sight: What hinders sight, or only its mode: "bare", "wall" or "transmittance".
            tick: Time between two looks, s.
            formation_radius: How far from the lead's waypoint T2 may stand, m.
            bound_timeout: A bound that takes longer ends the mission as "timeout", s.
            lost_contact_after: If no robot has had contact for this long, the mission ends as
                "lost_contact", s. None: it goes on.

        Raises:
            TrustboError: A workspace without terrain, an unknown sight mode, a value that is not
                positive.
        """
        if workspace.terrain is None or workspace.pixels is None:
            raise TrustboError(
                "the kinematic simulator needs a terrain; make the workspace with "
                "Workspace.from_terrain, or pass your own simulator."
            )
        if not isinstance(sight, str | Sight):
            raise TrustboError(f"sight must be a mode's name or a Sight; got {sight!r}.")
        if require_positive("formation_radius", formation_radius) < SPACING:
            raise TrustboError(
                f"formation_radius must be at least {SPACING:g} m, the least distance between two "
                f"robots; got {formation_radius:g}."
            )
        self.workspace = workspace
        self.sight = Sight(sight) if isinstance(sight, str) else sight
        self.tick = require_positive("tick", tick)
        self.bound_timeout = require_positive("bound_timeout", bound_timeout)
        self.lost_contact_after = lost_contact_after
        if lost_contact_after is not None:
            require_positive("lost_contact_after", lost_contact_after)
        self._surface = surface_of(workspace.terrain, workspace.pixels)
        awareness = [workspace.pixels[str(f)].values for f in workspace.awareness["feature"].values]
        self._awareness = np.stack(awareness, axis=-1)
        self._positions = Positions(
            workspace,
            self._surface,
            self.sight,
            workspace.pixels["traversability"],
            formation_radius,
        )
        self._state: _State | None = None

    def describe(self) -> dict[str, object]:
        """The settings that decide what a mission measures, for the record."""
        return {
            "simulator": type(self).__name__,
            "sight": self.sight.mode,
            "extinction": self.sight.extinction,
            "crown_base": self.sight.crown_base,
            "tick": self.tick,
        }

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Run a path, start to goal or as far as it goes.

        Args:
            path: Cells, each a neighbour of the last.
            seed: Same seed, same mission, on any machine.

        Raises:
            TrustboError: A cell that is off the grid or impassable, or fewer than two cells.
        """
        cells = [self.workspace.require_cell(f"path[{k}]", cell) for k, cell in enumerate(path)]
        if len(cells) < 2:
            raise TrustboError(f"a path needs at least two cells; got {cells}.")
        self.reset(cells[0], seed, next_cell=cells[1])
        bounds: list[Bound] = []
        for k, cell in enumerate(cells[1:], start=1):
            after = cells[k + 1] if k + 1 < len(cells) else None
            bounds.append(self.run_bound(k, cell, next_cell=after))
            if bounds[-1].status != "ok":
                break
        self.close()
        features = tuple(str(f) for f in self.workspace.awareness["feature"].values)
        robots = self.workspace.team.names
        return Mission(tuple(cells), tuple(bounds), bounds[-1].status, features, robots)

    def reset(self, start: Cell, seed: int, *, next_cell: Cell | None = None) -> None:
        """Put the team into a cell.

        Args:
            start: The cell.
            seed: Decides slip and contacts of all bounds to come.
            next_cell: Where the lead will go first, if known: T2 takes positions that see it.
        """
        cell = self.workspace.require_cell("start", start)
        here = self._positions.waypoint(cell)
        positions = self._positions.formation(cell, next_cell)
        poses = np.zeros((1 + len(positions), 3))
        poses[0, :2], poses[1:, :2] = here, positions
        self._state = _State(cell, poses, 0.0, require_whole("seed", seed, 0))

    def run_bound(self, k: int, cell: Cell, *, next_cell: Cell | None = None) -> Bound:
        """Run one bound.

        Args:
            k: Number of the bound, 1 for the first.
            cell: The cell to enter.
            next_cell: The cell after it, if known: T2 takes positions that see it.

        Returns:
            What was measured; if the status is not "ok", up to where the bound ended.

        Raises:
            TrustboError: `reset` was not called, or the cell is off the grid or impassable.
        """
        state = self._state
        if state is None:
            raise TrustboError("call reset(start, seed) before run_bound.")
        cell = self.workspace.require_cell("cell", cell)
        rng = np.random.default_rng([state.seed, k])
        team, ticks_left = self.workspace.team, round(self.bound_timeout / self.tick)
        leading, status = self._move(
            state.poses[:1],
            [team.lead],
            [self._positions.waypoint(cell)],
            (state.cell, cell),
            ticks_left,
            rng,
        )
        watching = np.repeat(state.poses[None, 1:], len(leading), axis=0)
        poses = np.concatenate([leading, watching], axis=1)
        moved_from = len(poses)
        if status == "ok":
            targets = list(self._positions.formation(cell, next_cell))
            ticks_left -= len(leading)
            closing, status = self._move(
                state.poses[1:], team.robots, targets, (state.cell, cell), ticks_left, rng
            )
            waiting = np.repeat(leading[-1:], len(closing), axis=0)
            poses = np.concatenate([poses, np.concatenate([waiting, closing], axis=1)])
        contact = self._contact(poses, moved_from, rng)
        poses, contact, status = self._cut_at_lost_contact(poses, contact, status)
        # On failure in the first phase T2 has not moved: what it measured is where it stands.
        awareness = self._measure(poses[min(moved_from, len(poses) - 1) :, 1:])
        duration = np.full(len(team.robots), len(poses) * self.tick)
        exposure = np.full(len(team.robots), len(contact))
        bound = Bound(
            cell,
            awareness,
            contact.mean(0),
            duration,
            status,
            state.time,
            poses,
            contact,
            exposure,
        )
        self._state = _State(cell, poses[-1], bound.t1, state.seed)
        return bound

    def close(self) -> None:
        """Forget where everybody is."""
        self._state = None

    def _move(
        self,
        poses: np.ndarray,
        robots: Sequence[Robot],
        goals: Sequence[np.ndarray],
        cells: tuple[Cell, Cell],
        max_ticks: int,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, str]:
        """Drive several robots at once; poses (tick, robot, 3) until all are there or one fails."""
        tracks, failures = [], []
        window = self._positions.window(*cells)
        for pose, robot, goal in zip(poses, robots, goals, strict=True):
            route = find_route(self._surface, robot, pose[:2], goal, window)
            if route is None:
                track, status = pose[None], "stuck"
            else:
                track, status = drive(
                    self._surface, robot, route, pose[2], self.tick, max(1, max_ticks), rng
                )
            tracks.append(track)
            if status != "ok":
                failures.append((len(track), status))
        n_ticks, status = min(failures, default=(max(len(t) for t in tracks), "ok"))
        held = [t[np.minimum(np.arange(n_ticks), len(t) - 1)] for t in tracks]
        return np.stack(held, axis=1), status

    def _contact(self, poses: np.ndarray, n_leading: int, rng: np.random.Generator) -> np.ndarray:
        """Whether each robot had contact, (tick, robot): T2's lidars first, then the lead's."""
        team = self.workspace.team
        chance = np.zeros((len(poses), len(team.robots)))
        for i, robot in enumerate(team.robots):
            phases = ((slice(0, n_leading), robot, team.lead, 1 + i, 0),
                      (slice(n_leading, None), team.lead, robot, 0, 1 + i))  # fmt: skip
            for ticks, watcher, watched, a, b in phases:
                sensor, target = poses[ticks, a, :2], poses[ticks, b, :2]
                heights = (watcher.sensor_height, watched.target_height)
                clear = transmittance(self._surface, self.sight, sensor, target, *heights)
                view = in_view(self._surface, watcher, sensor, target, watched.target_height)
                chance[ticks, i] = np.where(view, clear, 0.0)
        return rng.random(chance.shape) < chance

    def _cut_at_lost_contact(
        self, poses: np.ndarray, contact: np.ndarray, status: str
    ) -> tuple[np.ndarray, np.ndarray, str]:
        if self.lost_contact_after is None:
            return poses, contact, status
        patience = max(1, round(self.lost_contact_after / self.tick))
        alone = 0
        for k, any_contact in enumerate(contact.any(1)):
            alone = 0 if any_contact else alone + 1
            if alone >= patience:
                return poses[: k + 1], contact[: k + 1], "lost_contact"
        return poses, contact, status

    def _measure(self, poses: np.ndarray) -> np.ndarray:
        """Mean awareness of the pixels each robot drove over, (robot, feature)."""
        pixels = self._awareness[self._surface.nearest(poses[..., 0], poses[..., 1])]
        # Once arrived, a robot waits for the others: those ticks say nothing about the way.
        moved = np.any(np.diff(poses[..., :2], axis=0, prepend=poses[:1, :, :2]) != 0.0, axis=-1)
        moved[0] = True
        weight = moved[..., None] & np.isfinite(pixels)
        total = np.where(weight, pixels, 0.0).sum(0)
        with np.errstate(invalid="ignore"):
            return total / weight.sum(0)
