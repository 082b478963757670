"""Conversion of poses and detections to missions in which all robots watch one lead."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from trustbo.data import STATUSES, Mission, Station, began_at, cells_of, stations_of
from trustbo.errors import TrustboError, require_choice, require_positive, warn
from trustbo.logs.crossings import crossings_of
from trustbo.logs.detections import (
    read_tables,
    ticks_of,
    warn_of_gaps,
    warn_of_names,
    warn_of_silence,
    warn_of_times,
)
from trustbo.logs.mapping import ColumnMap
from trustbo.logs.poses import GAP, UNITS, poses_at, track_of
from trustbo.workspace import Workspace

_FEATURES = ("near", "ahead")
_AHEAD = np.pi / 6.0
"""Largest angle between the heading of a robot and a lead ahead of it, rad."""
_ABORTED = "aborted"
"""Status of a mission that ended early although no bound failed."""
_ROUNDING = 1e-3
"""Part of a tick by which rounded times may shorten a log; Unix times have steps of 2.4e-7 s."""


def read_tracks(
    poses: Any,
    detections: Any,
    workspace: Workspace | None = None,
    *,
    path: Sequence[Station] | None = None,
    lead: str | None = None,
    window: float = 20.0,
    tick: float = 1.0,
    status: str = _ABORTED,
    columns: ColumnMap | None = None,
) -> list[Mission]:
    """Read a log of poses and detections as missions, one for each lead, which all robots watch.

    The contact rate of a robot in a bound is the fraction of ticks with a detection in which the
    robot is the `watcher` and the lead is `seen`, counting only the `n_ticks` ticks in which both
    poses are known. The ticks of each watcher are shifted by less than a tick, so that its readings
    lie in the middle of them. Poses are interpolated if they are at most 5 s apart. Phases of a
    bound are not distinguished: while T2 closes up, contact means that the lead detects the robot,
    so exchange `watcher` and `seen` in the lead's detections of this phase.

    With a workspace, the result is one mission for `Campaign.tell`, with the robots and features of
    the workspace and without measured awareness. A bound begins when the lead leaves its stop in a
    cell and ends when it leaves its stop in the next one. The lead is at a stop within 5 m of it
    (in small cells, a quarter of a side), even beyond an edge of the cell; if it never comes to the
    stop, it halts at the median of its positions in the cell. A cell is reached when the lead
    enters it. Excursions of at most 5 s, from which the lead returns to its cell, are ignored, and
    so is a cell whose corner it only cuts. If the lead drives round planned cells, those that it
    drove through are read instead. If it does not reach the last cell, the mission has the given
    status.

    Without a workspace, bounds are time windows. The lead is also listed as a robot, with contact
    rates NaN and features 0. All missions therefore have the same robots. A bound without any tick
    with known poses is not measured; its features are the means over the robot's other bounds.
    Features are averaged over a bound: `near` is r / (r + range) with the median range r of the
    log, and `ahead` is whether the lead is within 30 degrees of the heading.

    Args:
        poses: Path of a CSV file, a DataFrame, or a mapping of columns: t (s), robot, x, y (m; or
            lon, lat in degrees with a workspace) and, if known, heading (rad from east,
            anticlockwise); by default, the heading is the direction of motion. Headings are used
            only without a workspace.
        detections: Table in any of the same forms with the columns t (on the same clock), watcher
            and seen. Each row is a detection, so further columns are refused. Detections of objects
            without poses are ignored. A table without rows means that no robot detected another.
        workspace: Map of the cells that the lead enters.
        path: Planned path, such as `campaign.ask().path`; it needs a workspace.
        lead: Name of the lead. By default, it is the robot that is not in the workspace's team;
            without a workspace, every robot is used as the lead in turn.
        window: Length of a bound without a workspace, s.
        tick: Length of a tick, s.
        status: Why the mission ended before it was complete. If it is not `"aborted"`, the bound
            in which the poses end failed: the bound into the cell at whose stop the lead is, while
            T2 closes up, or else the one on which it has left this stop. This bound ends 10 s after
            the lead has moved for the last time.
        columns: Names and units of the columns in both tables, as for `read_table`.

    Returns:
        One mission for each lead that has a complete bound.

    Raises:
        TrustboError: Values, times, poses or units are invalid, the detections have a further
            column, no detection is between two robots with poses, the lead is unknown, it jumps
            over a cell of the given path, it leaves the start twice before it has driven the
            planned path, a status is given although it leaves the last cell, or the log has no
            complete bound.

    Warns:
        UserWarning: A watcher is unknown, detections lie outside the time of the poses, the lead
            detects robots, the interval of detections is not the tick, poses are more than 5 s
            apart, a robot has no poses, is never seen, never watches or stops watching long before
            the end, the lead leaves the
            planned path or starts again after it, a bound has fewer than 5 readings, or T2 stood at
            the posts of no set, although the workspace has several and the path has none.

    Example:
        >>> missions = tb.logs.read_tracks("poses.csv", "detections.csv", window=20.0)
        >>> missions[0].robots
        ('spot', 'husky')
    """
    tick = require_positive("tick", tick)
    window = require_positive("window", window)
    if path is not None and workspace is None:
        raise TrustboError("path= needs the workspace of its cells.")
    if require_choice("status", status, STATUSES[1:]) != _ABORTED and path is None:
        raise TrustboError(f"status={status!r} needs path=, with the cell that was not reached.")

    grid = None if workspace is None else workspace.grid
    tracks, looks, unknown = read_tables(poses, detections, columns, grid)
    robots = tuple(tracks["robot"].unique())
    team = robots if workspace is None else workspace.team.names
    leads = _leads(lead, robots, workspace)

    t = tracks["t"].to_numpy()
    n = int(np.ptp(t) / tick + _ROUNDING)
    if n < 1:
        raise TrustboError(f"the log of {np.ptp(t):.3g} s is shorter than a tick; give {UNITS}.")

    times = t.min() + (np.arange(n) + 0.5) * tick
    by_robot = [track_of(tracks, name, headings=workspace is None) for name in robots]
    places = pd.concat([poses_at(track, times) for track in by_robot])
    looks = looks.assign(tick=ticks_of(looks, t.min(), tick))
    pairs = _pairs(places, looks)

    missions = []
    for name in leads:
        cells = None
        edges = np.arange(0, n + 1, max(round(window / tick), 1))
        outcome = "ok"

        of_name = places.loc[places["robot"] == name]
        if workspace is not None and len(of_name):
            found = crossings_of(of_name, n, tick, workspace, path, is_failed=status != _ABORTED)
            cells = _with_sets(found.stations, found.reached[1:], places, workspace)
            edges = found.edges
            outcome = "ok" if found.is_complete else status

        of_lead = pairs.loc[pairs["lead"] == name]
        if len(edges) > 1 and len(of_lead):
            mission = _mission(of_lead, edges, tick, cells, team, workspace, outcome)
            began = began_at(t.min() + edges[0] * tick)
            missions.append(replace(mission, began=began))

    if not missions:
        usual = tracks.sort_values("t").groupby("robot")["t"].diff().median()
        raise TrustboError(
            f"the log of {n * tick:g} s has no complete bound in which the poses of two robots are "
            f"at most {GAP:g} s apart; they are usually {usual:.3g} s apart. Give {UNITS}, or a "
            "shorter window."
        )

    warn_of_names(looks, unknown, leads, team, robots)
    warn_of_times(tracks, looks, tick)
    warn_of_silence(tracks, looks, leads)
    warn_of_gaps(tracks, looks, pairs, leads)
    return missions


def _leads(lead: str | None, robots: Sequence[str], workspace: Workspace | None) -> Sequence[str]:
    """Return the leads of a log: the given one, the robot that is not in the team, or all."""
    team = () if workspace is None else workspace.team.names
    others = [name for name in robots if name not in team]
    leads = others if lead is None else [require_choice("lead", lead, robots)]
    absent = [name for name in team if name not in robots]
    if absent and (len(others) > 1 or len(absent) == len(team)):
        raise TrustboError(
            f"the table of poses has the robots {', '.join(robots)}, but no poses of "
            f"{', '.join(absent)} of the team; use the names of the team in both tables."
        )
    if absent:
        warn(
            f"there are no poses of {', '.join(absent)} of the team, so their contact in this "
            "mission is unknown; add the poses if they took part."
        )
    if workspace is not None and len(leads) != 1:
        raise TrustboError(f"a log with a map has one lead; pass lead=, one of {others or robots}.")
    return leads


def _with_sets(
    path: Sequence[Station], entered: Sequence[int], places: pd.DataFrame, workspace: Workspace
) -> Sequence[Station]:
    """Return a path with the sets of posts at which T2 stood when the lead entered each cell.

    A path that has names of sets keeps them. If T2 stood elsewhere, a warning is issued.

    Args:
        path: Planned or driven path.
        entered: Ticks at which the lead entered each cell after the first one.
        places: Poses with columns tick, robot, x and y.
        workspace: Workspace, which may have several sets.
    """
    if workspace.n_posts == 1 or any(len(station) > 2 for station in path):
        return path

    cells = cells_of(path)
    stood = np.full((len(cells) - 1, workspace.team.n_robots, 2), np.nan)
    by_robot = dict(iter(places.groupby("robot")))
    for i, name in enumerate(workspace.team.names):
        if name in by_robot:
            track = by_robot[name].set_index("tick")[["x", "y"]]
            stood[: len(entered), i] = track.reindex(entered).to_numpy()

    try:
        return stations_of(cells, workspace.post_sets_of(cells, stood))
    except TrustboError:
        warn(
            "some robots of the subteam did not stand at their posts of any set, so the subteam "
            "counts as being at the standard posts; pass path=plan.stations to name the sets."
        )
        return path


def _pairs(places: pd.DataFrame, looks: pd.DataFrame) -> pd.DataFrame:
    """Return the contact and features of each pair of robots at each tick with known poses."""
    pairs = places.merge(places, on="tick", suffixes=("", "_lead"))
    pairs = pairs.loc[pairs["robot"] != pairs["robot_lead"]].rename(columns={"robot_lead": "lead"})

    dx = pairs["x_lead"] - pairs["x"]
    dy = pairs["y_lead"] - pairs["y"]
    away = np.hypot(dx, dy)
    bearing = np.arctan2(dy, dx) - pairs["heading"]

    usual = max(float(pd.Series(away).median()), 1e-9)  # no division by zero if poses coincide
    keys = ["tick", "robot", "lead"]
    contact = pairs.set_index(keys).index.isin(looks.set_index(keys).index)
    ahead = np.cos(bearing) > np.cos(_AHEAD)
    return pairs[keys].assign(contact_rate=contact, near=usual / (usual + away), ahead=ahead)


def _mission(
    pairs: pd.DataFrame,
    edges: np.ndarray,
    tick: float,
    path: Sequence[Station] | None,
    robots: Sequence[str],
    workspace: Workspace | None,
    status: str,
) -> Mission:
    """Make a mission of one lead; `edges` has the first tick of each bound, and then the end."""
    duration = np.diff(edges) * tick
    bound = np.searchsorted(edges, pairs["tick"], side="right")  # 0 before, and too many after
    groups = pairs.assign(bound=bound).groupby(["bound", "robot"])
    means = {name: (name, "mean") for name in ("contact_rate", *_FEATURES)}
    data = groups.agg(n_ticks=("tick", "count"), **means).to_xarray()
    data = data.reindex(bound=range(1, len(duration) + 1), robot=list(robots))

    if workspace is None:
        features = _FEATURES
        z = data[[*_FEATURES]].to_dataarray("feature")
        z = z.fillna(z.mean("bound")).fillna(0.0)
    else:
        features = workspace.features
        z = np.full((*data["n_ticks"].shape, len(features)), np.nan)

    return Mission.from_arrays(
        path, z, data["contact_rate"], duration, status,
        n_ticks=data["n_ticks"], features=features, robots=robots,
    )  # fmt: skip
