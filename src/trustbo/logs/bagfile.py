"""Files of ROS bags: messages read by rosbags."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.errors import TrustboError, require_package
from trustbo.logs.messages import (
    CONTACT_TYPES,
    POSE_TYPES,
    READERS,
    stamp_of,
)
from trustbo.logs.recording import Series


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
    require_package("ROS bags need", "rosbags", "rosbags")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not path.exists():
        raise TrustboError(f"there is no bag {str(path)!r}; check its path.")
    try:
        # Bags of ROS 2 before Iron do not define their types.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # as above
        raise _unreadable(path, error) from None
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


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
