"""Kinematic simulator of bounding overwatch."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import Cell, Mission, Station
from trustbo.errors import (
    TrustboError,
    require_kind,
    require_list,
    require_positive,
    require_switch,
    require_whole,
)
from trustbo.identity import fingerprint
from trustbo.simulation.events import Event
from trustbo.simulation.motion import drive_together
from trustbo.simulation.protocol import DescribedSimulator, require_path
from trustbo.simulation.sensing import Drive, contact_of, detections, new_tracks
from trustbo.simulation.world import World, true_surface
from trustbo.team import Robot, Team
from trustbo.workspace import Workspace
from trustbo.workspace.posts import Posts
from trustbo.workspace.sight import Sight

_MOST_TICKS = 1_000_000
"""Largest number of ticks of a bound; wheel slip is drawn in advance for every tick."""
_LEAD = slice(0, 1)
"""Index of the lead in arrays with the lead first."""
_T2 = slice(1, None)
"""Index of the other robots in such arrays."""


class State(NamedTuple):
    """State of the team between two bounds; positions in CRS metres, headings in rad."""

    cell: Station
    """Cell of the lead."""
    poses: np.ndarray
    """Position and heading of each robot, the lead first, shape (1 + robot, 3)."""
    stops: np.ndarray
    """Planned positions of the robots, at which routes start, shape (1 + robot, 2)."""
    tracks: np.ndarray
    """State of the lidars' tracks; see `sensing.new_tracks`."""


class KinematicSimulator(DescribedSimulator):
    """Simulator of unicycle robots on a terrain; contact depends on lidar line of sight.

    In the first phase of a bound, the lead drives to its stop in the next cell while T2 watches
    from its posts in the previous cell. In the second phase, T2 closes up to its next posts while
    the lead watches. The contact rate of a robot of T2 is the fraction of ticks, over both phases,
    in which the robot is in contact with the lead. Awareness is taken from the workspace.

    To simulate a different kind of motion, derive from this class and override `drive`.

    Example:
        >>> jam = tb.simulation.Jam(workspace.grid.center((4, 4)), radius=40.0)
        >>> simulator = tb.simulation.KinematicSimulator(workspace, events=[jam])
        >>> simulator.run(path, seed=0).contact_rate.mean()
    """

    def __init__(
        self,
        workspace: Workspace,
        *,
        terrain: xr.Dataset | None = None,
        sight: Sight | None = None,
        team: Team | None = None,
        tick: float = 0.5,
        bound_timeout: float = 600.0,
        events: Sequence[Event] = (),
    ) -> None:
        """Prepare a simulation on a terrain.

        The workspace plans the stops, posts and routes. The true terrain, sight and team affect
        only contact, motion and failure.

        Args:
            workspace: A workspace made from a terrain.
            terrain: True DEM and DSM, which must cover the workspace; by default the workspace's.
            sight: True model of sight; by default the workspace's.
            team: True team, with the same names; by default the workspace's.
            tick: Length of a tick, in seconds.
            bound_timeout: Time limit of a bound, in s, at most a million ticks; a longer bound ends
                the mission ("timeout").
            events: Changes of the world in given missions, such as `Jam` or `Dust`.

        Raises:
            TrustboError: The workspace has no terrain, the team's names differ, a value is not
                positive, `bound_timeout` is too long, or an event does not fit the terrain or the
                team.
        """
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        self.workspace = workspace
        self.terrain = terrain
        self.sight = Sight.of(workspace.sight if sight is None else sight)
        self.team = workspace.team if team is None else team
        if self.team.names != workspace.team.names:
            raise TrustboError(
                f"the simulated team has the robots {self.team.names}, but the workspace's team "
                f"has {workspace.team.names}; the names must match."
            )

        surface = true_surface(workspace, terrain)
        self.tick = require_positive("tick", tick)
        self.bound_timeout = require_positive("bound_timeout", bound_timeout)
        if self.bound_timeout / self.tick > _MOST_TICKS:
            raise TrustboError(
                f"bound_timeout = {self.bound_timeout:g} s is too long: a bound can take at most "
                f"{_MOST_TICKS} ticks of {self.tick:g} s."
            )
        self._max_ticks = round(self.bound_timeout / self.tick)
        self.events = tuple(require_list("events", events, Event, "give events such as Jam(...)"))

        detection = np.array([[robot.detection for robot in self.team.robots]])
        self._usual = World(surface, self.sight, self.team, detection, self.team.lead.detection)
        for event in self.events:
            event.change(self._usual)  # raises if the event does not fit

        self._posts: Posts = workspace.posts  # pyright: ignore[reportAttributeAccessIssue]

    def describe(self) -> dict[str, object]:
        """Return the settings that affect the measurements of a mission."""
        same_team = self.team == self.workspace.team
        terrain = self.terrain
        rasters = [] if terrain is None else [terrain[n].values for n in ("y", "x", "dem", "dsm")]
        return {
            "simulator": type(self).__name__,
            "sight": dataclasses.asdict(self.sight),
            "tick": self.tick,
            "bound_timeout": self.bound_timeout,
            "events": [repr(event) for event in self.events],
            "true_team": None if same_team else dataclasses.asdict(self.team),
            "true_terrain": None if terrain is None else fingerprint(rasters),
        }

    def describe_world(self, mission: int) -> dict[str, object]:
        """Return the settings of a mission's world, which are equal for equal worlds."""
        acting = [event for event in self.events if event.acts_in(mission)]
        always = [repr(dataclasses.replace(event, first=0, last=None)) for event in acting]
        return {**self.describe(), "events": always}

    def world(self, mission: int = 0, *, long_run: bool = False) -> World:
        """Return the world of a mission; if `long_run`, random factors are replaced by means."""
        require_switch("long_run", long_run)
        number = require_whole("mission", mission, 0)
        world = self._usual._replace(mission=None if long_run else number)
        for event in self.events:
            if event.acts_in(number):
                world = event.change(world)
        return world

    def run(
        self,
        path: Sequence[Cell],
        *,
        seed: int,
        mission: int = 0,
        post_sets: Sequence[str] = (),
    ) -> Mission:
        """Run a path to the goal or until a bound fails.

        Args:
            path: Cells, each a neighbour of the previous one.
            seed: Seed of wheel slip and detections; the same seed gives the same mission.
            mission: Number of the mission, from 0, which determines the active events.
            post_sets: Name of the set of posts for each bound, such as `Plan.post_sets`; by
                default, all are standard.

        Raises:
            TrustboError: A cell is off the grid or impassable, or there are fewer than two cells.
        """
        cells = require_path(self.workspace, path, post_sets)
        seed = require_whole("seed", seed, 0)
        awareness = self.workspace.along(cells)
        world = self.world(mission)

        state = self.standing(*cells[:2])
        driven = []
        for k, ahead in enumerate(zip(cells[1:], [*cells[2:], None], strict=True), start=1):
            rng = np.random.default_rng([seed, k])
            [(drive, contact, state)] = self.outcomes(world, state, k, [ahead], rng)
            driven.append((drive.status, drive.poses, contact))
            if drive.status != "ok":
                break

        statuses, poses, contacts = zip(*driven, strict=True)
        n_ticks = np.array([len(contact) for contact in contacts])
        measured = Mission.from_arrays(
            cells,
            awareness[: len(driven)],
            [contact.mean(0) for contact in contacts],
            n_ticks * self.tick,
            statuses[-1],
            n_ticks=n_ticks,
            features=self.workspace.features,
            robots=self.workspace.team.names,
        )
        return dataclasses.replace(measured, poses=poses, contact=contacts)

    def standing(self, cell: Station, next_cell: Station | None) -> State:
        """Return the state of a team that stands at the stop and the posts of a cell."""
        posts = self._posts
        stops = np.concatenate([posts.stop(cell)[None], posts.watching(cell, next_cell)])
        poses = np.concatenate([stops, np.zeros((len(stops), 1))], axis=1)
        return State(cell, poses, stops, new_tracks(len(stops) - 1))

    def drive(
        self,
        world: World,
        poses: np.ndarray,
        robots: Sequence[Robot],
        routes: Sequence[np.ndarray | None],
        window: tuple[int, int, int, int],
        max_ticks: int,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, str]:
        """Drive robots along routes simultaneously until all arrive or one fails.

        Args:
            world: World of the mission.
            poses: Initial positions and headings, shape (robot, 3).
            robots: Robots with their true properties.
            routes: Route of each robot, shape (point, 2); None for a robot without a route.
            window: Window of the workspace's pixels that contains the routes: first row, end row,
                first column and end column.
            max_ticks: Number of ticks after which the status is "timeout".
            rng: Random number generator.

        Returns:
            Poses after each tick, shape (tick, robot, 3), and status.
        """
        return drive_together(world.surface, robots, routes, poses, self.tick, max_ticks, rng)

    def outcomes(
        self,
        world: World,
        state: State,
        k: int,
        ahead: Sequence[tuple[Station, Station | None]],
        rng: np.random.Generator,
        *,
        expected: bool = False,
    ) -> list[tuple[Drive, np.ndarray, State]]:
        """Simulate the k-th bound of a mission, counted from 1, for each possible continuation.

        A continuation in `ahead` consists of the cell that the bound enters, with the set of posts
        from which T2 watches the next bound, and the next cell or None; all enter the same cell.
        Movements shared by several continuations are simulated once. If `expected` is True and
        contact depends on a single scan, the detection probability is returned as contact.

        Returns:
            For each continuation, the movements, the contact at each tick, shape (tick, robot), and
            the state after the bound.
        """
        require_switch("expected", expected)
        cell = ahead[0][0]
        # First phase: the lead drives, and T2 watches.
        goals = self._posts.stop(cell)[None]
        lead = self._move(world, state, cell, _LEAD, goals, self._max_ticks, rng)
        drives = [lead]
        runs = []
        moves: dict[bytes, int] = {}  # index into `drives`, keyed by goals

        # Second phase: T2 drives to its posts for the next cell, and the lead watches.
        for entered, next_cell in ahead:
            run = [0]
            if lead.status == "ok":
                goals = self._posts.watching(entered, next_cell)
                key = goals.tobytes()
                if key not in moves:
                    now = state._replace(poses=lead.poses[-1], stops=lead.stops)
                    n_left = self._max_ticks - len(lead.poses)
                    moves[key] = len(drives)
                    drives.append(self._move(world, now, cell, _T2, goals, n_left, rng))
                run.append(moves[key])
            runs.append(run)

        lidars = world.team.lead, *world.team.robots
        is_single_scan = all(robot.acquire == robot.drop == 1 for robot in lidars)
        seen = detections(world, drives, k)

        found = []
        for run in runs:
            poses = np.concatenate([drives[i].poses for i in run])
            lead_moves = np.concatenate([drives[i].lead_moves for i in run])
            whole = drives[run[-1]]._replace(poses=poses, lead_moves=lead_moves)
            contact = np.concatenate([seen[i] for i in run])

            tracks = state.tracks
            if not (expected and is_single_scan):
                contact, tracks = self._contact(world, tracks, whole, contact, rng)
            found.append((whole, contact, State(cell, whole.poses[-1], whole.stops, tracks)))
        return found

    def _move(
        self,
        world: World,
        state: State,
        cell: Station,
        members: slice,
        goals: np.ndarray,
        max_ticks: int,
        rng: np.random.Generator,
    ) -> Drive:
        """Drive `members` of the team to goals (robot, 2) in a cell while the others stand still.

        Routes are planned from planned positions, but the robots start at their current positions.
        """
        true = (world.team.lead, *world.team.robots)[members]
        planned = (self.workspace.team.lead, *self.workspace.team.robots)[members]

        now = state.poses
        window = self._posts.window(state.cell, cell)
        routes: list[np.ndarray | None] = []
        for robot, start, goal, pose in zip(
            planned, state.stops[members], goals, now[members], strict=True
        ):
            route = self._posts.routes.find(robot, start, goal, window)
            routes.append(None if route is None else np.concatenate([pose[None, :2], route[1:]]))

        moved, status = self.drive(world, now[members], true, routes, window, max_ticks, rng)
        poses = np.repeat(now[None], len(moved), axis=0)
        poses[:, members] = moved

        stops = state.stops.copy()
        if status == "ok":
            stops[members] = goals

        lead_moves = np.full(len(poses), members == _LEAD)
        return Drive(poses, lead_moves, status, stops)

    def _contact(
        self,
        world: World,
        tracks: np.ndarray,
        drive: Drive,
        probability: np.ndarray,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the contact at each tick, (tick, robot), and the tracks after the last tick."""
        detected = rng.random(probability.shape) < probability
        contact = np.empty(detected.shape, bool)
        tracks = tracks.copy()
        watchers = world.team.robots, (world.team.lead,) * world.team.n_robots
        for phase, lidars in enumerate(watchers):
            mask = drive.lead_moves == (phase == 0)
            contact[mask] = contact_of(detected[mask], lidars, tracks[phase])
        return contact, tracks
