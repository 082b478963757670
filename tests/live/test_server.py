"""The server: tokens, limits, sources, and that it stays up when others go."""

import asyncio
import json
import socket
import time
from contextlib import suppress

import numpy as np
import pytest
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import WebSocketClosedError, websocket_connect

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.live import serve
from trustbo.live.session import FOLDER


def test_the_page_needs_no_token_and_everything_else_does(folder, serving):
    with serving(folder) as served:
        for name, content in (
            ("", "<title>trustbo live"),
            ("page.js", "websocket"),
            ("page.css", "body"),
        ):
            status, text = served.call(name, token="")
            assert status == 200
            assert content in text.lower()
            assert served.token not in text
        for path, data in (("api/state", None), ("api/map", None), ("api/plan", None),
                           ("api/messages", b'{"bound": 1}')):  # fmt: skip
            for token in ("", "x" * 24, served.token[:-1], served.token + "a", "\u00fc"):
                status, text = served.call(path, data, token=token.encode().decode("latin-1"))
                assert status == 401
                assert json.loads(text)["error"].startswith("wrong token")
                assert text.count("\n") == 1
        assert served.state()["phase"] == "ready"
        assert served.call("api/nothing")[0] == served.call("../token")[0] == 404
        file = folder / FOLDER / "token"
        assert file.read_text() == served.token
        assert file.stat().st_mode & 0o777 == 0o600
    with serving(folder) as again:
        assert again.token == served.token  # so that a page that was open goes on


def test_what_is_told_is_on_disk_when_it_is_answered(folder, serving):
    with serving(folder) as served:
        status, answer = served.tell(
            {"bound": 1}, {"contact": [1, 0, None]}, {"contact": [1, 1, 1]}, {"report": {"r2": 0.5}}
        )
        assert (status, answer["taken"]) == (200, 4)
        lines = (folder / FOLDER / "0002.jsonl").read_text().splitlines()
        assert [json.loads(line)["event"] for line in lines] == [
            "plan",
            "begin",
            "ticks",
            "ticks",
            "report",
        ]
        assert served.state()["robots"][1]["rate"] == 0.5
        assert served.state()["reports"][1] == [None, 0.5, None]
        plan = json.loads(served.call("api/plan")[1])
        assert plan["path"] == served.state()["path"]
        status, text = served.call("api/map?layer=cost&robot=r2")
        assert np.array(json.loads(text)["values"], dtype=float).shape == (4, 4)
        assert served.call("api/map?layer=x")[0] == 400


def test_garbage_and_10_megabytes_are_refused_in_a_line(folder, serving):
    with serving(folder) as served:
        status, text = served.call("api/messages", b"x" * 10_000_000)
        assert (status, text.count("\n")) == (413, 1)
        assert "at most 1048576 bytes; got 10000000" in text
        for line in (b"\x00\xff" * 100, b"[" * 60_000, b"{}", b'{"contact": [1]}', b"x" * 70_000):
            status, text = served.call("api/messages", line)
            assert (status, text.count("\n")) == (400, 1)
            assert json.loads(text)["error"].startswith("line 1: ")
        status, answer = served.tell({"bound": 1}, {"contact": [1, 1, 1]}, {"status": "eaten"})
        assert (status, answer["error"][:21]) == (400, "line 3: status is one")
        assert served.state()["robots"][0]["n_ticks"] == 1  # those before it were taken
        for garbage in (
            b"\x00" * 2000 + b"\r\n\r\n",
            b"GET / HTTP/9.9\r\n\r\n",
            b"\x16\x03\x01" * 99,
        ):
            with socket.create_connection(
                ("127.0.0.1", int(served.page.split(":")[2][:-1]))
            ) as raw:
                raw.settimeout(10)
                raw.sendall(garbage)
                raw.shutdown(socket.SHUT_WR)
                while raw.recv(4096):
                    pass
        assert served.state()["phase"] == "running"


def test_a_mission_by_http_is_learned_from_and_the_next_is_asked_for(folder, serving):
    with serving(folder) as served:
        while (state := served.until(lambda s: s["phase"] in ("ready", "running")))["mission"] == 2:
            k = state["bound"]
            taken = served.tell(
                {"bound": k}, {"contact": [18, 15, 12], "ticks": 20}, {"status": "ok"}
            )
            assert taken[0] == 200, taken
        assert served.state()["mission"] == 3
        assert served.said[1:] == [f"learned from mission 2: ok. {served.state()['to_do']}"]
        assert served.tell({"status": "ok", "mission": 2})[0] == 400  # a message that came twice
    with tb.Campaign.load(folder) as campaign:
        assert campaign.state.measured[-1].contact_rate[0].tolist() == [0.9, 0.75, 0.6]


def socket_of(served, token, **options):
    head = {"Authorization": f"Bearer {token}"}
    request = HTTPRequest(served.page.replace("http", "ws") + "api/live", headers=head)
    return websocket_connect(request, **options)


def test_a_websocket_gets_states_and_answers_and_may_break_off(folder, serving):
    async def talk(served):
        with pytest.raises(HTTPClientError, match="401"):
            await socket_of(served, "x" * 24)
        first = await socket_of(served, served.token)
        assert json.loads(await first.read_message())["phase"] == "ready"
        await first.write_message('{"bound": 1}\n{"contact": [1, 1, 0]}')
        seen = [json.loads(await first.read_message()) for _ in range(2)]
        assert {"answer": 2} in seen
        assert any(one.get("phase") == "running" for one in seen)
        await first.write_message("garbage")
        while "error" not in (answer := json.loads(await first.read_message())):
            pass
        assert answer["error"].startswith("line 1: a message is one line of JSON")
        await first.write_message("x" * 10_000_000)
        while "error" not in (answer := json.loads(await first.read_message())):
            pass
        assert answer["error"] == "a request has at most 1048576 bytes; got 10000000."
        huge = await socket_of(served, served.token)
        with suppress(WebSocketClosedError):  # it may be closed before all is sent
            await huge.write_message("x" * 20_000_000)
        while await huge.read_message() is not None:
            pass
        huge.close()
        first.protocol.stream.close()  # a browser that goes without a word
        first.close()

    with serving(folder) as served:
        asyncio.run(talk(served))
        assert served.tell({"contact": [1, 1, 1]})[0] == 200
        time.sleep(0.6)  # two more states are pushed to nobody
        assert served.state()["robots"][2]["rate"] == 0.5


def test_datagrams_are_taken_one_line_or_more_each(folder, serving):
    with serving(folder, udp=0) as served, socket.socket(type=socket.SOCK_DGRAM) as sender:
        to = "127.0.0.1", served.port_of("datagrams")
        sender.sendto(b'{"bound": 1}\n{"contact": {"r1": 1}}', to)
        for _ in range(50):
            sender.sendto(b'{"contact": {"r1": true, "r3": false}}', to)
        sender.sendto(b"garbage", to)
        state = served.until(lambda s: s["refused"] == 1)
        assert [robot["n_ticks"] for robot in state["robots"]] == [51, 0, 50]
        assert state["last_refusal"].startswith("a message is one line of JSON")


def test_datagrams_of_the_network_need_the_token(folder, serving):
    with serving(folder, udp=0, listen="0.0.0.0") as served:
        assert any(line.startswith("warning: the network can reach this") for line in served.lines)
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            to = "127.0.0.1", served.port_of("datagrams")
            sender.sendto(b'{"bound": 1}', to)
            sender.sendto(b'{"bound": 1, "token": "' + b"x" * 24 + b'"}', to)
            assert served.until(lambda s: s["refused"] == 2)["phase"] == "ready"
            sender.sendto(json.dumps({"bound": 1, "token": served.token}).encode(), to)
            served.until(lambda s: s["phase"] == "running")


class Lines:
    """A pipe of lines."""

    def __init__(self, *lines):
        self.parts = [json.dumps(line).encode() + b"\n" for line in lines]

    def read(self, n):
        return self.parts.pop(0) if self.parts else b""


def test_lines_of_a_stream_wait_for_what_is_planned_and_learned(folder, serving):
    with tb.Campaign.load(folder) as campaign:
        n = len(campaign.ask().path) - 1
    told = [
        m for k in range(1, n + 1) for m in ({"bound": k}, {"contact": [1, 1, 0]}, {"status": "ok"})
    ]
    lines = Lines(*told, {"nonsense": 1}, {"bound": 1})
    with serving(folder, lines=lines, replan=False) as served:
        state = served.until(lambda s: s["mission"] == 3 and s["phase"] == "running")
        assert (state["refused"], state["taken"]) == (1, 3 * n + 1)


def test_what_cannot_be_served_is_named(folder, tmp_path, monkeypatch, serving):
    for options, reason in (
        ({"listen": "robots.example"}, "listen must be an IP address"),
        ({"udp": 70_000}, "udp must be at most 65535; got 70000"),
        ({"rate": -1.0}, "rate must be 0 or more"),
        ({"bag": tmp_path / "none"}, "there is no bag"),
    ):
        with pytest.raises(TrustboError, match=reason), serving(folder, **options):
            pass
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(TrustboError, match=f"cannot listen at 127.0.0.1, port {port}"):
            serve(folder, port=port)
    monkeypatch.setenv("TRUSTBO_TOKEN", "short")
    with pytest.raises(TrustboError, match="TRUSTBO_TOKEN must be 16 letters"):
        serve(folder, port=0)
    monkeypatch.setenv("TRUSTBO_TOKEN", "a-token-of-our-own")
    with serving(folder) as served:
        assert served.token == "a-token-of-our-own"
