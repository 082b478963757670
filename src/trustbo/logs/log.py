"""Logs of robots: poses, and who detected whom, by time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trustbo.arrays import as_array, as_names
from trustbo.display import Rows, Summary, joined, number
from trustbo.errors import ShapeError, TrustboError, require_not_negative, require_positive
from trustbo.files import FilePath
from trustbo.logs.bagfile import opened
from trustbo.logs.messages import POSE_TYPES, TEXT, Topics
from trustbo.logs.rows import needed_columns, number_of

_POSE, _DETECTION = ("t", "robot", "x", "y"), ("t", "watcher", "seen")
_NS = 1e9  # in a second
_FILES = ("poses", "detections", "landmarks")
_ENDS = (".csv", ".csv.gz")


class Log(Summary):
    """Poses of robots and their detections of each other, with or without a map.

    Attributes:
        robots: Names of the robots, those with poses.
        tracks: Poses of each robot, (sample, 4): time (s), x, y (m), heading (rad from east,
            anticlockwise), times ascending.
        detections: Detections between robots, (detection, 3): time (s), indices of the watcher and
            of the robot seen, times ascending.
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
            poses: Columns t, robot, x, y and, if known, heading; by default robots face ahead, in
                the direction of their motion. Times are numbers of seconds, or dates with times.
            detections: Columns t, watcher, seen; others are left out, and so are detections of
                anything without poses.
            landmarks: Shape (landmark, 3), see the attribute; or (landmark, 2), of no radius.
            robot_radius: See the attribute.
            max_gap: See the attribute.

        Raises:
            TrustboError: A missing file or column, a value of the wrong kind, a robot with a single
                pose or two at one time, no robots, or no detection between robots with poses.
        """
        self.max_gap = require_positive("max_gap", max_gap)
        self.robot_radius = require_not_negative("robot_radius", robot_radius)
        self.landmarks = _landmarks(landmarks)
        columns = _columns("poses", poses, _POSE, ("heading",))
        given = _columns("detections", detections, _DETECTION)
        clock = _Clock(columns["t"][0])
        t, names = clock.seconds("poses", columns["t"]), [_name(n) for n in columns["robot"]]
        self.robots = as_names("robots", dict.fromkeys(names))
        if len(self.robots) < 2:
            raise TrustboError(f"a log is of two robots at least; poses are of {self.robots}.")
        xy = [_numbers("poses", name, columns[name]) for name in ("x", "y")]
        heading = np.full(len(t), np.nan)
        if "heading" in columns:
            heading = _numbers("poses", "heading", columns["heading"], blank=True)
        rows, of = np.column_stack([t, *xy, heading]), np.array(names)
        self.tracks = tuple(_track(name, rows[of == name]) for name in self.robots)
        self.detections = _between_robots(clock, given, self.robots)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of a pose, s."""
        return min(t[0, 0] for t in self.tracks), max(t[-1, 0] for t in self.tracks)

    def between(self, start: float, end: float) -> Self:
        """The part of the log from a time to another, both in s.

        Raises:
            TrustboError: A robot has fewer than two poses there, or nobody is seen.
        """
        new = object.__new__(type(self))
        vars(new).update(vars(self))
        for robot, track in zip(self.robots, self.tracks, strict=True):
            if np.count_nonzero((track[:, 0] >= start) & (track[:, 0] <= end)) < 2:
                raise TrustboError(
                    f"robot {robot!r} has no two poses from {start:g} to {end:g} s; the log is "
                    f"from {self.span[0]:g} to {self.span[1]:g} s."
                )
        new.tracks = tuple(t[(t[:, 0] >= start) & (t[:, 0] <= end)] for t in self.tracks)
        there = (self.detections[:, 0] >= start) & (self.detections[:, 0] <= end)
        if not there.any():
            raise TrustboError(f"nobody is seen from {start:g} to {end:g} s.")
        new.detections = self.detections[there]
        return new

    def at(self, times: ArrayLike) -> np.ndarray:
        """Poses at some times, (robot, time, 3): x, y, heading; NaN in longer gaps."""
        t = as_array("times", times)
        poses = np.full((len(self.robots), len(t), 3), np.nan)
        for one, track in zip(poses, self.tracks, strict=True):
            after = np.searchsorted(track[:, 0], t, side="left")
            inside = (t >= track[0, 0]) & (t <= track[-1, 0])
            after = np.clip(after, 1, len(track) - 1)
            gap = track[after, 0] - track[after - 1, 0]
            exact = (t == track[after, 0]) | (t == track[after - 1, 0])
            known = inside & ((gap <= self.max_gap) | exact)
            for column, values in enumerate(track[:, 1:].T):
                one[known, column] = np.interp(t[known], track[:, 0], values)
        return poses

    def _rows(self) -> Rows:
        start, end = self.span
        n, m = len(self.robots), len(self.detections)
        poses = sum(len(track) for track in self.tracks)
        rows = [
            ("robots", joined(self.robots)),
            ("time", f"{start:.6g} to {end:.6g} s"),
            ("poses", f"{poses}, {number(poses / n / max(end - start, 1e-9))} a second and robot"),
            ("detections", f"{m} between robots"),
            ("landmarks", str(len(self.landmarks))),
        ]
        return rows


def read_log(path: FilePath, *, topics: Topics | None = None, **options: Any) -> Log:
    """Read a log from a folder of tables or from a ROS bag.

    Args:
        path: A folder with `poses.csv` and `detections.csv`, and `landmarks.csv` (x, y[, radius])
            if there are any, each also as `.csv.gz`; or a bag of ROS 1 or 2 with poses of each
            robot, and the names of robots as it sees them (`std_msgs/msg/String`), on
            `Topics.pose` and `Topics.seen`.
        topics: Names of topics of a bag.
        options: Further arguments of `Log`.

    Raises:
        TrustboError: There is no such file, or what `Log` and bags refuse.
    """
    folder = Path(path)
    files = {name: _file(folder, name) for name in _FILES}
    if files["poses"] and files["detections"]:
        if files["landmarks"] and "landmarks" not in options:
            table = _columns("landmarks", files["landmarks"], ("x", "y"), ("radius",))
            names = [name for name in ("x", "y", "radius") if name in table]
            columns = [_numbers("landmarks", name, table[name]) for name in names]
            options["landmarks"] = np.column_stack(columns)
        return Log(files["poses"], files["detections"], **options)
    if folder.is_dir() and not (folder / "metadata.yaml").exists():
        raise TrustboError(
            f"{str(folder)!r} holds no poses.csv and detections.csv, and is no bag of ROS 2."
        )
    poses, seen = _from_bag(folder, Topics() if topics is None else topics)
    return Log(poses, seen, **options)


def _from_bag(path: Path, topics: Topics) -> tuple[dict[str, list], dict[str, list]]:
    """Tables of poses and detections of a bag, times in s since its first pose."""
    with opened(path) as bag:
        robots = bag.robots(topics.pose)
        pose, seen = topics.of("pose", robots), topics.of("seen", robots)
        bag.require(pose or [topics.pose])
        there = [topic for topic in seen if topic in bag.types]
        if not there:
            raise TrustboError(
                f"{str(path)!r} has no topic {topics.seen}: names of the robots that each sees, "
                f"{TEXT}; other names by topics=Topics(seen=...)."
            )
        series = bag.collect(dict.fromkeys(pose, POSE_TYPES) | dict.fromkeys(there, (TEXT,)))
    first = min(int(series[topic].time[0]) for topic in pose if len(series[topic].time))
    poses: dict[str, list] = {name: [] for name in (*_POSE, "heading")}
    detections: dict[str, list] = {name: [] for name in _DETECTION}
    for robot, topic in zip(robots, pose, strict=True):
        values = np.reshape(series[topic].value, (-1, 3))
        poses["t"] += ((series[topic].time - first) / _NS).tolist()
        poses["robot"] += [robot] * len(values)
        for name, column in zip(("x", "y", "heading"), values.T, strict=True):
            poses[name] += column.tolist()
    for robot, topic in zip(robots, seen, strict=True):
        if topic in there:
            detections["t"] += ((series[topic].time - first) / _NS).tolist()
            detections["watcher"] += [robot] * len(series[topic].time)
            detections["seen"] += [str(name) for name in series[topic].value]
    return poses, detections


class _Clock:
    """Seconds of the times of both tables: numbers, or dates since the first pose's."""

    def __init__(self, first: str) -> None:
        try:
            float(first)
            self.start = None
        except ValueError:
            self.start = _dates("poses", [first])[0]

    def seconds(self, what: str, times: Sequence[str]) -> np.ndarray:
        """Times of a table, (row,), s."""
        if self.start is None:
            return _numbers(what, "t", times)
        since: Any = _dates(what, times) - self.start
        return np.asarray(since.total_seconds())


def _dates(what: str, times: Sequence[str]) -> pd.DatetimeIndex:
    dates = pd.to_datetime(pd.Index(times), utc=True, format="ISO8601", errors="coerce")
    if (bad := np.flatnonzero(dates.isna())).size:
        raise TrustboError(
            f"{what}, row {bad[0] + 1}: t = {times[bad[0]]!r} is neither seconds nor a date such "
            "as 2026-11-24T10:00:00.5Z."
        )
    return pd.DatetimeIndex(dates)


def _columns(
    what: str, table: Any, needed: Sequence[str], others: Sequence[str] = ()
) -> dict[str, list[str]]:
    """Columns of a table by name; TrustboError: one that is needed is missing, or no rows."""
    columns = needed_columns(table, needed, of=f" of {what}")
    return {name: columns[name] for name in (*needed, *others) if name in columns}


def _numbers(what: str, name: str, texts: Sequence[str], *, blank: bool = False) -> np.ndarray:
    """Numbers of a column, (row,); NaN where blank, if this is allowed."""
    values = np.empty(len(texts))
    for i, text in enumerate(texts):
        values[i] = number_of(where := f"{what}, row {i + 1}", name, text)
        if np.isnan(values[i]) and not blank:
            raise TrustboError(f"{where}: {name} = {text!r} is no number.")
    return values


def _name(text: str) -> str:
    """Name of a robot; a number that was read as 1.0 is 1."""
    return text.removesuffix(".0") if text.removesuffix(".0").isdigit() else text


def _track(name: str, rows: np.ndarray) -> np.ndarray:
    """Poses of one robot by time, its heading unwound, or that of its motion."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    if len(rows) < 2:
        raise TrustboError(f"robot {name!r} has a single pose; give its track.")
    twice = np.flatnonzero(np.diff(rows[:, 0]) <= 0.0)
    if len(twice):
        raise TrustboError(f"robot {name!r} has two poses at t = {rows[twice[0], 0]:g} s.")
    blank = np.isnan(rows[:, 3])
    if blank.all():
        dx, dy = (np.gradient(rows[:, i], rows[:, 0]) for i in (1, 2))
        moves = np.hypot(dx, dy) > 1e-3  # m/s: one that stands looks on
        if not moves.any():
            raise TrustboError(f"robot {name!r} has no heading, and never moves; give heading.")
        heading = np.arctan2(dy, dx)
        latest = np.maximum.accumulate(np.where(moves, np.arange(len(rows)), -1))
        rows[:, 3] = heading[np.where(latest < 0, np.argmax(moves), latest)]
    elif blank.any():
        row = int(np.argmax(blank))
        raise TrustboError(
            f"heading of robot {name!r} at t = {rows[row, 0]:g} s is blank; give all or none."
        )
    rows[:, 3] = np.unwrap(rows[:, 3])
    return rows


def _between_robots(
    clock: _Clock, columns: Mapping[str, Sequence[str]], robots: tuple[str, ...]
) -> np.ndarray:
    """Detections of robots with poses by such, by time; TrustboError: there are none."""
    index = {name: i for i, name in enumerate(robots)}
    watcher, seen = ([_name(n) for n in columns[name]] for name in ("watcher", "seen"))
    kept = [k for k, w in enumerate(watcher) if w in index and seen[k] in index and w != seen[k]]
    if not kept:
        raise TrustboError(
            f"no detection is of a robot by another, of {joined(robots)}; the first is of "
            f"{seen[0]!r} by {watcher[0]!r}."
        )
    t = clock.seconds("detections", columns["t"])[kept]
    pairs = [(index[watcher[k]], index[seen[k]]) for k in kept]
    rows = np.column_stack([t, np.array(pairs, dtype=float)])
    return rows[np.argsort(t, kind="stable")]


def _landmarks(given: ArrayLike) -> np.ndarray:
    array = as_array("landmarks", given).reshape(-1, np.shape(given)[-1] if np.size(given) else 3)
    if array.shape[1] == 2:
        array = np.column_stack([array, np.zeros(len(array))])
    if array.shape[1] != 3 or not np.isfinite(array).all() or (array[:, 2] < 0.0).any():
        raise ShapeError(
            "landmarks must be (landmark, 3), x, y and radius (m); got shape "
            f"{np.shape(given)}, or a radius below 0."
        )
    return array


def _file(folder: Path, name: str) -> Path | None:
    """Path of a table in a folder, plain or compressed; None without it."""
    return next((f for end in _ENDS if (f := folder / f"{name}{end}").is_file()), None)
