"""Logs of poses and detections: who saw whom, as missions of robots that watch one of them."""

import warnings
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import NOWHERE, Bound, Cell, Mission, as_array
from trustbo.errors import TrustboError, require_choice, require_positive
from trustbo.logs.columns import Columns, require_one_spelling, seconds_of
from trustbo.workspace import Workspace

EACH = "each"
_AHEAD = np.pi / 6.0
"""Half of the angle in which a robot is ahead, rad."""
_CLOSE = 0.1
"""Distance to either end of a line of sight within which nothing hides, and least extent, m."""
_FEWEST = 2
"""Bounds of a mission."""


class Tracks:
    """Poses of robots and their detections of each other.

    Attributes:
        robots: Names of the robots, those with poses.
        tracks: Poses of each robot, (sample, 4): time (s), x, y (m), heading (rad from east,
            anticlockwise), times ascending.
        detections: Detections between robots, (detection, 3): time (s), indices of the watcher and
            of the robot seen.
        landmarks: Upright cylinders that hide robots, (landmark, 3): x, y, radius (m).
        robot_radius: Radius within which a robot hides others, m.
        max_gap: Longest time between two poses over which they are interpolated, s.
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
            poses: Columns t, robot, x, y (m) and, if known, heading (rad); by default robots face
                in the direction of their motion. Times are seconds, or dates with times.
            detections: Columns t, watcher, seen, by the same clock. Those of anything without
                poses are left out.
            landmarks: Shape (landmark, 3), see the attribute.
            robot_radius: See the attribute.
            max_gap: See the attribute.

        Raises:
            TrustboError: A missing column, a value of the wrong kind, two poses of a robot at one
                time, fewer than two robots, or no detection between robots; and times, positions or
                headings that cannot be in seconds, metres and radians.
        """
        self.max_gap, self.robot_radius = require_positive("max_gap", max_gap), robot_radius
        self.landmarks = as_array("landmarks", landmarks).reshape(-1, 3)
        where = Columns(poses, "the table of poses")
        where.require(("t", "robot", "x", "y"))
        looks = Columns(detections, "the table of detections")
        looks.require(("t", "watcher", "seen"))
        t, seen_at = seconds_of(where, looks)
        names, pairs = where.names("robot"), [looks.names(end) for end in ("watcher", "seen")]
        self.robots = tuple(dict.fromkeys(names))
        if len(self.robots) < 2 or "" in self.robots:
            raise TrustboError(f"a log is of two named robots at least; got {self.robots}.")
        require_one_spelling("the names in poses and detections", [*names, *pairs[0], *pairs[1]])
        xy = [where.numbers(name, blank=False) for name in ("x", "y")]
        if max(np.ptp(xy[0]), np.ptp(xy[1])) < _CLOSE:
            raise TrustboError(
                f"all poses lie within {_CLOSE:g} m; x and y are metres, not degrees or kilometres."
            )
        heading = np.full(len(t), np.nan)
        if where.find("heading"):
            heading = where.numbers("heading")
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
        """Poses at some times, (robot, time, 3): x, y, heading; NaN in longer gaps."""
        poses = np.full((len(self.robots), len(times), 3), np.nan)
        for one, track in zip(poses, self.tracks, strict=True):
            after = np.clip(np.searchsorted(track[:, 0], times), 1, len(track) - 1)
            gap = track[after, 0] - track[after - 1, 0]
            exact = (times == track[after, 0]) | (times == track[after - 1, 0])
            known = (times >= track[0, 0]) & (times <= track[-1, 0])
            known &= (gap <= self.max_gap) | exact
            for column, values in enumerate(track[:, 1:].T):
                one[known, column] = np.interp(times[known], track[:, 0], values)
        return poses

    def geometry(self, tick: float = 1.0) -> xr.Dataset:
        """Geometry of every pair of robots at every tick, and whether one detected the other.

        Returns:
            Dataset over (watcher, seen, time), NaN where a pose is not known, or of a robot with
            itself: `range` (m); `bearing` from the watcher's heading, in [-pi, pi]; `hidden`, 1
            where a landmark or another robot stands between, else 0; `contact`, 1 where it was
            detected in the tick, else 0.
        """
        start, end = self.span
        n = int(np.floor((end - start) / require_positive("tick", tick) + 1e-9))
        if n < 1:
            raise TrustboError(f"a tick of {tick:g} s is longer than the log, {end - start:g} s.")
        time = start + (np.arange(n) + 0.5) * tick
        poses = self.at(time)
        across = poses[None, ..., :2] - poses[:, None, :, :2]  # (watcher, seen, time, 2)
        away = np.hypot(across[..., 0], across[..., 1])
        angle = np.arctan2(across[..., 1], across[..., 0]) - poses[:, None, :, 2]
        away[np.eye(len(poses), dtype=bool)] = np.nan
        contact = np.zeros(away.shape)
        t, watcher, seen = self.detections.T
        k = np.floor((t - start) / tick + 1e-9).astype(int)
        there = (k >= 0) & (k < n)
        contact[watcher[there].astype(int), seen[there].astype(int), k[there]] = 1.0
        columns = {
            "range": away,
            "bearing": (angle + np.pi) % (2.0 * np.pi) - np.pi,
            "hidden": self._hidden(poses[..., :2]).astype(float),
            "contact": contact,
        }
        dims, names = ("watcher", "seen", "time"), list(self.robots)
        known = {name: (dims, np.where(np.isnan(away), np.nan, values))
                 for name, values in columns.items()}  # fmt: skip
        return xr.Dataset(known, {"watcher": names, "seen": names, "time": time}, {"tick": tick})

    def _hidden(self, xy: np.ndarray) -> np.ndarray:
        """Whether a landmark or another robot is between two, (watcher, seen, time)."""
        across = xy[None] - xy[:, None]
        away = np.hypot(across[..., 0], across[..., 1])
        hidden = np.zeros(away.shape, dtype=bool)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = across / away[..., None]
        cylinders = [(np.array([x, y]), radius, -1) for x, y, radius in self.landmarks]
        cylinders += [(xy[k], self.robot_radius, k) for k in range(len(xy))]
        for place, radius, k in cylinders:
            to = (place - xy)[:, None]
            along = (to * unit).sum(-1)
            beside = np.abs(to[..., 0] * unit[..., 1] - to[..., 1] * unit[..., 0])
            between = (along > _CLOSE) & (along < away - _CLOSE) & (beside < radius)
            if k >= 0:  # a robot hides neither itself nor from itself
                between[k], between[:, k] = False, False
            hidden |= between
        return hidden


def missions_of(
    tracks: Tracks,
    window: float = 20.0,
    *,
    lead: str = EACH,
    workspace: Workspace | None = None,
    tick: float = 1.0,
) -> list[Mission]:
    """Make missions of a log: all robots watch one, the lead, bound after bound.

    A contact rate is the share of a bound's ticks in which a robot detected the lead, and `n_ticks`
    their number. The lead is a robot of the mission too, so that all have the same: its rates are
    not measured (NaN), its features 0. A bound in which a pose is not known in any tick is not
    measured, and has the mean of each feature over the others of its robot. Features are the means
    over a bound of `near`, r / (r + range) with the median range r of the log; `ahead`, whether the
    lead is within 30 degrees of the heading; and `clear`, whether nothing hides it.

    Args:
        tracks: Poses and detections.
        window: Length of a bound, s; not used with a workspace.
        lead: Name of the lead; or `"each"`: missions for each robot that the others watch.
        workspace: Map; bounds then are the lead's crossings from cell to cell, and missions end
            where it leaves the grid or comes to a cell that is no neighbour.
        tick: Length of a tick, s.

    Returns:
        Missions by lead and time, with a path where there is a workspace.

    Raises:
        TrustboError: An unknown robot, a window below a tick, or a log too short for two bounds.
    """
    known = tracks.geometry(tick)
    n = known.sizes["time"]
    if not known["range"].notnull().any():
        raise TrustboError(
            f"in no tick of {tick:g} s are the poses of two robots known: they are of different "
            f"times, or further apart than max_gap, {tracks.max_gap:g} s."
        )
    usual = max(float(known["range"].median()), 1e-9)
    features = {
        "near": usual / (usual + known["range"]),
        "ahead": abs(known["bearing"]) < _AHEAD,
        "clear": known["hidden"] == 0.0,
    }
    require_choice("robot", lead, (*tracks.robots, EACH))
    missions = []
    for i, name in enumerate(tracks.robots):
        if lead not in (name, EACH):
            continue
        if workspace is None:
            step = max(round(require_positive("window", window) / tick), 1)
            stretches = [_Stretch(np.arange(0, n + 1, step), ())]
        else:
            stretches = _crossings(tracks.at(known["time"].values)[i, :, :2], workspace)
        missions += [_mission(tracks.robots, i, stretch, known, features)
                     for stretch in stretches if len(stretch.edges) > _FEWEST]  # fmt: skip
    if not missions:
        raise TrustboError(f"the log of {n * tick:g} s has no two bounds; give a shorter window.")
    return missions


class _Stretch(NamedTuple):
    """Bounds of one mission."""

    edges: np.ndarray  # (bound + 1,), the first tick of each bound, and the end
    path: tuple[Cell, ...]  # empty without a map


def _mission(
    robots: tuple[str, ...],
    lead: int,
    stretch: _Stretch,
    known: xr.Dataset,
    features: dict[str, xr.DataArray],
) -> Mission:
    """Mission of a stretch; features are over (watcher, seen, time)."""
    edges, tick = stretch.edges, known.attrs["tick"]
    cut, starts = slice(int(edges[0]), int(edges[-1])), edges[:-1] - edges[0]

    def total(values: xr.DataArray) -> np.ndarray:
        """Sums over the known ticks of each bound, (bound, robot)."""
        ticks = np.where(seen, values.values[:, lead, cut], 0.0)
        return np.add.reduceat(ticks, starts, axis=1).T

    seen = np.isfinite(known["range"].values[:, lead, cut])
    n_ticks = np.add.reduceat(seen.astype(float), starts, axis=1).T
    with np.errstate(invalid="ignore"):
        rate = total(known["contact"]) / n_ticks
        z = np.stack([total(values) / n_ticks for values in features.values()], axis=-1)
    for i in range(len(robots)):
        mean = np.nanmean(z[:, i], axis=0) if np.isfinite(z[:, i]).any() else 0.0
        z[:, i] = np.where(np.isnan(z[:, i]), mean, z[:, i])
    z[:, lead], rate[:, lead], n_ticks[:, lead] = 0.0, np.nan, np.nan
    n_ticks[n_ticks == 0.0] = np.nan
    bounds, t0 = [], 0.0
    for k, seconds in enumerate(np.diff(edges) * tick):
        cell, duration = stretch.path[k + 1] if stretch.path else NOWHERE, [seconds] * len(robots)
        bounds.append(Bound(cell, z[k], rate[k], np.array(duration), "ok", t0, n_ticks=n_ticks[k]))
        t0 += seconds
    return Mission(stretch.path, tuple(bounds), "ok", tuple(features), robots)


def _crossings(xy: np.ndarray, workspace: Workspace) -> list[_Stretch]:
    """Stretches along neighbouring cells that the lead, at xy (tick, 2), entered in order."""
    cells: list[Cell] = []
    for x, y in xy:
        try:
            cells.append(workspace.grid.locate({"x": x, "y": y}, "position"))
        except TrustboError:  # off the grid, or not known
            cells.append(NOWHERE)
    stretches, path, edges = [], [], []
    for k, cell in enumerate([*cells, NOWHERE]):
        if path and cell == path[-1]:
            continue
        if path and (cell == NOWHERE or np.abs(np.subtract(path[-1], cell)).max() > 1):
            if len(path) > 1:
                stretches.append(_Stretch(np.array([*edges[1:], k]), tuple(path)))
            path, edges = [], []
        if cell != NOWHERE:
            path.append(cell)
            edges.append(k)
    return stretches


def _track(name: str, rows: np.ndarray) -> np.ndarray:
    """Poses of one robot (sample, 4) by time, its heading unwound, or that of its motion."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    if len(rows) < 2 or (np.diff(rows[:, 0]) <= 0.0).any():
        raise TrustboError(f"robot {name!r} has a single pose, or two at one time.")
    dx, dy = (np.gradient(rows[:, i], rows[:, 0]) for i in (1, 2))
    moves, course = np.hypot(dx, dy) > 1e-3, np.arctan2(dy, dx)  # m/s: one that stands looks on
    blank = np.isnan(rows[:, 3])
    if blank.all():
        if not moves.any():
            raise TrustboError(
                f"robot {name!r} has no heading, and moves by less than 1 mm/s: are times in "
                "seconds and positions in metres? Else give its heading."
            )
        latest = np.maximum.accumulate(np.where(moves, np.arange(len(rows)), -1))
        rows[:, 3] = course[np.where(latest < 0, np.argmax(moves), latest)]
    elif blank.any():
        raise TrustboError(f"headings of robot {name!r} are blank in some poses; give all or none")
    elif _in_degrees(rows[:, 3], course[moves], rows[moves, 3]):
        raise TrustboError(
            f"headings of robot {name!r} are up to {np.abs(rows[:, 3]).max():g}, in degrees; "
            "give rad from east, anticlockwise: radians(90 - compass heading)."
        )
    rows[:, 3] = np.unwrap(rows[:, 3])
    return rows


def _in_degrees(heading: np.ndarray, course: np.ndarray, along: np.ndarray) -> bool:
    """Whether headings jump as no radians do, or are the course of robots that move in degrees."""
    if np.abs(heading).max() <= 2.0 * np.pi + 1e-6:
        return False
    fit, other = (np.cos(h - course).sum() for h in (along, np.radians(along)))
    return bool(np.abs(np.diff(heading)).max() > 2.0 * np.pi + 0.1 or other > max(fit, 0.0) + 0.5)
