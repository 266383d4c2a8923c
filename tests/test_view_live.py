"""What a notebook shows, and the live view: what it serves, to whom, what it leaves behind."""

import asyncio
import html as html_
import socket
import threading
import time
import urllib.error
import urllib.request

import mujoco
import numpy as np
import pytest
import umsgpack
from test_view_playback import SCENE, tumbled
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect


@pytest.fixture(autouse=True)
def served(monkeypatch, tmp_path):
    """As in JupyterLab, whatever the tests run in; files go to an empty folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("CMC_EMBED", "VSCODE_PID", "SERVER_SOFTWARE"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def recording():
    return tumbled(mujoco.MjModel.from_xml_string(SCENE), 1)


@pytest.fixture
def moved():
    """MuJoCo's data with the torso at x = 0.25 m."""
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(SCENE))
    data.qpos[0] = 0.25
    mujoco.mj_kinematics(data.model, data)
    return data


def test_shown_in_a_notebook_as_a_frame_on_the_file(recording, tmp_path):
    frame = recording.show("playback/tumble.html", height=300)
    assert 'src="playback/tumble.html"' in frame._repr_html_()
    assert (tmp_path / "playback/tumble.html").read_text() == recording.html()
    for path in (tmp_path / "x.html", "../x.html"):
        with pytest.raises(ValueError, match="relative"):
            recording.show(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("", ""), ("CMC_EMBED", "1"), ("VSCODE_PID", "7"), ("SERVER_SOFTWARE", "voila/0.5")],
)
def test_embedded_without_a_path_or_a_server(recording, tmp_path, monkeypatch, name, value):
    if name:
        monkeypatch.setenv(name, value)
    markup = recording.show("playback/tumble.html" if name else None)._repr_html_()
    assert recording.html() in html_.unescape(markup)
    assert 'sandbox="allow-scripts"' in markup
    assert list(tmp_path.iterdir()) == []


def refused(port, host="127.0.0.1"):
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((host, port)) != 0


def socket_of(live):
    return live.url.replace("http", "ws") + "socket"


async def follow(live, moved):
    """Connect as a browser does, read the scene, move the bodies, read four more messages."""
    client = await websocket_connect(socket_of(live))

    async def read():
        return umsgpack.unpackb(await asyncio.wait_for(client.read_message(), 5))

    received = [await read()]
    while received[-1]["path"] != "/meshcat/last":
        received.append(await read())
    live.update(moved)
    fresh = [await read() for _ in range(4)]
    client.close()
    return received, {c["path"]: np.reshape(c["matrix"], (4, 4)).T for c in fresh}


def mark_end(live):
    live.send(type="set_property", path="/meshcat/last", property="visible", value=True)


def test_live_view_serves_drives_and_leaves_nothing(recording, moved):
    before = set(threading.enumerate())
    with recording.serve(timeout=30) as live:
        with urllib.request.urlopen(live.url, timeout=5) as answer:
            assert b"cmcPlayback" in answer.read()
            assert "frame-ancestors" in answer.headers["Content-Security-Policy"]
        mark_end(live)
        scene, places = asyncio.run(follow(live, moved))
        assert {c["type"] for c in scene} == {"set_object", "set_transform", "set_property"}
        np.testing.assert_allclose(places["/meshcat/torso"][:3, 3], moved.body("torso").xpos)
        assert refused(live.port, "127.0.0.2")  # a server on all interfaces would answer here
    live.close()
    assert live.closed
    assert set(threading.enumerate()) <= before
    assert refused(live.port)
    with pytest.raises(RuntimeError, match="closed"):
        live.update(moved)


def test_live_view_closes_itself(recording):
    live = recording.serve(timeout=0.1)
    deadline = time.monotonic() + 5
    while not live.closed and time.monotonic() < deadline:
        time.sleep(0.02)
    assert live.closed
    assert refused(live.port)
    live.close()
    with pytest.raises(ValueError, match="timeout"):
        recording.serve(timeout=0)


def test_live_view_answers_no_foreign_host_or_origin_and_obeys_no_browser(recording):
    async def knock():
        evil = {"Origin": "http://evil.example"}
        await websocket_connect(HTTPRequest(socket_of(live), headers=evil))

    async def shout():
        client = await websocket_connect(socket_of(live))
        await client.write_message(umsgpack.packb({"type": "delete", "path": "/"}), binary=True)
        await client.write_message("x" * 1000)
        await asyncio.wait_for(client.read_message(), 5)
        client.close()

    with recording.serve(timeout=30) as live:
        request = urllib.request.Request(live.url, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request, timeout=5)
        with pytest.raises(HTTPClientError, match="403"):
            asyncio.run(knock())
        before = dict(live.commands)
        asyncio.run(shout())
        assert live.commands == before


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


def test_a_browser_that_stops_reading_starves_nobody(recording, moved):
    """Others follow, the view closes at once, and its port is free."""
    live = recording.serve(timeout=60)
    with stalled(live):
        while not live.sockets:
            time.sleep(0.01)
        for _ in range(40):  # more than any buffer on the way holds
            note = {"property": "note", "value": "x" * 1_000_000}
            live.send(type="set_property", path="/meshcat/heavy", **note)
            time.sleep(0.02)
        assert any(browser.waiting for browser in live.sockets)  # it does not get them
        mark_end(live)
        _, places = asyncio.run(follow(live, moved))
        assert "/meshcat/torso" in places
        began = time.monotonic()
        live.close()
        assert live.closed
        assert time.monotonic() - began < 4
    assert refused(live.port)
