"""Missions of logs: windows of time, or crossings between cells, become bounds."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import NOWHERE, Bound, Cell, Mission
from trustbo.errors import TrustboError, one_line, require_kind, require_positive, unknown
from trustbo.logs.geometry import geometry as geometry_of
from trustbo.logs.log import Log
from trustbo.logs.sensor import Sensor
from trustbo.workspace import Workspace

EACH = "each"
EXPECTED = "expected"
"""Feature of a sensor: log odds of the share of ticks expected by it."""
SIMPLE = ("near", "ahead", "clear")
"""Features without a sensor, in [0, 1]."""
_AHEAD = np.pi / 6.0  # rad from the heading
_HALF = 0.05  # of a tick: keeps the logit of no and of all ticks finite
_FEWEST = 2  # bounds of a mission

CouldSee = Callable[[xr.Dataset], xr.DataArray]


class _Stretch(NamedTuple):
    """Bounds of one mission, as ticks of the log."""

    lead: int
    edges: np.ndarray  # (bound + 1,), the first tick of each bound, and the end
    path: tuple[Cell, ...] | None


def missions_of(
    log: Log,
    window: float = 20.0,
    *,
    lead: str | Sequence[tuple[float, str]] = EACH,
    sensor: Sensor | None = None,
    could_see: CouldSee | None = None,
    workspace: Workspace | None = None,
    length: int | None = None,
    geometry: xr.Dataset | None = None,
) -> list[Mission]:
    """Make missions of a log: all robots watch one, the lead, bound after bound.

    A contact rate is the share of a bound's ticks in which a robot detected the lead, and `n_ticks`
    their number. The lead is a robot of the mission too, so that all have the same: its rates are
    not measured (NaN), its features 0. A bound in which a pose is not known in any tick is not
    measured, and has the mean of each feature over the others of its robot.

    Args:
        log: Poses and detections.
        window: Length of a bound, s; not used with a workspace.
        lead: `"each"`: one mission, or row of missions, for each robot that the others watch; the
            name of one; or a list of (time, name), who leads from when on.
        sensor: Chance of detection, from `fit_sensor`. The feature is then `expected`, the logit of
            the share of ticks expected by it. Otherwise there are three, shares of ticks or means,
            in [0, 1]: `near`, r / (r + range) with the median range r of the log; `ahead`, within
            30 degrees of the heading; `clear`, not hidden.
        could_see: Function of the geometry to booleans (watcher, seen, time): the ticks in which a
            robot could have seen. Others are no ticks: a sensor that faces away measures nothing.
        workspace: Map; bounds then are the lead's crossings from cell to cell, and missions end
            where it leaves the grid or comes to a cell that is no neighbour.
        length: Most bounds of a mission; by default trust carries over the whole log.
        geometry: Dataset of `logs.geometry`, if it is known; by default that of ticks of 1 s.

    Returns:
        Missions by lead and time, with a path where there is a workspace, in features that this
        does not have: fit them alone.

    Raises:
        TrustboError: An unknown robot, a window below a tick, a log too short for two bounds, or
            masks of another shape.
    """
    require_kind("log", log, Log, "give a trustbo.logs.Log, such as of read_log")
    known = geometry_of(log) if geometry is None else geometry
    tick, n = float(known.attrs["tick"]), known.sizes["time"]
    seen = np.isfinite(known["range"].values)
    if not seen.any():
        raise TrustboError(
            f"in no tick of {tick:g} s are the poses of two robots known; they may be of different "
            f"times, or further apart than max_gap, {log.max_gap:g} s."
        )
    if could_see is not None:
        seen = seen & _mask(could_see(known), known)
    names, columns = _columns(known, sensor)
    contact = np.where(seen, known["contact"].values, 0.0)
    missions = []
    for one, first, last in _leads(log, lead, known["time"].values - 0.5 * tick, n):
        if workspace is None:
            edges = np.arange(first, last + 1, _ticks_of(window, tick))
            stretches = [_Stretch(one, edges, None)]
        else:
            stretches = _crossings(log, one, first, last, known["time"].values, workspace)
        for stretch in stretches:
            for part in _parts(stretch, length):
                missions.append(_mission(log, part, tick, seen, contact, names, columns))
    if not missions:
        raise TrustboError(
            f"the log of {n * tick:g} s has no two bounds"
            + (f" of {window:g} s." if workspace is None else " between cells of the workspace.")
        )
    return missions


def join_missions(missions: Sequence[Mission]) -> Mission:
    """One mission of several that continue each other: trust carries over from each to the next.

    Args:
        missions: Missions of the same robots and features, in order. All but the last reached their
            goals; with a map, each begins in the cell in which the one before ended.

    Raises:
        TrustboError: Missions that do not continue each other.
    """
    first = missions[0] if missions else None
    if first is None:
        raise TrustboError("join_missions needs at least one mission; got none.")
    path, bounds, start = list(first.path), [], 0.0
    for j, mission in enumerate(missions):
        if (mission.robots, mission.features) != (first.robots, first.features):
            raise TrustboError(f"mission {j} has other robots or features than mission 0.")
        if mission.has_map != first.has_map:
            raise TrustboError(f"mission {j} has a path, or none, unlike mission 0.")
        if j and missions[j - 1].status != "ok":
            raise TrustboError(
                f"mission {j - 1} ended {missions[j - 1].status!r}: no other continues it."
            )
        if j and mission.has_map:
            if mission.path[0] != path[-1]:
                raise TrustboError(
                    f"mission {j} begins in {mission.path[0]}, and the one before ended in "
                    f"{path[-1]}; only missions that continue each other are joined."
                )
            path += mission.path[1:]
        bounds += [replace(bound, t0=bound.t0 + start) for bound in mission.bounds]
        start = bounds[-1].t1
    return replace(first, path=tuple(path), bounds=tuple(bounds), status=missions[-1].status)


def _mission(
    log: Log,
    stretch: _Stretch,
    tick: float,
    seen: np.ndarray,
    contact: np.ndarray,
    names: tuple[str, ...],
    columns: Sequence[np.ndarray],
) -> Mission:
    """Mission of a stretch; seen, contact and columns are over (watcher, seen, time)."""
    lead, edges = stretch.lead, stretch.edges
    cut = slice(int(edges[0]), int(edges[-1]))
    starts = edges[:-1] - edges[0]

    def total(values: np.ndarray) -> np.ndarray:
        """Sums over the ticks of each bound, (bound, robot)."""
        return np.add.reduceat(values[:, lead, cut], starts, axis=1).T

    n_ticks = total(seen.astype(float))
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = total(contact) / n_ticks
        shares = [total(np.where(seen, column, 0.0)) / n_ticks for column in columns]
    if names == (EXPECTED,):
        shares = [_logit(shares[0], n_ticks)]
    z = np.stack(shares, axis=-1)
    for i in range(len(log.robots)):
        mean = np.nanmean(z[:, i], axis=0) if np.isfinite(z[:, i]).any() else 0.0
        z[:, i] = np.where(np.isnan(z[:, i]), mean, z[:, i])
    z[:, lead], rate[:, lead], n_ticks[:, lead] = 0.0, np.nan, np.nan
    n_ticks[n_ticks == 0.0] = np.nan
    seconds = np.diff(edges) * tick
    bounds, t0 = [], 0.0
    for k, lasts in enumerate(seconds):
        cell = NOWHERE if stretch.path is None else stretch.path[k + 1]
        duration = np.full(len(log.robots), lasts)
        bounds.append(Bound(cell, z[k], rate[k], duration, "ok", t0, n_ticks=n_ticks[k]))
        t0 += lasts
    return Mission(stretch.path or (), tuple(bounds), "ok", names, log.robots)


def _columns(known: xr.Dataset, sensor: Sensor | None) -> tuple[tuple[str, ...], list[np.ndarray]]:
    """Names of the features, and their values by tick, (watcher, seen, time)."""
    if sensor is not None:
        require_kind("sensor", sensor, Sensor, "give a Sensor, as fit_sensor returns it")
        return (EXPECTED,), [sensor.predict(known).values]
    away, usual = known["range"].values, max(float(known["range"].median()), 1e-9)
    ahead = np.abs(known["bearing"].values) < _AHEAD
    return SIMPLE, [usual / (usual + away), ahead * 1.0, 1.0 - known["hidden"].values]


def _logit(share: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Log odds of a share of n ticks, finite at 0 and 1."""
    return np.log((share * n + _HALF) / ((1.0 - share) * n + _HALF))


def _mask(given: object, known: xr.Dataset) -> np.ndarray:
    """Ticks in which a robot could have seen, as booleans."""
    sizes = {name: known.sizes[name] for name in known["range"].dims}
    if not isinstance(given, xr.DataArray) or dict(given.sizes) != sizes:
        raise TrustboError(f"could_see must return booleans over {sizes}; got {one_line(given)}.")
    return np.asarray(given.transpose(*known["range"].dims).values, dtype=bool)


def _leads(
    log: Log, lead: str | Sequence[tuple[float, str]], starts: np.ndarray, n: int
) -> list[tuple[int, int, int]]:
    """Index of each lead, and its first and last tick."""
    if isinstance(lead, str):
        names = log.robots if lead == EACH else (lead,)
        return [(_index(log, name), 0, n) for name in names]
    try:
        rows = sorted((float(t), str(name)) for t, name in lead)
    except (TypeError, ValueError):
        raise TrustboError(
            f'lead must be "each", a name, or a list of (time, name); got {one_line(lead)}.'
        ) from None
    firsts = [int(np.searchsorted(starts, t - 1e-9)) for t, _ in rows]
    ends = [*firsts[1:], n]
    return [(_index(log, m), a, b) for (_, m), a, b in zip(rows, firsts, ends, strict=True)]


def _index(log: Log, name: str) -> int:
    if name not in log.robots:
        raise unknown("robot", name, (*log.robots, EACH))
    return log.robots.index(name)


def _ticks_of(window: float, tick: float) -> int:
    n = round(require_positive("window", window) / tick)
    if n < 1:
        raise TrustboError(f"a window of {window:g} s is shorter than a tick, {tick:g} s.")
    return n


def _crossings(
    log: Log, lead: int, first: int, last: int, time: np.ndarray, workspace: Workspace
) -> list[_Stretch]:
    """Stretches along neighbouring cells that the lead entered one after the other."""
    require_kind("workspace", workspace, Workspace, "give a Workspace")
    poses, grid = log.at(time[first:last])[lead], workspace.grid
    row, col = np.full((2, len(poses)), -1)
    for k, (x, y) in enumerate(poses[:, :2]):
        try:
            row[k], col[k] = grid.cell_at(x, y)
        except TrustboError:  # off the grid, or not known
            continue
    changes = np.flatnonzero(np.diff(row, prepend=-2) | np.diff(col, prepend=-2))
    stretches: list[_Stretch] = []
    path: list[Cell] = []
    edges: list[int] = []

    def close(end: int) -> None:
        if len(path) > 1:
            stretches.append(_Stretch(lead, np.array([*edges[1:], end]) + first, tuple(path)))
        path.clear()
        edges.clear()

    for k in changes.tolist():
        cell = (int(row[k]), int(col[k]))
        if path and (cell[0] < 0 or np.abs(np.subtract(path[-1], cell)).max() > 1):
            close(k)
        if cell[0] >= 0:
            path.append(cell)
            edges.append(k)
    close(len(poses))
    return stretches


def _parts(stretch: _Stretch, length: int | None) -> list[_Stretch]:
    """Parts of at most `length` bounds; those of a single bound are left out."""
    n = len(stretch.edges) - 1
    step = n if length is None else max(int(require_positive("length", length)), _FEWEST)
    parts = []
    for a in range(0, n, max(step, 1)):
        b = min(a + step, n)
        if b - a >= _FEWEST:
            path = None if stretch.path is None else stretch.path[a : b + 1]
            parts.append(_Stretch(stretch.lead, stretch.edges[a : b + 1], path))
    return parts
