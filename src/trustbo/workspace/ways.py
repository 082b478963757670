"""Ways: the route of each robot within a bound, from post to post.

The simulator drives them, exports contain them, and line of sight is computed along them.
"""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Cell
from trustbo.workspace.bounding import legs_along
from trustbo.workspace.posts import Posts


class Ways:
    """Ways of a team between its posts; positions are x, y in CRS metres."""

    def __init__(self, posts: Posts) -> None:
        """Take the routes over the posts' surface."""
        self.posts, self.routes = posts, posts.routes

    def bound(
        self, a: Cell, c: Cell, next_cell: Cell | None, before: Cell | None = None
    ) -> list[np.ndarray | None]:
        """Ways in the bound a -> c: the lead's, then that of each robot of T2 to watch the next.

        In alternate bounding those of either, which come from the cell `before`, if there is one.
        """
        start, watched, lead_from = a, c, c
        if self.posts.formation.bounding == "alternate" and before is not None:
            start, watched, lead_from = before, a, a
        posts = self.posts.watching(start, watched), self.posts.watching(c, next_cell, lead_from)
        return [self.posts.lead_way(start, a, c), *self.between((start, a, c), *posts)]

    def along(
        self, path: Sequence[Cell], own: np.ndarray | None = None
    ) -> list[tuple[np.ndarray | None, ...]]:
        """Ways in each bound of a path: the lead's, then that of each robot of T2.

        T2 goes between its `own` posts (bound, robot, 2), or those of the rule. The way of a robot
        that does not move is its place, twice.
        """
        lead, t2 = self.posts.places(path, own)
        ways = []
        for k, moves in enumerate(legs_along(self.posts.formation.bounding, path)):
            of_lead: np.ndarray | None = np.stack([lead[k], lead[k + 1]])
            of_t2: Sequence[np.ndarray | None] = list(np.stack([t2[k], t2[k + 1]], axis=1))
            for leg in moves:
                if leg.of_lead:
                    of_lead = self.posts.lead_way(*leg.cells)
                else:
                    of_t2 = self.between(leg.cells, t2[k], t2[k + 1])
            ways.append((of_lead, *of_t2))
        return ways

    def between(
        self, cells: Sequence[Cell], starts: np.ndarray, goals: np.ndarray
    ) -> list[np.ndarray | None]:
        """Way of each robot of T2, from and to positions (robot, 2), near some cells."""
        window = self.posts.window(*cells)
        return [
            self.routes.find(robot, start, goal, window)
            for robot, start, goal in zip(self.posts.team.robots, starts, goals, strict=True)
        ]
