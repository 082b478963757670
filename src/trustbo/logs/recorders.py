"""Messages that several recorders received, or that one recorder received more than once.

A recorder that starts during a mission receives the last message of a latched topic again, and so
does each part of a bag with `rosbag record --repeat-latched`. Messages in a bag have the time at
which they were received, so the same message may have different times in two bags.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, one_line

_NANOSECONDS = 1e9
"""Nanoseconds per second."""
_LATE = 1.0
"""Largest difference of the times at which two recorders receive a message, s."""
_GAP = 5.0
"""Time without messages after which a recorder is taken to have missed some, s."""
_SOME = 0.1
"""Share of messages at the same time that must differ, so that two runs are told apart."""
_REMEDY = (
    "If a simulated clock started again, record a bag for each run, and read the bags one by one."
)


def joined(names: Sequence[str], parts: Sequence[pd.DataFrame], markers: str) -> pd.DataFrame:
    """Return the messages of bags, in which a message that several of them contain counts once.

    Of two bags with the same topic, the messages of the one that begins first are used. Those of
    the other are added before the first and after the last of them, and in gaps of 5 s.

    Args:
        names: Names of the bags.
        parts: Messages of each bag, with the columns time (ns), topic and data, sorted by time.
        markers: Topic of the bounds.

    Raises:
        TrustboError: If bags contain the same bounds at times that differ by more than 1 s, or
            different messages at the same time.
    """
    bags = [(name, part) for name, part in zip(names, parts, strict=True) if len(part)]
    if not bags:
        return pd.DataFrame(columns=["time", "topic", "data"])
    bags.sort(key=lambda bag: bag[1]["time"].iloc[0])

    first, kept = bags[0]
    for name, part in bags[1:]:
        for topic, messages in part.groupby("topic"):
            known = kept.loc[kept["topic"] == topic]
            _require_same_run(first, name, known, messages)
            if topic == markers:
                _require_same_clock(first, name, known, messages)
        added = part.loc[_is_new(kept, part)]
        kept = pd.concat([kept, added]).sort_values("time", kind="stable")
    return kept


def _is_new(kept: pd.DataFrame, part: pd.DataFrame) -> np.ndarray:
    """Return whether each message of a bag is not among those of other bags; see `joined`."""
    away = np.full(len(part), np.inf)  # from the nearest message on the same topic, ns
    is_within = np.zeros(len(part), dtype=bool)  # between two messages on the same topic
    for topic, known in kept.groupby("topic"):
        times = known["time"].to_numpy()
        of_topic = (part["topic"] == topic).to_numpy()
        own = part["time"].to_numpy()[of_topic]
        away[of_topic] = _distance(times, own)
        is_within[of_topic] = (own >= times[0]) & (own <= times[-1])

    # The last messages of the other bags may have been received after their end.
    delay = np.median(away[is_within]) if is_within.any() else 0.0
    is_outside = ~is_within & (away > 1.5 * delay)
    return is_outside | (away > _GAP * _NANOSECONDS)


def _distance(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distance of each of the other times from the nearest of the sorted times, ns."""
    after = np.searchsorted(times, others)
    next_one = times[np.minimum(after, len(times) - 1)]
    last_one = times[np.maximum(after - 1, 0)]
    return np.minimum(np.abs(next_one - others), np.abs(others - last_one))


def _require_same_run(first: str, name: str, kept: pd.DataFrame, part: pd.DataFrame) -> None:
    """Raise TrustboError if two bags have different messages of a topic at the same times."""
    both = part.merge(kept, on="time", suffixes=("", "_kept"))
    equal = (both["data"] == both["data_kept"]).groupby(both["time"]).any().to_numpy(dtype=bool)
    if len(equal) and np.mean(~equal) > _SOME:
        topic = part["topic"].iloc[0]
        raise TrustboError(
            f"{first!r} and {name!r} have different messages on {topic} at the same times, so they "
            f"are of two runs whose clocks overlap. {_REMEDY}"
        )


def _require_same_clock(first: str, name: str, kept: pd.DataFrame, part: pd.DataFrame) -> None:
    """Raise TrustboError if two bags contain the same bounds at different times.

    The first marker of a bag may have been sent long before the recorder started.
    """
    off = []
    unknown = []
    first_time = kept["time"].min()
    last_time = kept["time"].max()
    for time, data in part[["time", "data"]].iloc[1:].itertuples(index=False):
        times = kept.loc[kept["data"] == data, "time"].to_numpy()
        if len(times):
            differences = time - times
            off.append(differences[np.abs(differences).argmin()] / _NANOSECONDS)
        elif first_time <= time <= last_time:
            unknown.append(data)

    if len(unknown) > _SOME * len(part):
        raise TrustboError(
            f"{first!r} and {name!r} mark different bounds at the same time, such as "
            f"{one_line(unknown[0])}, so they are of two runs whose clocks overlap. {_REMEDY}"
        )
    usual = float(np.median(off)) if off else 0.0
    if abs(usual) > _LATE:
        raise TrustboError(
            f"the clocks of {first!r} and {name!r} differ by {abs(usual):.1f} s: the same bounds "
            "are marked at these times in both. Read one of them alone, or correct the times of "
            f"the other. {_REMEDY}"
        )


def without_repeats(bounds: pd.DataFrame) -> pd.DataFrame:
    """Return the markers of bounds, without those that repeat the bound that has begun.

    The planned path of a mission is that of the last marker of its start.

    Args:
        bounds: Markers in order: time `begin` (ns), `bound`, `cell` and `path`.
    """
    same = (bounds["bound"] == bounds["bound"].shift()) & (bounds["cell"] == bounds["cell"].shift())
    path = bounds.groupby((~same).cumsum())["path"].transform("last")
    return bounds.assign(path=path).loc[~same].reset_index(drop=True)


def without_repeated_statuses(
    statuses: pd.Series, markers: pd.DataFrame, bounds: pd.DataFrame
) -> pd.Series:
    """Return the statuses without those that were received again with the marker of a bound.

    If a topic of markers is latched, that of statuses is as well. A recorder that starts within a
    bound then receives the status of the bound before again, within 1 s of the marker.

    Args:
        statuses: Statuses, indexed and sorted by time, ns.
        markers: All markers in order, with the time `begin`, ns.
        bounds: The markers without repeats.
    """
    again = markers.loc[~markers["begin"].isin(bounds["begin"]), "begin"].to_numpy()
    row = np.searchsorted(bounds["begin"].to_numpy(), again, side="right")
    numbers, count = np.unique(row, return_counts=True)
    again = again[np.isin(row, numbers[count == 1])]  # many repeats are sent at a constant rate
    if not len(again):
        return statuses

    away = _distance(again, statuses.index.to_numpy())
    is_near = away <= _LATE * _NANOSECONDS
    is_same = statuses.to_numpy() == statuses.shift().to_numpy()
    return statuses.loc[~(is_near & is_same)]


def require_in_order(
    names: str, bounds: pd.DataFrame, markers: pd.DataFrame, ticks: pd.DataFrame
) -> None:
    """Raise TrustboError unless bounds are marked 0, 1, 2, ..., by one clock that never falls.

    Args:
        names: Names of the bags, for messages.
        bounds: Markers without repeats, with the number of the `mission`.
        markers: All markers in order.
        ticks: Contact of each `robot`, indexed and sorted by time.
    """
    numbers = bounds["bound"].to_numpy(dtype=int)
    shown = one_line(markers["bound"].tolist())
    steps = np.diff(numbers, prepend=-1)
    falls = (steps < 0) & (numbers > 0)
    if falls.any() or (len(markers) > len(bounds) and _differ_at_once(ticks)):
        raise TrustboError(
            f"the messages in {names} are not in the order of time, because a clock was set back "
            f"or the clocks of several recorders differ; the markers are {shown}. {_REMEDY}"
        )

    again = np.flatnonzero(steps == 0)
    if len(again):
        row = int(again[0])
        cells = bounds["cell"].tolist()[row - 1 : row + 1]
        raise TrustboError(
            f"bound {numbers[row]} in {names} is marked with different cells, {one_line(cells)}; "
            "send the marker of a bound when it begins, and number each bound once."
        )
    if bounds.empty or (bounds["bound"] != bounds.groupby("mission").cumcount()).any():
        raise TrustboError(
            f"the bounds in {names} must be marked 0, 1, 2, ... in order; the markers are {shown}. "
            "Record all markers, beginning with bound 0 in the start cell."
        )


def _differ_at_once(ticks: pd.DataFrame) -> bool:
    """Return whether robots often send different contact at one time, as after a clock's reset."""
    n_values = ticks.groupby([ticks.index, ticks["robot"]])["contact"].agg(["size", "nunique"])
    shared = n_values.loc[n_values["size"] > 1, "nunique"]
    return bool(len(shared)) and float((shared > 1).mean()) > _SOME
