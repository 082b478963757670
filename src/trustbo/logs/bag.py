"""Missions in ROS bags (`.bag` files or ROS 2 folders), read with rosbags (extra `ros`).

    /mission/bound    std_msgs/String, JSON {"bound": k, "cell": [row, col]}, at the start of bound
                      k. Bound 0 is the start of a mission, in its start cell, and may have "path",
                      the planned cells.
    /mission/status   std_msgs/String, "ok", "stuck", ..., optional, at the end of a bound; a second
                      one after the last bound is the status of the mission.
    /{robot}/contact  std_msgs/Bool, or Float32 or Float64 in [0, 1], at each tick

A bound lasts from its marker to its status or, without a status, to the last contact message
before the next marker. Its contact rate is the fraction of a robot's ticks with contact; NaN ticks
are ignored.
"""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trustbo.data import Bound, Cell, Mission, require_unit_interval
from trustbo.errors import TrustboError, require_pair, require_whole
from trustbo.files import FilePath
from trustbo.workspace import Workspace

_NEVER = np.iinfo(np.int64).max
_NS = 1e9  # nanoseconds per second

type Marker = tuple[int, int, Cell, tuple[Cell, ...]]
"""Time (ns), number and cell of a bound, and the planned path, which may be empty."""


def read_bag(
    path: FilePath,
    workspace: Workspace,
    *,
    bound: str = "/mission/bound",
    status: str = "/mission/status",
    contact: str = "/{robot}/contact",
) -> list[Mission]:
    """Read the missions of a ROS bag.

    Args:
        path: A `.bag` file of ROS 1, or the folder of a bag of ROS 2.
        workspace: Workspace whose robots are read, in the order of its team.
        bound: Topic that marks the start of each bound.
        status: Topic with the status of bounds and missions.
        contact: Topic with the contact of each robot, whose name replaces `{robot}`.

    Returns:
        Missions without ticks. Awareness is NaN; campaigns use awareness from the map.

    Raises:
        TrustboError: rosbags is not installed; the path is not a bag, or the bag is damaged; a
            topic is missing; markers are out of order; or `Mission` rejects the data.
    """
    topics = [contact.replace("{robot}", robot) for robot in workspace.team.names]
    messages = _messages(Path(path), [bound, *topics], status)
    statuses = messages[status].map(lambda message: str(message.data))
    found = statuses, [_contacts(topic, messages[topic]) for topic in topics]
    markers = sorted(_marker(time, message) for time, message in messages[bound].items())
    starts = [i for i, (_, k, *_) in enumerate(markers) if k == 0]
    if not starts or starts[0] > 0:
        raise TrustboError(f"{str(path)!r} must begin with the marker of bound 0, the start cell.")
    missions = []
    for first, end in pairwise([*starts, len(markers)]):
        if end - first < 2:  # nothing was driven
            continue
        until = markers[end][0] if end < len(markers) else _NEVER
        try:
            missions.append(_mission(*found, markers[first:end], until, workspace))
        except TrustboError as error:
            raise TrustboError(f"{str(path)!r}, mission {len(missions) + 1}: {error}") from None
    return missions


def _messages(path: Path, needed: Sequence[str], optional: str) -> dict[str, pd.Series]:
    """Read the messages of each topic, indexed and sorted by recording time, ns."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise TrustboError("ROS bags need rosbags: python -m pip install rosbags") from None

    messages: dict[str, list[Any]] = {topic: [] for topic in (*needed, optional)}
    times: dict[str, list[int]] = {topic: [] for topic in messages}
    there = {}
    try:
        # ROS 2 bags recorded before Iron do not define their message types.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            there = {c.topic: c.msgtype for c in reader.connections}
            chosen = [c for c in reader.connections if c.topic in messages]
            for c, time, raw in reader.messages(connections=chosen) if chosen else ():
                times[c.topic].append(time)
                messages[c.topic].append(reader.deserialize(raw, c.msgtype))
    except Exception as error:  # rosbags raises many types of errors for bad files
        raise TrustboError(
            f"{str(path)!r} cannot be read as a ROS bag ({error or type(error).__name__}); give a "
            "complete .bag file of ROS 1, or the folder of a ROS 2 bag with its metadata.yaml."
        ) from None
    if missing := [topic for topic in needed if topic not in there]:
        found = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(there.items()))
        raise TrustboError(
            f"{str(path)!r} lacks {', '.join(missing)}; it has {found or 'no topics'}. "
            'Pass other topics, such as contact="/{robot}/sees".'
        )
    return {t: pd.Series(m, pd.Index(times[t], dtype=int), object) for t, m in messages.items()}


def _contacts(topic: str, messages: pd.Series) -> pd.Series:
    """Return the contact of a robot at each tick, 1 or 0; NaN ticks are dropped."""
    value = messages.map(lambda message: float(message.data)).astype(float)
    require_unit_interval(topic, value.to_numpy())
    return (value.dropna() > 0.5).astype(float)


def _marker(time: Any, message: Any) -> Marker:
    """Parse a message that marks the start of a bound."""
    try:
        content = json.loads(message.data)
        path = tuple(require_pair("path", cell) for cell in content.get("path", ()))
        k = require_whole("bound", content["bound"], 0)
        return time, k, require_pair("cell", content["cell"]), path
    except (AttributeError, KeyError, TypeError, ValueError):
        raise TrustboError(
            "a marker must be JSON with a bound and a cell; got "
            f"{getattr(message, 'data', message)!r:.60}."
        ) from None


def _mission(
    statuses: pd.Series,
    contacts: list[pd.Series],
    markers: list[Marker],
    until: int,
    workspace: Workspace,
) -> Mission:
    """Make a mission from its markers; its last bound ends at `until` at the latest."""
    times, numbers, cells, paths = zip(*markers, strict=True)
    if numbers != (*range(len(markers)),):
        raise TrustboError(f"bounds must be numbered 0, 1, 2, ... in order; got {list(numbers)}.")
    path = paths[0] or cells
    if path[0] != cells[0]:
        raise TrustboError(f"it starts in {cells[0]}, but its path starts in {path[0]}.")
    bounds = []
    for cell, begin, until_next in zip(cells[1:], times[1:], [*times[2:], until], strict=True):
        ended = statuses.loc[begin + 1 : until_next]
        end = int(ended.index[0]) if len(ended) else until_next
        looks = [one.loc[begin + 1 : end] for one in contacts]
        if not len(ended):
            end = max((int(one.index[-1]) for one in looks if len(one)), default=begin)
        rate = np.array([one.mean() for one in looks])
        n_ticks = np.array([len(one) or np.nan for one in looks])
        duration = np.full(len(looks), (end - begin) / _NS if end > begin else np.nan)
        status, t0 = ended.iloc[0] if len(ended) else "ok", (begin - times[0]) / _NS
        z = np.full((len(looks), len(workspace.features)), np.nan)
        bounds.append(Bound(cell, z, rate, duration, status, t0, n_ticks=n_ticks))
    last = statuses.loc[times[-1] + 1 : until]
    status = last.iloc[-1] if len(last) else "ok"
    if status == "ok" and len(bounds) < len(path) - 1:
        status = "aborted"  # no record of the reason
    return Mission(path, tuple(bounds), status, workspace.features, workspace.team.names)
