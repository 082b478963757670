"""The server for Foxglove, as a client of it sees it."""

import asyncio
import json

import pytest
from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect

from trustbo.errors import TrustboError


async def read_state(port):
    """Topics that are offered, and the last state."""
    connection = await websocket_connect(
        HTTPRequest(f"ws://127.0.0.1:{port}"), subprotocols=["foxglove.sdk.v1"]
    )
    topics, state = {}, None
    while state is None:
        message = await asyncio.wait_for(connection.read_message(), 20)
        if isinstance(message, bytes):
            state = json.loads(message[13:])  # after the kind, the subscription and the time
            continue
        record = json.loads(message)
        if record["op"] == "advertise":
            topics |= {c["topic"]: c for c in record["channels"]}
            if "/state" in topics:
                wanted = [{"id": 1, "channelId": topics["/state"]["id"]}]
                await connection.write_message(
                    json.dumps({"op": "subscribe", "subscriptions": wanted})
                )
    connection.close()
    return topics, state


@pytest.mark.slow  # waits for seconds
def test_foxglove_gets_the_map_the_path_and_the_state(folder, serving):
    pytest.importorskip("foxglove")
    with serving(folder, foxglove=0) as served:
        served.tell({"bound": 1}, {"contact": [1, 0, 1]}, {"pose": {"lead": [10.0, 20.0]}})
        topics, state = asyncio.run(read_state(served.port_of("foxglove")))
        kinds = {name: channel["schemaName"] for name, channel in topics.items()}
        assert kinds["/trust"] == "foxglove.Grid"
        assert kinds["/path"] == "foxglove.SceneUpdate"
        assert (state["phase"], state["path"]) == ("running", served.state()["path"])


def test_the_grid_of_foxglove_begins_in_the_south(folder):
    fg = pytest.importorskip("foxglove")
    import numpy as np

    from trustbo.live import Live
    from trustbo.live.foxglove import grid_of

    with Live(folder) as live:
        values = np.arange(16.0).reshape(4, 4)
        message = grid_of(values, live.campaign.workspace.grid)
    southern = np.array([12.0, 13.0, 14.0, 15.0], dtype="<f4").tobytes()
    encoded = message.encode()
    assert isinstance(message, fg.messages.Grid)
    assert encoded.index(southern) < encoded.index(np.array([0.0, 1.0], dtype="<f4").tobytes())


def test_without_foxglove_the_command_that_installs_it_is_named(folder, serving, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with (
        pytest.raises(
            TrustboError, match=r"Foxglove needs foxglove-sdk: .*pip install foxglove-sdk"
        ),
        serving(folder, foxglove=0),
    ):
        pass
