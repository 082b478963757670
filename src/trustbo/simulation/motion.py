"""How a robot gets from one position to another: a route over pixels, and a drive along it."""

import heapq
import math

import numpy as np
from numba import njit

from trustbo.data import Robot
from trustbo.simulation.sight import Surface

LOOKAHEAD = 1.5
"""How far ahead on its route a robot steers, m."""
ARRIVED = 0.5
"""How close to its goal a robot stops, m."""
SLOWEST = 0.1
"""Share of its speed that a robot keeps on the steepest slope it stands."""
_LEAST_STEPS = 5
_compiled = njit(cache=True, error_model="numpy")
_STATUS = ("ok", "stuck", "tipped", "timeout")


class Routes:
    """Fastest ways over passable pixels, by A*; one that was found is kept.

    Robots of one make share them, and missions over one path ask for few.
    """

    def __init__(self, surface: Surface) -> None:
        """Prepare; a robot's speed falls with the slope."""
        self._surface = surface
        self._slope = np.arctan(np.hypot(*surface.gradient))
        self._paces: dict[float, np.ndarray] = {}
        self._known: dict[tuple[object, ...], np.ndarray] = {}

    def find(
        self,
        robot: Robot,
        start: np.ndarray,
        goal: np.ndarray,
        window: tuple[int, int, int, int],
    ) -> np.ndarray | None:
        """Way from a position to another.

        Args:
            robot: Who drives.
            start: x and y, CRS metres.
            goal: x and y, CRS metres.
            window: Pixels the route may use: first row, end row, first col, end col.

        Returns:
            Positions from start to goal, shape (point, 2), CRS metres; None if there is no way.
        """
        ends = [self._surface.pixel_at(*p.tolist()) for p in (start, goal)]
        key = (*ends, window, robot.max_slope)
        if key not in self._known:
            self._known[key] = self._search(ends[0], ends[1], window, robot.max_slope)
        found = self._known[key]
        if not len(found):
            return None
        if len(found) == 1:  # a single-pixel route still needs two ends
            return np.stack([start, goal])
        route = found.copy()
        route[0], route[-1] = start, goal
        return route

    def _search(
        self,
        start: tuple[int, ...],
        goal: tuple[int, ...],
        window: tuple[int, int, int, int],
        max_slope: float,
    ) -> np.ndarray:
        """Positions of the pixels from start to goal; empty if there is no way."""
        surface = self._surface
        if max_slope not in self._paces:
            pace = 1.0 / _speed_share(self._slope, max_slope)
            self._paces[max_slope] = np.where(surface.passable, pace, np.inf)
        top, bottom, left, right = window
        cells = _a_star(
            self._paces[max_slope][top:bottom, left:right],
            surface.pixel,
            (start[0] - top, start[1] - left),
            (goal[0] - top, goal[1] - left),
        )
        x = surface.origin[0] + (cells[:, 1] + left) * surface.pixel[1]
        y = surface.origin[1] - (cells[:, 0] + top) * surface.pixel[0]
        return np.stack([x, y], axis=1)


def drive(
    surface: Surface,
    robot: Robot,
    route: np.ndarray,
    heading: float,
    tick: float,
    max_ticks: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, str]:
    """Drive along a route as a unicycle that steers for a point ahead (pure pursuit).

    Speed falls linearly with the larger of pitch and roll, to a tenth at the limit; a pitch beyond
    the limit leaves the robot stuck, a roll beyond it tips it over. Wheel slip scales the speed of
    each tick by a random factor of some 5 %.

    Args:
        surface: The terrain.
        robot: Who drives.
        route: Positions, shape (point, 2), CRS metres.
        heading: At the start, rad from east, anticlockwise.
        tick: Length of a tick, s.
        max_ticks: Give up after so many.
        rng: Where slip comes from.

    Returns:
        Poses (x, y, heading) after each tick, shape (tick, 3), and the status.
    """
    poses, code = _drive(
        surface.gradient,
        surface.pixel,
        surface.origin,
        route,
        heading,
        (robot.speed, robot.turn_rate, robot.max_slope),
        tick,
        # Short enough that no step leaps over the goal.
        max(_LEAST_STEPS, math.ceil(robot.speed * tick / (0.5 * ARRIVED))),
        rng.standard_normal(max_ticks),
    )
    return poses, _STATUS[code]


@_compiled
def _squared(route, i, x, y):
    return (route[i, 0] - x) ** 2 + (route[i, 1] - y) ** 2


@_compiled
def _within_a_turn(angle):
    """The same angle in [-pi, pi); a remainder takes long, and is rarely needed."""
    if -math.pi <= angle < math.pi:
        return angle
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@_compiled
def _speed_share(tilt, max_slope):
    return np.maximum(SLOWEST, 1.0 - (1.0 - SLOWEST) * tilt / max_slope)


@_compiled
def _a_star(pace, pixel, start, goal):
    """Cells of the cheapest way over a grid of paces (s per m, inf where closed); empty if none."""
    rows, cols = pace.shape
    known = np.full((rows, cols), np.inf)
    came = np.full((rows, cols), -1)
    least = pace.min()
    for r, c in (start, goal):
        if not (0 <= r < rows and 0 <= c < cols):
            return np.empty((0, 2), np.int64)
    known[start] = 0.0
    queue = [(0.0, start[0], start[1])]
    while queue:
        estimate, r, c = heapq.heappop(queue)
        if (r, c) == goal:
            break
        ahead = math.hypot((goal[0] - r) * pixel[0], (goal[1] - c) * pixel[1]) * least
        if estimate > known[r, c] + ahead + 1e-9:
            continue  # a stale entry: the cell was improved since
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                i, j = r + dr, c + dc
                if (dr == 0 and dc == 0) or not (0 <= i < rows and 0 <= j < cols):
                    continue
                # No squeezing between two closed pixels, nor round the corner of one.
                if not (np.isfinite(pace[i, c]) and np.isfinite(pace[r, j])):
                    continue
                length = math.hypot(dr * pixel[0], dc * pixel[1])
                cost = known[r, c] + 0.5 * (pace[r, c] + pace[i, j]) * length
                if cost < known[i, j]:
                    known[i, j] = cost
                    came[i, j] = r * cols + c
                    rest = math.hypot((goal[0] - i) * pixel[0], (goal[1] - j) * pixel[1])
                    heapq.heappush(queue, (cost + rest * least, i, j))
    if not np.isfinite(known[goal]):
        return np.empty((0, 2), np.int64)
    n, cell = 1, goal[0] * cols + goal[1]
    while came[cell // cols, cell % cols] >= 0:
        cell = came[cell // cols, cell % cols]
        n += 1
    cells = np.empty((n, 2), np.int64)
    cell = goal[0] * cols + goal[1]
    for k in range(n - 1, -1, -1):
        cells[k, 0], cells[k, 1] = cell // cols, cell % cols
        cell = came[cell // cols, cell % cols]
    return cells


@_compiled
def _drive(gradient, pixel, origin, route, heading, limits, tick, n_steps, slip):
    speed, turn_rate, max_slope = limits
    rows, cols = gradient.shape[1:]
    x, y, aim = route[0, 0], route[0, 1], 1
    poses = np.empty((len(slip), 3))
    dt, steepest = tick / n_steps, math.tan(max_slope)
    for k in range(len(slip)):
        pace = speed * math.exp(0.05 * slip[k])
        for _ in range(n_steps):
            while aim < len(route) - 1 and _squared(route, aim, x, y) < LOOKAHEAD**2:
                aim += 1
            dx, dy = route[aim, 0] - x, route[aim, 1] - y
            error = _within_a_turn(math.atan2(dy, dx) - heading)
            turn = min(turn_rate * dt, max(-turn_rate * dt, error))
            heading += turn
            i = min(rows - 1, max(0, int((origin[1] - y) / pixel[0] + 0.5)))
            j = min(cols - 1, max(0, int((x - origin[0]) / pixel[1] + 0.5)))
            gx, gy = gradient[0, i, j], gradient[1, i, j]
            ahead, left = math.cos(heading), math.sin(heading)
            # Tangents of pitch and roll.
            pitch, roll = abs(gx * ahead + gy * left), abs(gy * ahead - gx * left)
            if not (roll <= steepest and pitch <= steepest):  # unknown ground fails too
                poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
                return poses[: k + 1], 2 if roll > steepest else 1
            # A skid-steer robot turns on the spot until it faces its way.
            v = pace * _speed_share(math.atan(max(pitch, roll)), max_slope)
            v *= 1.0 if error == turn else max(0.0, math.cos(error - turn))
            x += v * dt * ahead
            y += v * dt * left
            if aim == len(route) - 1 and _squared(route, aim, x, y) < ARRIVED**2:
                poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
                return poses[: k + 1], 0
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
    return poses, 3
