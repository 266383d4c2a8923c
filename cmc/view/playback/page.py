"""One HTML file that holds meshcat's viewer, a recorded scene and its motion.

Nothing is loaded from elsewhere, and the page's own security policy forbids it: the file plays from
disk, from a notebook server, or from an e-mail attachment. Poses travel as base64 of little-endian
float32; the player (`player.js`) interpolates between frames and is exact at them.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cmc.view.playback.cameras import FIELD_OF_VIEW

if TYPE_CHECKING:
    from cmc.view.playback.recorder import Recording

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)


def page(recording: Recording, live: bool = False) -> str:
    """The page of a recording as text; a live page also listens to the server it came from."""
    policy = _POLICY + ("; connect-src ws://127.0.0.1:* ws://localhost:*" if live else "")
    scene = json.dumps(scene_data(recording, live), separators=(",", ":"))
    parts = {
        "POLICY": policy,
        "TITLE": html.escape(recording.title),
        "VIEWER": viewer_source(),
        "SCENE": scene.replace("<", "\\u003c"),  # a name such as </script> stays text
        "PLAYER": _own("player.js"),
    }
    head, *rest = _own("page.html").split("@@")
    return head + "".join(parts.get(part, part) for part in rest)


def scene_data(recording: Recording, live: bool = False) -> dict[str, Any]:
    """What the player reads: everything of a recording, arrays packed as base64 text."""
    return {
        "id": scene_id(recording),
        "title": recording.title,
        "live": live,
        "field_of_view": FIELD_OF_VIEW,
        "commands": [] if live else [_text(c) for c in recording.commands],
        "times": _pack(recording.times, "<f8"),
        "bodies": recording.bodies,
        "poses": _pack(recording.poses, "<f4"),
        "overlays": [_overlay(overlay) for overlay in recording.overlays],
        "readouts": [
            {"name": name, "values": _pack(v, "<f8")} for name, v in recording.readouts.items()
        ],
        "cameras": [{"name": name} | vars(camera) for name, camera in recording.cameras.items()],
    }


def scene_id(recording: Recording) -> str:
    """Short name of a recording made of its contents; messages to its page carry it."""
    digest = hashlib.sha256(recording.title.encode())
    for part in (recording.times, recording.poses, *recording.commands):
        digest.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()[:16]


@cache
def viewer_source() -> str:
    """Meshcat's bundled viewer, three.js included, about 0.9 MB of JavaScript."""
    source = resources.files("meshcat").joinpath("viewer/dist/main.min.js").read_text("utf-8")
    if "</script" in source:
        raise RuntimeError("meshcat's viewer cannot be inlined: it contains a closing script tag")
    return source


def _overlay(overlay: Any) -> dict[str, Any]:
    arrays = {k: _pack(v, "<f4") for k, v in vars(overlay).items() if isinstance(v, np.ndarray)}
    return {"kind": type(overlay).__name__} | vars(overlay) | arrays


def _own(name: str) -> str:
    return resources.files("cmc.view.playback").joinpath(name).read_text("utf-8")


def _pack(array: NDArray[Any], kind: str) -> str:
    return _text(np.ascontiguousarray(array, dtype=kind).tobytes())


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
