"""Files of ROS bags: messages read and written by rosbags."""

import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trustbo.errors import TrustboError, require_package
from trustbo.files import naming_refusal, require_regular
from trustbo.logs.messages import (
    CONTACT_TYPES,
    DEFINITIONS,
    POSE_TYPES,
    READERS,
    Messages,
    stamp_of,
)
from trustbo.logs.recording import Series

STORAGES = ("sqlite3", "mcap")


def _require_rosbags() -> None:
    require_package("ROS bags need", "rosbags", "rosbags")


class Record(NamedTuple):
    """Message and its time of recording."""

    time: int
    """ns."""
    topic: str
    kind: str
    message: Any


class Bag:
    """Bag that is open for reading."""

    def __init__(self, path: Path, reader: Any) -> None:
        """Hold a reader of rosbags."""
        self._path, self._reader = path, reader
        self.types: dict[str, str] = {c.topic: c.msgtype for c in reader.connections}

    def require(self, topics: Sequence[str]) -> None:
        """Check that the bag has topics; the TrustboError lists those that it has."""
        missing = [topic for topic in topics if topic not in self.types]
        if missing:
            there = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self.types.items()))
            raise TrustboError(
                f"{str(self._path)!r} lacks {', '.join(missing)}; it has {there or 'no topics'}. "
                "Topics with other names: topics=Topics(...)."
            )

    def robots(self, topic: str) -> tuple[str, ...]:
        """Names of the robots with a topic, given with `{robot}` in place of a name."""
        pattern = re.escape(topic).replace(re.escape("{robot}"), "([^/]+)")
        matches = (re.fullmatch(pattern, name) for name in self.types)
        return tuple(sorted(match[1] for match in matches if match))

    def collect(self, topics: Mapping[str, tuple[str, ...]]) -> dict[str, Series]:
        """Records of several topics, each given with its admissible types.

        TrustboError: a topic of another type, an invalid message, a damaged bag, or a clock that
        goes backwards.
        """
        times: dict[str, list[int]] = {topic: [] for topic in topics}
        values: dict[str, list[Any]] = {topic: [] for topic in topics}
        for topic, time, value in self.values(topics):
            times[topic].append(time)
            values[topic].append(value)
        return {
            topic: Series(np.array(times[topic], np.int64), _as_array(values[topic], topics[topic]))
            for topic in topics
        }

    def values(self, topics: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time in ns and value of each record, in order of time; see `collect`."""
        stamps, numbers = dict.fromkeys(topics, 0), dict.fromkeys(topics, 0)
        for topic, time, message in self.messages(topics):
            types = topics[topic]
            stamp = stamp_of(message) if types is POSE_TYPES else time
            if stamp < stamps[topic]:
                raise TrustboError(
                    f"the clock of {topic} goes backwards: its message {numbers[topic]} is of "
                    f"{stamp / 1e9:.9f} s, the one before of {stamps[topic] / 1e9:.9f} s."
                )
            stamps[topic] = stamp
            numbers[topic] += 1
            try:
                yield topic, time, READERS[types](message)
            except TrustboError as error:
                raise TrustboError(f"{topic}: {error}") from None

    def messages(self, topics: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time in ns and content of all messages on some topics."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        for c in chosen:
            if c.msgtype not in topics[c.topic]:
                raise TrustboError(
                    f"{c.topic} is {c.msgtype}; it must be {' or '.join(topics[c.topic])}."
                )
        if not chosen:  # rosbags would read all
            return
        try:
            for connection, time, raw in self._reader.messages(connections=chosen):
                message = self._reader.deserialize(raw, connection.msgtype)
                yield connection.topic, time, message
        except Exception as error:  # rosbags raises many types for a damaged file
            raise _unreadable(self._path, error) from None


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Open a bag for reading; TrustboError: no rosbags, no such file or folder, or not a bag."""
    _require_rosbags()
    from rosbags.highlevel import AnyReader

    if not path.exists():
        raise TrustboError(f"there is no bag {str(path)!r}; check its path.")
    if not path.is_dir():
        require_regular(path)
    try:
        # Bags of ROS 2 before Iron do not define their types.
        reader = AnyReader([path], default_typestore=_types(2))
        reader.open()
    except Exception as error:  # as above
        raise _unreadable(path, error) from None
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


def require_new_bag(path: Path) -> int:
    """Version of ROS of a new bag, by its path: .bag for 1.

    TrustboError: no rosbags; the path exists.
    """
    _require_rosbags()
    if path.exists():
        raise TrustboError(
            f"{str(path)!r} exists; bags are not overwritten: remove it, or give another path."
        )
    return 1 if path.suffix == ".bag" else 2


def write_messages(
    path: Path,
    version: int,
    storage: str,
    records: Callable[[Messages], Iterable[Record]],
    *,
    latched: bool = False,
    frame: str = "map",
) -> None:
    """Write a bag, which `require_new_bag` allowed, whole or not at all.

    The path is a file or folder; its parent is made if need be. `version` of ROS is 1
    or 2, `storage` of ROS 2 one of `STORAGES`. `records` makes records in order of time with the
    given `Messages`, in `frame`. If `latched`, late subscribers get the messages played before.
    """
    from rosbags import rosbag1, rosbag2

    store = _types(version)
    serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr
    with naming_refusal(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        file = Path(folder) / path.name  # files within a bag are named after it
        if version == 1:
            writer: Any = rosbag1.Writer(file)
        else:
            plugin = rosbag2.StoragePlugin[storage.upper()]
            writer = rosbag2.Writer(file, version=8, storage_plugin=plugin)
        options = _latch(version) if latched else {}
        connections: dict[str, Any] = {}
        with writer:
            for time, topic, kind, message in records(Messages(store.types, frame)):
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        topic, kind, typestore=store, **options
                    )
                writer.write(connections[topic], time, serialize(message, kind))
        os.replace(file, path)


def _types(version: int) -> Any:
    """Types of a version of ROS, those of `DEFINITIONS` included."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    for kind, text in DEFINITIONS[version].items():
        store.register(get_types_from_msg(text, kind))
    return store


def _latch(version: int) -> dict[str, Any]:
    """Options of rosbags' writer that offer a topic to late subscribers."""
    from rosbags import interfaces as ros

    if version == 1:
        return {"latching": 1}
    ever = ros.QosTime(9_223_372_036, 854_775_807)  # how ROS 2 writes "no limit"
    return {
        "offered_qos_profiles": [
            ros.Qos(
                history=ros.QosHistory.KEEP_LAST,
                depth=1,
                reliability=ros.QosReliability.RELIABLE,
                durability=ros.QosDurability.TRANSIENT_LOCAL,
                deadline=ever,
                lifespan=ever,
                liveliness=ros.QosLiveliness.AUTOMATIC,
                liveliness_lease_duration=ever,
                avoid_ros_namespace_conventions=False,
            )
        ]
    }


def _as_array(values: Sequence[Any], types: tuple[str, ...]) -> np.ndarray:
    """Array of the records along the first axis."""
    if types is POSE_TYPES:
        return np.array(values, dtype=float).reshape(-1, 3)
    if types is CONTACT_TYPES:
        return np.array(values, dtype=float)
    return np.fromiter(values, dtype=object, count=len(values))


def _unreadable(path: Path, error: Exception) -> TrustboError:
    return TrustboError(
        f"{str(path)!r} cannot be read as a ROS bag ({error or type(error).__name__}); give a "
        "whole .bag file of ROS 1, or the folder of a bag of ROS 2 with its metadata.yaml."
    )
