"""Trust of each robot during a mission, with what is expected of the bounds ahead."""

from collections.abc import Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError
from trustbo.inference import TrustFilter, params_of, sample_prior
from trustbo.inference.filter import TrustForecast, TrustState
from trustbo.live.underway import Run, Underway

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

_N_DRAWS = 1000
_P_FALSE = 0.01
"""Chance of a false alarm in a bound, of the whole team."""
_FIVE_PERCENT = -NormalDist().inv_cdf(0.05)
_LEAST_LOSS = 0.1
"""Share of contact below which a loss is no alarm."""
_LEAST_DRAWS = 20.0
"""Effective number of draws below which a forecast is too narrow for an alarm."""
_LEAST_TICKS = 30
"""Ticks before which the rate of a bound that runs is no evidence."""


class Low(NamedTuple):
    """Contact far below what was expected."""

    bound: int
    robot: int
    rate: float
    expected: float


class Follower:
    """Filter of a mission that runs, and what it expected before each bound.

    Ticks are summed up, as their numbers are all that the filter takes of them, and filtered when
    the trust of now is asked for: a tick costs microseconds, and its trust is that of every tick.

    Attributes:
        after: Trust after each bound that ended.
        ahead: Forecast of the bounds of the rest, the one that runs included.
        n_draws: Effective number of draws of the forecast; below 20 its bands are too narrow.
        filter: Filter after the bounds that ended; None where there is none.
        low: Alarms of the bounds that ended.
        reason: Reason why there is no filter; empty where there is one.
    """

    def __init__(self, campaign: "Campaign") -> None:
        """Start before the first bound of a mission of a campaign."""
        self._campaign = campaign
        self.reason = ""
        self.filter: TrustFilter | None = None
        self._now: TrustState | None = None
        self._waiting: np.ndarray | None = None  # ticks with contact, and ticks, (2, robot)
        self.after: list[TrustState] = []
        self.ahead: TrustForecast | None = None
        self.low: list[Low] = []
        self.n_draws = 0.0
        try:
            self.filter = _filter_of(campaign)
            self._now = self.start = self.filter.state
        except TrustboError as error:  # parameters that no filter takes
            self.reason = str(error)

    @property
    def now(self) -> TrustState | None:
        """Trust now; of a bound that runs, as if it ended now. None where nothing is filtered."""
        if self._waiting is not None and self.filter is not None:
            waiting, self._waiting = self._waiting, None
            self._now = self.filter.update_ticks(*waiting)
        return self._now

    def catch_up(self, mission: Underway) -> None:
        """Take in a mission from its beginning."""
        if self.filter is None:
            return
        self.filter.reset()
        self._now, self._waiting, self.after, self.low = self.filter.state, None, [], []
        cells, runs = mission.path, mission.bounds
        for k, run in enumerate(runs):
            self.look_ahead(cells[k : k + 2])
            self._over(cells[k], run)
        self.look_ahead(mission.rest)
        if mission.running is not None:
            self.begin(mission)
            self.ticks(mission.running.n_contact, mission.running.n_ticks)

    def look_ahead(self, rest: Sequence[Cell]) -> None:
        """Forecast the bounds of the rest of a path, the current cell first."""
        self.ahead = None
        if self.filter is None or len(rest) < 2:
            return
        try:
            known = self._campaign.known_along(rest)
            self.ahead = self.filter.predict(known, rest)
            self.n_draws = float(1.0 / np.sum(self.filter.weights**2))
        except TrustboError as error:
            self._give_up(error)

    def begin(self, mission: Underway) -> None:
        """Begin the bound that runs."""
        if self.filter is None or mission.running is None:
            return
        bound = mission.here, mission.running.cell
        try:
            if self.ahead is None or not mission.planned:
                self.look_ahead(bound)
            self.filter.begin_bound(self._campaign.known_along(bound)[0], bound)
            self.ticks(*np.zeros((2, mission.n_robots)))  # trust is predicted
        except TrustboError as error:
            self._give_up(error)

    def ticks(self, n_contact: np.ndarray, n_ticks: np.ndarray) -> None:
        """Take in ticks of the bound that runs."""
        if self.filter is None:
            return
        if self._waiting is None:
            self._waiting = np.zeros((2, len(n_ticks)))
        self._waiting[0] += n_contact
        self._waiting[1] += n_ticks

    def end(self, mission: Underway) -> None:
        """End the last bound of a mission."""
        if self.filter is None:
            return
        run, _ = mission.bounds[-1], self.now  # with all ticks
        if run.awareness is not None and self._campaign.learner.awareness is not None:
            self.catch_up(mission)  # the bound was begun with what was expected
            return
        try:
            self.filter.end_bound()
        except TrustboError:  # it failed before it began
            self._over(mission.path[len(mission.bounds) - 1], run)
            return
        self._kept(run)

    def _over(self, left: Cell, run: Run) -> None:
        """Take in a bound that ended."""
        if self.filter is None:
            return
        crossed, names = (left, run.cell), self._campaign.workspace.features
        try:
            bound = replace(run.to_bound(len(names), run.begun), status="ok")
            driven = Mission(crossed, (bound,))
            awareness = self._campaign.as_learned(self._campaign.workspace.in_order(driven))
            self.filter.update(
                awareness.awareness[0], bound.contact_rate, crossed, n_ticks=bound.n_ticks
            )
        except TrustboError as error:
            self._give_up(error)
            return
        self._kept(run)

    def _kept(self, run: Run) -> None:
        assert self.filter is not None  # noqa: S101
        self.low += self.low_of(run, len(self.after) + 1)
        self._now = self.filter.state
        self.after.append(self._now)

    def low_of(self, run: Run, bound: int) -> list[Low]:
        """Robots with contact far below what was expected of a bound, the first one ahead.

        Far is below a quantile of the forecast that all robots together pass once in a hundred
        bounds, and by a tenth of contact; of the bound that runs, after 30 ticks. The quantile is
        that of a normal distribution with the forecast's mean and 5 % quantile. There are no alarms
        where fewer than 20 draws carry the weight, as may be in the first missions.
        """
        if self.ahead is None or self.n_draws < _LEAST_DRAWS:
            return []
        mean, low, rate = self.ahead.rate[0], self.ahead.rate_low[0], run.rate
        limit = -NormalDist().inv_cdf(_P_FALSE / len(mean))
        least = np.minimum(mean - limit / _FIVE_PERCENT * (mean - low), mean - _LEAST_LOSS)
        with np.errstate(invalid="ignore"):
            far = rate < least
        if not run.status:
            far &= run.n_ticks >= _LEAST_TICKS
        return [Low(bound, int(i), float(rate[i]), float(mean[i])) for i in np.flatnonzero(far)]

    def _give_up(self, error: TrustboError) -> None:
        self.filter, self._now, self.ahead, self.reason = None, None, None, str(error)


def _filter_of(campaign: "Campaign") -> TrustFilter:
    """Filter of the posterior of a campaign, or of the prior before its first mission."""
    n_robots, features = len(campaign.workspace.team.robots), campaign.workspace.features
    if (posterior := campaign.state.last_tree) is not None:
        params, observation = params_of(posterior, day=True), campaign.learner.observation
    else:
        model, observation = campaign.model.observing("gaussian"), "gaussian"
        params = sample_prior(
            model.for_features(features), len(features), _N_DRAWS, campaign.seed_of("prior"),
            n_robots=n_robots,
        )  # fmt: skip
    return TrustFilter(
        params, n_robots, response=campaign.model.response, observation=observation,
        max_draws=_N_DRAWS,
    )  # fmt: skip
