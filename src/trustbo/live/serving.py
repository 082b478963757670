"""`serve`: a live campaign with its page and its sources, until it is stopped."""

import asyncio
import os
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager, suppress
from ipaddress import ip_address
from pathlib import Path
from typing import IO

from trustbo.errors import TrustboError, require_not_negative, require_package, require_whole
from trustbo.files import FilePath, as_path, folder_to_disk, naming_refusal
from trustbo.live.hub import Hub
from trustbo.live.server import http_server
from trustbo.live.session import FOLDER, Live
from trustbo.live.sources import Datagrams, Feed, bag_messages, lines_of

PORT = 8737
_TOKEN_FILE = "token"
TOKEN_VARIABLE = "TRUSTBO_TOKEN"
"""Environment variable with a token of the user."""


def serve(
    folder: FilePath,
    *,
    port: int = PORT,
    listen: str = "127.0.0.1",
    udp: int | None = None,
    lines: IO[bytes] | None = None,
    bag: FilePath | None = None,
    rate: float = 1.0,
    foxglove: int | None = None,
    replan: bool = True,
    ready: Callable[[str], object] = print,
    stop: threading.Event | None = None,
) -> None:
    """Serve a campaign while its missions run; see `docs/live.md`.

    Args:
        folder: Folder of the campaign, see `Campaign.load`.
        port: Port of the page; 0 for any that is free.
        listen: Address to listen at; by default nobody else reaches it.
        udp: Port of datagrams; None takes none, 0 any that is free.
        lines: Stream of messages, such as `sys.stdin.buffer`.
        bag: ROS bag to replay.
        rate: Speed of the replay, 1 that of the bag; 0 for no waiting.
        foxglove: Port of a server for Foxglove, on this machine alone; None for none.
        replan: Whether the rest of a path is planned again after each bound.
        ready: Function that gets the addresses, in lines of text, once they answer; then a line
            about each mission that is over.
        stop: Event that ends it; in the main thread Ctrl-C and SIGTERM do too.

    Raises:
        TrustboError: There is no campaign, another process has locked it, a port is taken, or a
            package is missing.
        DamagedFileError: A file of the folder or the journal is damaged.
    """
    for name, number in (("port", port), ("udp", udp), ("foxglove", foxglove)):
        if number is not None and require_whole(name, number, 0) > 65_535:
            raise TrustboError(f"{name} must be at most 65535; got {number}.")
    require_not_negative("rate", rate)
    address = _address(listen)
    if bag is not None and not as_path(bag).exists():
        raise TrustboError(f"there is no bag {str(bag)!r}; check its path.")
    if foxglove is not None:
        require_package("Foxglove needs", "foxglove-sdk", "foxglove")

    def over(line: str) -> None:
        with suppress(OSError):  # a terminal that is gone ends no mission
            ready(line)

    # A thread in a computation lets the loop in more often: ticks wait for less.
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        with Live(folder, replan=replan, over=over) as live:
            asyncio.run(
                _serve(live, as_path(folder), address, port, udp, lines,
                       None if bag is None else (as_path(bag), rate), foxglove, ready, stop)
            )  # fmt: skip
    finally:
        sys.setswitchinterval(before)


async def _serve(
    live: Live,
    folder: Path,
    listen: str,
    port: int,
    udp: int | None,
    lines: IO[bytes] | None,
    bag: tuple[Path, float] | None,
    foxglove: int | None,
    ready: Callable[[str], object],
    stop: threading.Event | None,
) -> None:
    loop, over, hub = asyncio.get_running_loop(), asyncio.Event(), Hub(live)
    token = token_of(folder)
    async with AsyncExitStack() as stack:
        stack.push_async_callback(hub.close)
        with _naming_port(listen, port):
            family = socket.AF_INET6 if ":" in listen else socket.AF_INET
            listening = socket.create_server((listen, port), family=family)
        listening.setblocking(False)
        server = http_server(hub, token)
        server.add_socket(listening)
        stack.callback(server.stop)
        port = listening.getsockname()[1]
        host = f"[{listen}]" if ":" in listen else listen
        said = [f"page      http://{host}:{port}/#token={token}"]
        if udp is not None:
            with _naming_port(listen, udp):
                transport, _ = await loop.create_datagram_endpoint(
                    lambda: Datagrams(hub, "" if _is_loopback(listen) else token),
                    local_addr=(listen, udp),
                )
            stack.callback(transport.close)
            said.append(f"datagrams {host}:{transport.get_extra_info('sockname')[1]}")
        if foxglove is not None:
            from trustbo.live.foxglove import Scene

            scene = stack.enter_context(Scene(hub, foxglove))
            said.append(f"foxglove  ws://127.0.0.1:{scene.port}")
        if not _is_loopback(listen):
            said.append(
                "warning: the network can reach this, and read what is sent; the token alone keeps "
                "others out."
            )
        with _signals(loop, over):
            runs = loop.create_task(hub.run())
            stack.callback(runs.cancel)
            ready("\n".join(said))
            feeds = []
            if lines is not None:
                feeds.append(Feed(hub, "the standard input", lines_of(lines)))
            if bag is not None:
                feeds.append(Feed(hub, str(bag[0]), bag_messages(*bag, hub)))
            for feed in feeds:
                feed.start()
            while not over.is_set() and not (stop is not None and stop.is_set()):
                with suppress(TimeoutError):
                    await asyncio.wait_for(over.wait(), 0.2)
                if runs.done():
                    runs.result()


def token_of(folder: Path) -> str:
    """Token of a campaign: that of the environment, or one kept in its folder for its owner alone.

    TrustboError: the folder may not be written to, or the token is too short.
    """
    if given := os.environ.get(TOKEN_VARIABLE, ""):
        if len(given) < 16 or not given.replace("-", "").replace("_", "").isalnum():
            raise TrustboError(
                f"{TOKEN_VARIABLE} must be 16 letters, digits, - or _ at least; leave it out for a "
                "random one."
            )
        return given
    file = folder / FOLDER / _TOKEN_FILE
    with naming_refusal(folder):
        with suppress(FileNotFoundError):
            kept = file.read_text(encoding="utf-8").strip()
            if kept:
                return kept
        token = secrets.token_urlsafe(18)
        opened = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        try:
            os.write(opened, token.encode())
            os.fsync(opened)
        finally:
            os.close(opened)
        folder_to_disk(file.parent)
    return token


def _address(listen: str) -> str:
    """Return an IP address to listen at; a name could become another's."""
    if listen == "localhost":
        return "127.0.0.1"
    try:
        return str(ip_address(listen))
    except ValueError:
        raise TrustboError(
            f"listen must be an IP address of this machine, 0.0.0.0 for all; got {listen!r:.60}."
        ) from None


def _is_loopback(listen: str) -> bool:
    return ip_address(listen).is_loopback


@contextmanager
def _naming_port(listen: str, port: int) -> Iterator[None]:
    """Convert the system's refusal of a port to a TrustboError."""
    try:
        yield
    except OSError as error:
        raise TrustboError(
            f"cannot listen at {listen}, port {port}: {error.strerror}; give another --port or "
            "address."
        ) from error


@contextmanager
def _signals(loop: asyncio.AbstractEventLoop, over: asyncio.Event) -> Iterator[None]:
    """Set an event at Ctrl-C and SIGTERM, in the main thread."""
    main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if main else ()
    for number in numbers:
        loop.add_signal_handler(number, over.set)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
