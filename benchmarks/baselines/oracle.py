"""Oracle that knows all changes of the world and drives the best path in each mission.

It plans with the truth that is used to compute the regret. Its regret must therefore be 0;
otherwise, the benchmark has a fault. Its loss is due to chance alone. A mission takes less than
0.01 s after the truth has been computed.
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
