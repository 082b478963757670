"""Kinematic simulator of bounding overwatch: movements and contacts, bound by bound."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError, require_positive, require_whole
from trustbo.planning.plan import Plan
from trustbo.simulation.events import Degradation, Event, Threat, require_events
from trustbo.simulation.measure import Measure
from trustbo.simulation.motion import drive_together
from trustbo.simulation.protocol import DescribedSimulator
from trustbo.simulation.sensing import contact_of, detections, new_tracks
from trustbo.simulation.state import Drive, State
from trustbo.simulation.world import Worlds, true_surface
from trustbo.team import Robot, Team
from trustbo.terrain import CompositeIndex
from trustbo.terrain.read import digest_of
from trustbo.workspace import Workspace
from trustbo.workspace.sight import Sight, sights_of


class KinematicSimulator(DescribedSimulator):
    """Unicycle robots on a DEM and DSM, in contact while their lidar has a line of sight.

    In the first phase of a bound the lead drives to its stop in the next cell while T2 watches from
    its posts in the last; in the second, T2 closes up to its next posts while the lead watches. The
    contact rate of a robot of T2 is the share of ticks, of both phases, in which it is in contact
    with the lead.

    `run` runs a path, `run_batch` many missions over one; `reset`, `run_bound` and `close` run one
    bound by bound.
    """

    def __init__(
        self,
        workspace: Workspace,
        *,
        terrain: xr.Dataset | None = None,
        sight: Sight | str | None = None,
        team: Team | None = None,
        tick: float = 0.5,
        bound_timeout: float = 600.0,
        threats: Sequence[Threat] = (),
        degradations: Sequence[Degradation] = (),
        events: Sequence[Event] = (),
        realtime: Mapping[str, CompositeIndex] | None = None,
        record_states: bool = False,
    ) -> None:
        """Prepare a terrain for simulation.

        Robots stand and drive where the workspace planned. The true terrain, sight and team decide
        contact, motion and failure only.

        Args:
            workspace: A workspace made from a terrain in memory.
            terrain: True DEM and DSM, where they differ from the workspace's, which they cover.
            sight: True model of sight, or only its mode: "bare", "wall" or "transmittance"; by
                default the workspace's first.
            team: True robots, of the same names; by default the workspace's.
            tick: Length of a tick, s.
            bound_timeout: Longest duration of a bound, s; the mission then ends as "timeout".
            threats: Regions that jam sight or forbid passage in some missions.
            degradations: Lidars of T2 that are worse in some missions.
            events: Events of any kind, `Dust`, `Fouling`, `Vegetation` and `Season` too, which act
                after threats and degradations, in this order.
            realtime: Fitted `CompositeIndex` of `REALTIME` by feature: measured awareness is then
                the map's value fused with the robot's state. Samples to fit them on: `calibration`.
            record_states: Keep each robot's state at each tick, `Bound.states`.

        Raises:
            TrustboError: A workspace without terrain, an unknown sight mode or robot, a value that
                is not positive, a threat off the terrain.
        """
        assumed = (*workspace.sights, Sight())[0]
        self.workspace, self.terrain = workspace, terrain
        self.sight = assumed if sight is None else sights_of(sight)[0]
        self.team = workspace.team if team is None else team
        if self.team.names != workspace.team.names:
            raise TrustboError(
                f"the true team has robots {self.team.names}, the workspace's "
                f"{workspace.team.names}; give as many, by the same names."
            )
        surface = true_surface(workspace, terrain)
        self.tick = require_positive("tick", tick)
        self.bound_timeout = require_positive("bound_timeout", bound_timeout)
        self._max_ticks = round(self.bound_timeout / self.tick)
        self.realtime, self.record_states = dict(realtime or {}), record_states
        self._wants_states = record_states or bool(self.realtime)
        require_events("threats", threats, Threat)
        require_events("degradations", degradations, Degradation)
        require_events("events", events, Event)
        self.threats, self.degradations = tuple(threats), tuple(degradations)
        self.events = (*self.threats, *self.degradations, *events)
        self._worlds = Worlds(workspace, self.sight, self.team, surface, self.events)
        self._measure = Measure(workspace, self.team, surface, self.sight, self.tick, self.realtime)
        self._watchers = self.team.robots, (self.team.lead,) * len(self.team.robots)
        self._state: State | None = None
        self._enter(0)

    def describe(self) -> dict[str, object]:
        """Return the settings that decide what a mission measures."""
        same = self.team == self.workspace.team
        n_older = len(self.threats) + len(self.degradations)
        return {
            "simulator": type(self).__name__,
            "sight": self.sight.mode,
            "extinction": self.sight.extinction,
            "crown_base": self.sight.crown_base,
            "tick": self.tick,
            "bound_timeout": self.bound_timeout,
            "threats": [dataclasses.asdict(threat) for threat in self.threats],
            "degradations": [dataclasses.asdict(degradation) for degradation in self.degradations],
            "events": [event.settings for event in self.events[n_older:]],
            "realtime": sorted(self.realtime),
            "true_team": None if same else dataclasses.asdict(self.team),
            "true_terrain": None if self.terrain is None else digest_of(self.terrain),
        }

    def describe_mission(self, mission: int) -> dict[str, object]:
        """Return the settings of the world of a mission, which are equal in equal worlds."""
        every = ("threats", "degradations", "events")
        settings = {name: value for name, value in self.describe().items() if name not in every}
        return settings | {"acting": [e.effect for e in self.events if e.acts_in(mission)]}

    def run(
        self,
        path: Sequence[Cell] | Plan,
        *,
        seed: int,
        mission: int = 0,
    ) -> Mission:
        """Run a path, or that of a plan, from start to goal or until it fails.

        Args:
            path: Cells, each a neighbour of the last; or a plan.
            seed: Seed of slip and detections: same seed, same mission, on any machine.
            mission: Number of the mission, from 0, by which events go.

        Raises:
            TrustboError: A cell that is off the grid or impassable, or fewer than two cells.
        """
        return self.run_batch(path, [seed], mission=mission)[0]

    def run_batch(
        self,
        path: Sequence[Cell] | Plan,
        seeds: Sequence[int],
        *,
        mission: int = 0,
    ) -> list[Mission]:
        """Run a path many times, faster than one by one; each as `run` does with its seed.

        Args:
            path: See `run`.
            seeds: Seeds of the missions.
            mission: See `run`.

        Raises:
            TrustboError: See `run`.
        """
        if isinstance(path, Plan):
            path = path.path
        cells = [self.workspace.require_cell(f"path[{k}]", cell) for k, cell in enumerate(path)]
        if len(cells) < 2:
            raise TrustboError(f"a path needs at least two cells; got {cells}.")
        numbers = [require_whole("seed", seed, 0) for seed in seeds]
        self._enter(mission)
        states = [self.standing(*cells[:2], seed=n) for n in numbers]
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
        names = self.workspace.features, self.workspace.team.names
        return [Mission(tuple(cells), tuple(run), run[-1].status, *names) for run in bounds]

    def reset(
        self, start: Cell, seed: int, *, next_cell: Cell | None = None, mission: int = 0
    ) -> None:
        """Put the team into a cell.

        Args:
            start: Start cell.
            seed: Seed of slip and detections in all bounds to come.
            next_cell: Cell of the first bound, if given: T2 takes positions that see it.
            mission: See `run`.
        """
        self._enter(mission)
        cell, seed = self.workspace.require_cell("start", start), require_whole("seed", seed, 0)
        self._state = self.standing(cell, next_cell, seed=seed)

    def run_bound(self, k: int, cell: Cell, *, next_cell: Cell | None = None) -> Bound:
        """Run one bound.

        Args:
            k: Number of the bound, 1 for the first.
            cell: Cell to enter.
            next_cell: Cell after it, which T2 takes positions to see; None: `cell` is the goal.

        Returns:
            Measured data; if the status is not "ok", up to the tick in which the bound ended.

        Raises:
            TrustboError: `reset` was not called, or the cell is off the grid or impassable.
        """
        if self._state is None:
            raise TrustboError("call reset(start, seed) before run_bound.")
        cell = self.workspace.require_cell("cell", cell)
        return self._bounds([self._state], k, cell, next_cell)[0]

    def close(self) -> None:
        """End the mission that runs bound by bound."""
        self._state = None

    def run_ahead(
        self,
        k: int,
        cell: Cell,
        ahead: Sequence[Cell | None],
        rng: np.random.Generator,
        state: State,
    ) -> list[tuple[np.ndarray, str, State]]:
        """Simulate bound k for each admissible next cell; moves that they share are computed once.

        From a state of the team. Returns for each the contact rate (robot,), the status and the
        state after it. The rate is the mean probability of contact over the ticks where scans are
        independent; where tracks outlast misses, that of simulated scans. Fouling is as in the long
        run.
        """
        lead = self._advance(state, cell, self._max_ticks, rng)
        now, left = _after(state, lead), self._max_ticks - len(lead.poses)
        drives, runs = [lead], []
        moves: dict[bytes, int] = {}  # by their goals
        for next_cell in ahead:
            run = [0]
            if lead.status == "ok":
                goals = self._ways.posts.watching(cell, next_cell)
                if (key := goals.tobytes()) not in moves:
                    moves[key] = len(drives)
                    drives.append(self._close_up(now, cell, goals, left, rng))
                run.append(moves[key])
            runs.append(run)
        lidars = self.team.lead, *self.team.robots
        independent = all(robot.acquire == robot.drop == 1 for robot in lidars)
        fouling = np.ones(len(self.team.robots))
        for event in self._now.fouling:  # the probability of contact is linear in the factors
            fouling *= event.mean if independent else event.draw(rng, len(fouling))
        seen = detections(self._now, self.team, drives, fouling)
        outcomes = []
        for run in runs:
            whole = _joined([drives[i] for i in run])
            then = _after(state, whole, cell)
            then.tracks = state.tracks.copy()
            probability = np.concatenate([seen[i] for i in run])
            if not independent:
                probability = self._contact(then, whole, probability, rng)
            outcomes.append((probability.mean(0), whole.status, then))
        return outcomes

    def calibration(self, n_bounds: int = 300, seed: int = 0) -> dict[str, xr.Dataset]:
        """Simulate random bounds, without threats, to fit real-time indices on.

        Args:
            n_bounds: Number of bounds, each from a passable cell to a neighbour.
            seed: Seed of the bounds.

        Returns:
            Dataset (sample) by feature: the map's value, `offline`, and the states of
            `Bound.states`, averaged over a bound; one sample per robot and bound.
        """
        rng = np.random.default_rng(require_whole("seed", seed, 0))
        plain = copy.copy(self)
        plain.record_states = plain._wants_states = True
        of_world = self._worlds.surface, self.sight
        plain._measure = Measure(self.workspace, self.team, *of_world, self.tick, {})
        plain._worlds = Worlds(self.workspace, self.sight, self.team, self._worlds.surface)
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
        """Switch to the world of a mission."""
        self._now = self._worlds.of_mission(require_whole("mission", mission, 0))
        self._mission, self._surface, self._ways = mission, self._now.surface, self._now.ways

    # --- one bound ---

    def standing(self, cell: Cell, next_cell: Cell | None, *, seed: int = 0) -> State:
        """State of a mission with all in their places in a cell, to go to the next."""
        rule = self._ways.posts
        first = rule.watching(cell, next_cell)
        stops = np.concatenate([rule.stop(cell)[None], first])
        poses = np.concatenate([stops, np.zeros((len(stops), 1))], axis=1)
        return State(cell, poses, stops, 0.0, seed, new_tracks(len(first)))

    def _bounds(
        self, states: Sequence[State], k: int, cell: Cell, next_cell: Cell | None
    ) -> list[Bound]:
        """Run the same bound of several missions, and update their states."""
        rngs = [np.random.default_rng([state.seed, k]) for state in states]
        drives = [
            self._drive(state, k, cell, next_cell, rng)
            for state, rng in zip(states, rngs, strict=True)
        ]
        fouling = np.ones(len(self.team.robots))
        for event in self._now.fouling:
            fouling *= event.factors(self._mission, k, len(fouling))
        probabilities = detections(self._now, self.team, drives, fouling)
        contacts = [
            self._contact(*one) for one in zip(states, drives, probabilities, rngs, strict=True)
        ]
        closing = [drive.closing for drive in drives]
        moved = [
            self._measure.states(d.poses[:, 1:]) if self._wants_states else None for d in drives
        ]
        awareness = self._measure(
            [drive.poses[one, 1:] for drive, one in zip(drives, closing, strict=True)],
            [x[one] for x, one in zip(moved, closing, strict=True) if x is not None],
        )
        bounds = []
        for state, drive, contact, x, z in zip(
            states, drives, contacts, moved, awareness, strict=True
        ):
            n_ticks, n_robots = contact.shape
            duration, ticks = np.full(n_robots, n_ticks * self.tick), np.full(n_robots, n_ticks)
            kept = x if self.record_states else None
            of_bound = cell, z, contact.mean(0), duration, drive.status, state.time
            bounds.append(Bound(*of_bound, drive.poses, contact, ticks, kept))
            state.poses, state.stops, state.time = drive.poses[-1], drive.stops, bounds[-1].t1
            state.cell = cell if drive.status == "ok" else state.cell
        return bounds

    def _drive(
        self, state: State, k: int, cell: Cell, next_cell: Cell | None, rng: np.random.Generator
    ) -> Drive:
        """Drive the lead, then T2."""
        lead = self._advance(state, cell, self._max_ticks, rng)
        if lead.status != "ok":
            return lead
        goals = self._ways.posts.watching(cell, next_cell)
        left = self._max_ticks - len(lead.poses)
        return _joined([lead, self._close_up(_after(state, lead), cell, goals, left, rng)])

    def _advance(self, state: State, cell: Cell, max_ticks: int, rng: np.random.Generator) -> Drive:
        """Drive the lead to its stop in a cell while T2 stands."""
        robots = [self.team.lead], [self.workspace.team.lead]
        goals = self._ways.posts.stop(cell)[None]
        return self._move_part(state, cell, slice(0, 1), robots, goals, max_ticks, rng)

    def _close_up(
        self,
        state: State,
        cell: Cell,
        goals: np.ndarray,
        max_ticks: int,
        rng: np.random.Generator,
    ) -> Drive:
        """Drive T2 to goals (robot, 2) in a cell while the lead stands."""
        robots = self.team.robots, self.workspace.team.robots
        return self._move_part(state, cell, slice(1, None), robots, goals, max_ticks, rng)

    def _move_part(
        self,
        state: State,
        cell: Cell,
        members: slice,
        robots: tuple[Sequence[Robot], Sequence[Robot]],
        goals: np.ndarray,
        max_ticks: int,
        rng: np.random.Generator,
    ) -> Drive:
        """Drive part of the team, the true `robots` as those that were planned for, to goals.

        Routes start at the planned posts, robots at their current poses.
        """
        true, planned = robots
        now, window = state.poses, self._ways.posts.window(state.cell, cell)
        routes: list[np.ndarray | None] = []
        for robot, start, goal, pose in zip(
            planned, state.stops[members], goals, now[members], strict=True
        ):
            route = self._ways.routes.find(robot, start, goal, window)
            routes.append(None if route is None else np.concatenate([pose[None, :2], route[1:]]))
        moved, status = self._move(now[members], true, routes, window, max_ticks, rng)
        poses = np.repeat(now[None], len(moved), axis=0)
        poses[:, members] = moved
        stops = state.stops.copy()
        if status == "ok":
            stops[members] = goals
        return Drive(poses, np.full(len(poses), members.start == 0), status, stops)

    def _move(
        self,
        poses: np.ndarray,
        robots: Sequence[Robot],
        routes: Sequence[np.ndarray | None],
        window: tuple[int, int, int, int],
        max_ticks: int,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, str]:
        """Drive robots at the same time: poses (tick, robot, 3) until all arrive or one fails.

        The routes keep within a window of the planned surface: first and end row, then column.
        """
        return drive_together(self._surface, robots, routes, poses, self.tick, max_ticks, rng)

    def _contact(
        self, state: State, drive: Drive, probabilities: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Contact at each tick, (tick, robot)."""
        detected = rng.random(probabilities.shape) < probabilities
        contact = np.empty(detected.shape, bool)
        for phase, watchers in enumerate(self._watchers):
            mask = drive.lead_moves == (phase == 0)
            contact[mask] = contact_of(detected[mask], watchers, state.tracks[phase])
        return contact


def _after(state: State, drive: Drive, cell: Cell | None = None) -> State:
    """State after movements, of the same tracks; in a cell if the bound into it is over."""
    moved = dataclasses.replace(state, poses=drive.poses[-1], stops=drive.stops)
    return moved if cell is None else dataclasses.replace(moved, cell=cell)


def _joined(drives: Sequence[Drive]) -> Drive:
    """Movements one after the other."""
    poses, moves = (
        np.concatenate([getattr(drive, name) for drive in drives]) for name in Drive._fields[:2]
    )
    return drives[-1]._replace(poses=poses, lead_moves=moves)
