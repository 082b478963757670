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

from pathlib import Path

import numpy as np

from trustbo.data import FEATURES, Mission, default_features
from trustbo.errors import TrustboError
from trustbo.files import FilePath
from trustbo.logs.bagfile import opened
from trustbo.logs.messages import (
    AWARENESS_TYPES,
    CONTACT_TYPES,
    MARKER_TYPES,
    POSE_TYPES,
    STATUS_TYPES,
    Topics,
)
from trustbo.logs.netcdf import STATES
from trustbo.logs.recording import Marker, Recording, Series
from trustbo.workspace import Workspace


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
