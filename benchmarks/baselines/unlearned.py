"""Baselines that do not learn: a random path, and a random path with the fewest bounds."""

import numpy as np

from trustbo.campaign.campaign import Campaign
from trustbo.planning import Planner

from .paths import Path, PathPolicy, best_paths, line_of_sight


class RandomPath(PathPolicy):
    """Policy that draws paths; it recommends what it would drive next."""

    def __init__(self, scale: float = 100.0) -> None:
        """Draw the best path under random values of bounds, up to `scale` bounds each."""
        self.scale = scale

    def recommend(self, campaign: Campaign) -> Path:
        """Path of the next mission."""
        return campaign.ask().stations

    def choose(self, planner: Planner, rng: np.random.Generator) -> Path:
        """Draw a path, at no cost of failures."""
        sight = line_of_sight(planner)
        values = np.where(np.isnan(sight), np.nan, self.scale * rng.random(sight.shape))
        return best_paths(planner.with_failure_cost(0.0), values[None])[0]


def shortest() -> RandomPath:
    """Policy that draws any of the paths with the fewest bounds: random values break ties."""
    return RandomPath(1e-3)
