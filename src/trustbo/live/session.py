"""A campaign in the field: the mission that runs, its journal, and what is to be computed."""

import os
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np

from trustbo.answers import levels_of
from trustbo.campaign import Campaign
from trustbo.campaign.running import better_rest, weighted_mean
from trustbo.campaign.state import LEARNED
from trustbo.data import Cell
from trustbo.errors import DamagedFileError, TrustboError, require_kind
from trustbo.files import FilePath
from trustbo.hazard.exposures import CAUSES
from trustbo.live import view
from trustbo.live.follow import Follower
from trustbo.live.journal import Journal
from trustbo.live.messages import (
    Awareness,
    Contact,
    Ending,
    Marker,
    Message,
    Pose,
    Reader,
    Report,
)
from trustbo.live.underway import Event, Underway, ticks_event
from trustbo.logs.reports import scale_of
from trustbo.planning import Plan

FOLDER = "live"
"""Folder of the journals, in that of the campaign."""
_MOST_LINES = 50

type Apply = Callable[[], None]
type Job = Callable[[], Apply]
"""Work that may take seconds, and may be done in another thread; what it returns is called after
it in the thread of the session."""


class _Opened(NamedTuple):
    """Mission that runs, as read from its journal."""

    number: int
    journal: Journal
    mission: Underway
    follower: Follower
    plan: Plan


class Live:
    """Campaign in the field: its state is that of the folder, and the events of a journal.

    Each message that changes the state is a line of the journal before it counts. A mission that is
    over is passed to `Campaign.tell` or `Campaign.fail`, whose folder then counts it; the next one
    has another journal. A process that opens the folder after a kill has the same state.

    Attributes:
        campaign: Campaign, with its folder.
        mission: Mission that runs.
        number: Number of the mission, from 1; those given up count.
        follower: Trust of each robot during the mission.
        poses: Last position of each robot that was reported, CRS metres.
        log: Last lines about what happened, with their times, POSIX s.
        job: Work to be done before the mission goes on, see `take`; None if there is none.
        trouble: Reason why nothing more can be taken; empty while all is well.
        n_idle: Number of messages of contact between two bounds, which count for none.
        version: Number that grows with each change.
    """

    def __init__(
        self,
        campaign: Campaign | FilePath,
        *,
        replan: bool = True,
        over: Callable[[str], object] = str,
    ) -> None:
        """Open a campaign, and go on with its mission.

        Args:
            campaign: Campaign that writes to a folder, or its folder, see `Campaign.load`.
            replan: Whether the rest of a path is planned again after each bound.
            over: Function that gets a line about each mission that is over, and the `trouble`.

        Raises:
            TrustboError: There is no campaign, another process has locked it, or it writes to no
                folder.
            DamagedFileError: A file of the folder or the journal is damaged.
        """
        if isinstance(campaign, str | os.PathLike):
            campaign = Campaign.load(campaign)
        self.campaign = require_kind("campaign", campaign, Campaign, "give it, or its folder")
        if campaign.storage is None:
            raise TrustboError(
                "a live campaign writes to a folder: Campaign(..., directory=), or save(keep=True)."
            )
        self._folder = campaign.storage.path / FOLDER
        self._replan, self._over = replan, over
        told = [mission for mission in campaign.state.measured if mission.reports is not None]
        self._scale = scale_of(told) if told else "unit"
        names = campaign.workspace.team.names, campaign.workspace.features
        self.reader = Reader(*names, levels=levels_of(self._scale))
        self.poses: dict[str, tuple[float, float]] = {}
        self.log: deque[tuple[float, str]] = deque(maxlen=_MOST_LINES)
        self.job: Job | None = None
        self.trouble, self.n_idle, self.version, self.busy_with = "", 0, 0, ""
        try:
            self._hold(self._open())
            if (k := self.mission.k) > 1 or self.mission.running is not None:
                self.say(f"went on with mission {self.number} at bound {k}")
        except BaseException:
            campaign.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the journal, and release the folder; the mission goes on when it is opened."""
        self.journal.close()
        self.campaign.__exit__()

    # --- messages ---

    def tell(self, line: str | bytes) -> None:
        """Take a message, and do the work that follows; see `docs/live.md` for messages.

        Args:
            line: One JSON object.

        Raises:
            TrustboError: The message is refused, and nothing has changed.
        """
        message = self.reader.read(line)
        while not self.take(message):
            self.settle()
        self.journal.sync()
        self.settle()

    def settle(self) -> None:
        """Do the work that is to be done."""
        while self.job is not None:
            self.job()()

    def take(self, message: Message) -> bool:
        """Take a message, unless work is to be done first.

        Returns:
            False if the message is to be passed again when the `job` was done.

        Raises:
            TrustboError: The message is refused, and nothing has changed.
        """
        if self.trouble:
            raise TrustboError(self.trouble)
        if isinstance(message, Contact):
            self._ticks(message)
            return True
        if isinstance(message, Pose):
            self.poses.update(message.places)
            self.version += 1
            return True
        if self.job is not None:
            return False
        if isinstance(message, Report):
            values = [None if np.isnan(v) else v for v in message.values.tolist()]
            self._happen({"event": "report", "values": values, "person": message.person})
            return True
        if isinstance(message, Awareness):
            self._awareness(message)
            return True
        if isinstance(message, Ending):
            self._require_mission(message)
            self._end(message.status, message.note, message.t)
            return True
        return self._start(message) if message.bound == 0 else self._begin(message)

    def _ticks(self, message: Contact) -> None:
        running = self.mission.running
        if running is None:
            self.n_idle += 1
            return
        t = time.time() if message.t is None else message.t
        self._happen(ticks_event(message.n_contact, message.n_ticks, t))
        self.follower.ticks(message.n_contact, message.n_ticks)

    def _awareness(self, message: Awareness) -> None:
        values = [[None if np.isnan(v) else v for v in row] for row in message.values.tolist()]
        self._happen({"event": "awareness", "values": values})
        if self.mission.running is None and self.campaign.learner.awareness is not None:
            self.follower.catch_up(self.mission)  # of the bound before

    def _start(self, marker: Marker) -> bool:
        """Start a mission; one that runs is over then."""
        mission = self.mission
        if mission.running is not None:
            self._end("ok", "", None)
        elif mission.bounds:
            self._end("aborted", "another mission began", marker.t)
        else:
            path = marker.path or mission.path
            if marker.cell is not None and marker.cell != path[0]:
                raise TrustboError(
                    f"the mission starts at {path[0]}, not at {marker.cell}; a mission on another "
                    'path gives its "path".'
                )
            if path != mission.path:
                self._happen({"event": "route", "path": path})
                self.follower.look_ahead(path)
            return True
        return False

    def _begin(self, marker: Marker) -> bool:
        mission = self.mission
        if mission.running is not None:
            if marker.bound != mission.k + 1:
                raise TrustboError(f"bound {marker.bound} cannot begin: bound {mission.k} runs.")
            # Both or none: a marker that is refused does not end the bound before it.
            over = mission.after({"event": "end", "status": "ok", "t": None})
            over.after(self._beginning(marker, over))
            self._end("ok", "", None)
            return False
        self._happen(self._beginning(marker, mission))
        self.follower.begin(self.mission)
        self.n_idle = 0
        return True

    def _beginning(self, marker: Marker, mission: Underway) -> Event:
        """Event of the start of a bound, by default to the planned cell."""
        cell = marker.cell
        if cell is None and not mission.status:
            if not mission.planned:
                raise TrustboError(f"no path leads on from {mission.here}: give the cell entered.")
            cell = mission.path[mission.k]
        t = time.time() if marker.t is None else marker.t
        return {"event": "begin", "bound": marker.bound, "cell": cell, "t": t}

    def _end(self, status: str, note: str, t: float | None) -> None:
        """End the bound that runs, by its last tick unless a time is given."""
        before, running = self.mission, self.mission.running
        if t is None and (running is None or running.last is None):
            t = time.time()
        self._happen({"event": "end", "status": status, "note": note, "t": t})
        if len(self.mission.bounds) > len(before.bounds):
            self.follower.end(self.mission)
            for low in self.follower.low:
                if low.bound == before.k:
                    self.say(view.sentence_of(low, self.reader.robots))
        self.say(f"bound {before.k}: {status}" + (f" ({note})" if note else ""))
        self._plan_work()

    def _require_mission(self, ending: Ending) -> None:
        """Refuse an end of another mission: a message that came twice must give up one alone."""
        if ending.mission not in (None, self.number):
            raise TrustboError(f"mission {self.number} runs, not {ending.mission}.")
        begun = self.mission.bounds or self.mission.running is not None
        if ending.status != "ok" and ending.mission is None and not begun:
            raise TrustboError(
                f"no bound of mission {self.number} has begun; to give it up, name it: "
                f'"mission": {self.number}.'
            )

    def _happen(self, event: Event) -> None:
        """Check an event, write it to the journal, and apply it."""
        if event["event"] == "ticks":  # checked when it was read, and applied in place
            self.journal.write(event)
            self.mission.after(event)
        else:
            after = self.mission.after(event)
            self.journal.write(event)
            self.mission = after
        self.version += 1

    # --- work ---

    def _plan_work(self) -> None:
        """Set the job that the state of the mission asks for."""
        mission = self.mission
        if mission.status:
            self.job, self.busy_with = self._learn, "learning"
        elif mission.bounds and mission.running is None:
            self.job, self.busy_with = self._route, "planning"
        self.version += 1

    def _may_replan(self) -> bool:
        """Whether the rest of the mission is that of the campaign's planner, and not fixed."""
        mission, planner = self.mission, self.campaign.planner
        ends = mission.path[0], mission.goal
        return ends == (planner.start, planner.goal) and (self._replan or not mission.planned)

    def _route(self) -> Apply:
        """Plan the rest of the mission from the trust of now."""
        mission, follower = self.mission, self.follower
        rest = mission.rest
        if self._may_replan():
            with suppress(TrustboError):  # no way on: too few bounds are left
                rest = self._better_rest()
        follower.look_ahead(rest)

        def apply() -> None:
            self.job, self.busy_with = None, ""
            if tuple(rest) != mission.rest or not mission.planned:
                if len(rest) > 1:
                    self._happen({"event": "route", "path": rest})
                    self.say(f"planned anew from {mission.here}")
                else:
                    self.say(
                        f"no path leads on from {mission.here} within the bounds that are left"
                    )
            self.version += 1

        return apply

    def _better_rest(self) -> tuple[Cell, ...]:
        """Best rest of the mission from here; TrustboError: too few bounds are left."""
        mission, campaign, live = self.mission, self.campaign, self.follower.filter
        planner = campaign.planner_now().onward(mission.path[: mission.k])
        if mission.planned:
            if live is None or campaign.state.last is None:  # the prior is no reason to change
                return mission.rest
            return better_rest(planner, live, mission.rest)
        if live is None:
            return planner.plan(campaign.belief.mean()).path
        params = weighted_mean(live.params, live.weights)
        return planner.plan(params, x0=live.state.mean).path

    def _learn(self) -> Apply:
        """Pass the mission to the campaign, and plan the next one."""
        try:
            said, refused = self._record(), False
        except TrustboError as error:
            if isinstance(error.__cause__, OSError):  # the disk is full: another try may succeed
                return partial(self.stopped, str(error))
            said, refused = f"mission {self.number} is not recorded: {error}", True
        except Exception as error:
            return partial(self.stopped, f"{type(error).__name__}: {error}")
        try:
            opened = self._open(refused=refused)
        except Exception as error:
            return partial(self.stopped, f"{type(error).__name__}: {error}")

        def apply() -> None:
            self.journal.close()
            self._hold(opened)
            self.say(said)
            self._over(f"{said}. {view.to_do(self)}")

        return apply

    def _record(self) -> str:
        """Record the mission in the campaign; returned is a line about it."""
        mission, campaign = self.mission, self.campaign
        names = campaign.workspace.features, self.reader.robots
        measured = mission.to_mission(*names, self._scale)
        tried = any(run.status == "ok" or run.n_ticks.any() for run in mission.bounds)
        if measured is None or not tried:
            where: Cell | None = mission.bounds[-1].cell if mission.bounds else None
            if mission.status not in CAUSES or where not in campaign.ask().path[1:]:
                where = None
            campaign.fail(mission.status, where=where)
            return f"mission {self.number} was given up: {mission.status}"
        campaign.tell(measured, other_path=True)
        row = campaign.state.entries[-1].row
        learned = f"learned from mission {self.number}: {mission.status}"
        return learned if row["state"] == LEARNED else f"mission {self.number}: {row['reason']}"

    def _open(self, *, refused: bool = False) -> "_Opened":
        """Open the journal of the next mission, or of the one that runs, and fold its events."""
        campaign = self.campaign
        lost = sum(not failure.reported for failure in campaign.state.failures)
        number = len(campaign.state.entries) + lost + 1
        plan, follower = campaign.ask(), Follower(campaign)
        file = self._folder / f"{number:04d}.jsonl"
        if refused:
            os.replace(file, file.with_suffix(f".refused-{time.time_ns()}.jsonl"))
        journal = Journal(file)
        if not journal.records:
            journal.write({"event": "plan", "path": plan.path, "mission": number})
            journal.sync()
        mission = _fold(journal, plan.path, campaign)
        follower.catch_up(mission)
        return _Opened(number, journal, mission, follower, plan)

    def _hold(self, opened: "_Opened") -> None:
        """Go on with a mission that was opened."""
        self.number, self.journal, self.mission = opened.number, opened.journal, opened.mission
        self.follower, self.plan = opened.follower, opened.plan
        self.journal.records.clear()
        self.maps: dict[str, Any] = {}
        self.posts: dict[tuple[Cell, Cell, Cell | None], list[list[float]]] = {}
        self.job, self.busy_with = None, ""
        self._plan_work()

    def stopped(self, reason: str) -> None:
        """Take nothing more, for a reason."""
        self.job, self.busy_with = None, ""
        self.trouble = f"{reason} Nothing that was told is lost; start again to go on."
        self.say(self.trouble)
        self._over(self.trouble)

    def say(self, text: str) -> None:
        """Add a line to the log."""
        self.log.append((time.time(), text))
        self.version += 1

    # --- views ---

    def state(self) -> dict[str, Any]:
        """State of the mission as JSON; see `docs/live.md` for its fields."""
        return view.state_of(self)

    def map(self, layer: str = "trust", robot: str | None = None) -> dict[str, Any]:
        """Map of the planning cells as JSON.

        Args:
            layer: `"trust"`, the largest expected trust with which a cell can be reached, or
                `"cost"`, 1 - sigma(trust).
            robot: Robot that it is of; None for the team.

        Raises:
            TrustboError: There is no such layer or robot.
        """
        return view.map_of(self, layer, robot)


def _fold(journal: Journal, path: tuple[Cell, ...], campaign: Campaign) -> Underway:
    """Mission of the events of a journal; DamagedFileError if one cannot follow."""
    shape, n_robots = campaign.workspace.grid.shape, len(campaign.workspace.team.robots)
    mission = Underway(shape, n_robots, tuple(path), path[-1])
    for number, event in enumerate(journal.records, start=1):
        try:
            if number == 1:
                cells = tuple((row, col) for row, col in event["path"])
                mission = Underway(shape, n_robots, cells, cells[-1])
            else:
                mission = mission.after(event)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise DamagedFileError(
                f"{str(journal.path)!r} is damaged: line {number} cannot follow those before "
                f"({' '.join(str(error).split())}). The campaign is whole; move the file away to "
                "give up the mission that it holds."
            ) from None
    return mission
