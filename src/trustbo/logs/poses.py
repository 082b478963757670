"""Poses of robots: checks of their times, speeds and headings, and poses at given times."""

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, warn

UNITS = "t in seconds (days * 86400, minutes * 60, milliseconds / 1000) and x, y in metres"
GAP = 5.0
"""Longest gap between two poses that is interpolated, s."""
_STANDING = 1e-3
"""Speed up to which a robot counts as standing, so that its course is unknown, m/s."""
_FAST = 30.0
"""Usual speed of a robot above which a warning is issued, m/s."""
_FASTEST = 100.0
"""Highest speed that is accepted, m/s."""


def track_of(tracks: pd.DataFrame, name: str, *, headings: bool) -> pd.DataFrame:
    """Return the poses of one robot, sorted by time, with its unwrapped heading.

    If `headings` is False, headings are not checked, and NaN.
    """
    track = tracks.loc[tracks["robot"] == name]
    _require_order(name, track["t"].to_numpy())

    track = track.sort_values("t")
    t, x, y, heading = track[["t", "x", "y", "heading"]].to_numpy().T
    dx = np.gradient(x, t)
    dy = np.gradient(y, t)
    speed = np.hypot(dx, dy)
    course = np.arctan2(dy, dx)
    moves = speed > _STANDING
    _check_speed(name, t, speed, moves)

    if not headings:
        return track.assign(heading=np.nan)

    if np.isnan(heading).all():
        heading = pd.Series(np.where(moves, course, np.nan)).ffill().bfill().to_numpy()
    if np.isnan(heading).any():
        raise TrustboError(
            f"headings of robot {name!r} are blank in some poses, or in all although it moves at "
            "less than 1 mm/s; give all headings, times in seconds and positions in metres, or "
            "pass the workspace, with which headings are not needed."
        )
    _require_radians(name, heading, course, moves)
    return track.assign(heading=np.unwrap(heading))


def _require_order(name: str, t: np.ndarray) -> None:
    """Raise TrustboError for a robot with one pose, equal times, or a clock that was reset.

    Args:
        name: Name of the robot.
        t: Times of its poses in the order of the table, shape (pose,), s.
    """
    if len(t) < 2:
        raise TrustboError(f"robot {name!r} has only one pose; leave it out, or give more poses.")

    ordered = np.sort(t)
    same = np.diff(ordered) <= 0.0
    if same.any():
        raise TrustboError(
            f"robot {name!r} has two poses at t = {ordered[1:][same][0]:.9g} s; drop exact copies "
            "(poses.drop_duplicates()), and give times in seconds that are not rounded."
        )

    # Unsorted rows have many drops. A single, long one comes from a clock that was reset, or from
    # two logs in the wrong order.
    drops = -np.diff(t)
    if (drops > 0.0).sum() == 1 and drops.max() > 0.5 * np.ptp(t):
        raise TrustboError(
            f"times of robot {name!r} fall by {drops.max():g} s in the middle of the log; correct "
            "them if its clock was reset, or sort the rows."
        )


def _check_speed(name: str, t: np.ndarray, speed: np.ndarray, moves: np.ndarray) -> None:
    """Raise TrustboError, or warn, if a robot is too fast for times in s and positions in m.

    Args:
        name: Name of the robot.
        t: Times of its poses, shape (pose,), s.
        speed: Its speed, shape (pose,), m/s.
        moves: Whether it moves, shape (pose,).
    """
    usual = float(np.median(speed[moves])) if moves.any() else 0.0
    if usual > _FASTEST:
        raise TrustboError(f"robot {name!r} usually moves at {usual:.3g} m/s; give {UNITS}.")
    if usual > _FAST:
        warn(f"robot {name!r} usually moves at {usual:.3g} m/s; the tables must have {UNITS}.")

    if speed.max() > _FASTEST:
        raise TrustboError(
            f"robot {name!r} moves at {speed.max():.3g} m/s at t = {t[speed.argmax()]:.9g} s; "
            "leave out poses without a fix, such as (0, 0), give x and y in metres, correct the "
            "times if its clock was set back, and keep about one pose per second if they are noisy."
        )


def _require_radians(name: str, heading: np.ndarray, course: np.ndarray, moves: np.ndarray) -> None:
    """Raise TrustboError if headings fit the course better in degrees, or clockwise from north.

    The fit is the mean cosine between heading and course while the robot moves: 1 if they agree,
    -1 if the robot drives backwards.

    Args:
        name: Name of the robot.
        heading: Headings as given, shape (pose,).
        course: Direction of motion, shape (pose,), rad from east, anticlockwise.
        moves: Whether the robot moves, shape (pose,).
    """
    n = max(moves.sum(), 1)

    def fit(angle: np.ndarray) -> float:
        return np.cos(angle - course)[moves].sum() / n

    largest = np.abs(heading).max()
    exceeds_turn = largest > 2.0 * np.pi + 1e-6
    if exceeds_turn:
        others = [np.radians(heading), np.radians(90.0 - heading)]
    else:
        others = [np.pi / 2.0 - heading]
    own = fit(heading)
    best = max(map(fit, others))

    # Radians above a full turn were unwrapped, and have neither jumps nor a better fit as degrees.
    jumps = not moves.any() or np.abs(np.diff(heading)).max() > 2.0 * np.pi + 0.1
    in_degrees = exceeds_turn and (jumps or best > max(own, 0.0) + 0.5)

    # On a straight course, a constant offset of the headings looks the same as another convention.
    turns = abs(np.exp(1j * course)[moves].sum()) < 0.9 * n
    fits_other = turns and best > 0.9 > own + 0.4

    if in_degrees or fits_other:
        raise TrustboError(
            f"headings of robot {name!r}, up to {largest:g}, seem to be in degrees or clockwise "
            "from north; give radians from east, anticlockwise: radians(90 - compass degrees)."
        )


def poses_at(track: pd.DataFrame, times: np.ndarray) -> pd.DataFrame:
    """Interpolate the poses of a robot; ticks at which they are unknown are left out."""
    t = track["t"].to_numpy()
    gap = np.diff(t)[np.clip(np.searchsorted(t, times), 1, len(t) - 1) - 1]
    known = (times >= t[0]) & (times <= t[-1]) & (gap <= GAP)
    poses = {name: np.interp(times, t, track[name]) for name in ("x", "y", "heading")}

    frame = pd.DataFrame(poses).assign(tick=range(len(times)), robot=track["robot"].iloc[0])
    return frame.loc[known]
