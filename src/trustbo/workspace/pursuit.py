"""Pure pursuit: the motion of a unicycle robot along a route.

The simulator drives the robots by pure pursuit. The difficulty of a bound is measured along the
curve that a robot drives by pure pursuit without wheel slip. This curve cuts the corners of the
route.
"""

import math
from typing import NamedTuple, Self

import numpy as np

from trustbo.kernels import kernel, part
from trustbo.team import Robot
from trustbo.terrain.pixels import nearest_pixel
from trustbo.workspace.routes import SLOWEST, speed_share

ARRIVED = 0.5
"""Distance in m from the goal at which a robot stops."""
OK = 0
STUCK = 1
TIPPED = 2
TIMEOUT = 3
STATUS = ("ok", "stuck", "tipped", "timeout")
"""Statuses in the order of their codes."""
_LEAST_STEPS = 5
"""Smallest number of integration steps per tick."""
_SLIP = 0.05
"""Standard deviation of the log of the factor by which wheel slip multiplies the speed."""
_TICK = 0.5
"""Length of a tick of `tilts_along`, s."""
_compiled = kernel()
_part = part()


def steps_per_tick(robot: Robot, tick: float) -> int:
    """Return the number of integration steps per tick, so that no step jumps over the goal."""
    return max(_LEAST_STEPS, math.ceil(robot.speed * tick / (0.5 * ARRIVED)))


@_part
def _squared(route, i, x, y):
    """Compute the squared distance from (x, y) to point i of a route."""
    return (route[i, 0] - x) ** 2 + (route[i, 1] - y) ** 2


@_part
def _within_a_turn(angle):
    """Wrap an angle to [-pi, pi); the remainder is slow, so it is computed only if needed."""
    if -math.pi <= angle < math.pi:
        return angle
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@_part
def _step(gradient, pixel, origin, route, limits, pace, dt, state):
    """Integrate the motion of a robot that follows a route over one step of `dt` seconds.

    Args:
        gradient: See `pursue`.
        pixel: See `pursue`.
        origin: See `pursue`.
        route: See `pursue`.
        limits: See `pursue`.
        pace: Speed on level ground, m/s.
        dt: Length of the step, s.
        state: Position x and y, heading, and index of the point that the robot steers towards.

    Returns:
        The state after the step, the larger tangent of pitch or roll, which is inf if the robot got
        stuck or tipped over, and the status code, which is TIMEOUT if the robot is on its way.
    """
    _, turn_rate, lookahead, max_slope, steepest = limits
    x, y, heading, aim = state

    # Pure pursuit: steer towards a point of the route ahead (Coulter 1992).
    while aim < len(route) - 1 and _squared(route, aim, x, y) < lookahead**2:
        aim += 1

    dx = route[aim, 0] - x
    dy = route[aim, 1] - y
    error = _within_a_turn(math.atan2(dy, dx) - heading)
    turn = min(turn_rate * dt, max(-turn_rate * dt, error))
    heading += turn

    i, j = nearest_pixel(x, y, origin, pixel, gradient.shape[1:])
    gx = gradient[0, i, j]
    gy = gradient[1, i, j]

    ahead = math.cos(heading)
    left = math.sin(heading)
    # Tangents of pitch and roll.
    pitch = abs(gx * ahead + gy * left)
    roll = abs(gy * ahead - gx * left)
    if not (roll <= steepest and pitch <= steepest):  # NaN slopes also fail
        return (x, y, heading, aim), np.inf, TIPPED if roll > steepest else STUCK

    # A skid-steer robot turns on the spot until it faces its route.
    v = pace * speed_share(math.atan(max(pitch, roll)), max_slope)
    v *= 1.0 if error == turn else max(0.0, math.cos(error - turn))
    x += v * dt * ahead
    y += v * dt * left

    arrived = aim == len(route) - 1 and _squared(route, aim, x, y) < ARRIVED**2
    return (x, y, heading, aim), max(pitch, roll), OK if arrived else TIMEOUT


@_compiled
def pursue(gradient, pixel, origin, route, heading, limits, tick, n_steps, slip):
    """Integrate the motion of a robot that follows a route, until it arrives or fails.

    Args:
        gradient: Slopes of the ground towards east and north, shape (2, row, col).
        pixel: Height and width of a pixel, m.
        origin: Position of the centre of pixel (0, 0).
        route: Points of the route, shape (point, 2).
        heading: Heading at the start, rad.
        limits: Speed in m/s, turn rate in rad/s, look-ahead in m, slope limit for the speed in rad,
            and the tangent of pitch or roll at which the robot fails, which may be infinite.
        tick: Length of a tick, s.
        n_steps: Number of integration steps per tick.
        slip: Standard normal scores of the wheel slip in each tick, shape (tick,).

    Returns:
        Poses after each tick, shape (tick, 3), and the status code.
    """
    poses = np.empty((len(slip), 3))
    state = route[0, 0], route[0, 1], heading, min(1, len(route) - 1)
    dt = tick / n_steps

    for k in range(len(slip)):
        pace = limits[0] * math.exp(_SLIP * slip[k])
        code = TIMEOUT
        for _ in range(n_steps):
            state, _, code = _step(gradient, pixel, origin, route, limits, pace, dt, state)
            if code != TIMEOUT:
                break

        poses[k, 0], poses[k, 1], poses[k, 2] = state[0], state[1], state[2]
        if code != TIMEOUT:
            return poses[: k + 1], code
    return poses, TIMEOUT


class Driving(NamedTuple):
    """A robot's parameters, as `tilts_along` needs them."""

    speed: float
    turn_rate: float
    lookahead: float
    max_slope: float
    n_steps: int

    @classmethod
    def of(cls, robot: Robot) -> Self:
        """Return the parameters of a robot."""
        n_steps = steps_per_tick(robot, _TICK)
        return cls(robot.speed, robot.turn_rate, robot.lookahead, robot.max_slope, n_steps)


@_compiled
def tilts_along(gradient, pixel, origin, flat, first, driving):
    """Compute the largest tangent of pitch or roll on the curve that a robot drives on each route.

    There is no wheel slip, and the robot faces its route at the start. A tangent is inf if the
    curve leaves the pixels with known slopes. The beginning that a route has in common with an
    earlier one is driven only once.

    Args:
        gradient: See `pursue`.
        pixel: See `pursue`.
        origin: See `pursue`.
        flat: Points of all routes, one route after another, shape (point, 2).
        first: Index of the first point of each route, followed by the number of points.
        driving: Parameters of the robot.

    Returns:
        The largest tangent on each route; NaN for a route without points.
    """
    n_routes = len(first) - 1
    largest = np.full(n_routes, np.nan)
    # x, y, heading, aim, largest tangent so far, and number of steps, before the robot first steers
    # towards each point or a later one.
    states = np.full((len(flat), 6), np.nan)

    for k in range(n_routes):
        begin = first[k]
        end = first[k + 1]
        route = flat[begin:end]
        if end == begin:
            continue

        other, known = _same_beginning(flat, first, k)
        if known < 2:  # the robot faces the second point
            known = min(1, len(route) - 1)
            _face(route, states[begin + known])
        else:
            for i in range(1, known + 1):
                for m in range(6):
                    states[begin + i, m] = states[other + i, m]
            while math.isnan(states[begin + known, 0]):  # not reached in time
                known -= 1
        largest[k] = _drive(gradient, pixel, origin, route, driving, states[begin:end], known)
    return largest


@_part
def _same_beginning(flat, first, k):
    """Find the earlier route that has the longest beginning in common with route k.

    Returns the index of its first point, and the number of common points, which include the last
    point of neither route.
    """
    best = 0
    other = 0
    for j in range(k):
        most = min(first[j + 1] - first[j], first[k + 1] - first[k]) - 1
        n = 0
        while n < most and _is_same(flat, first[j] + n, first[k] + n):
            n += 1
        if n > best:
            best = n
            other = first[j]
    return other, best


@_part
def _is_same(points, i, j):
    """Return whether two points (point, 2) have the same position."""
    return points[i, 0] == points[j, 0] and points[i, 1] == points[j, 1]


@_part
def _face(route, state):
    """Write the state in which a robot begins a route; see `tilts_along`."""
    second = min(1, len(route) - 1)
    state[0] = route[0, 0]
    state[1] = route[0, 1]
    state[2] = math.atan2(route[second, 1] - route[0, 1], route[second, 0] - route[0, 0])
    state[3] = second
    state[4] = 0.0
    state[5] = 0.0


@_part
def _drive(gradient, pixel, origin, route, driving, states, known):
    """Drive a route on from the state that belongs to its point `known`; see `tilts_along`.

    Writes the states of later points, and returns the largest tangent of pitch or roll.
    """
    speed, turn_rate, lookahead, max_slope, n_steps = driving
    length = 0.0
    for k in range(1, len(route)):
        length += math.hypot(route[k, 0] - route[k - 1, 0], route[k, 1] - route[k - 1, 1])

    n_ticks = math.ceil((length / (SLOWEST * speed) + 2.0 * math.pi / turn_rate) / _TICK)
    limits = speed, turn_rate, lookahead, max_slope, math.inf
    dt = _TICK / n_steps

    state = states[known, 0], states[known, 1], states[known, 2], int(states[known, 3])
    largest = states[known, 4]
    for step in range(int(states[known, 5]), n_ticks * n_steps):
        before = state
        state, tilt, code = _step(gradient, pixel, origin, route, limits, speed, dt, before)
        for k in range(before[3] + 1, state[3] + 1):
            states[k, 0], states[k, 1], states[k, 2] = before[0], before[1], before[2]
            states[k, 3], states[k, 4], states[k, 5] = before[3], largest, step

        largest = max(largest, tilt)
        if code != TIMEOUT:
            break
    return largest
