"""Ways: the route of each robot within a bound, from post to post.

The simulator drives them, exports contain them, and line of sight is computed along them.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from trustbo.data import Cell
from trustbo.workspace.posts import Posts


class Ways:
    """Ways of a team between its posts; positions are x, y in CRS metres."""

    def __init__(self, posts: Posts) -> None:
        """Take the routes over the posts' surface."""
        self.posts, self.routes = posts, posts.routes

    def bound(self, a: Cell, c: Cell, next_cell: Cell | None) -> list[np.ndarray | None]:
        """Ways in the bound a -> c: the lead's, then that of each robot of T2 to watch the next."""
        posts = self.posts.watching(a, c), self.posts.watching(c, next_cell)
        return [self.posts.lead_way(a, c), *self.between((a, c), *posts)]

    def along(self, path: Sequence[Cell]) -> list[tuple[np.ndarray | None, ...]]:
        """Ways in each bound of a path: the lead's, then that of each robot of T2."""
        t2 = self.posts.places(path)[1]
        return [
            (self.posts.lead_way(a, c), *self.between((a, c), t2[k], t2[k + 1]))
            for k, (a, c) in enumerate(pairwise(path))
        ]

    def between(
        self, cells: Sequence[Cell], starts: np.ndarray, goals: np.ndarray
    ) -> list[np.ndarray | None]:
        """Way of each robot of T2, from and to positions (robot, 2), near some cells."""
        window = self.posts.window(*cells)
        return [
            self.routes.find(robot, start, goal, window)
            for robot, start, goal in zip(self.posts.team.robots, starts, goals, strict=True)
        ]
