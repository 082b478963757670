"""Missions in ROS bags (`.bag` files or ROS 2 folders), read with rosbags (extra `ros`).

    /mission/bound    std_msgs/String, JSON {"bound": k, "cell": [row, col]}, at the start of bound
                      k. Bound 0 is the start of a mission, in its start cell, and may have "path",
                      the planned cells, which the mission may leave.
    /mission/status   std_msgs/String, "ok", "stuck", ..., optional, at the end of a bound
    /{robot}/contact  std_msgs/Bool, or Float32 or Float64 in [0, 1], at each tick: whether the
                      robot detects the lead or, while T2 closes up, the lead detects the robot

A marker of the bound that has begun, which a latched topic repeats, is no new bound.
A bound lasts from its marker to its status or, without a status, to the last contact message
before the next marker. A status may arrive up to 1 s after the next marker if the bound has no
other status; the bound then ends at this marker. The contact rate of a bound is the fraction of a
robot's ticks with contact; NaN ticks are ignored. If the last bound is ok but does not reach the
end of the planned path, the mission is "aborted".
"""

import json
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trustbo.data import Cell, Mission, require_unit_interval
from trustbo.errors import TrustboError, require_pair, require_whole, warn
from trustbo.files import FilePath, to_path
from trustbo.logs.recorders import (
    joined,
    require_in_order,
    without_repeated_statuses,
    without_repeats,
)
from trustbo.logs.statuses import ends_of, in_bounds, warn_of_ends, warn_of_robots
from trustbo.logs.table import read_table
from trustbo.workspace import Workspace

_BOUND = "/mission/bound"
_STATUS = "/mission/status"
_NANOSECONDS = 1e9
"""Nanoseconds per second."""
_NEVER = np.iinfo(np.int64).max
"""Time after the last message, ns."""


def read_bag(
    path: FilePath | Sequence[FilePath],
    workspace: Workspace,
    *,
    contact: str = "/{robot}/contact",
    prefix: str = "",
) -> list[Mission]:
    """Read the missions of a ROS bag, without ticks, pauses or measured awareness.

    Args:
        path: A `.bag` file of ROS 1, or the folder of a bag of ROS 2; a list of them is read as one
            bag. They may be the parts of a bag that was split, or bags of several recorders, with
            the same or different topics, if their clocks differ by less than 1 s. A message that
            several bags contain counts once.
        workspace: Workspace whose robots are read, in the order of its team.
        contact: Topic with the contact of a robot; its name replaces `{robot}`.
        prefix: Namespace of the topics of bounds and statuses, such as `"/fleet"` for
            `/fleet/mission/bound`.

    Returns:
        Missions in the order of their markers. Awareness is NaN; campaigns take it from the map.

    Raises:
        TrustboError: rosbags is not installed, the path is not a complete bag, a topic is missing
            or of another type, markers are out of order, a clock was set back, clocks of recorders
            differ, a bound has different statuses, or `Mission` rejects the data.

    Warns:
        UserWarning: A status ends a bound although contact messages continue, no contact message
            was sent in a bound, or the topic of a robot is missing, has no message in any bound, or
            has messages only during contact.

    Example:
        >>> missions = tb.logs.read_bag("log.bag", workspace)
        >>> posterior = tb.fit(missions, workspace=workspace)
    """
    files = [path] if isinstance(path, str | PathLike) else path
    paths = [to_path(file) for file in files]
    space = f"/{prefix.strip('/')}" if prefix.strip("/") else ""
    of_bounds = space + _BOUND
    of_statuses = space + _STATUS

    of_topic = {contact.replace("{robot}", robot): robot for robot in workspace.team.names}
    messages = _messages(paths, of_bounds, of_statuses, contact, [*of_topic])

    looks = messages.loc[messages["topic"].isin([*of_topic])].astype({"data": float})
    seen = looks.dropna()
    require_unit_interval(f"messages on {contact}", seen["data"].to_numpy())
    ticks = seen.assign(robot=seen["topic"].map(of_topic), contact=seen["data"] > 0.5)

    marked = messages.loc[messages["topic"] == of_bounds, "data"]
    rows = sorted(_marker(time, text) for time, text in marked.items())
    markers = pd.DataFrame(rows, columns=["begin", "bound", "cell", "path"])

    bounds = without_repeats(markers)
    bounds["until"] = bounds["begin"].shift(-1, fill_value=_NEVER)
    bounds["mission"] = (bounds["bound"] == 0).cumsum()
    require_in_order(_listed(paths), bounds, markers, ticks)
    missions = bounds.groupby("mission")

    statuses = messages.loc[messages["topic"] == of_statuses, "data"]
    statuses = without_repeated_statuses(statuses, markers, bounds)
    ends = ends_of(bounds, statuses, ticks)
    warn_of_ends(bounds, ends, looks.index)
    ticks = in_bounds(ticks, bounds, ends)
    warn_of_robots(ticks, looks["topic"].map(of_topic).unique())
    tables = [
        _table(driven, ticks, ends, workspace.team.names).assign(mission=mission)
        for mission, driven in missions
        if len(driven) > 1
    ]

    if not tables:
        return []

    unknown = dict.fromkeys(workspace.features, np.nan)
    return read_table(pd.concat(tables).assign(**unknown))


def _listed(paths: Sequence[Path]) -> str:
    """Return the names of bags for messages."""
    return ", ".join(repr(str(path)) for path in paths)


def _messages(
    paths: Sequence[Path], bounds: str, statuses: str, contact: str, contacts: Sequence[str]
) -> pd.DataFrame:
    """Read the topic and data of different messages, indexed and sorted by recording time, ns.

    Args:
        paths: Bags.
        bounds: Topic of the bounds.
        statuses: Topic of the statuses, which may be missing.
        contact: Topic of contact, with `{robot}`, for error messages.
        contacts: Topics of the contact of each robot.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise TrustboError("ROS bags need rosbags: python -m pip install rosbags") from None

    messages: list[list[tuple[int, str, Any]]] = [[] for _ in paths]
    try:
        # ROS 2 bags recorded before Iron do not define their message types.
        with AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            there = {c.topic: c.msgtype for c in reader.connections}
            _require_topics(paths, there, bounds, contact, contacts)
            for of_bag, part in zip(reader.readers, messages, strict=True):
                of_topics = (bounds, statuses, *contacts)
                chosen = [c for c in of_bag.connections if c.topic in of_topics]
                found = of_bag.messages(connections=chosen) if chosen else ()
                for c, time, raw in found:
                    is_text = c.topic in (bounds, statuses)
                    kinds = (str,) if is_text else (bool, int, float, np.number)
                    part.append((time, c.topic, _data(reader, c, raw, kinds)))
    except TrustboError:
        raise
    except Exception as error:  # rosbags raises many types of errors for bad files
        raise TrustboError(
            f"{_listed(paths)} cannot be read as a ROS bag ({error or type(error).__name__}); give "
            "a complete .bag file of ROS 1, or the folder of a ROS 2 bag with its metadata.yaml."
        ) from None

    parts = [
        # The files of a bag that was split are read one after another, although they may overlap.
        pd.DataFrame(part, columns=["time", "topic", "data"]).sort_values("time", kind="stable")
        for part in messages
    ]
    return joined([str(path) for path in paths], parts, bounds).set_index("time")


def _data(reader: Any, connection: Any, raw: bytes, kinds: tuple[type, ...]) -> Any:
    """Return the data of a message; raises TrustboError if they are not of one of these types."""
    topic = connection.topic
    kind = connection.msgtype
    needed = "String" if kinds == (str,) else "Bool, Float32 or Float64"
    try:
        data = getattr(reader.deserialize(raw, kind), "data", None)
    except Exception as error:  # of many types; also an unknown type of messages
        raise TrustboError(
            f"messages on {topic} ({kind}) cannot be decoded ({error or type(error).__name__}); "
            f"publish std_msgs {needed}, or record the bag again if it is damaged."
        ) from None
    if not isinstance(data, kinds):
        raise TrustboError(f"messages on {topic} are {kind}; publish std_msgs {needed}.")
    return data


def _require_topics(
    paths: Sequence[Path],
    there: dict[str, str],
    bounds: str,
    contact: str,
    contacts: Sequence[str],
) -> None:
    """Raise TrustboError that lists missing topics and the argument that names other topics.

    If some robots have topics of contact, the others may not have taken part, which is warned of.
    """

    def namespace(topic: str, other: str) -> str:
        """Return what precedes a missing topic in the bag, or an example."""
        return next((name.removesuffix(topic) for name in there if name.endswith(topic)), other)

    missing = [topic for topic in (bounds, *contacts) if topic not in there]
    of_robots = [topic for topic in missing if topic != bounds]
    if bounds in there and len(of_robots) < len(contacts):
        if of_robots:
            warn(
                f"{_listed(paths)} lacks {', '.join(of_robots)}, so the contact of these robots is "
                "unknown; rename the topics if the robots took part."
            )
        return

    remedies = []
    if bounds in missing:
        remedies.append(f'prefix="{namespace(_BOUND, "/fleet")}" for {_BOUND}')
    if of_robots:
        space = namespace(of_robots[0], "")
        remedies.append(f'contact="{space + contact if space else "/{robot}/sees"}"')
    found = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(there.items()))
    raise TrustboError(
        f"{_listed(paths)} lacks {', '.join(missing)}; it has {found or 'no topics'}. Pass the "
        f"names of other topics, such as {' and '.join(remedies)}."
    )


def _marker(time: Any, text: Any) -> tuple[int, int, Cell, tuple[Cell, ...]]:
    """Parse the marker of a bound: its time (ns), number, cell, and the planned path or ()."""
    try:
        content = json.loads(text)
        path = tuple(require_pair("path", cell) for cell in content.get("path", ()))
        k = require_whole("bound", content["bound"], 0)
        return time, k, require_pair("cell", content["cell"]), path
    except (AttributeError, KeyError, TypeError, ValueError):
        raise TrustboError(f"a marker must be JSON of bound and cell; got {text!r:.60}.") from None


def _table(
    bounds: pd.DataFrame, ticks: pd.DataFrame, ends: pd.DataFrame, robots: Sequence[str]
) -> pd.DataFrame:
    """Return a mission as a table: rows of its planned cells, then rows of its bounds.

    `ticks` are those of `in_bounds`.
    """
    driven = tuple(bounds["cell"])
    planned = bounds["path"].iloc[0]
    left_path = planned[:1] == driven[:1] and planned[: len(driven)] != driven
    path = driven if left_path else planned  # `read_table` refuses a path from another cell
    reaches_end = not planned or (len(path) <= len(driven) and driven[-1] == planned[-1])

    cells = [(0, *driven[0]), *((k, *cell) for k, cell in enumerate(path))]
    tables = [pd.DataFrame(cells, columns=["bound", "row", "col"]).drop_duplicates()]

    of_bounds = ends.drop_duplicates("row").set_index("row")
    for i, begin, k, (row, col), *_ in bounds.iloc[1:].itertuples():
        looks = ticks.loc[ticks["row"] == i]
        has_status = i in of_bounds.index
        end = of_bounds.loc[i, "end"] if has_status else max(looks.index, default=begin)

        duration = (end - begin) / _NANOSECONDS if end > begin else np.nan
        status = of_bounds.loc[i, "status"] if has_status else "ok"
        if status == "ok" and k == len(driven) - 1 and not reaches_end:
            status = "aborted"  # no record of the reason

        contact = looks.groupby("robot")["contact"]
        table = contact.agg(contact_rate="mean", n_ticks="count").reindex(robots).reset_index()
        tables.append(table.assign(bound=k, row=row, col=col, duration=duration, status=status))

    return pd.concat(tables)
