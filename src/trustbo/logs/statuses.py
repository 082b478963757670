"""Bounds in a bag: their statuses and contact messages, and doubts about both."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, warn
from trustbo.logs.detections import share_before_missing

_LATE = 1_000_000_000
"""Time after a marker in which the status of the bound before may arrive, ns."""
_SMALL = 0.1
"""Share of the contact messages of a bound that is small."""
_MANY_MISSING = 0.1
"""Share of messages after which others are missing from which it is warned of."""
_ABORTED = "aborted"
"""Status that a mission may also have after the status of its last bound."""


def ends_of(bounds: pd.DataFrame, statuses: pd.Series, ticks: pd.DataFrame) -> pd.DataFrame:
    """Return the statuses of bounds in order: row of the bound, end of the bound (ns), and status.

    A status that arrives shortly after the next marker belongs to the bound before, which ended at
    this marker, if that bound has no other status. A failure can also be that of the bound that has
    just begun, if a robot has already sent its contact twice since the marker.

    Args:
        bounds: Markers in order: time `begin` (ns), `bound` (0 is a start) and number of `mission`.
        statuses: Statuses, indexed and sorted by time, ns.
        ticks: Contact of each `robot`, indexed and sorted by time, ns.

    Raises:
        TrustboError: A bound has different statuses.
    """
    begins = bounds["begin"].to_numpy()
    numbers = bounds["bound"].to_numpy()
    rows = (np.searchsorted(begins, statuses.index.to_numpy()) - 1).tolist()
    ends: list[tuple[int, int, str]] = []
    ended = set()

    for row, time, status in zip(rows, statuses.index, statuses, strict=True):
        if row < 0:
            continue  # before the first mission

        # The start of a mission, bound 0, has no status.
        previous = row - 1 if numbers[row - 1] > 0 else row - 2
        marker = int(begins[previous + 1])

        heard = ticks.loc[marker + 1 : time, "robot"]
        may_be_late = time - marker <= _LATE and (status == "ok" or not heard.duplicated().any())
        if may_be_late and previous >= 0 and previous not in ended:
            ends.append((previous, marker, status))
            ended.add(previous)
        elif numbers[row] > 0:
            ends.append((row, time, status))
            ended.add(row)

    table = pd.DataFrame(ends, columns=["row", "end", "status"])
    _require_one_status(bounds, table)
    return table


def _require_one_status(bounds: pd.DataFrame, ends: pd.DataFrame) -> None:
    """Raise TrustboError if a bound has different statuses, of which one may be its own."""
    for row, statuses in ends.loc[ends["status"] != _ABORTED].groupby("row")["status"]:
        if statuses.nunique() > 1:
            bound = bounds.loc[row]
            raise TrustboError(
                f"bound {bound['bound']} of mission {bound['mission']} has the statuses "
                f"{', '.join(statuses.unique())}; leave out all but the one at its end."
            )


def in_bounds(ticks: pd.DataFrame, bounds: pd.DataFrame, ends: pd.DataFrame) -> pd.DataFrame:
    """Return the ticks after the marker of a bound and up to its end, with the `row` of the bound.

    Args:
        ticks: Contact of each `robot`, indexed and sorted by time, ns.
        bounds: Markers in order, as for `ends_of`, with the time `until` the next one, ns.
        ends: Statuses of the bounds; a bound without a status lasts until the next marker.
    """
    until = bounds["until"].to_numpy(copy=True)
    first = ends.drop_duplicates("row")
    until[first["row"].astype(int)] = first["end"]

    times = ticks.index.to_numpy()
    row = np.searchsorted(bounds["begin"].to_numpy(), times) - 1
    is_in_bound = (row >= 0) & (bounds["bound"].to_numpy()[row] > 0) & (times <= until[row])
    return ticks.assign(row=row).loc[is_in_bound]


def warn_of_robots(ticks: pd.DataFrame, robots: Sequence[str]) -> None:
    """Warn of robots without messages in bounds, and of robots that send only during contact.

    Args:
        ticks: Contact of each `robot` in bounds, as from `in_bounds`.
        robots: Robots with messages.
    """
    present = set(ticks["robot"])
    if outside := [robot for robot in robots if robot not in present]:
        warn(
            f"all contact messages of {', '.join(outside)} lie outside the bounds, so the contact "
            "is unknown; check the clocks of these robots."
        )

    timed = ticks.assign(time=ticks.index)
    timed["gap"] = timed.groupby(["robot", "row"])["time"].diff().to_numpy()
    for robot, of_robot in timed.groupby("robot"):
        always = np.all(of_robot["contact"].to_numpy())
        if always and share_before_missing(of_robot["gap"].to_numpy()) > _MANY_MISSING:
            warn(
                f"all contact messages of {robot} say that there is contact, and often some are "
                "missing; if they are sent only during contact, also send those without contact. "
                "Otherwise, the contact rate is 1."
            )


def warn_of_ends(bounds: pd.DataFrame, ends: pd.DataFrame, looks: pd.Index) -> None:
    """Warn of bounds that end although contact messages continue, or without contact messages.

    Args:
        bounds: Markers in order, as for `ends_of`, with the time `until` the next one, ns.
        ends: Statuses of the bounds.
        looks: Times of all contact messages in order, also of those that are not measured, ns.
    """
    cut_off, silent = [], []
    for mission, of_mission in bounds.groupby("mission"):
        last = of_mission.index[-1]

        for row, bound in of_mission.iloc[1:].iterrows():
            own = ends.loc[ends["row"] == row]
            end = own["end"].min() if len(own) else bound["until"]
            repeated = own.loc[own["status"] != _ABORTED, "end"].max()
            marks = [bound["begin"], end, bound["until"]]
            before, after = np.diff(np.searchsorted(looks, marks, side="right"))
            between = ((looks > end) & (looks <= repeated)).sum()

            # Robots may go on sending their contact while they wait, or after the mission.
            is_early = row != last and before < _SMALL * (before + after)
            if is_early or between > _SMALL * before:
                cut_off.append(f"{bound['bound']} of mission {mission}")
            elif before == 0:
                silent.append(f"{bound['bound']} of mission {mission}")

    if cut_off:
        warn(
            f"the first status ends bounds although contact messages continue ({_some(cut_off)}); "
            "send the status of a bound once, at its end, and at most 1 s after the next marker."
        )
    if silent:
        warn(
            f"no contact message was sent in bounds ({_some(silent)}), so their contact is "
            "unknown; send it between the marker and the status of each bound."
        )


def _some(names: list[str]) -> str:
    """Return names of bounds as text, at most three of them."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"bound {', '.join(names[:3])}{more}"
