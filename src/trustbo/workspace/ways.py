"""Ways: the route of each robot within a bound, from post to post.

The simulator drives them, exports contain them, and line of sight is computed along them.
"""

import numpy as np

from trustbo.data import Cell
from trustbo.workspace.posts import Posts


class Ways:
    """Ways of a team between its posts; positions are x, y in CRS metres."""

    def __init__(self, posts: Posts) -> None:
        """Take the routes over the posts' surface."""
        self.posts, self.routes = posts, posts.routes

    def lead(self, a: Cell, c: Cell) -> np.ndarray | None:
        """Way of the lead from waypoint to waypoint, (point, 2); None if there is none."""
        return self.posts.lead_way(a, c)

    def closing(self, a: Cell, c: Cell, next_cell: Cell | None) -> list[np.ndarray | None]:
        """Way of each robot of T2, from where it watched a -> c to where it watches c -> next."""
        return self.between(a, c, self.posts.watching(a, c), self.posts.watching(c, next_cell))

    def between(
        self, a: Cell, c: Cell, starts: np.ndarray, goals: np.ndarray
    ) -> list[np.ndarray | None]:
        """Way of each robot of T2 in the bound a -> c, from and to positions (robot, 2)."""
        window = self.posts.window(a, c)
        return [
            self.routes.find(robot, start, goal, window)
            for robot, start, goal in zip(self.posts.team.robots, starts, goals, strict=True)
        ]
