"""Motion of unicycle robots along routes."""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from trustbo.kernels import PART, kernel
from trustbo.team import Robot
from trustbo.terrain.pixels import nearest_pixel
from trustbo.workspace.routes import speed_share
from trustbo.workspace.surface import Surface

LOOKAHEAD = 1.5
"""Distance in m to the point of the route that a robot steers towards."""
ARRIVED = 0.5
"""Distance in m from the goal at which a robot stops."""
_LEAST_STEPS = 5
"""Smallest number of integration steps per tick."""
_SLIP = 0.05
"""Standard deviation of the log of the factor by which wheel slip multiplies the speed."""
_compiled = kernel()
_part = njit(nogil=True, error_model="numpy", **PART)
_STATUS = ("ok", "stuck", "tipped", "timeout")
"""Statuses in the order of their codes."""
_OK = 0
_STUCK = 1
_TIPPED = 2
_TIMEOUT = 3


def drive(
    surface: Surface,
    robot: Robot,
    route: np.ndarray,
    heading: float,
    tick: float,
    max_ticks: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, str]:
    """Simulate a unicycle robot that follows a route by pure pursuit.

    The speed falls linearly with the larger of pitch and roll, to a tenth at the slope limit. The
    robot gets stuck if its pitch exceeds the limit, and tips over if its roll exceeds the limit.
    Wheel slip multiplies the speed in each tick by a random factor with an sd of about 5 %. The
    route has shape (point, 2), in CRS metres. The initial heading is in rad, anticlockwise from
    east. After `max_ticks` ticks, the status is "timeout".

    Returns the poses (x, y, heading) after each tick, shape (tick, 3), and the status.
    """
    # The steps are short enough that no step jumps over the goal.
    n_steps = max(_LEAST_STEPS, math.ceil(robot.speed * tick / (0.5 * ARRIVED)))
    poses, code = _drive(
        surface.gradient,
        surface.pixel,
        surface.origin,
        route,
        heading,
        (robot.speed, robot.turn_rate, robot.max_slope),
        tick,
        n_steps,
        rng.standard_normal(max_ticks),
    )
    return poses, _STATUS[code]


def drive_together(
    surface: Surface,
    robots: Sequence[Robot],
    routes: Sequence[np.ndarray | None],
    poses: np.ndarray,
    tick: float,
    max_ticks: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, str]:
    """Drive several robots simultaneously (see `drive`) until all arrive or one fails.

    A robot without a route is stuck. Initial poses have shape (robot, 3). Returns the poses after
    each tick, shape (tick, robot, 3), and the status: "ok", or that of the first robot that fails.
    """
    tracks = []
    failures = []
    for pose, robot, route in zip(poses, robots, routes, strict=True):
        if route is None:
            track = pose[None]
            status = "stuck"
        else:
            track, status = drive(surface, robot, route, pose[2], tick, max(1, max_ticks), rng)
        tracks.append(track)
        if status != "ok":
            failures.append((len(track), status))

    if failures:
        n_ticks, status = min(failures)  # in one tick, the first status in the alphabet
    else:
        n_ticks = max(len(track) for track in tracks)
        status = "ok"

    # A robot that has arrived waits for the others.
    held = [track[np.minimum(np.arange(n_ticks), len(track) - 1)] for track in tracks]
    return np.stack(held, axis=1), status


@_part
def _squared(route, i, x, y):
    """Compute the squared distance from (x, y) to point i of a route."""
    return (route[i, 0] - x) ** 2 + (route[i, 1] - y) ** 2


@_part
def _within_a_turn(angle):
    """Wrap an angle to [-pi, pi); the remainder is slow and computed only if needed."""
    if -math.pi <= angle < math.pi:
        return angle
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@_compiled
def _drive(gradient, pixel, origin, route, heading, limits, tick, n_steps, slip):
    """Integrate the motion in steps; return the poses after each tick, and the status code."""
    speed, turn_rate, max_slope = limits
    shape = gradient.shape[1:]

    x = route[0, 0]
    y = route[0, 1]
    aim = min(1, len(route) - 1)
    poses = np.empty((len(slip), 3))
    dt = tick / n_steps
    steepest = math.tan(max_slope)

    for k in range(len(slip)):
        pace = speed * math.exp(_SLIP * slip[k])
        for _ in range(n_steps):
            # Pure pursuit: steer towards a point of the route ahead (Coulter 1992).
            while aim < len(route) - 1 and _squared(route, aim, x, y) < LOOKAHEAD**2:
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
                return poses[: k + 1], _TIPPED if roll > steepest else _STUCK

            # A skid-steer robot turns on the spot until it faces its route.
            v = pace * speed_share(math.atan(max(pitch, roll)), max_slope)
            v *= 1.0 if error == turn else max(0.0, math.cos(error - turn))
            x += v * dt * ahead
            y += v * dt * left

            if aim == len(route) - 1 and _squared(route, aim, x, y) < ARRIVED**2:
                poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
                return poses[: k + 1], _OK

        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
    return poses, _TIMEOUT
