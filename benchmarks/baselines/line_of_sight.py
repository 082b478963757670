"""Line of sight alone: the path that loses least contact where the map and its physics are right.

It has the predicted contact of every bound, which all methods here are given, and never learns.
Its advocate would say that a good survey needs no missions: it is the method to beat where the map
is right. Less than 0.01 s a mission.
"""

from trustbo.planning import Planner

from .paths import Path, PathPolicy, best_paths, line_of_sight


class LineOfSight(PathPolicy):
    """Policy that always takes the best path by line of sight."""

    __name__ = "line of sight"

    def best(self, planner: Planner) -> Path:
        """Best path by line of sight."""
        return best_paths(planner, line_of_sight(planner)[None])[0]
