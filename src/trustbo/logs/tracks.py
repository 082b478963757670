"""Logs of poses and detections, converted to missions in which all robots watch one lead."""

import warnings
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trustbo.data import NOWHERE, Cell, Mission, as_array
from trustbo.errors import TrustboError, require_choice, require_positive
from trustbo.logs.columns import Columns, require_one_spelling, seconds_of
from trustbo.workspace import Workspace

EACH = "each"
_FEATURES = ("near", "ahead", "clear")
_AHEAD = np.pi / 6.0
"""Half of the angle in which a robot is ahead, rad."""
_CLOSE = 0.1
"""Distance to the ends of a line of sight within which nothing occludes, and least extent, m."""
_FEWEST = 2
"""Minimum number of bounds of a mission."""


class Tracks:
    """Poses of robots, and their detections of each other.

    Attributes:
        robots: Names of the robots with poses.
        tracks: Poses of each robot, (sample, 4): time (s), x, y (m), heading (rad from east,
            anticlockwise), times ascending.
        detections: Detections between robots, (detection, 3): time (s), indices of the watcher and
            of the robot seen.
        landmarks: Vertical cylinders that occlude robots, (landmark, 3): x, y, radius (m).
        robot_radius: Radius of a robot, which occludes others, m.
        max_gap: Longest gap between two poses that is interpolated, s.
    """

    def __init__(
        self,
        poses: Any,
        detections: Any,
        *,
        landmarks: ArrayLike = (),
        robot_radius: float = 0.0,
        max_gap: float = 5.0,
    ) -> None:
        """Read two tables: paths of CSV files, DataFrames, or mappings of columns.

        Args:
            poses: Columns t, robot, x, y (m) and, if known, heading (rad); by default the heading
                is the direction of motion. Times are seconds, or dates with times.
            detections: Columns t, watcher, seen, on the same clock. Detections of objects without
                poses are ignored.
            landmarks: Shape (landmark, 3), see the attribute.
            robot_radius: See the attribute.
            max_gap: See the attribute.

        Raises:
            TrustboError: A column is missing, a value has the wrong type, a robot has two poses at
                one time, there are fewer than two robots or no detections between robots, or times,
                positions or headings cannot be in seconds, metres and radians.
        """
        self.max_gap, self.robot_radius = require_positive("max_gap", max_gap), robot_radius
        self.landmarks = as_array("landmarks", landmarks).reshape(-1, 3)
        where = Columns(poses, "the table of poses")
        looks = Columns(detections, "the table of detections")
        t, seen_at = seconds_of(where, looks)
        names, pairs = where.texts("robot"), [looks.texts(end) for end in ("watcher", "seen")]
        self.robots = tuple(dict.fromkeys(names))
        if len(self.robots) < 2 or "" in self.robots:
            raise TrustboError(f"a log is of two named robots at least; got {self.robots}.")
        require_one_spelling("the names in poses and detections", [*names, *pairs[0], *pairs[1]])
        xy = [where.numbers(name, blank=False) for name in ("x", "y")]
        if max(np.ptp(xy[0]), np.ptp(xy[1])) < _CLOSE:
            raise TrustboError(
                f"all poses lie within {_CLOSE:g} m; x and y are metres, not degrees or kilometres."
            )
        heading = where.numbers("heading", required=False)
        rows, of = np.column_stack([t, *xy, heading]), np.array(names)
        self.tracks = tuple(_track(name, rows[of == name]) for name in self.robots)
        index = {name: i for i, name in enumerate(self.robots)}
        kept = [(s, index[a], index[b]) for s, a, b in zip(seen_at, *pairs, strict=True)
                if a in index and b in index and a != b]  # fmt: skip
        if not kept:
            raise TrustboError(
                f"no detection is of one of {self.robots} by another; the first is of "
                f"{pairs[1][0]!r} by {pairs[0][0]!r}."
            )
        if silent := {*self.robots} - {self.robots[i] for row in kept for i in row[1:]}:
            warnings.warn(
                f"no detection names {', '.join(sorted(silent))}: contact of such a robot is 0.",
                stacklevel=2,
            )
        self.detections = np.array(kept, dtype=float)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of a pose, s."""
        return min(t[0, 0] for t in self.tracks), max(t[-1, 0] for t in self.tracks)

    def at(self, times: np.ndarray) -> np.ndarray:
        """Poses at given times, (robot, time, 3): x, y, heading; NaN in gaps over `max_gap`."""
        poses = np.full((len(self.robots), len(times), 3), np.nan)
        for one, track in zip(poses, self.tracks, strict=True):
            t = track[:, 0]
            gap = np.diff(t)[np.clip(np.searchsorted(t, times), 1, len(t) - 1) - 1]
            known = (times >= t[0]) & (times <= t[-1]) & (gap <= self.max_gap)
            for column, values in enumerate(track[:, 1:].T):
                one[known, column] = np.interp(times[known], t, values)
        return poses


def missions_of(
    tracks: Tracks,
    window: float = 20.0,
    *,
    lead: str = EACH,
    workspace: Workspace | None = None,
    tick: float = 1.0,
) -> list[Mission]:
    """Convert a log to missions in which all robots watch the lead, bound after bound.

    A contact rate is the fraction of a bound's ticks in which a robot detected the lead, and
    `n_ticks` is the number of ticks. The lead is also listed as a robot, so that all missions have
    the same robots. Its contact rates are NaN, because they are not measured, and its features are
    0. A bound without any tick with known poses is not measured; its features are the means over
    the robot's other bounds. Features are averaged over a bound: `near` is r / (r + range) with the
    median range r of the log, `ahead` whether the lead is within 30 degrees of the heading, and
    `clear` whether the lead is not occluded.

    Args:
        tracks: Poses and detections.
        window: Length of a bound, s; ignored if a workspace is given.
        lead: Name of the lead; or `"each"`, to use every robot as the lead in turn.
        workspace: Map, with which each move of the lead to another cell is a bound. A mission ends
            where the lead leaves the grid or jumps to a cell that is not a neighbour.
        tick: Length of a tick, s.

    Returns:
        Missions sorted by lead and time, with a path if a workspace is given.

    Raises:
        TrustboError: The lead is unknown, the window is shorter than a tick, or the log is too
            short for two bounds.
    """
    require_choice("robot", lead, (*tracks.robots, EACH))
    start, end = tracks.span
    n = int(np.floor((end - start) / require_positive("tick", tick) + 1e-9))
    poses = tracks.at(start + (np.arange(n) + 0.5) * tick)
    ticks = _ticks(tracks, poses, tick)
    missions = []
    for i, name in enumerate(tracks.robots):
        if lead not in (name, EACH):
            continue
        if workspace is None:
            step = max(round(require_positive("window", window) / tick), 1)
            stretches = [(np.arange(0, n + 1, step), None)]
        else:
            stretches = _crossings(poses[i, :, :2], workspace)
        missions += [_mission(tracks.robots, ticks[:, i], edges, tick, path)
                     for edges, path in stretches if len(edges) > _FEWEST]  # fmt: skip
    if not missions:
        raise TrustboError(f"the log of {n * tick:g} s has no two bounds; give a shorter window.")
    return missions


def _ticks(tracks: Tracks, poses: np.ndarray, tick: float) -> np.ndarray:
    """Data of each pair of robots at each tick, shape (watcher, seen, tick, 2 + feature).

    The last axis has whether both poses are known, contact, and the features; all are 0 where a
    pose is unknown, and on the diagonal.

    Raises:
        TrustboError: There is no tick at which two poses are known.
    """
    place = poses[..., 0] + 1j * poses[..., 1]  # a point of the plane is a complex number
    across = place[None] - place[:, None]
    away = np.abs(across)
    away[np.eye(len(place), dtype=bool)] = np.nan
    known = ~np.isnan(away)
    if not known.any():
        raise TrustboError(
            f"in no tick of {tick:g} s are the poses of two robots known: the log is too short, or "
            f"they are of different times, or further apart than max_gap, {tracks.max_gap:g} s."
        )
    usual = max(float(np.nanmedian(away)), 1e-9)
    ahead = np.abs(np.angle(across * np.exp(-1j * poses[:, None, :, 2]))) < _AHEAD
    clear = np.ones(known.shape, dtype=bool)
    bodies = [(x + 1j * y, radius) for x, y, radius in tracks.landmarks]
    bodies += [(one, tracks.robot_radius) for one in place]
    for body, radius in bodies:
        with np.errstate(invalid="ignore"):  # along the line of sight, and beside it
            to = (body - place)[:, None] * np.conj(across) / away
        clear &= ~((to.real > _CLOSE) & (to.real < away - _CLOSE) & (np.abs(to.imag) < radius))
    contact = np.zeros(known.shape, dtype=bool)
    t, watcher, seen = tracks.detections.T
    k = np.floor((t - tracks.span[0]) / tick + 1e-9)
    there = (k >= 0) & (k < known.shape[-1])
    contact[tuple(np.stack([watcher, seen, k])[:, there].astype(int))] = True
    values = np.stack([known, contact, usual / (usual + away), ahead, clear], axis=-1)
    return np.where(known[..., None], values, 0.0)


def _mission(
    robots: tuple[str, ...],
    ticks: np.ndarray,
    edges: np.ndarray,
    tick: float,
    path: list[Cell] | None,
) -> Mission:
    """Make a mission from the ticks (watcher, tick, 2 + feature) of one lead.

    `edges`, shape (bound + 1,), has the first tick of each bound, and the end.
    """
    sums = np.add.reduceat(ticks[:, : edges[-1]], edges[:-1], axis=1).swapaxes(0, 1)
    n_ticks = np.where(sums[..., :1] > 0.0, sums[..., :1], np.nan)
    means = sums[..., 1:] / n_ticks
    z, measured = means[..., 1:], ~np.isnan(n_ticks)
    usual = np.nansum(z, axis=0) / np.maximum(measured.sum(axis=0), 1)
    return Mission.from_arrays(
        path, np.where(measured, z, usual), means[..., 0], np.diff(edges) * tick,
        n_ticks=n_ticks[..., 0], features=_FEATURES, robots=robots,
    )  # fmt: skip


def _crossings(xy: np.ndarray, workspace: Workspace) -> list[tuple[np.ndarray, list[Cell]]]:
    """Edges and path of each sequence of neighbouring cells that the lead, (tick, 2), entered."""
    cells: list[Cell] = []
    for x, y in xy:
        try:
            cells.append(workspace.grid.locate({"x": x, "y": y}, "position"))
        except TrustboError:  # off the grid, or not known
            cells.append(NOWHERE)
    entered = [k for k, cell in enumerate(cells) if k == 0 or cell != cells[k - 1]]
    path, edges = [cells[k] for k in entered], np.array([*entered, len(cells)])
    ends = [i for i, (a, b) in enumerate(pairwise(path), start=1)
            if NOWHERE in (a, b) or np.abs(np.subtract(a, b)).max() > 1]  # fmt: skip
    stretches = pairwise([0, *ends, len(path)])
    return [(edges[first + 1 : end + 1], path[first:end]) for first, end in stretches]


def _track(name: str, rows: np.ndarray) -> np.ndarray:
    """Poses of one robot (sample, 4) by time, with unwrapped heading or direction of motion."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    t, x, y, heading = rows.T
    if len(t) < 2 or (np.diff(t) <= 0.0).any():
        raise TrustboError(f"robot {name!r} has a single pose, or two at one time.")
    dx, dy = np.gradient(x, t), np.gradient(y, t)
    moves, course = np.hypot(dx, dy) > 1e-3, np.arctan2(dy, dx)  # m/s: one that stands looks on
    if np.isnan(heading).all():
        if not moves.any():
            raise TrustboError(
                f"robot {name!r} has no heading, and moves by less than 1 mm/s: are times in "
                "seconds and positions in metres? Else give its heading."
            )
        heading = pd.Series(np.where(moves, course, np.nan)).ffill().bfill().to_numpy()
    elif np.isnan(heading).any():
        raise TrustboError(f"headings of robot {name!r} are blank in some poses; give all or none")
    elif _in_degrees(heading, course[moves], heading[moves]):
        raise TrustboError(
            f"headings of robot {name!r} are up to {np.abs(heading).max():g}, in degrees; "
            "give rad from east, anticlockwise: radians(90 - compass heading)."
        )
    return np.column_stack([t, x, y, np.unwrap(heading)])


def _in_degrees(heading: np.ndarray, course: np.ndarray, along: np.ndarray) -> bool:
    """Whether headings are in degrees, by their jumps or the directions of motion."""
    if np.abs(heading).max() <= 2.0 * np.pi + 1e-6:
        return False
    fit, other = (np.cos(h - course).sum() for h in (along, np.radians(along)))
    return bool(np.abs(np.diff(heading)).max() > 2.0 * np.pi + 0.1 or other > max(fit, 0.0) + 0.5)
