"""meshcat served live, headless and only to this machine.

meshcat's own server runs in a process of its own, listens on every interface, outlives a killed
kernel and can block for ever. This one runs in a thread of the calling process, listens on
127.0.0.1 at a free port, refuses other host names, closes itself after `timeout` seconds without
use, and leaves nothing behind. A remote notebook cannot reach it: there the file is the way.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import threading
from typing import Any

import meshcat
import mujoco
import numpy as np
import tornado.httpserver
import tornado.netutil
import tornado.web
import tornado.websocket
import umsgpack

from cmc.view.playback.geometry import transform
from cmc.view.playback.page import page
from cmc.view.playback.recorder import Recording, body_path

HOST = "127.0.0.1"
_FLUSH = 1 / 60  # seconds between two sendings of what has moved


class _Page(tornado.web.RequestHandler):
    def initialize(self, view: LiveView) -> None:
        self.view = view

    def prepare(self) -> None:
        # A page elsewhere may point its own host name at 127.0.0.1; only these names are served.
        if self.request.host_name not in (HOST, "localhost"):
            raise tornado.web.HTTPError(403)

    def get(self) -> None:
        self.view.touch()
        self.set_header("Cache-Control", "no-store")
        self.write(page(self.view.recording, live=True))


class _Socket(tornado.websocket.WebSocketHandler):
    """One browser; tornado refuses sockets opened by pages of another origin."""

    def initialize(self, view: LiveView) -> None:
        self.view = view

    def prepare(self) -> None:
        if self.request.host_name not in (HOST, "localhost"):
            raise tornado.web.HTTPError(403)

    def open(self, *args: str, **kwargs: str) -> None:
        self.view.touch()
        self.view.join(self)

    def on_message(self, message: str | bytes) -> None:
        """Browsers have nothing to say."""

    def on_close(self) -> None:
        self.view.sockets.discard(self)


class LiveView:
    """A scene in the browser that follows the program; also a window that meshcat can draw into.

    Args:
        recording: the scene to serve; its poses are the starting ones.
        timeout: seconds without an update or a visit after which the server closes itself.

    Raises:
        ValueError: unless `timeout` is positive.
        TimeoutError: if the server has not started after five seconds.
    """

    def __init__(self, recording: Recording, timeout: float = 600.0) -> None:
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, got {timeout}")
        self.recording, self.timeout = recording, float(timeout)
        self.sockets: set[_Socket] = set()
        self._scene: dict[Any, bytes] = dict(enumerate(recording.commands))
        self._moved: dict[str, bytes] = {}
        self._ready, self._closed = threading.Event(), threading.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="cmc-live-view", daemon=True)
        self._thread.start()
        if not self._ready.wait(5.0):
            raise TimeoutError("the live view did not start within five seconds")
        atexit.register(self.close)

    @property
    def url(self) -> str:
        """Address of the page, on this machine only."""
        return f"http://{HOST}:{self.port}/"

    @property
    def closed(self) -> bool:
        """Whether the server has been closed, by `close` or by its timeout."""
        return self._closed.is_set()

    @property
    def visualizer(self) -> Any:
        """A `meshcat.Visualizer` that draws into this view."""
        return meshcat.Visualizer(window=self)  # type: ignore[no-untyped-call]

    def send(self, command: Any) -> None:
        """Send one meshcat command to every browser, now and to those that come later."""
        lowered = command.lower()
        self._call(self._keep, lowered["type"], lowered["path"], umsgpack.packb(lowered))

    def update(self, data: mujoco.MjData) -> None:
        """Show the pose `data` holds; the newest one wins if browsers are slower than updates."""
        model = data.model
        for body in np.flatnonzero((model.body_weldid > 0) | (model.body_mocapid >= 0)):
            pose = transform(data.xpos[body], data.xquat[body])
            self.visualizer[body_path(model, int(body))].set_transform(pose)

    def close(self) -> None:
        """Close sockets, port and thread; calling it again does nothing."""
        if not self._closed.is_set():
            with contextlib.suppress(RuntimeError):  # the loop may have just stopped by itself
                self._loop.call_soon_threadsafe(self._stop)
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)
        atexit.unregister(self.close)

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- below, everything runs on the server's own thread ----

    def touch(self) -> None:
        """Start the timeout anew."""
        self._last_use = self._loop.time()

    def join(self, socket: _Socket) -> None:
        """Send a new browser the whole scene, then let it follow."""
        for data in self._scene.values():
            socket.write_message(data, binary=True)
        self.sockets.add(socket)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._closed.set()
            self._ready.set()
            self._loop.close()

    async def _serve(self) -> None:
        self._stopping = asyncio.Event()
        self.touch()
        shared = {"view": self}
        application = tornado.web.Application(
            [("/", _Page, shared), ("/socket", _Socket, shared)],
            log_function=lambda handler: None,
        )
        server = tornado.httpserver.HTTPServer(application)
        listeners = tornado.netutil.bind_sockets(0, HOST)
        self.port = listeners[0].getsockname()[1]
        server.add_sockets(listeners)
        self._ready.set()
        while not self._stopping.is_set() and self._loop.time() - self._last_use < self.timeout:
            await self._flush()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), _FLUSH)
        for socket in list(self.sockets):
            socket.close()
        server.stop()
        await server.close_all_connections()

    async def _flush(self) -> None:
        moved, self._moved = self._moved, {}
        for socket in list(self.sockets):
            with contextlib.suppress(tornado.websocket.WebSocketClosedError):
                for data in moved.values():
                    await socket.write_message(data, binary=True)

    def _keep(self, kind: str, path: str, data: bytes) -> None:
        self.touch()
        self._scene.pop((kind, path), None)
        self._scene[kind, path] = data
        if kind == "set_transform":
            self._moved[path] = data  # only the newest pose of a body travels
            return
        for socket in list(self.sockets):
            with contextlib.suppress(tornado.websocket.WebSocketClosedError):
                socket.write_message(data, binary=True)

    def _call(self, function: Any, *arguments: Any) -> None:
        if self.closed:
            raise RuntimeError("the live view is closed")
        self._loop.call_soon_threadsafe(function, *arguments)

    def _stop(self) -> None:
        self._stopping.set()
