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
"""Length of a tick of `tilt_along`, s."""
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
        Poses after each tick, shape (tick, 3), the status code, and the largest tangent of pitch or
        roll on the way, which is inf if the robot got stuck or tipped over.
    """
    speed, turn_rate, lookahead, max_slope, steepest = limits
    shape = gradient.shape[1:]

    x = route[0, 0]
    y = route[0, 1]
    aim = min(1, len(route) - 1)
    poses = np.empty((len(slip), 3))
    dt = tick / n_steps
    largest = 0.0

    for k in range(len(slip)):
        pace = speed * math.exp(_SLIP * slip[k])
        for _ in range(n_steps):
            # Pure pursuit: steer towards a point of the route ahead (Coulter 1992).
            while aim < len(route) - 1 and _squared(route, aim, x, y) < lookahead**2:
                aim += 1

            dx = route[aim, 0] - x
            dy = route[aim, 1] - y
            error = _within_a_turn(math.atan2(dy, dx) - heading)
            turn = min(turn_rate * dt, max(-turn_rate * dt, error))
            heading += turn

            i, j = nearest_pixel(x, y, origin, pixel, shape)
            gx = gradient[0, i, j]
            gy = gradient[1, i, j]

            ahead = math.cos(heading)
            left = math.sin(heading)
            # Tangents of pitch and roll.
            pitch = abs(gx * ahead + gy * left)
            roll = abs(gy * ahead - gx * left)
            if not (roll <= steepest and pitch <= steepest):  # NaN slopes also fail
                poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
                return poses[: k + 1], TIPPED if roll > steepest else STUCK, np.inf
            largest = max(largest, pitch, roll)

            # A skid-steer robot turns on the spot until it faces its route.
            v = pace * speed_share(math.atan(max(pitch, roll)), max_slope)
            v *= 1.0 if error == turn else max(0.0, math.cos(error - turn))
            x += v * dt * ahead
            y += v * dt * left

            if aim == len(route) - 1 and _squared(route, aim, x, y) < ARRIVED**2:
                poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
                return poses[: k + 1], OK, largest

        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
    return poses, TIMEOUT, largest


class Driving(NamedTuple):
    """A robot's parameters, as `tilt_along` needs them."""

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
def tilt_along(gradient, pixel, origin, route, driving):
    """Compute the largest tangent of pitch or roll on the curve that a robot drives.

    There is no wheel slip, and the robot faces its route at the start. The result is inf if the
    curve leaves the pixels with known slopes.
    """
    speed, turn_rate, lookahead, max_slope, n_steps = driving
    length = 0.0
    for k in range(1, len(route)):
        length += math.hypot(route[k, 0] - route[k - 1, 0], route[k, 1] - route[k - 1, 1])

    second = min(1, len(route) - 1)
    heading = math.atan2(route[second, 1] - route[0, 1], route[second, 0] - route[0, 0])
    n_ticks = math.ceil((length / (SLOWEST * speed) + 2.0 * math.pi / turn_rate) / _TICK)
    limits = speed, turn_rate, lookahead, max_slope, math.inf
    no_slip = np.zeros(n_ticks)
    _, _, largest = pursue(gradient, pixel, origin, route, heading, limits, _TICK, n_steps, no_slip)
    return largest
