"""Messages of all sources, one after the other, and work off the event loop.

The event loop is the thread of the session. Fits, plans and maps are done in one other thread, and
flushes to the disk in a third, so that ticks do not wait for them.
"""

import asyncio
import json
import logging
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from trustbo.errors import TrustboError
from trustbo.live.messages import Contact, Message, Pose
from trustbo.live.session import Live

_log = logging.getLogger(__name__)
_PUSH, _FLUSH = 0.25, 1.0
"""Seconds between two states for the page, and between two flushes of ticks."""

type Client = Callable[[str], None]
"""Function that passes a state, as JSON, to a page."""


class Hub:
    """Session in an event loop.

    Attributes:
        live: Session.
        clients: Functions that get each new state.
        n_taken: Number of messages taken.
        n_refused: Number of messages refused.
        n_lost: Number of datagrams that came faster than they were taken.
        last_refusal: Reason of the last refusal.
    """

    def __init__(self, live: Live) -> None:
        """Hold a session; `run` is to be awaited."""
        self.live = live
        self.clients: set[Client] = set()
        self.n_taken = self.n_refused = self.n_lost = 0
        self.last_refusal = ""
        self._control = asyncio.Lock()
        self._worker = ThreadPoolExecutor(1, "trustbo-live-work")
        self._flusher = ThreadPoolExecutor(1, "trustbo-live-disk")
        self._task: asyncio.Task[None] | None = None
        self._pushed, self._quiet_until = -1, 0.0

    async def take(self, message: Message) -> None:
        """Take a message, after the work that it waits for; TrustboError: it is refused."""
        live = self.live
        try:
            if isinstance(message, Contact | Pose):
                live.take(message)
            else:
                async with self._control:
                    while not live.take(message):
                        await self.work()
                self._begin_work()
        except TrustboError as error:
            self.refuse(error)
            raise
        except Exception as error:  # such as a disk that fails
            live.stopped(f"{type(error).__name__}: {error}")
            self.refuse(TrustboError(live.trouble))
            raise TrustboError(live.trouble) from error
        self.n_taken += 1

    async def take_line(self, line: bytes | str) -> None:
        """Read a line and take it; TrustboError: it is refused."""
        try:
            message = self.live.reader.read(line)
        except TrustboError as error:
            self.refuse(error)
            raise
        await self.take(message)

    async def take_lines(self, lines: Iterable[bytes]) -> int:
        """Take lines up to the first that is refused, until they are on the disk.

        TrustboError: one is refused; the message names its number, from 1.
        """
        number = 0
        try:
            for line in lines:
                if line.strip():
                    number += 1
                    await self.take_line(line)
        except TrustboError as error:
            raise TrustboError(f"line {number}: {error}") from None
        finally:
            await self.flush()
        return number

    def refuse(self, error: TrustboError) -> None:
        """Count a message that is refused, and log it, once a second at most."""
        self.n_refused += 1
        self.last_refusal = str(error)
        if (now := time.monotonic()) >= self._quiet_until:
            self._quiet_until = now + 1.0
            _log.warning("refused: %s", error)

    async def flush(self) -> None:
        """Wait until everything taken so far is on the disk."""
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._flusher, self.live.journal.sync)

    async def work(self) -> None:
        """Wait for the work that is to be done."""
        self._begin_work()
        if self._task is not None:
            await asyncio.shield(self._task)

    async def compute(self, function: Callable[[], Any]) -> Any:
        """Call a function in the thread of the work, between two jobs."""
        return await asyncio.get_running_loop().run_in_executor(self._worker, function)

    def _begin_work(self) -> None:
        if self.live.job is not None and (self._task is None or self._task.done()):
            self._task = asyncio.get_running_loop().create_task(self._work())

    async def _work(self) -> None:
        while (job := self.live.job) is not None:
            try:
                (await self.compute(job))()
            except Exception as error:  # a defect must not end the process: ticks go on
                self.live.stopped(f"{type(error).__name__}: {error}")

    async def run(self) -> None:
        """Do the work of a mission that was read, flush ticks, and push states, for ever."""
        self._begin_work()
        loop = asyncio.get_running_loop()
        flushed = loop.time()
        while True:
            await asyncio.sleep(_PUSH)
            if loop.time() - flushed >= _FLUSH:
                await self.flush()
                flushed = loop.time()
            if self.clients and self._pushed != self.live.version:
                self._pushed = self.live.version
                text = self.text()
                for client in list(self.clients):
                    client(text)

    def text(self) -> str:
        """State as JSON."""
        counts = {"taken": self.n_taken, "refused": self.n_refused, "lost": self.n_lost}
        return json.dumps(self.live.state() | counts | {"last_refusal": self.last_refusal})

    async def close(self) -> None:
        """Finish the work that is under way."""
        if self._task is not None:
            await self._task
        self._worker.shutdown()
        self._flusher.shutdown()
