"""Oracle: given every change, it drives the best path of each mission's world.

It has the truth that regret is held against, as no method can. Its advocate is the referee: a
regret that is not 0 shows a fault of the benchmark, and its loss is what chance alone costs.
Less than 0.01 s a mission, once the truth is there.
"""

from trustbo.campaign.campaign import Campaign
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.planning import Planner
from trustbo.simulation import Truth

from .paths import Path, PathPolicy


class Oracle(PathPolicy):
    """Policy that takes the best path of the next mission's world."""

    __name__ = "oracle"

    def __init__(self, truth: Truth | None) -> None:
        """Begin before the first mission."""
        self._truth, self._n_missions = truth, 0

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Count the mission."""
        self._n_missions += 1

    def best(self, planner: Planner) -> Path:
        """Best path of the world of the next mission; TrustboError: there is no truth."""
        if self._truth is None:
            raise TrustboError("the oracle needs the truth of the scene, which has none.")
        world = self._truth.at(self._n_missions)
        return world.best(planner.start, planner.goal, max_bounds=planner.max_bounds)
