"""Baseline that plans with the predicted line of sight and does not learn.

It uses the predicted contact of every bound, which all methods are given. If the map and the model
of sight are right, no other method should lose less contact. A mission takes less than 0.01 s.
"""

from trustbo.planning import Planner

from .paths import Path, PathPolicy, best_paths, line_of_sight


class LineOfSight(PathPolicy):
    """Policy that always takes the best path by line of sight."""

    __name__ = "line of sight"

    def best(self, planner: Planner) -> Path:
        """Best path by line of sight."""
        return best_paths(planner, line_of_sight(planner)[None])[0]
