"""HTTP and websocket of a live campaign: the page, its state, and messages with a token."""

import asyncio
import hmac
import json
import logging
from functools import partial
from importlib.resources import files
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.web import Application, RequestHandler, stream_request_body
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from trustbo.errors import TrustboError
from trustbo.live import view
from trustbo.live.hub import Hub

_log = logging.getLogger(__name__)
_MOST_BODY = 1 << 20
"""Upper limit in bytes of the messages of a request, or of one of the websocket."""
_MOST_READ = 1 << 26
"""Bytes of a larger request that are read and dropped, so that its answer is read too."""
_MOST_FRAME = 1 << 24
"""Bytes of a message of the websocket that is read to be refused; a larger one ends it."""
_MOST_UNSENT = 4
"""States that a page may be behind before others are left out."""
_PAGE = {"": "text/html", "page.css": "text/css", "page.js": "text/javascript"}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_PROTOCOL, _TOKEN = "trustbo", "token."


def application(hub: Hub, token: str) -> Application:
    """Application of a hub, whose every request but those of the page's files needs a token."""
    common = {"hub": hub, "token": token}
    return Application(
        [
            (r"/(|page\.css|page\.js)", _Page),
            (r"/api/(state|map|plan)", _Read, common),
            (r"/api/messages", _Messages, common),
            (r"/api/live", _Socket, common),
        ],
        default_handler_class=_Missing,
        log_function=lambda handler: _log.debug(
            "%d %s", handler.get_status(), handler.request.path
        ),
        websocket_ping_interval=20,
        websocket_max_message_size=_MOST_FRAME,
    )


def http_server(hub: Hub, token: str) -> HTTPServer:
    """Server of the application, which drops connections that idle."""
    return HTTPServer(
        application(hub, token),
        max_body_size=_MOST_READ,
        max_header_size=1 << 14,
        idle_connection_timeout=120.0,
        body_timeout=60.0,
    )


class _Handler(RequestHandler):
    def set_default_headers(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("Content-Security-Policy", _POLICY)
        self.set_header("Server", "trustbo")

    def write_error(self, status_code: int, **details: Any) -> None:
        error = details.get("exc_info", (None, None, None))[1]
        reason = str(error) if isinstance(error, TrustboError) else self._reason
        self.refuse(status_code, reason)

    def refuse(self, status: int, reason: str) -> None:
        """Answer with an error in a line."""
        self.set_status(status)
        self.set_header("Content-Type", "application/json")
        self.finish(json.dumps({"error": " ".join(reason.split())}) + "\n")


class _Missing(_Handler):
    def prepare(self) -> None:
        self.refuse(404, f"there is no {self.request.path[:100]}.")


class _Page(_Handler):
    def get(self, name: str) -> None:
        self.set_header("Content-Type", f"{_PAGE[name]}; charset=utf-8")
        self.finish(files("trustbo.live").joinpath("page", name or "page.html").read_bytes())


class _Api(_Handler):
    def initialize(self, hub: Hub, token: str) -> None:
        self.hub, self._token = hub, token

    def prepare(self) -> None:
        kind, _, given = self.request.headers.get("Authorization", "").partition(" ")
        if kind != "Bearer" or not _same(given, self._token):
            self.refuse(401, "wrong token: give the header Authorization: Bearer TOKEN.")

    def answer(self, text: str) -> None:
        """Answer with JSON."""
        self.set_header("Content-Type", "application/json")
        self.finish(text + "\n")


class _Read(_Api):
    async def get(self, name: str) -> None:
        live = self.hub.live
        try:
            if name == "state":
                self.answer(self.hub.text())
            elif name == "plan":
                await self.hub.work()
                self.answer(json.dumps(view.plan_of(live)))
            else:
                layer, robot = (
                    self.get_query_argument("layer", "trust"),
                    self.get_query_argument("robot", None),
                )
                self.answer(json.dumps(await self.hub.compute(partial(live.map, layer, robot))))
        except TrustboError as error:
            self.refuse(400, str(error))


@stream_request_body
class _Messages(_Api):
    def prepare(self) -> None:
        self._body, self._size = bytearray(), 0
        super().prepare()

    def data_received(self, chunk: bytes) -> None:
        self._size += len(chunk)
        if self._size <= _MOST_BODY:
            self._body += chunk

    async def post(self) -> None:
        if self._size > _MOST_BODY:
            self.refuse(413, f"a request has at most {_MOST_BODY} bytes; got {self._size}.")
            return
        try:
            taken = await self.hub.take_lines(bytes(self._body).splitlines())
        except TrustboError as error:
            self.refuse(400, str(error))
            return
        self.answer(json.dumps({"taken": taken, "version": self.hub.live.version}))


class _Socket(WebSocketHandler):
    def initialize(self, hub: Hub, token: str) -> None:
        self.hub, self._token, self._unsent = hub, token, 0

    def select_subprotocol(self, subprotocols: list[str]) -> str | None:
        return _PROTOCOL if _PROTOCOL in subprotocols else None

    def prepare(self) -> None:
        # Pages cannot set headers of a websocket.
        offered = self.request.headers.get("Sec-WebSocket-Protocol", "").split(",")
        given = [one.strip()[len(_TOKEN) :] for one in offered if one.strip().startswith(_TOKEN)]
        given.append(self.request.headers.get("Authorization", "").removeprefix("Bearer "))
        if not any(_same(one, self._token) for one in given):
            self.set_status(401)
            self.finish('{"error": "wrong token: give the header Authorization: Bearer TOKEN."}\n')

    def open(self, *args: str, **kwargs: str) -> None:
        self.set_nodelay(True)
        self.hub.clients.add(self.send)
        self.send(self.hub.text())

    def send(self, text: str) -> None:
        """Send a line, unless the other end has not read the last ones."""
        if self._unsent >= _MOST_UNSENT:
            return
        try:
            sent = self.write_message(text)
        except WebSocketClosedError:
            self.on_close()
            return
        self._unsent += 1
        sent.add_done_callback(self._on_sent)

    def _on_sent(self, sent: "asyncio.Future[None]") -> None:
        self._unsent -= 1
        if not sent.cancelled():
            sent.exception()  # of a connection that was closed meanwhile

    async def on_message(self, message: str | bytes) -> None:
        if len(message) > _MOST_BODY:
            reason = f"a request has at most {_MOST_BODY} bytes; got {len(message)}."
            self.send(json.dumps({"error": reason}))
            return
        lines = (message.encode() if isinstance(message, str) else message).splitlines()
        try:
            self.send(json.dumps({"answer": await self.hub.take_lines(lines)}))
        except TrustboError as error:
            self.send(json.dumps({"error": str(error)}))

    def on_close(self) -> None:
        self.hub.clients.discard(self.send)


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())
