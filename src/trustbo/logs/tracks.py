"""Conversion of poses and detections to missions in which all robots watch one lead."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_cells, require_choice, require_positive, warn
from trustbo.logs.columns import Columns, require_one_spelling, seconds_of
from trustbo.workspace import Workspace

_FEATURES = ("near", "ahead")
_GAP = 5.0
"""Longest gap between two poses that is interpolated, s."""
_STANDING = 1e-3
"""Speed up to which a robot stands, so that its course is not known, m/s."""
_FAST = 30.0
"""Usual speed of a robot that is warned of, m/s."""
_FASTEST = 100.0
"""Highest speed that is read, m/s."""
_OUTSIDE = 0.05
"""Share of a robot's detections that may lie outside the time of the poses without a warning."""
_OFTEN = 0.03
"""Share of intervals between detections that may be shorter than those of the detector."""
_MANY = 4
"""Number of detections that may have another cause, such as a tree or a repeated message."""
_SHORT = 10.0
"""Length of a log whose unit of time is doubted, s."""
_LEAST_EXTENT = 0.1
"""Extent of all poses below which their unit is doubted, m."""
_AHEAD = np.pi / 6.0
"""Largest angle between the heading of a robot and a lead ahead of it, rad."""
_UNITS = "t in seconds (days * 86400, minutes * 60, milliseconds / 1000) and x, y in metres"


def read_tracks(
    poses: Any,
    detections: Any,
    workspace: Workspace | None = None,
    *,
    path: Sequence[Cell] | None = None,
    lead: str | None = None,
    window: float = 20.0,
    tick: float = 1.0,
) -> list[Mission]:
    """Read a log of poses and detections as missions, one for each lead, which all robots watch.

    The contact rate of a robot in a bound is the fraction of ticks in which it detected the lead,
    counting only the `n_ticks` ticks in which both poses are known. Poses are interpolated if they
    are at most 5 s apart.

    With a workspace, the result is one mission for `Campaign.tell`, with the robots and features of
    the workspace and without measured awareness. A bound begins where the lead enters the next cell
    of its path. If the planned path is given, a cell is not a bound if the lead only cuts its
    corner. If the lead does not reach the last cell, the status is `"aborted"`. The last bound ends
    where the lead leaves its cell for more than 5 s.

    Without a workspace, bounds are time windows. The lead is also listed as a robot, so that all
    missions have the same robots, with contact rates NaN and features 0. A bound without any tick
    with known poses is not measured; its features are the means over the robot's other bounds.
    Features are averaged over a bound: `near` is r / (r + range) with the median range r of the
    log, and `ahead` is whether the lead is within 30 degrees of the heading.

    Args:
        poses: Path of a CSV file, a DataFrame, or a mapping of columns: t (s), robot, x, y (m) and,
            if known, heading (rad from east, anticlockwise); by default, the heading is the
            direction of motion.
        detections: Another such table with the columns t (on the same clock), watcher and seen.
            Detections of objects without poses are ignored. A table without rows means that no
            robot detected another.
        workspace: Map of the cells that the lead enters.
        path: Planned path, such as `campaign.ask().path`; it needs a workspace.
        lead: Name of the lead. By default the robot that is not in the workspace's team; without a
            workspace, every robot is used as the lead in turn.
        window: Length of a bound without a workspace, s.
        tick: Length of a tick, s.

    Returns:
        One mission for each lead that has a complete bound.

    Raises:
        TrustboError: Values, times, poses or units are invalid, no detection is between two robots
            with poses, the lead is unknown, it misses a cell of the given path, or the log has no
            complete bound.

    Warns:
        UserWarning: A watcher is unknown, detections lie outside the time of the poses, their
            interval is not the tick, a robot is never seen or never watches, or the lead leaves the
            planned path.
    """
    tick = require_positive("tick", tick)
    window = require_positive("window", window)
    if path is not None and workspace is None:
        raise TrustboError("path= needs the workspace of its cells.")

    tracks, looks, unknown = _read(poses, detections)
    robots = tuple(tracks["robot"].unique())
    team = robots if workspace is None else workspace.team.names
    leads = _leads(lead, robots, workspace)

    t = tracks["t"].to_numpy()
    n = int(np.ptp(t) / tick + 1e-9)
    if n < 1:
        raise TrustboError(f"the log of {np.ptp(t):.3g} s is shorter than a tick; give {_UNITS}.")
    times = t.min() + (np.arange(n) + 0.5) * tick
    places = pd.concat([_at(_track(tracks, name), times) for name in robots])
    looks["tick"] = np.floor((looks["t"] - t.min()) / tick + 1e-9)
    pairs = _pairs(places, looks)

    missions = []
    for name in leads:
        cells = None
        edges = np.arange(0, n + 1, max(round(window / tick), 1))
        of_name = places.loc[places["robot"] == name]
        if workspace is not None and len(of_name):
            cells, edges = _crossings(of_name, n, tick, workspace, path)
        of_lead = pairs.loc[pairs["lead"] == name]
        if len(edges) > 1 and len(of_lead):
            missions.append(_mission(of_lead, edges, tick, cells, team, workspace))

    if not missions:
        usual = tracks.sort_values("t").groupby("robot")["t"].diff().median()
        raise TrustboError(
            f"the log of {n * tick:g} s has no complete bound in which the poses of two robots are "
            f"at most {_GAP:g} s apart; they are usually {usual:.3g} s apart. Give {_UNITS}, or a "
            "shorter window."
        )

    _warn_of_names(looks, unknown, leads, team)

    _warn_of_detections(tracks, looks, tick)
    return missions


def _leads(lead: str | None, robots: Sequence[str], workspace: Workspace | None) -> Sequence[str]:
    """Return the leads of a log: the given one, the robot that is not in the team, or all."""
    team = () if workspace is None else workspace.team.names
    for name in team:
        require_choice("robot of the team", name, robots)
    if lead is not None:
        return [require_choice("lead", lead, robots)]
    others = [name for name in robots if name not in team]
    if workspace is not None and len(others) != 1:
        raise TrustboError(f"a log with a map has one lead; pass lead=, one of {others or robots}.")
    return others


def _read(poses: Any, detections: Any) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Read poses (t, robot, x, y, heading), and detections (t, robot, lead).

    Returns the poses, the detections between two robots with poses, and all other detections.
    """
    where = Columns(poses, "the table of poses")
    seen = Columns(detections, "the table of detections", may_be_empty=True)
    t, seen_at = seconds_of(where, seen)
    tracks = pd.DataFrame({"t": t, "robot": where.texts("robot", blank=False)})
    tracks["x"] = where.numbers("x", blank=False)
    tracks["y"] = where.numbers("y", blank=False)
    tracks["heading"] = where.numbers("heading", required=False)
    looks = pd.DataFrame({"t": seen_at, "robot": seen.texts("watcher"), "lead": seen.texts("seen")})

    robots = tracks["robot"].unique().tolist()
    require_one_spelling("names of robots", [*robots, *looks["robot"], *looks["lead"]])
    if np.ptp(tracks[["x", "y"]], axis=0).max() < _LEAST_EXTENT:
        raise TrustboError("all poses lie within 0.1 m; x and y are in metres, not degrees or km.")

    known = looks["robot"].isin(robots) & looks["lead"].isin(robots)
    between = looks.loc[known & (looks["robot"] != looks["lead"])].drop_duplicates()
    if between.empty and len(looks):
        raise TrustboError(
            f"no detection (watcher, seen) is between two of the robots {', '.join(robots)}, which "
            f"have poses; watchers are {_listed(looks['robot'])}, and seen are "
            f"{_listed(looks['lead'])}. If no robot was detected, give a table without rows."
        )
    return tracks, between, looks.loc[~known]


def _listed(names: Iterable[str]) -> str:
    """Return different names as text, at most ten of them."""
    different = [name or "blank" for name in dict.fromkeys(names)]
    return ", ".join([*different[:10], "..."] if len(different) > 10 else different)


def _warn_of_names(
    looks: pd.DataFrame, unknown: pd.DataFrame, leads: Sequence[str], team: Sequence[str]
) -> None:
    """Warn of detections that are ignored because of their names, and of robots without any.

    Args:
        looks: Detections between two robots with poses.
        unknown: All other detections.
        leads: Robots that are watched.
        team: Robots that watch.
    """
    robots = {*team, *leads, *looks["robot"], *looks["lead"]}
    if strangers := [name for name in unknown["robot"].unique() if name not in robots]:
        warn(
            f"detections by {_listed(strangers)} are ignored, because the table of poses lacks "
            "these robots; if a robot was renamed, use one name in both tables."
        )

    # What is only seen may be a tree, unless it is seen where the lead is no longer seen.
    of_lead = looks.loc[looks["lead"].isin(leads), "t"]
    apart = unknown.loc[(unknown["t"] > of_lead.max()) | (unknown["t"] < of_lead.min())]
    n_apart = apart["lead"].value_counts()
    n_all = unknown["lead"].value_counts()
    if replacing := [name for name, n in n_apart.items() if n_all[name] == n > _MANY]:
        warn(
            f"{_listed(map(str, replacing))} is seen only before or after all detections of the "
            f"lead {_listed(leads)}, and has no poses; if the lead was renamed, use one name."
        )

    named = pd.unique(looks[["robot", "lead"]].to_numpy().ravel())
    if others := [name for name in named if name not in (*team, *leads)]:
        warn(
            f"detections by and of {_listed(others)} are ignored, because they are neither the "
            f"lead nor in the team ({', '.join(team)}); if a robot was renamed, use one name."
        )
    if silent := [name for name in dict.fromkeys([*team, *leads]) if name not in named]:
        warn(f"no detection names {', '.join(silent)}; their contact is 0.")


def _warn_of_detections(tracks: pd.DataFrame, looks: pd.DataFrame, tick: float) -> None:
    """Warn of detections outside the time of poses, and of a tick that is not their interval."""
    spans = tracks.groupby("robot")["t"].agg(["min", "max"])
    of_watcher = spans.loc[looks["robot"]].to_numpy()
    of_lead = spans.loc[looks["lead"]].to_numpy()
    t = looks["t"].to_numpy()
    begin = np.maximum(of_watcher[:, 0], of_lead[:, 0])
    end = np.minimum(of_watcher[:, 1], of_lead[:, 1])
    outside = np.maximum(begin - t, t - end)

    watchers = looks["robot"].to_numpy()
    shares = {name: (outside[watchers == name] > tick).mean() for name in looks["robot"].unique()}
    if late := [name for name, share in shares.items() if share > _OUTSIDE]:
        warn(
            f"up to {max(shares.values()):.0%} of the detections by {_listed(late)} lie outside "
            f"the time of the poses of the two robots, by up to {outside.max():.3g} s, and are "
            "ignored; check that both tables have the same clock."
        )

    gaps = looks.sort_values("t").groupby(["robot", "lead"])["t"].diff().dropna().to_numpy()
    short = gaps[gaps < 0.5 * tick]
    apart = float(np.quantile(gaps, _OFTEN)) if gaps.size else np.nan
    if apart > 1.5 * tick:
        warn(
            f"detections of one robot by another are at least {apart:g} s apart, but every tick of "
            f"{tick:g} s without a detection counts as lost contact; pass tick={apart:g}."
        )
    elif len(short) > max(_OFTEN * len(gaps), _MANY):
        apart = float(np.quantile(short, 0.05))
        warn(
            f"detections of one robot by another are only {apart:.3g} s apart, but one detection "
            f"counts as contact in a whole tick of {tick:g} s; pass the interval between two "
            f"readings of the detector, such as tick={apart:.3g}."
        )


def _track(tracks: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the poses of one robot, sorted by time, with its heading, unwrapped."""
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

    if np.isnan(heading).all():
        heading = pd.Series(np.where(moves, course, np.nan)).ffill().bfill().to_numpy()
    if np.isnan(heading).any():
        raise TrustboError(
            f"headings of robot {name!r} are blank in some poses, or in all although it moves at "
            "less than 1 mm/s; give all headings, times in seconds and positions in metres."
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
        raise TrustboError(f"robot {name!r} usually moves at {usual:.3g} m/s; give {_UNITS}.")
    if usual > _FAST:
        warn(f"robot {name!r} usually moves at {usual:.3g} m/s; the tables must have {_UNITS}.")

    if speed.max() > _FASTEST:
        raise TrustboError(
            f"robot {name!r} moves at {speed.max():.3g} m/s at t = {t[speed.argmax()]:.9g} s; "
            "leave out poses without a fix, such as (0, 0), and give x and y in metres."
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


def _at(track: pd.DataFrame, times: np.ndarray) -> pd.DataFrame:
    """Interpolate the poses of a robot; ticks at which they are unknown are left out."""
    t = track["t"].to_numpy()
    gap = np.diff(t)[np.clip(np.searchsorted(t, times), 1, len(t) - 1) - 1]
    known = (times >= t[0]) & (times <= t[-1]) & (gap <= _GAP)
    poses = {name: np.interp(times, t, track[name]) for name in ("x", "y", "heading")}

    frame = pd.DataFrame(poses).assign(tick=range(len(times)), robot=track["robot"].iloc[0])
    return frame.loc[known]


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
    path: Sequence[Cell] | None,
    robots: Sequence[str],
    workspace: Workspace | None,
) -> Mission:
    """Make a mission of one lead; `edges` has the first tick of each bound, then the end."""
    bound = np.searchsorted(edges, pairs["tick"], side="right")
    groups = pairs.assign(bound=bound).groupby(["bound", "robot"])
    means = {name: (name, "mean") for name in ("contact_rate", *_FEATURES)}
    data = groups.agg(n_ticks=("tick", "count"), **means).to_xarray()
    data = data.reindex(bound=range(1, len(edges)), robot=list(robots))

    if workspace is None:
        features = _FEATURES
        z = data[[*_FEATURES]].to_dataarray("feature")
        z = z.fillna(z.mean("bound")).fillna(0.0)
    else:
        features = workspace.features
        z = np.full((*data["n_ticks"].shape, len(features)), np.nan)

    status = "ok" if path is None or len(edges) == len(path) else "aborted"
    return Mission.from_arrays(
        path, z, data["contact_rate"], np.diff(edges) * tick, status,
        n_ticks=data["n_ticks"], features=features, robots=robots,
    )  # fmt: skip


def _crossings(
    places: pd.DataFrame,
    n: int,
    tick: float,
    workspace: Workspace,
    planned: Sequence[Cell] | None,
) -> tuple[Sequence[Cell], np.ndarray]:
    """Return the path of the lead, by default all cells that it enters, and edges of its bounds."""
    visits: list[tuple[int, Cell | None]] = []
    for k, x, y in zip(places["tick"], places["x"], places["y"], strict=True):
        cell = None
        with suppress(TrustboError):  # off the grid
            cell = workspace.grid.locate({"x": x, "y": y})
        visits.append((k, cell))

    entered = [(k, cell) for k, cell in visits if cell is not None]
    if not entered:
        x, y = places[["x", "y"]].median()
        raise TrustboError(
            f"the lead is never on the grid: its poses are around ({x:.8g}, {y:.8g}). Give x and y "
            f"in {workspace.grid.crs_name}, in which the lower left is {workspace.grid.corner}."
        )

    driven = [cell for cell, _ in groupby(cell for _, cell in entered)]
    path = require_cells("path", driven if planned is None else planned)
    if planned is not None and len(path) < 2:
        raise TrustboError(f"path must have at least two cells; got {list(path)}.")

    edges: list[int] = []
    for k, cell in entered:
        if len(edges) < len(path) and cell == path[len(edges)]:
            edges.append(k)

    short = f" The log lasts {n * tick:g} s; give {_UNITS}." if n * tick < _SHORT else ""
    _require_route(path, edges, entered, short)

    end = _end_of_visit(visits, edges[-1], path[len(edges) - 1], _GAP / tick, n)
    if len(edges) < len(path) and end < n:
        warn(
            f"the lead leaves cell {path[len(edges) - 1]} {end * tick:g} s after the start of the "
            f"log and never enters the next cell of the path, {path[len(edges)]}; the mission is "
            "read as aborted there."
        )
    return path, np.array([*edges[1:], end])


def _require_route(
    path: Sequence[Cell], edges: Sequence[int], entered: Sequence[tuple[int, Cell]], hint: str
) -> None:
    """Raise TrustboError if the lead misses a cell of the path, or has no complete bound.

    Args:
        path: Planned or driven cells.
        edges: First tick in each cell of the path that is reached in order.
        entered: Tick and cell of each pose of the lead on the grid.
        hint: End of the message.
    """
    n = len(edges)
    if n == len(path) > 1:
        return

    first = entered[0][1]
    last = entered[-1][1]
    if n == len(path):
        raise TrustboError(
            f"the lead stays in cell {path[0]} of the path, so there is no complete bound; use "
            f"`Campaign.fail` if no bound was run.{hint}"
        )

    since = edges[-1] if edges else 0
    later = [cell for k, cell in entered if k > since and cell in {*path[n + 1 :]} - {*path[:n]}]
    if later:
        raise TrustboError(
            f"the lead never enters cell {path[n]}, number {n} of the path (0 is the start), but "
            f"enters {later[0]}, which is further along. Pass the path that was driven, or leave "
            f"path= out to take it from the poses.{hint}"
        )

    if n < 2:
        raise TrustboError(
            f"the lead never enters cell {path[n]}, number {n} of the path (0 is the start), so "
            f"there is no complete bound; the log begins in cell {first} and ends in {last}. Pass "
            f"the path of this mission, or use `Campaign.fail` if no bound was run.{hint}"
        )


def _end_of_visit(
    visits: Sequence[tuple[int, Cell | None]], begin: int, cell: Cell, most: float, n: int
) -> int:
    """Return the tick in which the lead leaves a cell for more than `most` ticks, or else `n`."""
    left = None  # tick at which the lead left the cell, until it returns
    for k, at in visits:
        if k < begin or at == cell:
            left = None
        elif left is None:
            left = k
        if left is not None and k - left > most:
            return left
    return n
