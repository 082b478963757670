"""Online estimates of each robot's trust during a mission."""

from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled
from trustbo.campaign.campaign import Campaign
from trustbo.campaign.replan import trust_filter
from trustbo.data import (
    MEASURED,
    STATUSES,
    Bound,
    Cell,
    Mission,
    Station,
    began_at,
    cells_of,
    path_text,
    split_path,
)
from trustbo.display import Rows, Summary
from trustbo.errors import (
    TrustboError,
    require_choice,
    require_finite,
    require_kind,
    require_pair,
)
from trustbo.inference.filter import TrustForecast, TrustState
from trustbo.planning import Plan
from trustbo.workspace.grid import Location

_FEW = 20
"""Effective number of draws below which the summary of a follower says how many there are."""


class Follower(Summary):
    """Follows a mission of a campaign bound by bound and tick by tick.

    Call `begin`, `tick` and `end` for each bound, and `replan` to plan the rest of the mission
    again, for example after a bound failed. After the last bound, `to_mission` returns the mission
    for `Campaign.tell`. Times are in seconds, from a single clock. Trust is estimated by a
    `TrustFilter` with the campaign's last posterior, or with the prior before the first one.
    Awareness is taken from the map.

    Attributes:
        bounds: Bounds that have ended.
        trust: Current trust, shapes (robot,); during a bound, the trust if the bound ended now. If
            the rates surprise the posterior, it rests on few draws, as `print(follower)` shows.
        running: Whether a bound is in progress.

    Example:
        >>> follower = tb.Follower(tb.Campaign(workspace, (9, 0), (0, 9)))
        >>> follower.begin(t=0.0)
        >>> follower.tick(1.0, [True, True, False])  # contact of each robot with the lead
        >>> follower.end(t=30.0)
        >>> follower.trust.mean.shape
        (3,)
    """

    def __init__(self, campaign: Campaign) -> None:
        """Follow the path that `campaign.ask()` returns, from its start.

        Raises:
            TrustboError: `campaign` is not a campaign, or cannot plan a path (see `Campaign.ask`).
        """
        require_kind("campaign", campaign, Campaign, "give a trustbo.Campaign")
        plan = campaign.ask()
        self._stations = plan.stations
        self._campaign = campaign
        self._workspace = plan.workspace
        self._goal = plan.goal
        self.bounds: tuple[Bound, ...] = ()
        self.running = False

        self._is_over = False  # whether a bound failed, after which nothing was planned
        start = trust_filter(campaign, self._workspace)

        # `_before` covers the bounds that have ended; `_now` also covers the bound in progress.
        self._before = self._now = start
        self.trust: TrustState = start.state
        self._started = self._begun = self._last = -np.inf  # times of start and last call
        n_robots = self._workspace.team.n_robots
        self._counts = np.zeros((2, n_robots))  # ticks with contact; all ticks

    @property
    def path(self) -> tuple[Cell, ...]:
        """Cells of the mission in order: the cells entered, followed by the planned ones."""
        return tuple(cells_of(self._stations))

    @property
    def post_sets(self) -> tuple[str, ...]:
        """Name of the set of posts for each bound of `path`; empty if all are standard."""
        return split_path(self._stations)[1]

    def _rows(self) -> Rows:
        here, *planned = self.rest
        doing = f"entering {path_text([here])}" if self.running else f"in {path_text([here])}"
        if self._is_over:
            doing = f"over after {path_text([here])}: {self.bounds[-1].status}"
        trust = zip(self._workspace.team.names, self.trust.mean, self.trust.sd, strict=True)
        rows = [
            ("path", path_text(self.path)),
            ("bounds", f"{len(self.bounds)} ended, {len(planned)} planned"),
            ("lead", doing),
            ("trust", ", ".join(f"{name} {mean:.2f} ± {sd:.2f}" for name, mean, sd in trust)),
        ]
        kish, n_draws = self._now.kish, len(self._now.weights)
        if kish < min(_FEW, n_draws):
            rows.append(("draws", f"{kish:.0f} of {n_draws} are effective, so trust is inexact"))
        return rows

    @property
    def rest(self) -> tuple[Cell, ...]:
        """Cell that the lead is in or is entering, followed by the planned cells."""
        return tuple(cells_of(self._ahead))

    @property
    def _ahead(self) -> tuple[Station, ...]:
        """Stations of `rest`."""
        n_entered = len(self.bounds) + 1 if self.running else len(self.bounds)
        return self._stations[n_entered:]

    def begin(self, t: float, cell: Cell | None = None) -> None:
        """Begin the next bound at time `t`, into the planned cell or into a neighbouring `cell`.

        An unplanned cell discards the rest of the plan; all later bounds then need a `cell`.

        Raises:
            TrustboError: A bound is in progress, the last bound failed, no cell is planned, the
                cell is not a neighbour, or `t` is before the previous time.
        """
        self._require(running=False, t=t)
        if self._is_over:
            raise TrustboError(
                f"the mission is over ({self.bounds[-1].status}); call to_mission, or replan if it "
                "goes on."
            )

        here, *planned = self._ahead
        if cell is None and not planned:
            raise TrustboError(f"no cell is planned after {here[:2]}; pass the next cell to begin.")
        if cell is None:
            cell = planned[0]
        else:  # the planned cell has the planned posts
            cell = require_pair("cell", cell)
            cell = next((station for station in planned[:1] if station[:2] == cell), cell)

        self._count(t, np.zeros_like(self._counts), (here, cell))
        if planned[:1] != [cell]:
            self._stations = (*self._stations[: len(self.bounds) + 1], cell)

        self._started = self._started if self.bounds else t
        self._begun = t
        self.running = True

    def tick(self, t: float, in_contact: ArrayLike) -> None:
        """Add a tick at time `t` to the bound in progress.

        Args:
            t: Time, s.
            in_contact: Contact of each robot with the lead, shape (robot,): 1 for contact, 0 for no
                contact, and NaN where not measured. A Series, a DataArray or a dict is read by the
                names of the robots.

        Raises:
            TrustboError: No bound is in progress, a value is not 0, 1 or NaN, the number of values
                or their names are not those of the robots, or `t` is before the previous time.
        """
        self._require(running=True, t=t)
        robots = {"robot": self._workspace.team.names}
        seen = read_labelled("in_contact", in_contact, ("robot",), robots).values

        measured = ~np.isnan(seen)
        if measured.shape != self._counts[0].shape or not np.isin(seen[measured], (0, 1)).all():
            raise TrustboError(f"in_contact must be 0, 1 or NaN for each robot; got {seen}.")

        counts = self._counts + np.stack([np.nan_to_num(seen), measured])
        here, cell = self._stations[len(self.bounds) :][:2]
        self._count(t, counts, (here, cell))

    def end(self, t: float, status: str = "ok") -> None:
        """End the bound in progress; a status other than `"ok"` ends the mission unless you replan.

        Raises:
            TrustboError: No bound is in progress, the status is unknown, the bound has no duration,
                or `t` is before the previous time.
        """
        self._require(running=True, t=t)
        if t == self._begun:
            raise TrustboError(f"the bound begins at t = {t} s and must end at a later time.")
        require_choice("status", status, STATUSES)
        unknown = np.full((self._counts.shape[1], len(self._workspace.features)), np.nan)
        seconds = np.full(len(unknown), t - self._begun)
        since = self._begun - self._started

        rates, n_ticks = self._measured
        bound = Bound(self.rest[0], unknown, rates, seconds, n_ticks, status, since)
        self.bounds = (*self.bounds, bound)
        self.running = False
        self._is_over = status != "ok"
        self._last = t
        self._before = self._now

    def replan(
        self, cell: Location | None = None, *, blocked: Sequence[Sequence[Cell]] = ()
    ) -> Plan:
        """Plan the rest of the mission from the bounds so far, and follow the new plan.

        After a bound has failed, the rest avoids it. If the team is in the previous cell, the next
        bound of `path` leads back there, and its ticks count like those of other bounds. If the
        team is already back, call `begin` and, at a later time, `end` without ticks.

        Args:
            cell: Cell in which the team is; by default the cell of the last bound or, if that bound
                failed, the cell before it.
            blocked: Further bounds that cannot be driven; see `Campaign.replan`.

        Returns:
            Plan of the whole mission, which `Campaign.ask` returns from now on.

        Raises:
            TrustboError: A bound is in progress, or `Campaign.replan` raises an error. The follower
                is then unchanged.
        """
        self._require(running=False)
        n = len(self.bounds)
        if cell is None:
            cell = self.path[n - 1 if self._is_over else n]

        so_far = self.to_mission() if n else None
        plan = self._campaign.replan(cell, so_far, blocked=blocked)
        self._stations = plan.stations
        self._is_over = False
        return plan

    def ahead(self) -> TrustForecast:
        """Predict trust and contact rates in the bounds of `rest`, shapes (bound, robot).

        A bound in progress is treated as if it ended now.

        Raises:
            TrustboError: No bound is planned.
        """
        here, *planned = self.rest
        if not planned:
            raise TrustboError(f"no cell is planned after {here}; nothing is left to predict.")
        return self._now.predict(self._workspace.along(self._ahead, anywhere=True), self._ahead)

    def to_mission(self) -> Mission:
        """Return the completed bounds as a mission, whose awareness is NaN (not measured).

        The mission has the status of its last bound, or `"aborted"` if that bound is `"ok"` but did
        not reach the goal.

        Raises:
            TrustboError: A bound is in progress, or none was run (use `Campaign.fail`).
        """
        if self.running or not self.bounds:
            state = "a bound is in progress; call end" if self.running else "no bound was run"
            raise TrustboError(f"there is no mission yet: {state}.")

        status = self.bounds[-1].status
        workspace = self._workspace
        if status == "ok" and self.rest != (self._goal,):
            status = "aborted"
        return Mission(
            self._stations,
            *(np.stack([getattr(bound, name) for bound in self.bounds]) for name in MEASURED),
            bound_status=tuple(bound.status for bound in self.bounds),
            starts=tuple(bound.t0 for bound in self.bounds),
            status=status,
            features=workspace.features,
            robots=workspace.team.names,
            began=began_at(self._started),
        )

    def _count(self, t: float, counts: np.ndarray, bound: tuple[Station, Station]) -> None:
        """Store tick counts (2, robot) of a bound, and the trust as if the bound ended now."""
        now = copy(self._before)  # shallow, since `update` replaces arrays

        [known] = self._workspace.along(bound, anywhere=True)
        contacts, ticks = counts
        n_ticks = np.where(ticks > 0.0, ticks, np.nan)
        rates = contacts / n_ticks
        self.trust = now.update(known, rates, bound, n_ticks=n_ticks)
        self._now = now
        self._measured = rates, n_ticks
        self._counts = counts
        self._last = t

    def _require(self, *, running: bool, t: float | None = None) -> None:
        """Raise TrustboError if the call is out of order or `t` is before the previous time."""
        if running != self.running:
            if running:
                raise TrustboError("no bound is in progress; call begin first.")
            raise TrustboError("a bound is in progress; call end first.")
        if t is not None and require_finite("t", t) < self._last:
            raise TrustboError(f"t = {t} s must not be before the last time, {self._last} s.")
