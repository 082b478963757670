"""Stopping rules for campaigns."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trustbo.campaign.course import Course
from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_share
from trustbo.planning import InfeasibleError

Stop = Callable[[Result], str | bool | None]
"""Function called between missions; returning a reason (or True) ends the campaign."""

_N_DRAWS = 500
"""Number of posterior draws; the best path is planned under each of them."""
_N_SURE = 2
"""Successive missions after which the probability must be large enough."""


def require_stop(stop: Stop | None) -> None:
    """Raise TrustboError unless a stopping rule can be called with a campaign."""
    if stop is not None and (isinstance(stop, type) or not callable(stop)):
        raise TrustboError(f"stop must be a function of the campaign; got {stop!r}.")


@dataclass(frozen=True)
class RegretBound:
    """Stop when the recommended path is nearly optimal, with high probability.

    The best path is planned exactly under each of a few hundred posterior draws. For lost_contact,
    the regret of the recommended path is the additional contact that it loses, as a fraction of the
    contact kept on the best path. For other objectives, regret is a fraction of the best path's
    value. From the third mission on, the campaign stops if two conditions hold: P(regret <= eps) >=
    1 - delta after each of the last two missions, and every bound of the recommended path has been
    completed at least once, with its sets of posts. The second condition is needed because the map
    may be wrong about bounds that no robot has driven. In a campaign with several courses, both
    conditions must hold for each course on which missions were run.

    Attributes:
        eps: Acceptable regret, as a fraction; 0.05 is 5 %.
        delta: Acceptable probability of a larger regret.

    Raises:
        TrustboError: `eps` or `delta` is outside (0, 1).

    Example:
        >>> stop = tb.RegretBound(eps=0.02, delta=0.1)
        >>> campaign = tb.iterate(workspace, (9, 0), (0, 9), n_iterations=4, stop=stop)
        >>> campaign.stop_reason
    """

    eps: float = 0.05
    delta: float = 0.1

    def __post_init__(self) -> None:
        for name, value in (("eps", self.eps), ("delta", self.delta)):
            require_share(f"RegretBound.{name}", value, ends=False)

    def __call__(self, campaign: Result) -> str | None:
        """Return the reason to stop, or None."""
        n = len(campaign.state.entries)
        if n <= _N_SURE:
            return None

        risk = campaign.risk
        least = 1.0
        for course in campaign.courses:
            sure = [self.probability(campaign, n - k, course) for k in range(_N_SURE)]
            if min(sure) < 1.0 - self.delta:
                return None

            best = campaign.recommend(*course.ends, robots=course.robots)
            bounds = tuple(risk.pairs_along(best.stations).T)
            was_completed = risk.trials[bounds] > risk.failures[bounds]
            if not was_completed.all():
                return None
            least = min(least, sure[0])
        return f"regret_bound: P(regret <= {self.eps:g}) = {least:.3f} >= {1.0 - self.delta:g}"

    def probability(self, campaign: Result, n_missions: int, course: Course | None = None) -> float:
        """Compute P(regret of the recommended path <= eps) after the first `n_missions`.

        The path is that of a course of the campaign, by default the one of `Result.plan()`.
        """
        posterior = campaign.state.entries[n_missions - 1].posterior
        if posterior is None:
            return 0.0

        planner = campaign.planner if course is None else campaign.planner_of(course)
        draws = campaign.learner.draws(posterior(), campaign.workspace)
        draws = draws.in_order(planner.workspace.team.names, planner.workspace.features)
        try:
            path = planner.plan(draws.mean()).stations
            drawn = planner.plan_draws(draws, n_draws=_N_DRAWS)
        except InfeasibleError:  # no path satisfies `max_failure`
            return 0.0

        return float(np.mean(drawn.relative_regret(path) <= self.eps))
