"""Online estimates of each robot's trust during a mission."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled
from trustbo.campaign.campaign import Campaign
from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError, require_finite, require_kind, require_pair
from trustbo.inference import TrustFilter
from trustbo.inference.filter import TrustForecast, TrustState


class Follower:
    """Follows a mission of a campaign bound by bound and tick by tick.

    Call `begin`, `tick` and `end` for each bound; after the last one, `to_mission` returns the
    mission for `Campaign.tell`. Times are in seconds, from a single clock. Trust is estimated by a
    `TrustFilter` with the campaign's last posterior, or with the prior before the first one.
    Awareness is taken from the map. All methods raise TrustboError if they are called out of order
    or if an argument, such as a time before the previous time, is invalid.

    Attributes:
        path: Cells of the mission in order: the cells entered, followed by the planned ones.
        bounds: Bounds that have ended.
        trust: Current trust, shapes (robot,); during a bound, the trust if the bound ended now.
        running: Whether a bound is in progress.
    """

    def __init__(self, campaign: Campaign) -> None:
        """Follow the path that `campaign.ask()` returns, from its start."""
        require_kind("campaign", campaign, Campaign, "give a trustbo.Campaign")
        self.path: tuple[Cell, ...] = tuple(campaign.ask().path)
        self._workspace, self._goal = campaign.workspace, self.path[-1]
        self.bounds: tuple[Bound, ...] = ()
        self.running = False
        n_robots, family = self._workspace.team.n_robots, campaign.model.observation
        if (posterior := campaign.state.posterior) is not None:
            start = TrustFilter(posterior, workspace=self._workspace)
        else:
            start = TrustFilter(campaign.draw_prior(1000), n_robots, observation=family)
        # `_before` has the bounds that have ended, and `_now` also the bound in progress.
        self._before = self._now = start
        self.trust: TrustState = start.state
        self._started = self._begun = self._last = -np.inf  # times of start and last call
        self._counts = np.zeros((2, n_robots))  # ticks with contact; all ticks

    @property
    def rest(self) -> tuple[Cell, ...]:
        """Cell that the lead is in or is entering, followed by the planned cells."""
        return self.path[len(self.bounds) + self.running :]

    def begin(self, t: float, cell: Cell | None = None) -> None:
        """Begin the next bound at time `t`, into the planned cell or into a neighbouring `cell`.

        An unplanned cell discards the rest of the plan; all later bounds then need a `cell`.
        """
        self._require(running=False, t=t)
        if self.bounds and self.bounds[-1].status != "ok":
            raise TrustboError(f"the mission is over ({self.bounds[-1].status}); call to_mission.")
        here, *planned = self.rest
        if cell is None and not planned:
            raise TrustboError(f"no cell is planned after {here}; pass the next cell to begin.")
        cell = planned[0] if cell is None else require_pair("cell", cell)
        self._count(t, np.zeros_like(self._counts), (here, cell))
        if planned[:1] != [cell]:
            self.path = (*self.path[: len(self.bounds) + 1], cell)
        self._started = self._started if self.bounds else t
        self._begun, self.running = t, True

    def tick(self, t: float, in_contact: ArrayLike) -> None:
        """Add a tick at time `t` to the bound in progress.

        `in_contact` is 1 for each robot that has contact with the lead, 0 for the others, and NaN
        where it was not measured, shape (robot,). A Series, a DataArray or a dict is read by the
        names of the robots.
        """
        self._require(running=True, t=t)
        robots = {"robot": self._workspace.team.names}
        seen = read_labelled("in_contact", in_contact, ("robot",), robots).values
        measured = ~np.isnan(seen)
        if measured.shape != self._counts[0].shape or not np.isin(seen[measured], (0, 1)).all():
            raise TrustboError(f"in_contact must be 0, 1 or NaN for each robot; got {seen}.")
        counts = self._counts + np.stack([np.nan_to_num(seen), measured])
        here, cell = self.path[len(self.bounds) :][:2]
        self._count(t, counts, (here, cell))

    def end(self, t: float, status: str = "ok") -> None:
        """End the bound in progress; a status other than `"ok"` ends the mission."""
        self._require(running=True, t=t)
        unknown = np.full((self._counts.shape[1], len(self._workspace.features)), np.nan)
        seconds, since = np.full(len(unknown), t - self._begun), self._begun - self._started
        rates, n_ticks = self._measured
        bound = Bound(self.rest[0], unknown, rates, seconds, status, since, n_ticks=n_ticks)
        self.bounds = (*self.bounds, bound)
        self.running, self._last, self._before = False, t, self._now

    def ahead(self) -> TrustForecast:
        """Predict trust and contact rates in the bounds of `rest`, shapes (bound, robot).

        A bound in progress is treated as if it ended now.
        """
        here, *planned = self.rest
        if not planned:
            raise TrustboError(f"no cell is planned after {here}; nothing is left to predict.")
        return self._now.predict(self._workspace.along(self.rest, anywhere=True), self.rest)

    def to_mission(self) -> Mission:
        """Return the completed bounds as a mission, whose awareness is NaN (not measured).

        The mission has the status of its last bound, or `"aborted"` if that bound is `"ok"` but did
        not reach the goal. If no bound was run, use `Campaign.fail` instead.
        """
        if self.running or not self.bounds:
            state = "a bound is in progress; call end" if self.running else "no bound was run"
            raise TrustboError(f"there is no mission yet: {state}.")
        status, workspace = self.bounds[-1].status, self._workspace
        if status == "ok" and self.rest != (self._goal,):
            status = "aborted"
        return Mission(self.path, self.bounds, status, workspace.features, workspace.team.names)

    def _count(self, t: float, counts: np.ndarray, bound: tuple[Cell, Cell]) -> None:
        """Store tick counts (2, robot) of a bound, and the trust as if the bound ended now."""
        now = copy(self._before)  # shallow, since `update` replaces arrays
        [known] = self._workspace.along(bound, anywhere=True)
        n_ticks = np.where(counts[1] > 0.0, counts[1], np.nan)
        self._measured = rates, n_ticks = counts[0] / n_ticks, n_ticks
        self.trust = now.update(known, rates, bound, n_ticks=n_ticks)
        self._now, self._counts, self._last = now, counts, t

    def _require(self, *, running: bool, t: float) -> None:
        """Raise TrustboError if the call is out of order or `t` is before the previous time."""
        if running != self.running:
            some, first = ("no", "begin") if running else ("a", "end")
            raise TrustboError(f"{some} bound is in progress; call {first} first.")
        if require_finite("t", t) < self._last:
            raise TrustboError(f"t = {t} s must not be before the last time, {self._last} s.")
