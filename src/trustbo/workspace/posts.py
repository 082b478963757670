"""Choice of stops, where the lead halts, and of posts, from which T2 watches the lead's next move.

In a bound a -> c (docs/concepts.md, "Why bounds"), T2 watches the lead's route from posts in a.
Then the lead watches from its stop in c while T2 leaves these posts. In the previous bound, the
lead watched from its stop in a while T2 drove to these posts. The posts of T2 are those positions p
on a lattice around the stop in a that maximise

    w mean_k s(p, lead at t_k) + (1 - w) / 2 (s(stop in a, p) + s(stop in c, p)),

where s is the detection probability under the assumed model of sight, and w is `PostSet.watching`,
0.5 for the standard set. Posts are within `RADIUS` of
the stop, possibly outside the cell, and away from the lead's route. The slope is well below the
limit at each post and along at least one way from the post to the stop. The lead stops where the
routes to the neighbouring stops are most visible.

No choice of posts is best everywhere. The sets of posts in `SETS` differ in their weights and
distances, and a planner can choose among them in each bound.

Real obstacles may be missing from maps, and mapped obstacles may not block sight. The choice of
posts and stops allows for such errors (`Posts._seen`); the feature `line_of_sight` does not.

Line of sight, the difficulty of bounds, the routes of plans and the simulator depend on this
choice. Campaigns store line of sight, but not the posts. After a change of the choice, line of
sight that was stored before is that of other posts.
"""

import math
from collections.abc import Iterable
from copy import copy
from functools import cache
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import ndimage
from scipy.spatial.distance import cdist

from trustbo.data import POST_SETS, Cell, Station
from trustbo.errors import TrustboError, warn
from trustbo.team import Robot, Team
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import MOVES
from trustbo.workspace.routes import Routes, Window, at_times, largest_region, linked_to
from trustbo.workspace.sight import Sight, detection_between, jittered, optics
from trustbo.workspace.surface import Surface

TRAVERSABLE = "traversability"
"""Name of the feature that is averaged along the robots' tracks in each bound."""
SPACING = 2.0
"""Minimum distance between T2's robots, m."""
RADIUS = 25.0
"""Maximum distance of T2 from the lead's stop, m."""
_FOUND = "_stops", "_lines", "_posts"
"""Attributes of `Posts` with what was found so far."""
_STEP = 4.0  # spacing of the lattice of positions, m
_STOP_RADIUS = 16.0  # search radius for the lead's stop, m
_SMOOTHED = 5.0  # width of the moving average of traversability for stops, m
_SAFE = 0.7  # steepest ground for posts, as a fraction of the slope limit
_DISCOUNT = 0.005  # assumed rate at which detection falls with distance, 1/m
_DOUBT = 0.1  # probability of seeing a hidden target that is near
_DOUBT_REACH = 40.0  # decay length of this probability, m
_NEARER = 1e-3  # penalty on the score per metre from the stop
_IN_THE_WAY = 5.0  # penalty of a post on the lead's route, larger than any probability
_TOO_CLOSE = 10.0  # penalty of a post beside another one
_N_WATCHED = 30  # number of positions, best seen from the stops, that are rated for all aims
_N_AIMS = 6  # number of times on the lead's route at which sight is computed
_LISTED = 5  # number of cells without room that a warning names
_SHARES = np.array([0.25, 0.5, 0.75, 1.0])  # fractions of the straight line to a neighbouring stop


class PostSet(NamedTuple):
    """What makes good posts, in one of the sets from which a planner can choose.

    Attributes:
        radius: Maximum distance of T2 from the lead's stop, m.
        gap: Preferred minimum distance between two posts, m.
        nearer: Penalty on the score per metre from the stop.
        watching: Weight of the sight of the lead's route in the score; the sight from each of the
            lead's two stops has half of the remaining weight.
    """

    radius: float = RADIUS
    gap: float = 4.0
    nearer: float = _NEARER
    watching: float = 0.5


_STANDARD = PostSet()
SETS = dict(
    zip(
        POST_SETS,
        (
            _STANDARD,
            PostSet(radius=60.0, gap=20.0, nearer=0.0),
            PostSet(radius=35.0, gap=8.0, watching=0.9),
        ),
        strict=True,
    )
)
"""Sets of posts, keyed by name; the order is that in which a workspace offers them."""


class _View(NamedTuple):
    """What the choice of posts in a cell needs, for all sets."""

    ahead: list[Cell | None]  # next cells; None for the end of the path
    stops: np.ndarray  # of the lead in the cell and in the next cells, (1 + next cell, 2)
    points: np.ndarray  # of the lead's routes to the next cells, (point, 2)
    first: np.ndarray  # position in `points` of the first point of each route, and their number
    aims: np.ndarray  # positions of the lead on its routes, (next cell, aim, 2)
    safe: np.ndarray  # mask of the safe pixels that are connected to the stop
    corner: tuple[int, int]  # first row and column of this mask


@cache
def _lattice_offsets(radius: float) -> np.ndarray:
    """Return the offsets of a lattice from a stop, (position, 2), m."""
    steps = np.arange(-radius, radius + 1e-9, _STEP)
    offset = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(offset, axis=1)
    return offset[(distance <= radius) & (distance >= SPACING)]


class Posts:
    """Stops, posts and routes of a team on a grid; positions are x and y in CRS metres.

    Attributes:
        grid: Planning grid.
        team: Lead and the overwatching robots that take part; see `of_robots`.
        sight: Assumed model of sight.
        surface: Rasters of the terrain.
        routes: Fastest routes over the surface.
    """

    def __init__(
        self,
        grid: Grid,
        team: Team,
        sight: Sight,
        surface: Surface,
        traversability: np.ndarray | None = None,
    ) -> None:
        """Prepare the rasters; without `traversability` (row, col), passable pixels are alike."""
        self.grid = grid
        self.team = team
        self.sight = sight
        self.surface = surface
        self.routes = Routes(surface)
        self._whole = team  # for which stops and posts are chosen
        self._members: list[int] | None = None  # positions in it; None for all robots

        self._standable = largest_region(surface.passable)
        self._safe = self._standable & (surface.slope <= _SAFE * team.max_slope)

        # Cell row of each pixel row, and cell column of each pixel column.
        self._cells = grid.cells_along(*surface.axes)

        self._central = self._central_stops(traversability)
        self._stops: dict[Cell, np.ndarray] = {}
        self._lines: dict[tuple[Cell, Cell], np.ndarray] = {}
        self._views: dict[Cell, _View] = {}
        self._posts: dict[tuple[Cell, Cell | None, str], np.ndarray] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Include the posts, which take minutes on large grids, in an order of their own."""
        found = {name: vars(self)[name] for name in _FOUND}
        ordered = {
            name: dict(sorted(one.items(), key=lambda item: str(item[0])))
            for name, one in found.items()
        }
        return vars(self) | ordered | {"_views": {}}

    def of_robots(self, names: Iterable[str]) -> Self:
        """Return the stops, posts and routes of some robots, as planned for the whole team.

        Raises TrustboError if a name is unknown or repeated, or if there are no names.
        """
        some = copy(self)
        vars(some).update(vars(self))  # which shares the stops and posts found so far
        some.team = self.team.of_robots(names)
        some._members = [self._whole.names.index(name) for name in some.team.names]
        return some

    # --- routes ---

    def window(self, *stations: Station) -> Window:
        """Return the pixel window that contains cells and a margin of half a cell around them."""
        window = []
        for axis, (n_pixels, n_cells) in enumerate(
            zip(self.surface.ground.shape, self.grid.shape, strict=True)
        ):
            size = n_pixels / n_cells
            cells = [station[axis] for station in stations]
            first = int((min(cells) - 0.5) * size)
            end = math.ceil((max(cells) + 1.5) * size)
            window += [max(0, first), min(n_pixels, end)]
        return window[0], window[1], window[2], window[3]

    def linked_bounds(self, exists: np.ndarray) -> np.ndarray:
        """Return a mask (move, row, col) of the bounds in `exists` with routes for all robots.

        T2's posts are connected to the stop of their cell within the cell and a margin of half a
        cell. Therefore, if the stops of two cells are connected, all robots have routes in both
        directions, whatever the next cell is.
        """
        linked = np.zeros_like(exists)
        last = len(MOVES) - 1

        for m, (down, right) in enumerate(MOVES[: len(MOVES) // 2]):  # the others are reverse moves
            for row, col in np.argwhere(exists[m]).tolist():
                a = row - down, col - right
                c = row, col

                region, (top, left) = self._linked_to(self.stop(a), a, c)
                end = self.surface.nearest(*self.stop(c))
                linked[m, *c] = linked[last - m, *a] = region[end[0] - top, end[1] - left]
        return linked

    def are_parted_by_missing(self, a: Cell, c: Cell) -> bool:
        """Return whether only pixels without a height separate the stops of two cells."""
        rows, cols = self.surface.ground.shape
        ends = [self.surface.nearest(*self.stop(cell)) for cell in (a, c)]

        known = self.surface.passable
        either = known | np.isnan(self.surface.slope)

        now, then = (
            bool(linked_to(mask, (0, rows, 0, cols), ends[0])[ends[1]]) for mask in (known, either)
        )
        return then and not now

    def bound_routes(
        self, a: Station, c: Station, next_cell: Station | None
    ) -> tuple[np.ndarray | None, ...]:
        """Find the robots' routes in the bound a -> c, the lead's route first, each (point, 2).

        The lead drives to its stop in c. T2 then drives from its posts in a to its posts for the
        bound from c to `next_cell` or, if `next_cell` is None, to positions around the lead. A
        route is None if it does not exist.
        """
        ends = zip(self.team.robots, self.watching(a, c), self.watching(c, next_cell), strict=True)
        window = self.window(a, c)
        return self._lead_route(a, c), *(self.routes.find(*each, window) for each in ends)

    def _lead_route(self, a: Station, c: Station) -> np.ndarray | None:
        """Find the lead's route from its stop in a to its stop in c, (point, 2), or None."""
        return self.routes.find(self.team.lead, self.stop(a), self.stop(c), self.window(a, c))

    def lead_line(self, a: Station, c: Station) -> np.ndarray:
        """Return the lead's route in a bound, (point, 2), or a straight line if there is none.

        The array is kept; do not change it.
        """
        ends = a[:2], c[:2]
        if ends not in self._lines:
            route = self._lead_route(a, c)
            straight = np.stack([self.stop(a), self.stop(c)])
            self._lines[ends] = straight if route is None else route
        return self._lines[ends]

    # --- stops of the lead ---

    def stop(self, station: Station) -> np.ndarray:
        """Return the lead's stop, (2,), from which routes to other stops are most visible."""
        cell = station[:2]
        if cell not in self._stops:
            self._stops[cell] = self._choose_stop(cell)
        return self._stops[cell]

    def _choose_stop(self, cell: Cell) -> np.ndarray:
        """Choose the lead's stop among positions in a cell.

        The lead looks for the first robot of T2; the heights of the others may differ.
        """
        here = self._central[cell]
        around = [self._central[c] for c in self._around(cell)]
        goals = np.array([goal for goal in around if self._is_in_region(goal)])
        safe = self._linked_to(here, cell, over=self._safe)
        lattice = self._lattice(here, _STOP_RADIUS, *safe)
        row, col = self.surface.nearest(*lattice.T)
        inside = (self._cells[0][row] == cell[0]) & (self._cells[1][col] == cell[1])
        position = np.concatenate([here[None], lattice[inside]])
        if not len(goals) or len(position) == 1:
            return here

        aims = (here + _SHARES[:, None, None] * (goals - here)).reshape(-1, 2)
        seen = self._seen(position[:, None], aims, self.team.lead, self._whole.robots[0]).mean(1)
        return position[np.argmax(seen - _NEARER * np.linalg.norm(position - here, axis=1))]

    def _central_stops(self, traversability: np.ndarray | None) -> dict[Cell, np.ndarray]:
        """Find a position with high traversability near the centre of each cell, (2,)."""
        easy = self.surface.passable if traversability is None else traversability
        easy = easy.astype(float)
        np.nan_to_num(easy, copy=False)
        for axis, side in enumerate(self.surface.pixel):
            size = max(1, round(_SMOOTHED / side))
            ndimage.uniform_filter1d(easy, size, axis, output=easy, mode="nearest")

        stops = {}
        size = np.hypot(self.grid.cell_height, self.grid.cell_width)
        for cell in np.ndindex(self.grid.shape):
            row, col = self._pixels_of(cell)
            position = self.surface.centers(row, col)
            off_centre = np.linalg.norm(position - self.grid.center(cell), axis=1) / size
            best = np.argmax(easy[row, col] - off_centre)
            stops[cell] = position[best].copy()  # not a view of all positions
        return stops

    # --- posts of T2 ---

    def watching(self, station: Station, after: Station | None) -> np.ndarray:
        """Return the posts in a cell from which T2 watches the lead's next move, shape (robot, 2).

        The station is a cell, (row, col), or a cell with a set of posts, (row, col, name). If
        `after` is None, the cell is the goal, and T2 stands around the lead.
        """
        cell = station[:2]
        next_cell = after and after[:2]
        name = station[2] if len(station) > 2 and after else POST_SETS[0]
        key = cell, next_cell, name

        if key not in self._posts:  # all next cells take little longer
            view = self._view(cell, next_cell)
            for c, posts in zip(
                view.ahead, self._choose_posts(cell, view, SETS[name]), strict=True
            ):
                self._posts[cell, c, name] = posts
        posts = self._posts[key]
        return posts if self._members is None else posts[self._members]

    def _view(self, cell: Cell, next_cell: Cell | None) -> "_View":
        """Return what the choice of all sets of posts in a cell needs."""
        view = self._views.get(cell)
        if view is not None and next_cell in view.ahead:
            return view

        around = [c for c in self._around(cell) if self._is_in_region(self.stop(c))]
        ahead = list(dict.fromkeys([None, *around, next_cell]))
        here = self.stop(cell)
        stops = np.array([here, *(here if c is None else self.stop(c) for c in ahead)])
        routes = [np.stack([here] * 2) if c is None else self.lead_line(cell, c) for c in ahead]
        first = np.cumsum([0, *map(len, routes)])
        points = np.concatenate(routes)
        aims, _ = at_times(self.surface, self.team.lead, points, first, _N_AIMS)

        safe, corner = self._linked_to(here, cell, over=self._safe)
        self._views[cell] = _View(ahead, stops, points, first, aims, safe, corner)
        return self._views[cell]

    def _choose_posts(self, cell: Cell, view: "_View", aim: PostSet) -> np.ndarray:
        """Choose the posts for each next cell, one robot at a time, (next cell, robot, 2)."""
        here = self.stop(cell)
        robots = self._whole.robots

        position = self._lattice(here, aim.radius, view.safe, view.corner)
        gap = aim.gap
        if len(position) < len(robots):  # too little safe ground
            position = self._pixels_near(cell, here)
            gap = SPACING

        scores = self._scores(here, view, position, aim)

        posts = np.empty((len(view.ahead), len(robots), 2))
        nearest = np.full((len(view.ahead), len(position)), np.inf)  # distance to a post
        for i, robot in enumerate(robots):
            score = scores[robot]
            if i:
                np.minimum(nearest, cdist(posts[:, i - 1], position), out=nearest)
                is_taken = nearest == 0.0  # avoided even where all positions are too close
                score = score - _TOO_CLOSE * (nearest < gap) - _TOO_CLOSE * is_taken
            posts[:, i] = position[np.argmax(score, axis=1)]

        for of_next, c in zip(posts, view.ahead, strict=True):
            self._abreast(of_next, np.array([0.0, 1.0]) if c is None else self.stop(c) - here)
        return posts

    def _scores(
        self, here: np.ndarray, view: "_View", position: np.ndarray, aim: PostSet
    ) -> dict[Robot, np.ndarray]:
        """Score positions as posts of each robot, (next cell, position); see the formula above."""
        lead = self.team.lead
        nearer = aim.nearer * np.linalg.norm(position - here, axis=1)
        from_route = np.minimum.reduceat(cdist(view.points, position), view.first[:-1])
        blocking = from_route < SPACING

        scores = {}
        for robot in dict.fromkeys(self._whole.robots):
            closing = self._seen(view.stops[:, None], position, lead, robot)
            closing *= (1.0 - aim.watching) / 2.0
            seen = closing[0] + closing[1:]

            best = np.argsort(nearer - seen, axis=1, kind="stable")[:, :_N_WATCHED]
            eyes = position[best][:, :, None] + jittered(_N_AIMS)
            watched = aim.watching * self._seen(eyes, view.aims[:, None], robot, lead).mean(-1)

            score = seen - 1.0  # for positions whose sight of the route is not computed
            np.put_along_axis(score, best, np.take_along_axis(seen, best, 1) + watched, 1)
            scores[robot] = score - _IN_THE_WAY * blocking - nearer
        return scores

    def _abreast(self, posts: np.ndarray, direction: np.ndarray) -> None:
        """Sort identical robots from left to right, so that their routes do not cross."""
        robots = self._whole.robots

        to_right = posts @ np.array([direction[1], -direction[0]])
        for robot in dict.fromkeys(robots):
            same = np.array([i for i, other in enumerate(robots) if other == robot])
            posts[same] = posts[same[np.argsort(to_right[same], kind="stable")]]

    def _seen(
        self, eye: np.ndarray, target: np.ndarray, watcher: Robot, watched: Robot
    ) -> np.ndarray:
        """Compute the detection probability of targets (..., 2), allowing for errors in the map.

        The probability from the map is reduced with distance. Then a small probability of seeing a
        hidden target is added, which also decreases with distance.
        """
        view = optics(watcher, watched)
        distance = np.linalg.norm(target - eye, axis=-1)
        seen = detection_between(self.surface, self.sight, eye, target, view)

        kept = seen * np.exp(-_DISCOUNT * distance)
        return kept + _DOUBT * np.exp(-distance / _DOUBT_REACH) * (1.0 - kept)

    # --- pixels ---

    def _around(self, cell: Cell) -> list[Cell]:
        """Return the neighbours of a cell on the grid."""
        rows, cols = self.grid.shape
        near = [(cell[0] + down, cell[1] + right) for down, right in MOVES]
        return [c for c in near if 0 <= c[0] < rows and 0 <= c[1] < cols]

    def _is_in_region(self, position: np.ndarray) -> bool:
        """Return whether a position is in the largest passable region."""
        return bool(self._standable[self.surface.nearest(*position)])

    def _linked_to(
        self, position: np.ndarray, *cells: Cell, over: np.ndarray | None = None
    ) -> tuple[np.ndarray, tuple[int, int]]:
        """Return a mask of the pixels connected to a position, and the mask's first row and column.

        The mask covers the window of the given cells. The pixels are connected by passable pixels
        or, if given, by the pixels of the mask `over`.
        """
        ground = self.surface.passable if over is None else over
        window = self.window(*cells)
        pixel = self.surface.nearest(*position)
        return linked_to(ground, window, pixel), (window[0], window[2])

    def _lattice(
        self, here: np.ndarray, radius: float, linked: np.ndarray, corner: tuple[int, int]
    ) -> np.ndarray:
        """Return lattice positions (position, 2) around `here`, in a mask of pixels.

        The mask is that of `_linked_to`, which stays within half a cell of the cell, and thus in
        the window of each bound.
        """
        n_cols = linked.shape[1]
        offset = _lattice_offsets(radius)
        pixels = np.rint(np.stack(self.surface.to_pixel(*(here + offset).T), axis=1)).astype(int)
        row, col = (pixels - corner).T
        inside = (row >= 0) & (row < linked.shape[0]) & (col >= 0) & (col < n_cols)

        row, col = np.divmod(np.unique(row[inside] * n_cols + col[inside]), n_cols)
        kept = linked[row, col]
        return self.surface.centers(row[kept] + corner[0], col[kept] + corner[1])

    def _pixels_near(self, cell: Cell, here: np.ndarray) -> np.ndarray:
        """Return positions in a cell, connected to the stop `here` and near it if possible."""
        row, col = self._pixels_of(cell)
        region, (top, left) = self._linked_to(here, cell)
        linked = region[row - top, col - left]

        position = self.surface.centers(row, col)[linked if linked.any() else slice(None)]
        distance = np.linalg.norm(position - here, axis=1)
        n_robots = len(self._whole.robots)

        near = np.flatnonzero((distance <= RADIUS) & (distance >= SPACING))
        if len(near) < n_robots:  # few or large pixels
            order = np.argsort(distance, kind="stable")
            near = order[distance[order] > 0.0][:n_robots]
            near = near if len(near) else order
        return position[near]

    def with_room(self, passable: np.ndarray) -> np.ndarray:
        """Return which of the `passable` cells (row, col) have enough passable pixels for the team.

        A warning is issued if some cells have too few. Raises TrustboError if all cells have too
        few.
        """
        cells = [(row, col) for row, col in np.argwhere(passable).tolist()]
        cramped = [cell for cell in cells if not self._has_room(cell)]
        if not cramped:
            return passable

        n_pixels = len(self._pixels_of(cramped[0])[0])
        pixels = "pixel" if n_pixels == 1 else "pixels"
        robot = self._whole.names[max(0, n_pixels - 1)]
        problem = (
            f"cell {cramped[0]} has {n_pixels} passable {pixels}, on which robot {robot!r} has no "
            "room beside the lead"
        )
        remedy = "use larger cells, a finer raster or fewer robots"
        if len(cramped) == len(cells):
            raise TrustboError(f"{problem}, and no other cell has room; {remedy}.")

        others = [str(cell) for cell in cramped[1:_LISTED]]
        if len(cramped) > _LISTED:
            others.append(f"{len(cramped) - _LISTED} more")
        also = f" (also: {', '.join(others)})" if others else ""
        warn(
            f"{problem}{also}; pixels that are cut off from the rest do not count. Such a cell is "
            f"treated as impassable. If you need it, {remedy}."
        )

        roomy = passable.copy()
        roomy[tuple(np.transpose(cramped))] = False
        return roomy

    def _has_room(self, cell: Cell) -> bool:
        """Return whether a cell has a passable pixel for the lead and for each robot."""
        return len(self._pixels_of(cell)[0]) > len(self._whole.names)

    def _pixels_of(self, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of a cell's passable pixels, in the largest region if possible.

        If the cell has no passable pixel, all its pixels are returned; no route leads to them.
        """
        top, bottom = np.searchsorted(self._cells[0], (cell[0], cell[0] + 1))
        left, right = np.searchsorted(self._cells[1], (cell[1], cell[1] + 1))

        for allowed in (self._standable, self.surface.passable):
            row, col = np.nonzero(allowed[top:bottom, left:right])
            if len(row):
                break
        else:
            row, col = (axis.ravel() for axis in np.indices((bottom - top, right - left)))

        return row + top, col + left
