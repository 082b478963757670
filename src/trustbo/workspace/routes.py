"""Fastest routes over passable pixels, and the regions that routes connect.

Two pixels are in the same region if they are connected by passable pixels that share edges. A route
between two pixels therefore exists if and only if they are in the same region: it does not pass
diagonally between two impassable pixels or cut the corner of one.
"""

import math
from typing import Any

import numpy as np
from scipy import ndimage

from trustbo.kernels import kernel, part
from trustbo.team import Robot
from trustbo.terrain.pixels import nearest_pixel
from trustbo.workspace.surface import Surface

Window = tuple[int, int, int, int]
"""Window of pixels: first row, end row, first column and end column; ends are exclusive."""
SLOWEST = 0.1
"""Speed at the slope limit as a fraction of the speed on level ground."""
_CLEARANCE = 1.0  # preferred distance from obstacles, because robots stray from routes, m
_TIE = 1e-9  # m on level ground; costs that differ by less are equal up to rounding
SLACK = 2.0 * _TIE
"""Slack of a `search` that finds all ways that are as fast as the fastest one."""
_CLOSE = 4.0  # factor on the cost of a route that is closer to an obstacle
_compiled = kernel()
_part = part()


class Routes:
    """Fastest routes over passable pixels, found by A* and cached.

    Attributes:
        room: Distance of each pixel to the nearest impassable one (row, col), m, in single
            precision; inf if there is none.
    """

    def __init__(self, surface: Surface) -> None:
        """Find the pixels near obstacles."""
        self._surface = surface

        free: Any = ndimage.distance_transform_edt(surface.passable, sampling=surface.pixel)
        self._is_close = free <= max(_CLEARANCE, *surface.pixel)
        self.room = free.astype(np.float32)
        if surface.passable.all():
            self.room[:] = np.inf
        self._paces: dict[float, np.ndarray] = {}
        self._cached: dict[tuple[object, ...], np.ndarray] = {}

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_paces": {}, "_cached": {}}  # found again when needed

    def find(
        self, robot: Robot, start: np.ndarray, goal: np.ndarray, window: Window
    ) -> np.ndarray | None:
        """Return the fastest route from start to goal, or None if there is none.

        The route stays inside the pixel window. It has shape (point, 2), x and y in CRS metres.
        """
        ends = [self._surface.nearest(*position) for position in (start, goal)]

        low, high = sorted(ends)  # the reversed route is the same
        key = low, high, window, robot.max_slope
        if key not in self._cached:
            self._cached[key] = self._search(*key)

        cached = self._cached[key]
        if not len(cached):
            return None
        if len(cached) == 1:  # start and goal are in the same pixel
            return np.stack([start, goal])

        route = cached[:: 1 if ends[0] == low else -1].copy()
        route[0] = start
        route[-1] = goal
        return route

    def pace(self, max_slope: float) -> np.ndarray:
        """Return the inverse of the speed on each pixel (row, col); infinite where impassable.

        Speed is relative to level ground. Pixels near obstacles have a larger pace.
        """
        if max_slope not in self._paces:
            pace = speed_share(self._surface.slope, max_slope)
            np.divide(1.0, pace, out=pace)
            pace[self._is_close] *= _CLOSE
            pace[~self._surface.passable] = np.inf
            self._paces[max_slope] = pace
        return self._paces[max_slope]

    def _search(
        self, start: tuple[int, int], goal: tuple[int, int], window: Window, max_slope: float
    ) -> np.ndarray:
        """Find the pixels of a route, and return their positions; empty if there is no route."""
        surface = self._surface
        top, bottom, left, right = window
        pace = self.pace(max_slope)[top:bottom, left:right]
        row, col = a_star(
            np.pad(pace, 1, constant_values=np.inf),
            surface.pixel,
            (start[0] - top + 1, start[1] - left + 1),
            (goal[0] - top + 1, goal[1] - left + 1),
        ).T
        return surface.centers(row + top - 1, col + left - 1)


@_compiled
def speed_share(tilt, max_slope):
    """Compute the speed at a pitch or roll (rad) as a fraction of the speed on level ground."""
    return np.maximum(SLOWEST, 1.0 - (1.0 - SLOWEST) * tilt / max_slope)


@_part
def framed(pace, window):
    """Return a window of a map of paces with a frame of impassable pixels, one pixel wide."""
    top, bottom, left, right = window
    within = np.full((bottom - top + 2, right - left + 2), np.inf)
    for r in range(top, bottom):
        for c in range(left, right):
            within[r - top + 1, c - left + 1] = pace[r, c]
    return within


@_part
def _least_ahead(pace, pixel, box):
    """Compute a lower limit on the cost of the way from each pixel to a rectangle, flat.

    A way leads from a pixel to one of its 8 neighbours, so it is longer than a straight line. `box`
    contains the first and the last row, and the first and the last column.
    """
    rows, cols = pace.shape
    diagonal = math.hypot(pixel[0], pixel[1])
    least = np.inf
    for r in range(rows):
        for c in range(cols):
            least = min(least, pace[r, c])

    ahead = np.empty(rows * cols)
    for r in range(rows):
        down = max(box[0] - r, 0, r - box[1])
        for c in range(cols):
            right = max(box[2] - c, 0, c - box[3])
            n_diagonal = min(down, right)
            straight = (down - n_diagonal) * pixel[0] + (right - n_diagonal) * pixel[1]
            ahead[r * cols + c] = (n_diagonal * diagonal + straight) * least
    return ahead


@_part
def _neighbours(cols, pixel):
    """Return the steps to the 8 neighbours of a pixel, as flat indices and as distances.

    Args:
        cols: Number of columns of the map.
        pixel: Height and width of a pixel, m.

    Returns:
        Steps along the column, along the row, and in all, shape (3, neighbour), and distances.
    """
    steps = np.empty((3, 8), np.int64)
    length = np.empty(8)
    k = 0
    for down in range(-1, 2):
        for right in range(-1, 2):
            if down == 0 and right == 0:
                continue
            steps[0, k] = down * cols
            steps[1, k] = right
            steps[2, k] = down * cols + right
            length[k] = pixel[1] if down == 0 else pixel[0]
            if down != 0 and right != 0:
                length[k] = math.hypot(pixel[0], pixel[1])
            k += 1
    return steps, length


@_part
def _cost_of_step(paces, flat, steps, lengths, k):
    """Return the cost of step k of `_neighbours` from a pixel, or to it, since costs are symmetric.

    The cost is infinite if the step passes between two impassable pixels or cuts the corner of one.
    """
    if paces[flat + steps[0, k]] == np.inf or paces[flat + steps[1, k]] == np.inf:
        return np.inf
    return 0.5 * (paces[flat] + paces[flat + steps[2, k]]) * lengths[k]


@_part
def _mark(goals, is_goal):
    """Mark the goals inside the frame; return their number and the rectangle around them."""
    rows, cols = is_goal.shape
    n = 0
    box = rows, 0, cols, 0
    for k in range(len(goals)):
        r = goals[k, 0]
        c = goals[k, 1]
        if _is_inside((r, c), is_goal.shape) and not is_goal[r, c]:
            is_goal[r, c] = True
            n += 1
            box = min(box[0], r), max(box[1], r), min(box[2], c), max(box[3], c)
    return n, box


@_part
def _is_inside(pixel, shape):
    """Return whether a pixel (row, col) is inside the frame of a map."""
    return 0 < pixel[0] < shape[0] - 1 and 0 < pixel[1] < shape[1] - 1


@_part
def _rise(keys, queue, place, at, key, pixel):
    """Move a pixel up from a position of a binary heap, in the order of keys and then of pixels.

    Args:
        keys: Keys of the pixels in the heap.
        queue: Flat indices of the pixels in the heap.
        place: Position of each pixel in the heap; -1 if it is not there.
        at: Position.
        key: Key of the pixel.
        pixel: Flat index of the pixel.
    """
    while at > 0:
        parent = (at - 1) // 2
        if keys[parent] < key or (keys[parent] == key and queue[parent] < pixel):
            break
        keys[at] = keys[parent]
        queue[at] = queue[parent]
        place[queue[at]] = at
        at = parent
    keys[at] = key
    queue[at] = pixel
    place[pixel] = at


@_part
def _pop(keys, queue, place, n):
    """Remove the first of the n pixels of a binary heap; see `_rise`."""
    first = queue[0]
    n -= 1
    at = 0
    child = 1
    while child < n:
        if child + 1 < n:  # without branches, which are hard to predict
            equal = (keys[child + 1] == keys[child]) & (queue[child + 1] < queue[child])
            child += (keys[child + 1] < keys[child]) | equal
        keys[at] = keys[child]
        queue[at] = queue[child]
        place[queue[at]] = at
        at = child
        child = 2 * at + 1
    _rise(keys, queue, place, at, keys[n], queue[n])
    place[first] = -1
    return first


@_part
def search(pace, pixel, start, goals, slack):
    """Find the fastest ways from a pixel to other pixels by A* (Hart, Nilsson and Raphael 1968).

    The estimate of the way ahead is that to the rectangle around the goals. It is admissible and
    consistent.

    Args:
        pace: Inverse of the speed on each pixel (row, col); infinite where impassable, and in a
            frame around the map (see `framed`).
        pixel: Height and width of a pixel, m.
        start: Row and column.
        goals: Rows and columns, shape (goal, 2).
        slack: Amount by which the cost of a way may exceed that of the farthest goal, so that the
            search continues; if it is 0, the search ends at the farthest goal.

    Returns:
        The least cost to each pixel, inf if it was not reached, and the flat index of the previous
        pixel on the way, -1 at the start.
    """
    rows, cols = pace.shape
    best = np.full((rows, cols), np.inf)
    came = np.full((rows, cols), -1)
    is_goal = np.zeros((rows, cols), np.bool_)
    marks = is_goal.reshape(-1)
    n_left, box = _mark(goals, is_goal)
    if n_left == 0 or not _is_inside(start, pace.shape):
        return best, came

    paces = pace.reshape(-1)
    costs = best.reshape(-1)
    previous = came.reshape(-1)
    ahead = _least_ahead(pace, pixel, box)
    steps, lengths = _neighbours(cols, pixel)

    keys = np.empty(len(paces))
    queue = np.empty(len(paces), np.int64)
    place = np.full(len(paces), -1)
    n = 1  # of the queue
    queue[0] = start[0] * cols + start[1]
    keys[0] = 0.0
    place[queue[0]] = 0
    costs[queue[0]] = 0.0
    limit = np.inf

    while n > 0:
        estimate = keys[0]
        if estimate > limit:
            break
        flat = _pop(keys, queue, place, n)
        n -= 1

        if marks[flat]:
            marks[flat] = False
            n_left -= 1
            if n_left == 0:
                limit = estimate + slack
                if slack == 0.0:
                    break

        for k in range(8):
            to = flat + steps[2, k]
            cost = costs[flat] + _cost_of_step(paces, flat, steps, lengths, k)
            if not cost < costs[to]:
                continue

            costs[to] = cost
            previous[to] = flat
            at = place[to]
            if at < 0:
                at = n
                n += 1
            _rise(keys, queue, place, at, cost + ahead[to], to)
    return best, came


@_part
def way_to(best, came, goal):
    """Return the pixels (point, 2) of the way that `search` found to a goal; empty if none."""
    _, cols = best.shape
    if not _is_inside(goal, best.shape) or not np.isfinite(best[goal]):
        return np.empty((0, 2), np.int64)

    n = 1
    cell = goal[0] * cols + goal[1]
    while came[cell // cols, cell % cols] >= 0:
        cell = came[cell // cols, cell % cols]
        n += 1

    cells = np.empty((n, 2), np.int64)
    cell = goal[0] * cols + goal[1]
    for k in range(n - 1, -1, -1):
        cells[k, 0] = cell // cols
        cells[k, 1] = cell % cols
        cell = came[cell // cols, cell % cols]
    return cells


@_compiled
def a_star(pace, pixel, start, goal):
    """Find the pixels (point, 2) of the fastest way between two pixels; empty if there is none.

    The map of paces has a frame; see `search`.
    """
    best, came = search(pace, pixel, start, np.array([[goal[0], goal[1]]]), 0.0)
    return way_to(best, came, goal)


@_part
def same_way(pace, pixel, best, came, start, goal):
    """Return the way to one of the goals of a `search` with slack `SLACK`, as `Routes.find` does.

    Equally fast ways differ by the order in which a search visits pixels. A way that is not the
    only fastest one is therefore found again by `a_star`.
    """
    way = way_to(best, came, goal)
    if _is_only_one(pace, pixel, best, way):
        return way
    if start <= goal:  # as in `Routes.find`
        return a_star(pace, pixel, start, goal)
    return a_star(pace, pixel, goal, start)[::-1].copy()


@_part
def _is_only_one(pace, pixel, best, way):
    """Return whether no other way to the end of `way` is as fast, up to rounding.

    `best` contains the cost of all pixels from which another way could lead to the end.
    """
    _, cols = pace.shape
    paces = pace.reshape(-1)
    costs = best.reshape(-1)
    steps, lengths = _neighbours(cols, pixel)
    for k in range(1, len(way)):
        flat = way[k, 0] * cols + way[k, 1]
        before = way[k - 1, 0] * cols + way[k - 1, 1]
        for m in range(8):
            other = flat + steps[2, m]
            cost = costs[other] + _cost_of_step(paces, flat, steps, lengths, m)
            if other != before and cost <= costs[flat] + _TIE:
                return False
    return True


def at_times(
    surface: Surface, robot: Robot, flat: np.ndarray, first: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find a robot's positions at n evenly spaced times on each route, and the durations.

    The routes are concatenated in `flat`, shape (point, 2). `first` contains the index of the first
    point of each route, followed by the number of points. Positions have shape (route, time, 2),
    and durations, in seconds, have shape (route,).
    """
    limits = robot.speed, robot.max_slope
    return _resampled(surface.gradient, surface.pixel, surface.origin, flat, first, limits, n)


@_compiled
def _resampled(gradient, pixel, origin, flat, first, limits, n_samples):
    """Compute the result of `at_times`; the speed decreases with the larger of pitch and roll."""
    shape = gradient.shape[1:]
    n = len(first) - 1
    points = np.empty((n, n_samples, 2))
    duration = np.empty(n)

    longest = 0
    for b in range(n):
        longest = max(longest, first[b + 1] - first[b])

    clock = np.empty(longest)

    for b in range(n):
        way = flat[first[b] : first[b + 1]]
        clock[0] = 0.0
        for k in range(1, len(way)):
            dx = way[k, 0] - way[k - 1, 0]
            dy = way[k, 1] - way[k - 1, 1]

            length = max(np.hypot(dx, dy), 1e-9)
            i, j = nearest_pixel(way[k, 0], way[k, 1], origin, pixel, shape)
            gx = gradient[0, i, j]
            gy = gradient[1, i, j]

            pitch = abs(gx * dx + gy * dy) / length
            roll = abs(gy * dx - gx * dy) / length
            tilt = np.arctan(max(pitch, roll))
            clock[k] = clock[k - 1] + length / (limits[0] * speed_share(tilt, limits[1]))

        duration[b] = clock[len(way) - 1]

        k = 1
        for s in range(n_samples):
            t = duration[b] * (s + 0.5) / n_samples
            while k < len(way) - 1 and clock[k] < t:
                k += 1

            share = (t - clock[k - 1]) / max(clock[k] - clock[k - 1], 1e-12)
            for axis in range(2):
                points[b, s, axis] = way[k - 1, axis] + share * (way[k, axis] - way[k - 1, axis])
    return points, duration


def largest_region(passable: np.ndarray) -> np.ndarray:
    """Return a mask (row, col) of the largest region of passable pixels."""
    regions: Any = ndimage.label(passable)
    labels, n_regions = regions
    if n_regions == 0:
        return passable

    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == np.argmax(sizes)


def linked_to(passable: np.ndarray, window: Window, pixel: tuple[int, ...]) -> np.ndarray:
    """Return a mask of the passable pixels connected to `pixel` within a window."""
    top, bottom, left, right = window
    inside = passable[top:bottom, left:right]
    regions: Any = ndimage.label(inside)
    return inside & (regions[0] == regions[0][pixel[0] - top, pixel[1] - left])
