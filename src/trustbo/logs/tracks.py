"""Conversion of poses and detections to missions in which all robots watch one lead."""

import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from trustbo.data import NOWHERE, Cell, Mission
from trustbo.errors import TrustboError, require_cells, require_choice, require_positive
from trustbo.logs.columns import Columns, require_one_spelling, seconds_of
from trustbo.workspace import Workspace

_FEATURES = ("near", "ahead")
_AHEAD = np.pi / 6.0
"""Half-angle of the sector ahead of a robot, rad."""
_EXTENT = 0.1
"""Smallest extent of a log, m."""


def read_tracks(
    poses: Any,
    detections: Any,
    workspace: Workspace | None = None,
    *,
    path: Sequence[Cell] | None = None,
    lead: str | None = None,
    window: float = 20.0,
    tick: float = 1.0,
    max_gap: float = 5.0,
) -> list[Mission]:
    """Read a log of poses and detections as missions in which all robots watch the lead.

    The contact rate of a robot in a bound is the fraction of ticks in which it detected the lead,
    counting only the `n_ticks` ticks in which both poses are known.

    With a workspace, each move of the lead to another cell is a bound, and missions have the robots
    and features of the workspace, for `Campaign.tell`; awareness is NaN. A mission ends where the
    lead leaves the grid or jumps to a cell that is not a neighbour. If the planned `path` is given,
    a bound begins where the lead enters the next cell of the path, so that cells whose corners it
    cuts are not bounds. If it does not reach the last cell, the status is `"aborted"`.

    Without a workspace, bounds are time windows. The lead is also listed as a robot, so that all
    missions have the same robots; its contact rates are NaN, because they are not measured, and its
    features are 0. A bound without any tick with known poses is not measured; its features are the
    means over the robot's other bounds. Features are averaged over a bound: `near` is
    r / (r + range) with the median range r of the log, and `ahead` is whether the lead is within 30
    degrees of the heading.

    Args:
        poses: Path of a CSV file, a DataFrame, or a mapping of columns: t (seconds, or dates with
            times), robot, x, y (m) and, if known, heading (rad from east, anticlockwise); by
            default, the heading is the direction of motion.
        detections: Another such table with the columns t (on the same clock), watcher and seen.
            Detections of objects without poses are ignored.
        workspace: Map of the cells that the lead enters.
        path: Planned path, such as `campaign.ask().path`; it needs a workspace.
        lead: Name of the lead. By default the robot that is not in the workspace's team; without a
            workspace, every robot is used as the lead in turn.
        window: Length of a bound without a workspace, s.
        tick: Length of a tick, s.
        max_gap: Longest gap between two poses that is interpolated, s.

    Returns:
        Missions sorted by lead and time, with a path if a workspace is given.

    Raises:
        TrustboError: A column is missing; a value has the wrong type; a robot has two poses at one
            time or fewer than two poses; there are fewer than two robots or no detections between
            robots; times, positions or headings cannot be in seconds, metres and radians; the lead
            is unknown; or the log is too short for two bounds.
    """
    tick, max_gap = require_positive("tick", tick), require_positive("max_gap", max_gap)
    tracks, looks = _read(poses, detections, tick)
    robots = tuple(tracks)
    team = robots if workspace is None else workspace.team.names
    for name in team:
        require_choice("robot of the team", name, robots)
    leads = robots if workspace is None else [name for name in robots if name not in team]
    if lead is not None:
        leads = [require_choice("lead", lead, robots)]
    elif workspace is not None and len(leads) != 1:
        raise TrustboError(f"a log with a map has one lead; pass lead=, one of {leads or robots}.")
    planned = None if path is None else require_cells("path", path)
    if planned and workspace is None:
        raise TrustboError("path= needs the workspace of its cells.")
    start = min(track[0, 0] for track in tracks.values())
    end = max(track[-1, 0] for track in tracks.values())
    n = int((end - start) / tick + 1e-9)
    times = start + (np.arange(n) + 0.5) * tick
    places = np.stack([_at(track, times, max_gap) for track in tracks.values()])
    looks[:, 0] = np.floor((looks[:, 0] - start) / tick + 1e-9)
    ticks = _ticks(places, looks[(looks[:, 0] >= 0) & (looks[:, 0] < n)].astype(int))
    of_team, missions = [robots.index(name) for name in team], []
    fewest = 2 if planned is None else 1
    for i in map(robots.index, leads):
        if workspace is None:
            step = max(round(require_positive("window", window) / tick), 1)
            stretches = [(np.arange(0, n + 1, step), None)]
        else:
            stretches = _crossings(places[i, :, :2], workspace, planned)
        missions += [_mission(ticks[of_team, i], edges, tick, cells, team, workspace)
                     for edges, cells in stretches if len(edges) > fewest]  # fmt: skip
    if not missions:
        raise TrustboError(f"the log of {n * tick:g} s is too short; give a shorter window.")
    return missions


def _read(poses: Any, detections: Any, tick: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Read the poses of each robot, (sample, 4), and detections, (detection, 3).

    Poses hold the time (s), x, y (m) and heading (rad), sorted by time; detections hold the time
    and the indices of the watcher and of the robot seen.
    """
    where = Columns(poses, "the table of poses")
    seen = Columns(detections, "the table of detections")
    t, seen_at = seconds_of(where, seen)
    names, pairs = where.texts("robot", blank=False), [seen.texts(n) for n in ("watcher", "seen")]
    robots = tuple(dict.fromkeys(names))
    if len(robots) < 2:
        raise TrustboError(f"poses must include at least two named robots; got {robots}.")
    require_one_spelling("the names in poses and detections", [*names, *pairs[0], *pairs[1]])
    xy = [where.numbers(name, blank=False) for name in ("x", "y")]
    if np.ptp(xy, axis=1).max() < _EXTENT:
        raise TrustboError(
            f"all poses lie within {_EXTENT:g} m; x and y are in metres, not degrees or kilometres."
        )
    heading = where.numbers("heading", required=False)
    rows, of = np.column_stack([t, *xy, heading]), np.array(names)
    watcher, other = (pd.Index(robots).get_indexer(pd.Index(one)) for one in pairs)
    known = (watcher >= 0) & (other >= 0) & (watcher != other)
    looks = np.column_stack([seen_at, watcher, other])[known]
    if not len(looks):
        raise TrustboError(
            f"no detection is between two of the robots {robots}; in the first, "
            f"{pairs[0][0]!r} detects {pairs[1][0]!r}."
        )
    readings = pd.DataFrame(looks, columns=["t", "watcher", "seen"]).drop_duplicates()
    gaps = readings.sort_values("t").groupby(["watcher", "seen"])["t"].diff()
    apart = float(pd.Series(gaps).quantile(0.05))  # NaN if no robot detects another twice
    if apart > 1.5 * tick:
        warnings.warn(
            f"detections of one robot by another are at least {apart:g} s apart, but every tick of "
            f"{tick:g} s without a detection counts as lost contact; pass tick={apart:g}.",
            stacklevel=3,
        )
    if silent := [name for i, name in enumerate(robots) if i not in looks[:, 1:]]:
        warnings.warn(
            f"no detection names {', '.join(silent)}; robots without detections have contact 0.",
            stacklevel=3,
        )
    return {name: _track(name, rows[of == name]) for name in robots}, looks


def _track(name: str, rows: np.ndarray) -> np.ndarray:
    """Sort the poses of one robot (sample, 4) by time, and unwrap the heading."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    t, x, y, heading = rows.T
    if len(t) < 2 or (np.diff(t) <= 0.0).any():
        raise TrustboError(f"robot {name!r} has only one pose, or two poses at one time.")
    dx, dy = np.gradient(x, t), np.gradient(y, t)
    moves, course = np.hypot(dx, dy) > 1e-3, np.arctan2(dy, dx)  # m/s; slower is standing
    if np.isnan(heading).all():
        if not moves.any():
            raise TrustboError(
                f"robot {name!r} has no heading, and moves at less than 1 mm/s: are times in "
                "seconds and positions in metres? If so, give its heading."
            )
        heading = pd.Series(np.where(moves, course, np.nan)).ffill().bfill().to_numpy()
    elif np.isnan(heading).any():
        raise TrustboError(f"headings of robot {name!r} are blank in some poses; give all or none.")
    elif _in_degrees(heading, course[moves], heading[moves]):
        raise TrustboError(
            f"headings of robot {name!r} are up to {np.abs(heading).max():g}, so they seem to be "
            "in degrees; give radians from east, anticlockwise: radians(90 - compass heading)."
        )
    return np.column_stack([t, x, y, np.unwrap(heading)])


def _in_degrees(heading: np.ndarray, course: np.ndarray, along: np.ndarray) -> bool:
    """Return whether jumps or directions of motion show that headings are in degrees."""
    if np.abs(heading).max() <= 2.0 * np.pi + 1e-6:
        return False
    fit, other = (np.cos(h - course).sum() for h in (along, np.radians(along)))
    return bool(np.abs(np.diff(heading)).max() > 2.0 * np.pi + 0.1 or other > max(fit, 0.0) + 0.5)


def _at(track: np.ndarray, times: np.ndarray, max_gap: float) -> np.ndarray:
    """Interpolate the poses of a robot, (time, 3): x, y, heading; NaN in gaps over `max_gap`."""
    t = track[:, 0]
    gap = np.diff(t)[np.clip(np.searchsorted(t, times), 1, len(t) - 1) - 1]
    known = (times >= t[0]) & (times <= t[-1]) & (gap <= max_gap)
    poses = np.column_stack([np.interp(times, t, values) for values in track[:, 1:].T])
    return np.where(known[:, None], poses, np.nan)


def _ticks(poses: np.ndarray, looks: np.ndarray) -> np.ndarray:
    """Return data of each pair of robots at each tick, (watcher, seen, tick, 2 + feature).

    The last axis holds whether both poses are known, the contact, and the features; all are 0 where
    a pose is unknown and on the diagonal. `looks` has tick, watcher and robot seen, (detection, 3).

    Raises:
        TrustboError: There is no tick at which two poses are known.
    """
    place = poses[..., 0] + 1j * poses[..., 1]  # points of the plane as complex numbers
    across = place[None] - place[:, None]
    away = np.abs(across)
    away[np.eye(len(place), dtype=bool)] = np.nan
    known = ~np.isnan(away)
    if not known.any():
        raise TrustboError(
            "the poses of two robots are never known at the same time: the log is too short, or "
            "the gaps between poses are longer than max_gap."
        )
    usual = max(float(np.nanmedian(away)), 1e-9)
    ahead = np.abs(np.angle(across * np.exp(-1j * poses[:, None, :, 2]))) < _AHEAD
    contact = np.zeros(known.shape, dtype=bool)
    k, watcher, seen = looks.T
    contact[watcher, seen, k] = True
    values = np.stack([known, contact, usual / (usual + away), ahead], axis=-1)
    return np.where(known[..., None], values, 0.0)


def _mission(
    ticks: np.ndarray,
    edges: np.ndarray,
    tick: float,
    path: list[Cell] | None,
    robots: Sequence[str],
    workspace: Workspace | None,
) -> Mission:
    """Make a mission from the ticks (watcher, tick, 2 + feature) of one lead.

    `edges`, shape (bound + 1,), holds the first tick of each bound and the end of the last.
    """
    sums = np.add.reduceat(ticks[:, : edges[-1]], edges[:-1], axis=1).swapaxes(0, 1)
    n_ticks = np.where(sums[..., :1] > 0.0, sums[..., :1], np.nan)
    means = sums[..., 1:] / n_ticks
    z, features = means[..., 1:], _FEATURES
    if workspace is None:
        usual = np.nansum(z, axis=0) / np.maximum((~np.isnan(z)).sum(axis=0), 1)
        z = np.where(np.isnan(z), usual, z)
    else:
        features = workspace.features
        z = np.full((*n_ticks.shape[:2], len(features)), np.nan)
    status = "ok" if path is None or len(edges) == len(path) else "aborted"
    return Mission.from_arrays(
        path, z, means[..., 0], np.diff(edges) * tick,
        n_ticks=n_ticks[..., 0], features=features, robots=robots, status=status,
    )  # fmt: skip


def _crossings(
    xy: np.ndarray, workspace: Workspace, planned: Sequence[Cell] | None
) -> list[tuple[np.ndarray, list[Cell]]]:
    """Find the edges and path of each sequence of neighbouring cells that the lead entered."""
    cells: list[Cell] = []
    for x, y in xy:
        try:
            cells.append(workspace.grid.locate({"x": x, "y": y}, "position"))
        except TrustboError:  # off the grid, or unknown
            cells.append(NOWHERE)
    if planned is not None:
        edges = []
        for k, cell in enumerate(cells):
            if len(edges) < len(planned) and cell == planned[len(edges)]:
                edges.append(k)
        return [(np.array([*edges[1:], len(cells)]), [*planned])]
    entered = [k for k, cell in enumerate(cells) if k == 0 or cell != cells[k - 1]]
    path, edges = [cells[k] for k in entered], np.array([*entered, len(cells)])
    ends = [i for i, (a, b) in enumerate(pairwise(path), start=1)
            if NOWHERE in (a, b) or np.abs(np.subtract(a, b)).max() > 1]  # fmt: skip
    stretches = pairwise([0, *ends, len(path)])
    return [(edges[first + 1 : end + 1], path[first:end]) for first, end in stretches]
