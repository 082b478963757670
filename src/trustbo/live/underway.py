"""The mission that runs, as the fold of the events of its journal.

States are: between two bounds, in a bound, and over. An event is a record with the name `event`:
`plan` (first), `begin` and `end` of a bound, `ticks` and `awareness` in it, `report` of trust, and
`route`, the cells still to be entered, planned anew. The state is the events applied in their order
and nothing else, so that a process that reads them goes on where another one was killed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from trustbo.answers import PERSON, Reports
from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError, require_pair
from trustbo.workspace.moves import moves_along, require_on_grid

Event = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Run:
    """Bound that runs, or ran.

    Attributes:
        cell: Cell that it enters.
        begun: Time of its start, s, by the clock of the messages.
        n_contact: Number of ticks with contact, (robot,).
        n_ticks: Number of ticks, (robot,).
        awareness: Awareness that was measured, (robot, feature); None where it was not.
        last: Time of its last tick, s; of its end once that is known.
        status: Outcome; empty while it runs.
        reports: Trust that was reported in it or after it, (robot,); None where it was not.
    """

    cell: Cell
    begun: float
    n_contact: np.ndarray
    n_ticks: np.ndarray
    awareness: np.ndarray | None = None
    last: float | None = None
    status: str = ""
    reports: np.ndarray | None = None

    @property
    def rate(self) -> np.ndarray:
        """Share of the ticks with contact, (robot,); NaN without ticks."""
        with np.errstate(invalid="ignore"):
            return self.n_contact / self.n_ticks

    def to_bound(self, n_features: int, start: float) -> Bound:
        """Measurements of the bound, in a mission that began at a time."""
        n = len(self.n_ticks)
        seconds = self.last - self.begun if self.last is not None else 0.0
        unknown = np.full((n, n_features), np.nan)
        return Bound(
            self.cell,
            unknown if self.awareness is None else self.awareness,
            self.rate,
            np.full(n, seconds if seconds > 0.0 else np.nan),
            self.status,
            max(self.begun - start, 0.0),
            n_ticks=np.where(self.n_ticks > 0, self.n_ticks, np.nan),
        )


@dataclass(frozen=True, eq=False)
class Underway:
    """Mission that runs.

    Attributes:
        shape: Rows and columns of the grid.
        n_robots: Number of robots.
        path: Cells of the mission, those entered first; the rest is planned.
        goal: Cell at which the mission is complete.
        planned: Whether the path leads to its end; a bound to another cell than the planned one
            leaves no plan, until there is a `route`.
        bounds: Bounds that ended.
        running: Bound that runs.
        status: Outcome of the mission; empty until it is over.
        before: Trust that was reported before the first bound, (robot,); None where it was not.
        person: Person who reports trust.
    """

    shape: tuple[int, int]
    n_robots: int
    path: tuple[Cell, ...]
    goal: Cell
    planned: bool = True
    bounds: tuple[Run, ...] = ()
    running: Run | None = None
    status: str = ""
    before: np.ndarray | None = None
    person: str = PERSON

    @property
    def k(self) -> int:
        """Number of the bound that runs, or is next, from 1."""
        return len(self.bounds) + 1

    @property
    def here(self) -> Cell:
        """Cell where the team is, or that it left."""
        return self.path[len(self.bounds)]

    @property
    def rest(self) -> tuple[Cell, ...]:
        """Cells from here on, this one first."""
        return self.path[len(self.bounds) :]

    def after(self, event: Event) -> Self:
        """Mission after an event; TrustboError: the event cannot follow."""
        if self.status:
            raise TrustboError(f"the mission is over: {self.status}.")
        name = event.get("event")
        applied = {
            "begin": self._begun,
            "ticks": self._ticked,
            "awareness": self._measured,
            "end": self._ended,
            "report": self._reported,
            "route": self._routed,
        }.get(str(name))
        if applied is None:
            raise TrustboError(f"unknown event {name!r}.")
        return applied(event)

    def _begun(self, event: Event) -> Self:
        if self.running is not None:
            raise TrustboError(f"bound {self.k} runs: give its status first.")
        if event["bound"] != self.k:
            raise TrustboError(f"bound {event['bound']} cannot begin: bound {self.k} is next.")
        cell = require_pair("cell", event["cell"])
        entered = self.path[: self.k]
        if self.planned and cell == self.path[self.k]:
            path, planned = self.path, True
        else:
            require_on_grid([cell], self.shape)
            moves_along([self.here, cell])
            path, planned = (*entered, cell), False
        contacts, ticks = np.zeros((2, self.n_robots), dtype=np.int64)
        return replace(
            self,
            path=path,
            planned=planned,
            running=Run(cell, float(event["t"] or 0.0), contacts, ticks),
        )

    def _ticked(self, event: Event) -> Self:
        running = self._require_running("ticks")
        contacts, ticks = counts_of(event)
        if not len(contacts) == len(ticks) == self.n_robots:
            raise TrustboError(f"ticks of {len(ticks)} robots; there are {self.n_robots}.")
        # In place: the only event that comes by the thousand.
        running.n_contact[:] += contacts
        running.n_ticks[:] += ticks
        object.__setattr__(running, "last", event["t"])
        return self

    def _measured(self, event: Event) -> Self:
        if self._last is None:
            raise TrustboError("no bound has begun, of which awareness could be measured.")
        return self._changed(awareness=_updated(self._last.awareness, event["values"]))

    def _reported(self, event: Event) -> Self:
        if event["person"] != self.person and np.isfinite(self.reports).any():
            raise TrustboError(
                f"{self.person} reports in this mission; {event['person']} may in the next one."
            )
        if self._last is None:
            mission = replace(self, before=_updated(self.before, event["values"]))
        else:
            mission = self._changed(reports=_updated(self._last.reports, event["values"]))
        return replace(mission, person=event["person"])

    @property
    def _last(self) -> Run | None:
        """Bound that runs, or, before the next one, the last; None before the first."""
        return self.running or (self.bounds[-1] if self.bounds else None)

    def _changed(self, **fields: np.ndarray) -> Self:
        """Mission with other fields of the last bound."""
        changed = replace(self._last, **fields)  # pyright: ignore
        if self.running is not None:
            return replace(self, running=changed)
        return replace(self, bounds=(*self.bounds[:-1], changed))

    @property
    def reports(self) -> np.ndarray:
        """Trust that was reported, (1 + bound, robot), the bound that runs included."""
        runs = (*self.bounds, self.running) if self.running is not None else self.bounds
        rows = [self.before, *(run.reports for run in runs)]
        none = np.full(self.n_robots, np.nan)
        return np.array([none if row is None else row for row in rows])

    def _ended(self, event: Event) -> Self:
        status = str(event["status"])
        if self.running is None:
            if status == "ok":
                raise TrustboError(f"no bound runs: begin bound {self.k} first.")
            if status == "aborted" or not self.planned:
                return replace(self, status="aborted")
            # It failed to enter the next cell, of which nothing was measured.
            event = {"event": "begin", "bound": self.k, "cell": self.path[self.k], "t": event["t"]}
            return self._begun(event)._ended({"status": status, "t": None})
        end = event.get("t")
        running = replace(
            self.running, status=status, last=self.running.last if end is None else end
        )
        bounds = (*self.bounds, running)
        complete = len(bounds) == len(self.path) - 1 if self.planned else running.cell == self.goal
        status = status if status != "ok" or complete else ""
        return replace(self, bounds=bounds, running=None, status=status)

    def _routed(self, event: Event) -> Self:
        """Another way on from here; from the start it may lead to another goal."""
        rest = [require_pair("path", cell) for cell in event["path"]]
        if self.running is not None:
            raise TrustboError(f"bound {self.k} runs: the rest is planned when it ended.")
        require_on_grid(rest, self.shape)
        if len(rest) < 2:
            raise TrustboError(f"a path is of two cells or more; got {rest}.")
        moves_along(rest)
        if not self.bounds:  # a mission that another plan was made for
            return replace(self, path=tuple(rest), planned=True, goal=rest[-1])
        if rest[0] != self.here:
            raise TrustboError(f"the rest begins at {rest[0]}; the team is at {self.here}.")
        return replace(self, path=(*self.path[: len(self.bounds)], *rest), planned=True)

    def _require_running(self, what: str) -> Run:
        if self.running is None:
            raise TrustboError(f"no bound runs: {what} belong to none.")
        return self.running

    def to_mission(
        self, features: Sequence[str], robots: Sequence[str], scale: str = "unit"
    ) -> Mission | None:
        """Mission to learn from, once it is over; None if no bound was begun.

        Reports are on a scale.
        """
        if not self.bounds:
            return None
        start = self.bounds[0].begun
        bounds = tuple(run.to_bound(len(features), start) for run in self.bounds)
        given = np.isfinite(self.reports).any()
        reports = Reports(self.reports, self.person, scale) if given else None
        names = tuple(features), tuple(robots)
        return Mission(self.path, bounds, self.status, *names, reports=reports)


def _updated(before: np.ndarray | None, values: Sequence[Any]) -> np.ndarray:
    """Values of an event, with those before where it has none."""
    new = np.array(values, dtype=float)  # None becomes NaN
    return new if before is None else np.where(np.isnan(new), before, new)


def counts_of(event: Event) -> tuple[Sequence[int], Sequence[int]]:
    """Numbers of ticks with contact and of ticks, by robot, of an event."""
    if (tick := event.get("c")) is not None:  # one tick: 1, 0, or - where it was not measured
        return [int(sign == "1") for sign in tick], [int(sign != "-") for sign in tick]
    return event["contact"], event["n"]


def ticks_event(n_contact: np.ndarray, n_ticks: np.ndarray, t: float) -> Event:
    """Event of ticks; a short one for a single tick."""
    if n_ticks.max(initial=0) <= 1:
        signs = np.where(n_ticks > 0, np.where(n_contact > 0, "1", "0"), "-")
        return {"event": "ticks", "c": "".join(signs.tolist()), "t": t}
    return {"event": "ticks", "contact": n_contact, "n": n_ticks, "t": t}
