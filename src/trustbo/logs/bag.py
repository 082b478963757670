"""Missions in ROS bags: `.bag` files of ROS 1, folders of ROS 2 (sqlite3 or mcap).

Needs `pip install rosbags`, not ROS itself. All types are standard; topics, their types and
times of publication are tabulated in docs/howto/your-own-robots.md, and can be renamed (`Topics`).

All times are those of recording, whole nanoseconds; bounds are cut as in `Recording`. The contact
rate is the share of a robot's ticks with contact, n_ticks their number; a contact of NaN was not
measured, and is no tick. If robots have unequal numbers, `Bound.contact` has the ticks of the one
with most. Poses and states are the last ones at each tick, x and y as recorded: in CRS metres if
their frame is; headings have no jumps. Awareness that was not published is NaN, which
`Campaign.tell` takes from the map.
"""

import json
import time
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from trustbo.data import FEATURES, Mission, default_features
from trustbo.errors import TrustboError, require_choice, require_positive
from trustbo.files import FilePath
from trustbo.logs.bagfile import STORAGES, Record, opened, require_new_bag, write_messages
from trustbo.logs.messages import (
    AWARENESS_TYPES,
    CONTACT_TYPES,
    FLAG,
    MARKER_TYPES,
    NUMBERS,
    POSE,
    POSE_TYPES,
    STATUS_TYPES,
    TEXT,
    Messages,
    Topics,
    require_topic_names,
)
from trustbo.logs.netcdf import STATES
from trustbo.logs.recording import Marker, Recording, Series
from trustbo.stacking import require_same_team
from trustbo.workspace import Workspace

_NS = 1_000_000_000  # in a second


def read_bag(
    path: FilePath, workspace: Workspace | None = None, *, topics: Topics | None = None
) -> list[Mission]:
    """Read the missions of a ROS bag; see docs/howto/your-own-robots.md for its topics.

    Args:
        path: A `.bag` file of ROS 1, or the folder of a bag of ROS 2.
        workspace: Workspace with the robots and features to read, in its order. By default those
            that the first marker names, else those found: robots by name, features by label.
        topics: Names of topics, if not the default ones.

    Raises:
        TrustboError: No rosbags; not a bag, or a damaged one; a missing topic, or one of another
            type; a clock that goes backwards; markers out of order; or what `Mission` refuses.
    """
    names = Topics() if topics is None else topics
    with opened(Path(path)) as bag:
        bag.require([names.bound])
        marked = bag.collect({names.bound: MARKER_TYPES})[names.bound]
        if not len(marked.time):
            raise TrustboError(f"no message on {names.bound}, which marks the starts of bounds.")
        first = marked.value[0]
        if workspace is None:
            robots, features = first["robots"] or bag.robots(names.contact), first["features"]
        else:
            robots, features = workspace.team.names, workspace.features
        contact, awareness = names.of("contact", robots), names.of("awareness", robots)
        bag.require(contact or [names.contact])
        poses = names.of("pose", (names.lead, *robots))
        if any(topic in bag.types for topic in poses):
            bag.require(poses)
        else:
            poses = []
        states = [topic for topic in names.of("state", robots) if topic in bag.types]
        read: dict[str, tuple[str, ...]] = {names.status: STATUS_TYPES}
        read |= dict.fromkeys(states, AWARENESS_TYPES)
        read |= dict.fromkeys(contact, CONTACT_TYPES)
        read |= dict.fromkeys(awareness, AWARENESS_TYPES) | dict.fromkeys(poses, POSE_TYPES)
        series = bag.collect(read)
    named = (n or default_features(len(v)) for t in awareness for n, v in series[t].value)
    features = features or next(named, FEATURES)
    markers = zip(marked.time.tolist(), marked.value, strict=True)
    recording = Recording(
        [Marker(time, m["bound"], m["cell"], m["path"]) for time, m in markers],
        series[names.status],
        [series[topic] for topic in contact],
        [_by_feature(topic, series[topic], features) for topic in awareness],
        [series[topic] for topic in poses],
        [_by_feature(topic, series[topic], STATES) for topic in states],
    )
    try:
        return recording.missions(features, robots)
    except TrustboError as error:
        raise TrustboError(f"{str(path)!r}: {error}") from None


def write_bag(
    missions: Sequence[Mission],
    path: FilePath,
    *,
    storage: str = "sqlite3",
    topics: Topics | None = None,
    start: datetime | float | None = None,
) -> None:
    """Write missions as a ROS bag that `read_bag` reads back, on the same topics.

    Times are kept to the nanosecond, headings up to whole turns. Each mission begins 1 s after the
    end of the one before.

    Args:
        missions: Missions with the same robots and features, and with a contact of every tick.
        path: A `.bag` file for ROS 1, or a folder for ROS 2; written whole or not at all.
        storage: Storage of ROS 2, "sqlite3" or "mcap".
        topics: Names of topics, if not the default ones.
        start: Time of the first message, a datetime or POSIX seconds; by default the present.

    Raises:
        ShapeError: No missions, or missions that disagree on robots or features.
        TrustboError: No rosbags; a path that exists; missions whose
            ticks do not hold all they measured; names or a start that ROS does not take.
    """
    require_same_team(missions)
    require_choice("storage", storage, STORAGES)
    target, names = Path(path), Topics() if topics is None else topics
    begin = time.time_ns() if start is None else _ns(start)
    version = require_new_bag(target)
    _require_names(missions[0], names.lead)
    for j, mission in enumerate(missions):
        _require_ticks(f"mission {j}", mission)

    def records(messages: Messages) -> Iterator[Record]:
        now = begin
        for j, mission in enumerate(missions):
            in_time = sorted(_records(j, mission, now, names, messages), key=lambda r: r.time)
            yield from in_time
            now = in_time[-1].time + _NS

    write_messages(target, version, storage, records)


def _ns(start: datetime | float) -> int:
    """Time in ns; ROS has seconds from 1970 (0 means "unknown") to 2038."""
    seconds = start.timestamp() if isinstance(start, datetime) else start
    if require_positive("start", seconds) >= 2.0**31:
        raise TrustboError(f"start must be before 2038, as times of ROS are; got {start!r}.")
    whole, part = divmod(seconds, 1.0)  # apart, as a float holds 1e18 ns to 128 ns only
    return int(whole) * _NS + round(part * _NS)


def _require_names(mission: Mission, lead: str) -> None:
    """Check that topics and labels can hold the names of robots and features."""
    require_topic_names(lead, mission.robots)
    for feature in mission.features:
        if "," in feature or feature != feature.strip():
            raise TrustboError(f"feature {feature!r} cannot be in a label joined by commas.")


def _require_ticks(where: str, mission: Mission) -> None:
    """Check that the ticks of a mission hold all that it measured, except awareness."""
    ended = 0.0
    for k, bound in enumerate(mission.bounds, start=1):
        contact = np.empty((0, 0)) if bound.contact is None else np.asarray(bound.contact)
        poses = np.empty((len(contact), 0)) if bound.poses is None else bound.poses
        if not len(contact) or len(poses) != len(contact):
            what = "no contact of each tick, or other ticks than poses; a table keeps it"
        elif not np.allclose(contact.mean(0), bound.contact_rate, rtol=0.0, atol=1e-9):
            what = "contact rates that are not those of its ticks"
        elif not (np.isnan(bound.n_ticks) | (bound.n_ticks == len(contact))).all():
            what = "an n_ticks that is not the number of its ticks"
        elif not (bound.duration == bound.duration[0]).all():
            what = "no duration, or not one for all robots"
        elif bound.states is not None and bound.states.shape != (*contact.shape, len(STATES)):
            what = f"states that are not (tick, robot, state): {bound.states.shape}"
        elif bound.t0 < ended - 1e-6:
            what = f"a start at {bound.t0:g} s, before the last ends at {ended:g} s"
        else:
            ended = bound.t1
            continue
        raise TrustboError(f"{where}, bound {k} has {what}: write_bag cannot keep it.")


def _records(
    j: int, mission: Mission, start: int, names: Topics, make: Messages
) -> Iterator[Record]:
    """Messages of one mission that starts at a time in ns."""
    contact, awareness, states = (
        names.of(kind, mission.robots) for kind in ("contact", "awareness", "state")
    )
    poses = names.of("pose", (names.lead, *mission.robots))
    path = [[int(row), int(col)] for row, col in mission.path]
    plan = {"path": path, "robots": mission.robots, "features": mission.features}
    first = {"mission": j, "bound": 0, "cell": path[0], **plan}
    yield Record(start, names.bound, TEXT, make.text(json.dumps(first)))
    end = start
    for k, bound in enumerate(mission.bounds, start=1):
        begin = max(end, start + round(bound.t0 * _NS))
        end = start + round(bound.t1 * _NS)
        marker = {"mission": j, "bound": k, "cell": path[k]}
        yield Record(begin, names.bound, TEXT, make.text(json.dumps(marker)))
        contacts = np.asarray(bound.contact)
        tracks = np.empty((len(contacts), 0)) if bound.poses is None else bound.poses
        recorded = np.empty((len(contacts), 0)) if bound.states is None else bound.states
        ticks = zip(contacts, tracks, recorded, strict=True)
        for tick, (flags, track, now) in enumerate(ticks, start=1):
            time = begin + (end - begin) * tick // len(contacts)
            for topic, flag in zip(contact, flags, strict=True):
                yield Record(time, topic, FLAG, make.flag(flag))
            for topic, pose in zip(poses if len(track) else (), track, strict=True):
                yield Record(time, topic, POSE, make.pose(time, pose))
            for topic, state in zip(states if len(now) else (), now, strict=True):
                yield Record(time, topic, NUMBERS, make.numbers(state, STATES))
        for topic, values in zip(awareness, bound.awareness, strict=True):
            yield Record(end, topic, NUMBERS, make.numbers(values, mission.features))
        yield Record(end, names.status, TEXT, make.text(bound.status))
    if mission.status != mission.bounds[-1].status:
        yield Record(end + 1, names.status, TEXT, make.text(mission.status))


def _by_feature(topic: str, named: Series, features: tuple[str, ...]) -> Series:
    """Vectors in the order of the features, NaN for those that they lack."""
    values = np.full((len(named.time), len(features)), np.nan)
    for row, (names, entries) in zip(values, named.value, strict=True):
        labels = names or features
        unknown = [name for name in labels if name not in features]
        if unknown or len(labels) != len(entries):
            what = ", ".join(unknown) or f"{len(entries)} unnamed values"
            raise TrustboError(f"{topic} has {what}; the features are {', '.join(features)}.")
        row[[features.index(name) for name in labels]] = entries
    return Series(named.time, values)
