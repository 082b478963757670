"""Motion of unicycle robots along routes."""

import math
from collections.abc import Sequence

import numpy as np

from trustbo.team import Robot
from trustbo.workspace.pursuit import STATUS, pursue, steps_per_tick
from trustbo.workspace.surface import Surface


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
    steepest = math.tan(robot.max_slope)
    limits = robot.speed, robot.turn_rate, robot.lookahead, robot.max_slope, steepest
    poses, code = pursue(
        surface.gradient,
        surface.pixel,
        surface.origin,
        route,
        heading,
        limits,
        tick,
        steps_per_tick(robot, tick),
        rng.standard_normal(max_ticks),
    )
    return poses, STATUS[code]


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
        n_ticks, status = min(failures)  # within one tick, the alphabetically first status
    else:
        n_ticks = max(len(track) for track in tracks)
        status = "ok"

    # A robot that has arrived waits for the others.
    held = [track[np.minimum(np.arange(n_ticks), len(track) - 1)] for track in tracks]
    return np.stack(held, axis=1), status
