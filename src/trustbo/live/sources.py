"""Sources of messages: a stream of lines, datagrams, and a bag that is replayed."""

import asyncio
import hmac
import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import IO, Any

import numpy as np

from trustbo.errors import TrustboError, require_not_negative
from trustbo.live.hub import Hub
from trustbo.live.messages import MOST_BYTES, Contact, Ending, Marker, Message, Pose, Reader
from trustbo.logs.bagfile import Bag, opened
from trustbo.logs.messages import (
    AWARENESS_TYPES,
    CONTACT_TYPES,
    MARKER_TYPES,
    POSE_TYPES,
    STATUS_TYPES,
    Topics,
)

_MOST_WAITING = 10_000
"""Datagrams that may wait while work is done."""
_NS = 1e9


class Feed(threading.Thread):
    """Thread that passes messages to a hub, each when those before it are taken."""

    def __init__(self, hub: Hub, name: str, batches: Iterable[Sequence[Message | bytes]]) -> None:
        """Hold lists of messages that come together, which may block, and their name."""
        super().__init__(name="trustbo-live-feed", daemon=True)
        self._hub, self._name, self._batches = hub, name, batches
        self._loop = asyncio.get_running_loop()

    def run(self) -> None:
        """Pass the messages."""
        try:
            for batch in self._batches:
                asyncio.run_coroutine_threadsafe(self._take(batch), self._loop).result()
            self._loop.call_soon_threadsafe(self._hub.live.say, f"{self._name} is over")
        except TrustboError as error:  # of the bag
            self._loop.call_soon_threadsafe(self._hub.refuse, error)
        except (RuntimeError, CancelledError):  # the loop was closed
            return

    async def _take(self, batch: Sequence[Message | bytes]) -> None:
        for one in batch:
            with suppress(TrustboError):  # the hub counts it
                if not isinstance(one, bytes):
                    await self._hub.take(one)
                elif one.strip():
                    await self._hub.take_line(one)


def lines_of(stream: IO[bytes]) -> Iterator[list[bytes]]:
    """Lists of the lines of a stream, as they come; of a line that is too long, its beginning."""
    read = getattr(stream, "read1", stream.read)
    left, skipping = b"", False
    while chunk := read(MOST_BYTES):
        *lines, left = (left + chunk).split(b"\n")
        if skipping and lines:
            lines, skipping = lines[1:], False
        if len(left) > MOST_BYTES:
            if not skipping:
                lines.append(left[: MOST_BYTES + 1])
            left, skipping = b"", True
        if lines:
            yield lines
    if left and not skipping:
        yield [left]


class Datagrams(asyncio.DatagramProtocol):
    """Messages in datagrams, of one line or more each; with a token, it is a key of each line."""

    def __init__(self, hub: Hub, token: str = "") -> None:
        """Begin to take messages; TrustboErrors are counted by the hub."""
        self._hub, self._token = hub, token
        self._waiting: asyncio.Queue[bytes] = asyncio.Queue(_MOST_WAITING)
        self._task = asyncio.get_running_loop().create_task(self._take())

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Keep a datagram until it is its turn."""
        try:
            self._waiting.put_nowait(data)
        except asyncio.QueueFull:
            self._hub.n_lost += 1

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._task.cancel()

    async def _take(self) -> None:
        while True:
            for line in (await self._waiting.get()).splitlines():
                with suppress(TrustboError):  # the hub counts it
                    if self._token:
                        await self._hub.take(self._checked(line))
                    else:
                        await self._hub.take_line(line)

    def _checked(self, line: bytes) -> Message:
        try:
            record = json.loads(line)
            given = record.get("token", "") if isinstance(record, dict) else ""
            if not hmac.compare_digest(str(given).encode(), self._token.encode()):
                raise TrustboError("wrong token: a datagram has the key token.")
            return self._hub.live.reader.of_record(record)
        except (ValueError, RecursionError) as error:
            refused = error if isinstance(error, TrustboError) else TrustboError("no JSON.")
            self._hub.refuse(refused)
            raise refused from None


def bag_messages(path: Path, rate: float, hub: Hub) -> Iterator[Any]:
    """Lists of the messages of a bag, with those of one time together, at the bag's pace.

    The last mission is over with the bag.

    Args:
        path: Bag, as of `logs.read_bag`.
        rate: Speed, 1 that of the bag; 0 for no waiting.
        hub: Hub that takes them.

    Raises:
        TrustboError: No bag, a topic that is missing or of another type, or a damaged bag.
    """
    require_not_negative("rate", rate)
    reader = hub.live.reader
    with opened(path) as bag:
        kinds = _topics(bag, reader)
        values = bag.values({topic: types for topic, (types, _, _) in kinds.items()})
        began, first, last = time.monotonic(), None, 0.0
        for stamp, together in groupby(values, key=lambda one: one[1]):
            first = stamp if first is None else first
            if rate:
                due = began + (stamp - first) / _NS / rate
                time.sleep(max(0.0, due - time.monotonic()))
            last = stamp / _NS
            yield _merged([(kinds[topic], value) for topic, _, value in together], last)
    yield from _over(hub, last)


type _Kind = tuple[tuple[str, ...], int, Callable[[Any, float], Message]]
"""Types of a topic, its place among those of one time, and the message of its value."""


def _topics(bag: Bag, reader: Reader) -> dict[str, _Kind]:
    """Topics of a bag that are read."""
    names, robots = Topics(), reader.robots
    contacts = names.of("contact", robots)
    bag.require([names.bound, *contacts])
    kinds: dict[str, _Kind] = {
        names.status: (STATUS_TYPES, 3, lambda value, t: Ending(value, "", None, t)),
        names.bound: (MARKER_TYPES, 4, _marker),  # of the bound after what has the same time
    }
    for i, topic in enumerate(contacts):
        kinds[topic] = CONTACT_TYPES, 0, partial(_contact, i, len(robots))
    for name, topic in zip(robots, names.of("awareness", robots), strict=True):
        kinds[topic] = AWARENESS_TYPES, 1, partial(_awareness, reader, name)
    for name in (names.lead, *robots):
        kinds[names.of("pose", [name])[0]] = POSE_TYPES, 2, partial(_pose, name)
    return {topic: kind for topic, kind in kinds.items() if topic in bag.types}


def _contact(robot: int, n_robots: int, value: float, t: float) -> Contact:
    counts = np.zeros((2, n_robots), dtype=np.int64)
    if not np.isnan(value):
        counts[:, robot] = value > 0.5, 1
    return Contact(counts[0], counts[1], t)


def _marker(value: Any, t: float) -> Marker:
    return Marker(value["bound"], value["cell"], value["path"], t)


def _awareness(reader: Reader, robot: str, value: Any, t: float) -> Message:
    names, numbers = value
    row = dict(zip(names or reader.features, numbers.tolist(), strict=False))
    return reader.of_record({"awareness": {robot: row}, "t": t})


def _pose(name: str, value: Any, t: float) -> Pose:
    return Pose({name: (float(value[0]), float(value[1]))}, t)


def _merged(together: list[tuple[_Kind, Any]], t: float) -> list[Message]:
    """Messages of one time in their order, contacts as one tick."""
    together.sort(key=lambda one: one[0][1])
    messages = [kind[2](value, t) for kind, value in together]
    ticks = [one for one in messages if isinstance(one, Contact)]
    others: list[Message] = [one for one in messages if not isinstance(one, Contact)]
    if not ticks:
        return others
    contacts = np.sum([one.n_contact for one in ticks], axis=0)
    return [Contact(contacts, np.sum([one.n_ticks for one in ticks], axis=0), t), *others]


def _over(hub: Hub, t: float) -> Iterator[list[Message]]:
    """Messages that end the mission of a bag."""
    if hub.live.mission.running is not None:
        yield [Ending("ok", "", None, None)]
    if hub.live.mission.bounds and not hub.live.mission.status:
        yield [Ending("aborted", "the bag ended", None, t)]
