"""meshcat served live, headless and only to this machine.

meshcat's own server runs in a process of its own, listens on every interface, outlives a killed
kernel and can block for ever. This one runs in a thread of the calling process, listens on
127.0.0.1 at a free port, refuses other host names and pages of other origins, takes no commands,
closes itself after `timeout` seconds without use, and leaves nothing behind. A remote notebook
cannot reach it: there the file is the way.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import Any

import mujoco
import numpy as np
import tornado.httpserver
import tornado.netutil
import tornado.web
import tornado.websocket
import umsgpack
from IPython.display import IFrame, display

from cmc.view.playback.page import page
from cmc.view.playback.shapes import body_paths, transform

_HOST = "127.0.0.1"
_FLUSH = 1 / 60  # seconds between two sendings of what has moved
_FRAMED_BY = f"frame-ancestors http://{_HOST}:* http://localhost:* https://localhost:*"


class _Door(tornado.web.RequestHandler):
    def initialize(self, view: LiveView) -> None:
        self.view = view

    def prepare(self) -> None:
        # A page elsewhere may point its own host name at 127.0.0.1; only these names are served.
        if self.request.host_name not in (_HOST, "localhost"):
            raise tornado.web.HTTPError(403)
        self.view.touch()


class _Page(_Door):
    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("Content-Security-Policy", _FRAMED_BY)
        self.write(page([self.view.scene], live=True))


class _Socket(_Door, tornado.websocket.WebSocketHandler):
    """One browser; tornado refuses sockets opened by pages of another origin."""

    def open(self, *args: str, **kwargs: str) -> None:
        self.waiting = dict(self.view.commands)
        self.view.sockets.add(self)
        self._writer = asyncio.create_task(self._write())

    async def _write(self) -> None:
        """Send what waits; of many poses of a body, only the newest travels."""
        with contextlib.suppress(tornado.websocket.WebSocketClosedError):
            while True:
                waiting, self.waiting = self.waiting, {}
                for data in waiting.values():
                    await self.write_message(data, binary=True)
                await asyncio.sleep(_FLUSH)

    def on_message(self, message: str | bytes) -> None:
        """Browsers have nothing to say."""

    def on_close(self) -> None:
        """Close the connection at once, whether the browser answers or not."""
        self._writer.cancel()
        self.view.sockets.discard(self)
        if (stream := getattr(self.ws_connection, "stream", None)) is not None:
            stream.close()


class LiveView(contextlib.AbstractContextManager["LiveView"]):
    """A scene in the browser that follows the program.

    The poses of `scene` are the starting ones, and cloths stay as they were. After `timeout`
    seconds without an update or a visit the server closes itself.
    """

    def __init__(self, scene: Any, timeout: float = 600.0) -> None:
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, got {timeout}")
        self.scene, self.timeout = scene, float(timeout)
        self.sockets: set[_Socket] = set()
        self.commands: dict[Any, bytes] = dict(enumerate(scene.commands))
        self._loop = asyncio.new_event_loop()
        self._stopping = self._loop.create_future()
        self._listeners = tornado.netutil.bind_sockets(0, _HOST)
        self.port = self._listeners[0].getsockname()[1]
        self.touch()
        self._thread = threading.Thread(target=self._run, name="cmc-live-view", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page, on this machine only."""
        return f"http://{_HOST}:{self.port}/"

    @property
    def closed(self) -> bool:
        """Whether the server has been closed, by `close` or by its timeout."""
        return not self._thread.is_alive()

    def show(self, height: int = 480) -> LiveView:
        """Show the page in a notebook whose browser runs on this machine."""
        display(IFrame(self.url, width="100%", height=height))
        return self

    def update(self, data: mujoco.MjData) -> None:
        """Show the pose `data` holds; the newest one wins if browsers are slower than updates."""
        model, paths = data.model, body_paths(data.model)
        for body in np.flatnonzero((model.body_weldid > 0) | (model.body_mocapid >= 0)):
            matrix = transform(data.xpos[body], data.xquat[body]).T.ravel().tolist()
            self.send(type="set_transform", path=f"/meshcat/{paths[body]}", matrix=matrix)

    def send(self, **command: Any) -> None:
        """Send one meshcat command to every browser, now and to those that come later."""
        if self.closed:
            raise RuntimeError("the live view is closed")
        key, data = (command["type"], command["path"]), umsgpack.packb(command)
        self._loop.call_soon_threadsafe(self._keep, key, data)

    def close(self) -> None:
        """Close sockets, port and thread; calling it again does nothing."""
        with contextlib.suppress(RuntimeError):  # the loop may have stopped by itself
            self._loop.call_soon_threadsafe(self._stopping.cancel)
        self._thread.join(5.0)

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- below, everything runs on the server's own thread ----

    def touch(self) -> None:
        """Start the timeout anew."""
        self._last_use = self._loop.time()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        routes: list[Any] = [
            (path, door, {"view": self}) for path, door in (("/", _Page), ("/socket", _Socket))
        ]
        application = tornado.web.Application(routes, log_function=lambda handler: None)
        server = tornado.httpserver.HTTPServer(application)
        server.add_sockets(self._listeners)
        while not self._stopping.done() and self._loop.time() - self._last_use < self.timeout:
            await asyncio.wait([self._stopping], timeout=min(0.2, self.timeout))
        server.stop()
        for socket in list(self.sockets):
            socket.on_close()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(server.close_all_connections(), 2.0)

    def _keep(self, key: tuple[str, str], data: bytes) -> None:
        self.touch()
        for commands in (self.commands, *(socket.waiting for socket in self.sockets)):
            commands.pop(key, None)
            commands[key] = data
