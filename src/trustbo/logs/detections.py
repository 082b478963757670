"""Tables of poses and of detections between robots, with warnings about ignored rows."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, warn
from trustbo.logs.columns import Columns, require_one_spelling, seconds_of
from trustbo.logs.mapping import ColumnMap, require_columns
from trustbo.logs.poses import GAP
from trustbo.logs.positions import with_metres
from trustbo.workspace.grid import Grid

_OUTSIDE = 0.05
"""Share of a robot's detections that may be at times without poses without a warning."""
_OFTEN = 0.03
"""Share of intervals between detections that may be shorter than those of the detector."""
_LONGER = 1.04
"""Interval between readings, in ticks, from which ticks without a reading are warned of."""
_SHORTER = 0.92
"""Interval between readings, in ticks, below which ticks with two readings are warned of."""
_NEXT = 1.5
"""Time between two detections, in intervals of the detector, up to which none lies between them."""
_REGULAR = 0.9
"""Least time between nearly all detections of a regular detector, in its intervals."""
_LEAST_SINGLE = 0.2
"""Least share of the times between detections that are one interval of the detector."""
_POSES = ("t", "robot", "x", "y", "lon", "lat", "heading")
"""Columns of a table of poses, as far as it has them."""
_READ = ("t", "watcher", "seen")
"""Columns of a table of detections."""
_DETECTED = "detected"
"""Column of a mapping that says whether a row is a detection."""
_YES = ("true", "1", "yes")
_NO = ("false", "0", "no")
_MANY = 4
"""Number of detections that may have another cause, such as a tree or a repeated message."""
_NEARBY = 21
"""Number of successive detections from which the phase of a detector is estimated."""
_LEAST_REGULAR = 0.2
"""Mean resultant length of phases below which the phase of nearby detections is unknown."""
_JUST_BEFORE = 0.02
"""Time before the start of a tick, in ticks, at which a reading still counts as at its start."""
_OFTEN_SEEN = 20
"""Number of detections from which the end of all detections is unusual."""
_SILENCE = 60.0
"""Time without any detection before the end of a log that is unusual, s."""
_UNUSUAL = 5.0
"""Such a time as a multiple of the longest time between two detections."""
_LEAST_EXTENT = 0.1
"""Extent of all poses below which their unit is doubted, m."""


def read_tables(
    poses: Any, detections: Any, columns: ColumnMap | None = None, grid: Grid | None = None
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Read poses (t, robot, x, y, heading), and detections (t, robot, lead).

    With a grid, poses may have lon and lat in degrees instead of x and y.

    Returns the poses, the detections between two robots with poses, and all other detections.
    """
    given = None if columns is None else require_columns(columns)
    of_poses, of_seen = (
        None if given is None else {name: given[name] for name in names if name in given}
        for names in (_POSES, (*_READ, _DETECTED))
    )
    where = Columns(poses, "the table of poses", columns=of_poses)
    seen = Columns(detections, "the table of detections", columns=of_seen, may_be_empty=True)
    if of_seen is not None and _DETECTED in of_seen:
        _drop_misses(seen)
    _require_detections(seen)
    with_metres(where, grid)
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


def _drop_misses(table: Columns) -> None:
    """Keep the rows in which a column says that the robot was detected, without this column."""
    texts = np.array([text.lower() for text in table.texts(_DETECTED, blank=False)], dtype=str)
    table.refuse(_DETECTED, ~np.isin(texts, (*_YES, *_NO)), "is neither true nor false")
    table.frame = table.frame.loc[np.isin(texts, _YES)].drop(columns=[_DETECTED])


def _require_detections(table: Columns) -> None:
    """Raise TrustboError for a further column, which may mark rows that are no detections.

    Numbers of rows, such as the index of an xarray Dataset, are accepted.
    """
    read = [table.find(name) for name in _READ]
    others = [name for name in table.frame if name not in read]
    further = [
        name for name in others if not _numbers_rows(pd.Series(table.frame[name]))
    ] + table.unread
    if further:
        raise TrustboError(
            f"{table.what} also has {_listed(further)}, but every row counts as a detection; keep "
            f"only rows in which the robot was detected, and the columns {', '.join(_READ)}."
        )


def _numbers_rows(column: pd.Series) -> bool:
    """Return whether a column has increasing whole numbers."""
    numbers = pd.Series(pd.to_numeric(column, errors="coerce")).astype(float)
    is_whole = bool((np.floor(numbers) == numbers).all())
    return is_whole and numbers.is_monotonic_increasing and numbers.is_unique


def ticks_of(looks: pd.DataFrame, start: float, tick: float) -> np.ndarray:
    """Return the tick of each detection, shape (detection,).

    Readings at intervals of a tick may all lie close to the edges of ticks that begin at `start`.
    Small errors of their times would then leave some ticks without a reading and others with two.
    The edges are therefore placed half a tick away from the usual phase of each pair's readings.
    """
    ordered = looks.assign(at=(looks["t"] - start) / tick).sort_values("t")
    pairs = ordered.groupby(["robot", "lead"])["at"]
    return pairs.transform(_ticks_of_pair).reindex(looks.index).to_numpy()


def _ticks_of_pair(at: pd.Series) -> np.ndarray:
    """Return the ticks of one pair's detections, whose sorted times are in ticks since the start.

    A detection at time k + phase belongs to tick k. The phase is the circular mean over nearby
    detections, because clocks drift, or over all detections if those nearby are irregular.
    """
    turn = np.exp(2j * np.pi * at.to_numpy())
    of_all = turn.mean()
    nearby = _rolling_mean(np.real(turn)) + 1j * _rolling_mean(np.imag(turn))

    phase = (np.angle(of_all) / (2.0 * np.pi) + _JUST_BEFORE) % 1.0 - _JUST_BEFORE
    drift = np.angle(nearby * np.conj(of_all)) / (2.0 * np.pi)
    is_regular = np.abs(nearby) > _LEAST_REGULAR
    return np.rint(at.to_numpy() - phase - np.where(is_regular, drift, 0.0))


def _rolling_mean(values: np.ndarray) -> np.ndarray:
    """Return the means of `_NEARBY` successive values, or of fewer at the ends."""
    windows = pd.Series(values).rolling(_NEARBY, min_periods=1, center=True)
    return np.asarray(windows.mean())


def _listed(names: Iterable[str]) -> str:
    """Return distinct names as text, at most ten of them."""
    different = [name or "blank" for name in dict.fromkeys(names)]
    return ", ".join([*different[:10], "..."] if len(different) > 10 else different)


def warn_of_names(
    looks: pd.DataFrame,
    unknown: pd.DataFrame,
    leads: Sequence[str],
    team: Sequence[str],
    robots: Sequence[str],
) -> None:
    """Warn of detections that are ignored because of their names, and of robots without detections.

    Args:
        looks: Detections between two robots with poses.
        unknown: All other detections.
        leads: Robots that are watched.
        team: Robots that watch.
        robots: Robots with poses.
    """
    if strangers := [name for name in unknown["robot"].unique() if name not in robots]:
        warn(
            f"detections by {_listed(strangers)} are ignored, because the table of poses lacks "
            "these robots; if a robot was renamed, use one name in both tables."
        )

    # What is seen but has no poses may be a tree, unless it is seen only when the lead is not.
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
    present = [name for name in dict.fromkeys([*team, *leads]) if name in robots]
    if silent := [name for name in present if name not in named]:
        warn(f"no detection names {', '.join(silent)}; their contact is 0.")
    _warn_of_the_lead(looks, leads, team)


def _warn_of_the_lead(looks: pd.DataFrame, leads: Sequence[str], team: Sequence[str]) -> None:
    """Warn of detections by the only lead, and of robots that never detect it in return."""
    if len(leads) > 1:
        return

    watchers = looks.loc[looks["lead"].isin(leads), "robot"].unique()
    by_lead = looks.loc[looks["robot"].isin(leads) & looks["lead"].isin(team), "lead"]
    if by_lead.empty:
        return

    never = by_lead[~by_lead.isin(watchers)]
    of_never = f"{_listed(never)} never detects the lead, so the contact is 0; "
    warn(
        f"{of_never if len(never) else ''}{len(by_lead)} detections by the lead {_listed(leads)} "
        "are ignored. Exchange watcher and seen if they are swapped, or for detections by the lead "
        "while T2 closes up; leave out its other detections."
    )


def warn_of_times(tracks: pd.DataFrame, looks: pd.DataFrame, tick: float) -> None:
    """Warn of detections outside the time of poses, and of a tick that is not their spacing."""
    outside = _time_outside(tracks, looks)
    watchers = looks["robot"].to_numpy()
    shares = {name: (outside[watchers == name] > tick).mean() for name in looks["robot"].unique()}
    if late := [name for name, share in shares.items() if share > _OUTSIDE]:
        warn(
            f"up to {max(shares.values()):.0%} of the detections by {_listed(late)} lie outside "
            f"the time of the poses of the two robots, by up to {outside.max():.3g} s, and are "
            "ignored; check that both tables have the same clock."
        )

    _warn_of_intervals(looks, tick)


def warn_of_silence(tracks: pd.DataFrame, looks: pd.DataFrame, leads: Sequence[str]) -> None:
    """Warn of robots whose detections of the leads end long before their poses do."""
    of_lead = looks.loc[looks["lead"].isin(leads)].sort_values("t")
    ends = {str(name): np.max(t.to_numpy(float)) for name, t in tracks.groupby("robot")["t"]}
    lead_ends = max(ends[name] for name in leads)
    silent = {}
    for watcher, times in of_lead.groupby("robot")["t"]:
        name, t = str(watcher), times.to_numpy(float)
        silence = min(ends[name], lead_ends) - t[-1]
        longest = float(np.diff(t).max(initial=0.0))
        if len(t) >= _OFTEN_SEEN and silence > max(_SILENCE, _UNUSUAL * longest):
            silent[name] = silence

    if silent:
        warn(
            f"detections by {_listed(silent)} end {max(silent.values()):.0f} s before the poses, "
            "which counts as lost contact; if a detector failed, give the log of the poses until "
            "then, or leave out the poses of this robot afterwards."
        )


def warn_of_gaps(
    tracks: pd.DataFrame, looks: pd.DataFrame, pairs: pd.DataFrame, leads: Sequence[str]
) -> None:
    """Warn of detections of leads that are ignored because of long times between poses.

    Args:
        tracks: Poses.
        looks: Detections with their `tick`.
        pairs: Each `tick`, `robot` and `lead` with known poses.
        leads: Robots that are watched.
    """
    keys = ["tick", "robot", "lead"]
    is_known = looks.set_index(keys).index.isin(pairs.set_index(keys).index)
    has_tick = looks["tick"].between(0, pairs["tick"].max()).to_numpy()
    is_lost = has_tick & ~is_known & (_time_outside(tracks, looks) <= 0.0)

    of_lead = looks["lead"].isin(leads).to_numpy()
    watchers = looks["robot"].to_numpy()
    shares = {name: is_lost[of_lead & (watchers == name)] for name in np.unique(watchers[of_lead])}
    lost = {str(name): share.mean() for name, share in shares.items() if share.mean() > _OUTSIDE}
    if not lost:
        return

    ordered = tracks.sort_values("t")
    gaps = ordered.groupby("robot")["t"].diff().to_numpy()
    sparse = ordered.loc[gaps > GAP, "robot"].unique()
    warn(
        f"up to {max(lost.values()):.0%} of the detections by {_listed(lost)} are ignored, because "
        f"poses of {_listed(sparse)} are up to {np.nanmax(gaps):.3g} s "
        f"apart and are interpolated only over at most {GAP:g} s; add interpolated poses."
    )


def _time_outside(tracks: pd.DataFrame, looks: pd.DataFrame) -> np.ndarray:
    """Return the time by which detections lie outside the poses of both robots, s; negative inside.

    The shape is (detection,).
    """
    spans = tracks.groupby("robot")["t"].agg(["min", "max"])
    of_watcher = spans.loc[looks["robot"]].to_numpy()
    of_lead = spans.loc[looks["lead"]].to_numpy()
    t = looks["t"].to_numpy()
    begin = np.maximum(of_watcher[:, 0], of_lead[:, 0])
    end = np.minimum(of_watcher[:, 1], of_lead[:, 1])
    return np.maximum(begin - t, t - end)


def _warn_of_intervals(looks: pd.DataFrame, tick: float) -> None:
    """Warn of readings that are further apart than a tick, or closer together."""
    ordered = looks.sort_values("t")
    gaps = ordered.groupby(["robot", "lead"])["t"].diff().to_numpy()
    watchers = ordered["robot"].to_numpy()
    slow: dict[str, float] = {}
    fast: dict[str, float] = {}
    for name in np.unique(watchers):
        of_watcher = gaps[watchers == name]
        apart = _interval_of(of_watcher)
        if apart > _LONGER * tick:
            slow[str(name)] = apart

        # If every reading is a detection, the second one in a tick changes nothing.
        misses = share_before_missing(of_watcher) > _OFTEN
        if apart < _SHORTER * tick and misses and _is_regular(of_watcher, apart):
            fast[str(name)] = apart

    all_gaps = gaps[~np.isnan(gaps)]
    short = all_gaps[all_gaps < 0.5 * tick]
    least = float(np.quantile(all_gaps, _OFTEN)) if all_gaps.size else np.nan
    if slow or least > 1.5 * tick:
        apart = max(slow.values(), default=least)
        by = f"by {_listed(slow)} " if slow else "of one robot by another "
        warn(
            f"detections {by}are {apart:.4g} s or more apart, but every tick of {tick:g} s without "
            f"a detection counts as lost contact; pass tick={apart:.4g}."
        )
    elif fast or len(short) > max(_OFTEN * len(all_gaps), _MANY):
        apart = min(fast.values()) if fast else float(np.quantile(short, 0.05))
        by = f"by {_listed(fast)} " if fast else "of one robot by another "
        warn(
            f"detections {by}are only {apart:.3g} s apart, but one detection "
            f"counts as contact in a whole tick of {tick:g} s; pass the interval between two "
            f"readings of the detector, such as tick={apart:.3g}, or if those of other robots are "
            "further apart, leave out some scans of the robot."
        )


def _is_regular(gaps: np.ndarray, apart: float) -> bool:
    """Return whether hardly any detections are much closer together than the interval `apart`."""
    return float(np.nanquantile(gaps, _OFTEN)) > _REGULAR * apart


def share_before_missing(gaps: np.ndarray) -> float:
    """Return the share of times between readings in which others are missing; 0 if unknown."""
    return float((gaps > _NEXT * _interval_of(gaps)).mean())


def _interval_of(gaps: np.ndarray) -> float:
    """Return the interval between readings of a detector; NaN if it is unknown.

    Times between detections are multiples of the interval, because some readings detect nothing.
    """
    known = gaps[~np.isnan(gaps)]
    if not known.size:
        return np.nan

    single = known[known < _NEXT * np.quantile(known, _OFTEN)]
    is_known = len(single) > max(_MANY, _LEAST_SINGLE * len(known))
    if not is_known:
        return np.nan

    # If readings are irregular, the shortest times are those of few readings.
    return float(np.median(known[known < _NEXT * np.median(single)]))
