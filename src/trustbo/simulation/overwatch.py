"""Bounding overwatch, simulated: who moves where, who sees whom, bound by bound."""

import copy
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from trustbo.data import Bound, Cell, Mission, Robot
from trustbo.errors import TrustboError, require_choice, require_positive, require_whole
from trustbo.simulation.bounding import BOUNDING, Drive, State, turns
from trustbo.simulation.events import Degradation, Threat
from trustbo.simulation.measure import Measure
from trustbo.simulation.motion import drive
from trustbo.simulation.positions import SPACING
from trustbo.simulation.sensing import Looks, contact_of, cut_at_lost_contact, new_tracks
from trustbo.simulation.sight import Sight, chance
from trustbo.simulation.world import Worlds
from trustbo.terrain import CompositeIndex, Workspace


class KinematicSimulator:
    """Unicycle robots on a DEM and DSM, in contact while their lidar has a line of sight.

    One bound: the lead drives to its waypoint in the next cell while T2 watches from its positions
    in the last; then T2 closes up to positions around the lead, chosen for sight of the waypoint
    after, while the lead watches. Each tick, each robot of T2 is in contact with the lead or not;
    its contact rate is the share of the bound's ticks, both phases, with contact. With
    `bounding="alternate"` T2 does not close up but passes the lead in the next bound, so that they
    lead by turns; at the goal the one behind closes up.

    `run` runs a path, `run_batch` many missions over one; `reset`, `run_bound` and `close` run one
    bound by bound.
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
        bounding: str = "successive",
        threats: Sequence[Threat] = (),
        degradations: Sequence[Degradation] = (),
        realtime: Mapping[str, CompositeIndex] | None = None,
        record_states: bool = False,
    ) -> None:
        """Prepare a terrain for simulation.

        Args:
            workspace: A workspace made from a terrain in memory.
            sight: What hinders sight, or only its mode: "bare", "wall" or "transmittance".
            tick: Time between two looks, s.
            formation_radius: How far from the lead's waypoint T2 may stand, m.
            bound_timeout: A bound that takes longer ends the mission as "timeout", s.
            lost_contact_after: If no robot has had contact for this long, the mission ends as
                "lost_contact", s. None: it goes on.
            bounding: "successive" or "alternate".
            threats: Regions that jam sight or forbid passage from some mission on.
            degradations: Lidars of T2 that get worse from some mission on.
            realtime: Fitted `CompositeIndex.realtime` by feature: measured awareness is then the
                map's value fused with the robot's state. Rows to fit them on: `calibration`.
            record_states: Keep each robot's state at each tick, `Bound.states`.

        Raises:
            TrustboError: A workspace without terrain, an unknown sight mode, bounding or robot, a
                value that is not positive.
        """
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
        self.formation_radius = formation_radius
        self.bound_timeout = require_positive("bound_timeout", bound_timeout)
        self.lost_contact_after = lost_contact_after
        if lost_contact_after is not None:
            require_positive("lost_contact_after", lost_contact_after)
        self.bounding = require_choice("bounding", bounding, BOUNDING)
        self.realtime, self.record_states = dict(realtime or {}), record_states
        self._wants_states = record_states or bool(self.realtime)
        self._worlds = Worlds(workspace, self.sight, formation_radius, threats, degradations)
        self.threats, self.degradations = tuple(threats), tuple(degradations)
        self._measure = Measure(
            workspace, self._worlds.surface, self.sight, self.tick, self.realtime
        )
        team = workspace.team
        self._watchers = team.robots, (team.lead,) * len(team.robots)
        self._state: State | None = None
        self._enter(0)

    def describe(self) -> dict[str, object]:
        """The settings that decide what a mission measures, for the record."""
        return {
            "simulator": type(self).__name__,
            "sight": self.sight.mode,
            "extinction": self.sight.extinction,
            "crown_base": self.sight.crown_base,
            "tick": self.tick,
            "bounding": self.bounding,
            "threats": len(self.threats),
            "degradations": len(self.degradations),
            "realtime": sorted(self.realtime),
        }

    def run(self, path: Sequence[Cell], *, seed: int, mission: int = 0) -> Mission:
        """Run a path, start to goal or as far as it goes.

        Args:
            path: Cells, each a neighbour of the last.
            seed: Same seed, same mission, on any machine.
            mission: Its number in the campaign, from 0: threats and degradations go by it.

        Raises:
            TrustboError: A cell that is off the grid or impassable, or fewer than two cells.
        """
        return self.run_batch(path, [seed], mission=mission)[0]

    def run_batch(
        self, path: Sequence[Cell], seeds: Sequence[int], *, mission: int = 0
    ) -> list[Mission]:
        """Run a path many times, faster than one by one; each as `run` does with its seed.

        Args:
            path: Cells, each a neighbour of the last.
            seeds: Of the missions.
            mission: See `run`.

        Raises:
            TrustboError: See `run`.
        """
        cells = [self.workspace.require_cell(f"path[{k}]", cell) for k, cell in enumerate(path)]
        if len(cells) < 2:
            raise TrustboError(f"a path needs at least two cells; got {cells}.")
        self._enter(mission)
        states = [self._start(cells[0], seed, cells[1]) for seed in seeds]
        bounds: list[list[Bound]] = [[] for _ in states]
        under_way = list(range(len(states)))
        for k, cell in enumerate(cells[1:], start=1):
            after = cells[k + 1] if k + 1 < len(cells) else None
            done = self._bounds([states[i] for i in under_way], k, cell, after)
            for i, bound in zip(under_way, done, strict=True):
                bounds[i].append(bound)
            under_way = [i for i in under_way if bounds[i][-1].status == "ok"]
            if not under_way:
                break
        names = tuple(str(f) for f in self.workspace.awareness["feature"].values)
        return [
            Mission(tuple(cells), tuple(of), of[-1].status, names, self.workspace.team.names)
            for of in bounds
        ]

    def reset(
        self, start: Cell, seed: int, *, next_cell: Cell | None = None, mission: int = 0
    ) -> None:
        """Put the team into a cell.

        Args:
            start: The cell.
            seed: Decides slip and contacts of all bounds to come.
            next_cell: Where the lead will go first, if known: T2 takes positions that see it.
            mission: See `run`.
        """
        self._enter(mission)
        self._state = self._start(start, seed, next_cell)

    def run_bound(self, k: int, cell: Cell, *, next_cell: Cell | None = None) -> Bound:
        """Run one bound.

        Args:
            k: Number of the bound, 1 for the first.
            cell: The cell to enter.
            next_cell: The cell after it, if known: T2 takes positions that see it. None: it is the
                goal.

        Returns:
            What was measured; if the status is not "ok", up to where the bound ended.

        Raises:
            TrustboError: `reset` was not called, or the cell is off the grid or impassable.
        """
        if self._state is None:
            raise TrustboError("call reset(start, seed) before run_bound.")
        return self._bounds([self._state], k, self.workspace.require_cell("cell", cell), next_cell)[
            0
        ]

    def close(self) -> None:
        """Forget where everybody is."""
        self._state = None

    def calibration(self, n_bounds: int = 300, seed: int = 0) -> dict[str, xr.Dataset]:
        """What `CompositeIndex.realtime` is fitted on: robots on random bounds, without threats.

        Args:
            n_bounds: How many bounds, each from one passable cell to a neighbour.
            seed: Same seed, same bounds.

        Returns:
            By feature, a Dataset (sample) of the map's value, `offline`, and the states of
            `simulation.STATES`, averaged over a bound; one sample per robot and bound.
        """
        rng = np.random.default_rng(require_whole("seed", seed, 0))
        plain = copy.copy(self)
        plain.record_states = plain._wants_states = True
        plain._measure = Measure(self.workspace, self._worlds.surface, self.sight, self.tick, {})
        plain._worlds = Worlds(self.workspace, self.sight, self.formation_radius)
        free, rows = np.argwhere(self.workspace.passable.values), []
        for tried in range(20 * require_whole("n_bounds", n_bounds, 1)):
            a = free[rng.integers(len(free))]
            near = free[np.abs(free - a).max(1) == 1]
            if len(near):
                b = near[rng.integers(len(near))]
                path = [(int(row), int(col)) for row, col in (a, b)]
                rows.append(plain.run(path, seed=tried).bounds[0])
            if len(rows) == n_bounds:
                break
        return plain._measure.samples(rows)

    def _enter(self, mission: int) -> None:
        """Take the world as it is for a mission."""
        self._now = self._worlds.at(require_whole("mission", mission, 0))
        self._surface, self._positions, self._routes, *_ = self._now

    # --- one bound ---

    def _start(self, start: Cell, seed: int, next_cell: Cell | None) -> State:
        cell = self.workspace.require_cell("start", start)
        here = self._positions.waypoint(cell)
        positions = self._positions.formation(cell, next_cell)
        poses = np.zeros((1 + len(positions), 3))
        poses[0, :2], poses[1:, :2] = here, positions
        tracks = new_tracks(len(positions))
        return State((cell, cell), poses, 0.0, require_whole("seed", seed, 0), tracks)

    def _bounds(
        self, states: Sequence[State], k: int, cell: Cell, next_cell: Cell | None
    ) -> list[Bound]:
        """The same bound of several missions; their states move on."""
        rngs = [np.random.default_rng([state.seed, k]) for state in states]
        drives = [
            self._drive(state, k, cell, next_cell, rng)
            for state, rng in zip(states, rngs, strict=True)
        ]
        looked = [
            self._looked(state, drive, chances, rng)
            for state, drive, chances, rng in zip(
                states, drives, self._chances(drives), rngs, strict=True
            )
        ]
        ways = [
            drive.poses[: len(contact)] for drive, (contact, _) in zip(drives, looked, strict=True)
        ]
        closing = [drive.closing(len(way)) for drive, way in zip(drives, ways, strict=True)]
        moved = [self._measure.states(way[:, 1:]) if self._wants_states else None for way in ways]
        awareness = self._measure(
            [way[own, 1:] for way, own in zip(ways, closing, strict=True)],
            [x[own] for x, own in zip(moved, closing, strict=True) if x is not None],
        )
        bounds = []
        for state, done, way, look, x, z in zip(
            states, drives, ways, looked, moved, awareness, strict=True
        ):
            contact, status = look
            n_ticks, n_robots = contact.shape
            bound = Bound(
                cell,
                z,
                contact.mean(0),
                np.full(n_robots, n_ticks * self.tick),
                status,
                state.time,
                way,
                contact,
                np.full(n_robots, n_ticks),
                x if self.record_states else None,
            )
            state.cells, state.poses, state.time = done.cells, way[-1], bound.t1
            bounds.append(bound)
        return bounds

    def _drive(
        self, state: State, k: int, cell: Cell, next_cell: Cell | None, rng: np.random.Generator
    ) -> Drive:
        """Who moves, and where to: the lead, then T2; or by turns."""
        team, cells, status = self.workspace.team, list(state.cells), "ok"
        poses, lead_moves = [state.poses[None]], []
        ticks_left = round(self.bound_timeout / self.tick)
        for who in turns(self.bounding, k, next_cell is None):
            if who == "lead":
                i, them, robots = 0, slice(0, 1), (team.lead,)
                goals = self._positions.waypoint(cell)[None]
            else:
                i, them, robots = 1, slice(1, None), team.robots
                goals = self._positions.formation(cell, next_cell)
            now = poses[-1][-1]
            way = cells[i], cell
            moved, status = self._move(now[them], robots, list(goals), way, ticks_left, rng)
            part = np.repeat(now[None], len(moved), axis=0)
            part[:, them] = moved
            poses.append(part)
            lead_moves.append(np.full(len(moved), who == "lead"))
            ticks_left -= len(moved)
            if status != "ok":
                break
            cells[i] = cell
        return Drive(
            np.concatenate(poses[1:]), np.concatenate(lead_moves), status, (cells[0], cells[1])
        )

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
            route = self._routes.find(robot, pose[:2], goal, window)
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

    def _chances(self, drives: Sequence[Drive]) -> list[np.ndarray]:
        """Probability that a look finds its target, (tick, robot): of all missions at once."""
        looks = Looks.of(self.workspace.team, drives)
        found = chance(self._surface, self.sight, looks.sensor, looks.target, looks.glass)
        for mask, strength in self._now.jams:
            inside = mask[self._surface.nearest(looks.sensor[:, 0], looks.sensor[:, 1])]
            inside |= mask[self._surface.nearest(looks.target[:, 0], looks.target[:, 1])]
            found[inside] *= 1.0 - strength
        found = found.reshape(-1, len(self.workspace.team.robots))
        found *= np.where(looks.t2_looks, self._now.detection, self.workspace.team.lead.detection)
        return np.split(found, np.cumsum([len(drive.poses) for drive in drives])[:-1])

    def _looked(
        self, state: State, drive: Drive, chances: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, str]:
        """Contact at each tick, (tick, robot), up to where the bound ends, and how it ends."""
        found = rng.random(chances.shape) < chances
        contact = np.empty(found.shape, bool)
        for phase, watchers in enumerate(self._watchers):
            who = drive.lead_moves == (phase == 0)
            contact[who] = contact_of(found[who], watchers, state.tracks[phase])
        n_ticks, status = len(contact), drive.status
        if self.lost_contact_after is not None:
            patience = max(1, round(self.lost_contact_after / self.tick))
            n_ticks, status = cut_at_lost_contact(contact, patience, status)
        return contact[:n_ticks], status
