"""meshcat served live, headless and only to this machine.

meshcat's own server runs in a process of its own, listens on every interface, outlives a killed
kernel and can block for ever. This one runs in a thread of the calling process, listens on
127.0.0.1 at a free port, refuses other host names and pages of other origins, takes no commands,
closes itself after `timeout` seconds without use, and leaves nothing behind. A remote notebook
cannot reach it: there the file is the way.
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
from IPython.display import IFrame, display

from cmc.view.playback.geometry import transform
from cmc.view.playback.page import page
from cmc.view.playback.scene import Scene, body_paths

HOST = "127.0.0.1"
_FLUSH = 1 / 60  # seconds between two sendings of what has moved
_PATIENCE = 10.0  # seconds after which a browser that reads nothing is dropped
_FRAMED_BY = f"frame-ancestors http://{HOST}:* http://localhost:* https://localhost:*"


class _Door(tornado.web.RequestHandler):
    def initialize(self, view: LiveView) -> None:
        self.view = view

    def prepare(self) -> None:
        # A page elsewhere may point its own host name at 127.0.0.1; only these names are served.
        if self.request.host_name not in (HOST, "localhost"):
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
        try:
            while True:
                waiting, self.waiting = self.waiting, {}
                for data in waiting.values():
                    await asyncio.wait_for(self.write_message(data, binary=True), _PATIENCE)
                await asyncio.sleep(_FLUSH)
        except (TimeoutError, tornado.websocket.WebSocketClosedError):
            self.drop()

    def drop(self) -> None:
        """Close the connection at once, whether the browser answers or not."""
        self._writer.cancel()
        self.view.sockets.discard(self)
        stream = getattr(self.ws_connection, "stream", None)
        if stream is not None:
            stream.close()

    def on_message(self, message: str | bytes) -> None:
        """Browsers have nothing to say."""

    def on_close(self) -> None:
        self.drop()


class LiveView:
    """A scene in the browser that follows the program; also a window that meshcat can draw into.

    Args:
        scene: the scene to serve; its poses are the starting ones. Cloths stay as they were.
        timeout: seconds without an update or a visit after which the server closes itself.

    Raises:
        ValueError: unless `timeout` is positive.
        TimeoutError: if the server has not started after five seconds.
    """

    def __init__(self, scene: Scene, timeout: float = 600.0) -> None:
        if not timeout > 0:
            raise ValueError(f"timeout must be positive, got {timeout}")
        self.scene, self.timeout = scene, float(timeout)
        self.sockets: set[_Socket] = set()
        self.commands: dict[Any, bytes] = dict(enumerate(scene.commands))
        self._paths: tuple[mujoco.MjModel, list[str]] | None = None
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

    def show(self, height: int = 480) -> LiveView:
        """Show the page in a notebook whose browser runs on this machine."""
        display(IFrame(self.url, width="100%", height=height))
        return self

    def send(self, command: Any) -> None:
        """Send one meshcat command to every browser, now and to those that come later."""
        if self.closed:
            raise RuntimeError("the live view is closed")
        lowered = command.lower()
        key, data = (lowered["type"], lowered["path"]), umsgpack.packb(lowered)
        self._loop.call_soon_threadsafe(self._keep, key, data)

    def update(self, data: mujoco.MjData) -> None:
        """Show the pose `data` holds; the newest one wins if browsers are slower than updates."""
        model = data.model
        if self._paths is None or self._paths[0] is not model:
            self._paths = model, body_paths(model)
        for body in np.flatnonzero((model.body_weldid > 0) | (model.body_mocapid >= 0)):
            pose = transform(data.xpos[body], data.xquat[body])
            self.visualizer[self._paths[1][body]].set_transform(pose)

    def close(self) -> None:
        """Close sockets, port and thread; calling it again does nothing."""
        if not self._closed.is_set():
            with contextlib.suppress(RuntimeError):  # the loop may have just stopped by itself
                self._loop.call_soon_threadsafe(self._stopping.set)
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
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), min(0.2, self.timeout))
        server.stop()
        for socket in list(self.sockets):
            socket.drop()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(server.close_all_connections(), 2.0)
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _keep(self, key: tuple[str, str], data: bytes) -> None:
        self.touch()
        for commands in (self.commands, *(socket.waiting for socket in self.sockets)):
            commands.pop(key, None)
            commands[key] = data
