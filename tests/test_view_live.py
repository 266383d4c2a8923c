"""Live view: what it serves, to whom, and what it leaves behind."""

import asyncio
import socket
import threading
import time
import urllib.error
import urllib.request

import mujoco
import numpy as np
import pytest
import umsgpack
from test_view_playback import SCENE, tumble
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from cmc.view.playback import record


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(SCENE)


def refused(port, host="127.0.0.1"):
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((host, port)) != 0


async def follow(url, count, act):
    """Connect as a browser does, read the scene, act, read `count` more messages."""
    client = await websocket_connect(url.replace("http", "ws") + "socket")
    received = []
    while not received or received[-1]["path"] != "/meshcat/last":
        received.append(umsgpack.unpackb(await asyncio.wait_for(client.read_message(), 5)))
    act()
    fresh = [
        umsgpack.unpackb(await asyncio.wait_for(client.read_message(), 5)) for _ in range(count)
    ]
    client.close()
    return received, fresh


def test_live_view_serves_drives_and_leaves_nothing(model):
    qpos, _, times = tumble(model, frames=1)
    before = set(threading.enumerate())
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[0]
    data.qpos[0] = 0.25
    mujoco.mj_kinematics(model, data)
    with record(model, qpos, times).serve(timeout=30) as live:
        with urllib.request.urlopen(live.url, timeout=5) as answer:
            assert b"cmcPlayback" in answer.read()
        live.visualizer["last"].set_property("visible", True)  # marks the end of the scene
        scene, fresh = asyncio.run(follow(live.url, 4, lambda: live.update(data)))
        assert {c["type"] for c in scene} == {"set_object", "set_transform", "set_property"}
        moved = {c["path"]: np.reshape(c["matrix"], (4, 4)).T for c in fresh}
        np.testing.assert_allclose(moved["/meshcat/torso"][:3, 3], data.body("torso").xpos)
        assert refused(live.port, "127.0.0.2")  # a server on all interfaces would answer here
    live.close()
    assert live.closed
    assert set(threading.enumerate()) <= before
    assert refused(live.port)
    with pytest.raises(RuntimeError, match="closed"):
        live.update(data)


def test_live_view_closes_itself(model):
    qpos, _, times = tumble(model, frames=1)
    live = record(model, qpos, times).serve(timeout=0.1)
    deadline = time.monotonic() + 5
    while not live.closed and time.monotonic() < deadline:
        time.sleep(0.02)
    assert live.closed
    assert refused(live.port)
    live.close()
    with pytest.raises(ValueError, match="timeout"):
        record(model, qpos, times).serve(timeout=0)


def test_live_view_answers_no_foreign_host_or_origin(model):
    qpos, _, times = tumble(model, frames=1)
    with record(model, qpos, times).serve(timeout=30) as live:
        request = urllib.request.Request(live.url, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request, timeout=5)
        foreign = HTTPRequest(
            live.url.replace("http", "ws") + "socket", headers={"Origin": "http://evil.example"}
        )

        async def knock():
            await websocket_connect(foreign)

        with pytest.raises(HTTPClientError, match="403"):
            asyncio.run(knock())


def stalled(live):
    """A browser that opens the socket and then reads nothing."""
    lazy = socket.create_connection(("127.0.0.1", live.port))
    lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
    lazy.sendall(
        (
            f"GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        ).encode()
    )
    return lazy


def test_a_browser_that_stops_reading_starves_nobody(model):
    """Others follow, the view closes at once, and its port is free."""
    qpos, _, times = tumble(model, frames=1)
    data = mujoco.MjData(model)
    live = record(model, qpos, times).serve(timeout=60)
    with stalled(live):
        while not live.sockets:
            time.sleep(0.01)
        heavy = live.visualizer["heavy"]
        for _ in range(40):  # more than any buffer on the way holds
            heavy.set_property("note", "x" * 1_000_000)
            time.sleep(0.02)

        def act():
            data.qpos[0] = 0.5
            mujoco.mj_kinematics(model, data)
            live.update(data)

        assert any(browser.waiting for browser in live.sockets)  # it does not get them
        live.visualizer["last"].set_property("visible", True)
        _, fresh = asyncio.run(follow(live.url, 4, act))
        assert any(c["path"] == "/meshcat/torso" for c in fresh)
        began = time.monotonic()
        live.close()
        assert live.closed
        assert time.monotonic() - began < 4
    assert refused(live.port)


def test_what_a_browser_sends_moves_nothing(model):
    qpos, _, times = tumble(model, frames=1)
    with record(model, qpos, times).serve(timeout=30) as live:
        before = dict(live.commands)

        async def shout():
            client = await websocket_connect(live.url.replace("http", "ws") + "socket")
            await client.write_message(umsgpack.packb({"type": "delete", "path": "/"}), binary=True)
            await client.write_message("x" * 1000)
            await asyncio.wait_for(client.read_message(), 5)
            client.close()

        asyncio.run(shout())
        assert live.commands == before
        with urllib.request.urlopen(live.url, timeout=5) as answer:
            assert "frame-ancestors" in answer.headers["Content-Security-Policy"]
